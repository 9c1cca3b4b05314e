"""Every command and every snippet of the README runs, in the order in which a reader meets them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"```(sh|python)\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
COMMANDS = [line for kind, block in BLOCKS if kind == "sh" for line in block.splitlines()]
OWN = Path(sys.prefix) == ROOT / ".venv"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """An empty folder that looks like the clone, so that the clone's own logs stay as they are."""
    folder = tmp_path_factory.mktemp("clone")
    for name in ("configs", "scripts"):
        (folder / name).symlink_to(ROOT / name)
    return folder


def run(arguments, place, **options):
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(arguments, cwd=place, env=environment, capture_output=True, text=True, timeout=600, check=False, **options)
    assert done.returncode == 0, f"{arguments}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.slow
def test_every_command_and_snippet_runs(place):
    for kind, block in BLOCKS:
        if kind == "python":
            assert run([sys.executable, "-c", block], place)
            continue
        for line in block.splitlines():
            if line.startswith("scripts/run"):
                continue  # the test below, and the run of the tests itself
            run(["bash", "-c", line.replace("torchcmax ", f"{sys.executable} -m torchcmax.cli ", 1)], place)
    assert len(list((place / "logs" / "compensated" / "images").glob("*.png"))) >= 1
    assert (place / "logs" / "tracked" / "map.png").is_file()
    assert (place / "logs" / "thesis" / "figure_2_3.png").is_file()


def test_every_link_leads_somewhere_and_nothing_waits_to_be_filled_in():
    text = (ROOT / "README.md").read_text()
    links = re.findall(r"\]\(([^)#]+)\)", text)
    assert len(links) >= 2
    for link in links:
        assert (ROOT / link).exists(), link
    assert not re.findall(r"\b[A-Z]+_[A-Z]+\b|\bTODO\b|@\w+@", text.replace("TORCHCMAX_KERNELS", ""))


def test_the_readme_begins_with_the_two_commands():
    assert COMMANDS[:2] == ["scripts/run", "scripts/run pytest"]


@pytest.mark.slow
@pytest.mark.skipif(not OWN, reason="not in the environment that scripts/run makes")
def test_the_first_command_ends_with_a_map_and_its_error():
    out = run(["scripts/run"], ROOT)
    assert "done: look at the map, logs/demo/track/map.png" in out
    assert "% of the plane's distance" in out
    assert (ROOT / "logs/demo/track/map.png").is_file()


def test_what_ci_runs_is_what_the_readme_says():
    steps = [line for line in (ROOT / ".ci" / "run").read_text().splitlines() if line.startswith("scripts/run")]
    assert set(COMMANDS[:2]) <= set(steps)
