"""Broken copies of HDF5 files, and of text, end in a DataError or are read as far as they go: no traceback, no hang, no crash."""

import pytest
from mutated import assert_safe
from samples import noise

from torchcmax.io import save


def test_broken_files_of_our_own(tmp_path):
    save(noise(20_000), tmp_path / "a.h5")
    assert_safe(tmp_path, (tmp_path / "a.h5").read_bytes(), 2048, ".h5")


def test_broken_files_of_the_simulator(demo, tmp_path):
    assert_safe(tmp_path, (demo / "events.h5").read_bytes(), 2048, ".h5")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_broken_text(tmp_path, end):
    lines = (f"{i * 1e-5:.6f} {i % 240} {i % 180} {i % 2}" for i in range(5000))
    assert_safe(tmp_path, (end.join(lines) + end).encode(), 60, ".txt")
