"""The snippets of docs/learning.md run, one after the other."""

import re
from pathlib import Path

from torchcmax.simulator import Simulation, write

SNIPPETS = re.findall(r"```python\n(.*?)```", (Path(__file__).parents[1] / "docs" / "learning.md").read_text(), re.S)


def test_every_snippet_runs(tmp_path, monkeypatch):
    write(Simulation(scene="panorama", motion="rotation", duration=0.2), tmp_path / "logs" / "street")
    monkeypatch.chdir(tmp_path)
    known: dict[str, object] = {}
    for snippet in SNIPPETS:
        exec(snippet, known)
    assert len(SNIPPETS) == 2
    assert known["motion"].omega.shape == (2, 3)
    assert known["loss"].isfinite()
    assert known["loss"].requires_grad
