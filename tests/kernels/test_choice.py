"""Which kernels are taken, and what is said about it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchcmax import kernels
from torchcmax.core.camera import Canvas

ROOT = Path(__file__).parents[2]
ESTIMATE = """
import torch
from torchcmax.core.camera import Camera
from torchcmax.core.estimate import estimate
from torchcmax.core.model import Rotation
from torchcmax.core.window import Window
torch.set_num_threads(1)
t = torch.linspace(0, 1, 500)
dots = torch.stack([torch.arange(500) % 7 / 7 - 0.5 + 0.05 * t, torch.arange(500) % 5 / 5 - 0.5, torch.ones(500)], -1)
window = Window(dots[None], t[None], torch.ones(1, 500), torch.zeros(1, dtype=torch.int64), torch.ones(1))
for _ in range(2):
    found = estimate(window, Camera.pinhole((60, 80)), Rotation(96.0))
print(round(found.gain.item(), 3))
"""
WITHOUT_NUMBA = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "numba":
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Missing())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name == "numba" else found(name, *rest)
"""


def run(program, **more):
    told = {"capture_output": True, "text": True, "cwd": ROOT, "env": {**os.environ, **more}, "timeout": 300, "check": False}
    done = subprocess.run([sys.executable, "-c", program], **told)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def test_without_numba_everything_works_and_the_log_says_once_how_to_get_it():
    out, err = run(WITHOUT_NUMBA + ESTIMATE)
    assert float(out) > 1.5
    assert err.count("pip install 'torchcmax[fast]'") == 1


def test_the_switch_leaves_the_kernels_out(monkeypatch):
    monkeypatch.setenv(kernels.SWITCH, "0")
    assert kernels.drawing(torch.zeros(1)) is None
    assert kernels.searching(torch.zeros(1), Canvas(1.0, (0.0, 0.0), (8, 8))) is None


def test_other_types_of_numbers_take_the_torch_path():
    assert kernels.drawing(torch.zeros(1, dtype=torch.bfloat16)) is None
    assert kernels.drawing(torch.zeros(1, device="meta")) is None


def test_threads_follow_torch_until_told_otherwise():
    assert kernels.threads() == torch.get_num_threads()
    kernels.set_threads(3)
    try:
        assert kernels.threads() == 3
    finally:
        kernels.set_threads(0)
    assert kernels.threads() == torch.get_num_threads()
    with pytest.raises(ValueError, match="at least 0, got -1"):
        kernels.set_threads(-1)


@pytest.mark.slow
def test_compiling_is_said_once_and_done_once(tmp_path):
    pytest.importorskip("numba", reason="numba is not installed")
    first_out, first = run(ESTIMATE, NUMBA_CACHE_DIR=str(tmp_path))
    again_out, again = run(ESTIMATE, NUMBA_CACHE_DIR=str(tmp_path))
    assert first.count("compiling the kernels") == 1
    assert "compiling" not in again
    assert first_out == again_out


@pytest.mark.slow
def test_kernels_work_where_nothing_can_be_kept_on_disk(tmp_path):
    pytest.importorskip("numba", reason="numba is not installed")
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    out, _ = run(ESTIMATE, NUMBA_CACHE_DIR=str(blocked / "cache"))
    assert float(out) > 1.5


def test_machine_code_older_than_its_source_is_forgotten(tmp_path):
    compiling = pytest.importorskip("torchcmax.kernels.compiling", reason="numba is not installed")
    (tmp_path / "__pycache__").mkdir()
    old, new = tmp_path / "__pycache__" / "old.nbi", tmp_path / "__pycache__" / "new.nbi"
    for path in (old, tmp_path / "source.py", new):
        path.write_text("")
    os.utime(old, (1, 1))
    os.utime(tmp_path / "source.py", (2, 2))
    compiling.forget_stale(tmp_path / "__pycache__", tmp_path)
    assert new.exists()
    assert not old.exists()


def test_a_numba_that_cannot_be_imported_is_said_once_and_done_without(tmp_path):
    (tmp_path / "numba").mkdir()
    (tmp_path / "numba" / "__init__.py").write_text("raise ImportError('Numba needs another numpy')")
    out, err = run(ESTIMATE, PYTHONPATH=str(tmp_path))
    assert float(out) > 1.5
    assert err.count("Numba needs another numpy") == 1
