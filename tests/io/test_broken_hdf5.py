"""Broken copies of HDF5 files, and of text, end in a DataError or are read as far as they go: no traceback, no hang, no crash."""

import h5py
import pytest
from hdf5samples import LAYOUTS, compound
from mutated import assert_safe, mutations, outcomes
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


def heap_without_size(path):
    """Text whose heap ends with an entry of no size, which HDF5 would read forever."""
    with h5py.File(path, "w") as file:
        compound("CD/events")(file)
    data = bytearray(path.read_bytes())
    at = data.index(b"GCOL") + 16
    while int.from_bytes(data[at : at + 2], "little"):  # the last entry, of what is free, has the number 0
        at += 16 + -(-int.from_bytes(data[at + 8 : at + 16], "little") // 8) * 8
    data[at : at + 16] = bytes(16)
    path.write_bytes(data)


def test_broken_files_of_every_layout(tmp_path):
    paths = [tmp_path / "heap.h5"]
    heap_without_size(paths[0])
    for name, (write, _, _) in LAYOUTS.items():
        with h5py.File(tmp_path / "whole.h5", "w") as file:
            write(file)
        for i, broken in enumerate(mutations((tmp_path / "whole.h5").read_bytes(), 2048)):
            paths.append(tmp_path / f"{name}_{i:03d}.h5")
            paths[-1].write_bytes(broken)
    found = dict(zip((path.name for path in paths), outcomes(paths), strict=True))  # in one process, which takes longest to start
    assert found["heap.h5"] == "DataError"
    assert not {path: outcome for path, outcome in found.items() if outcome not in ("read", "partial", "DataError")}
    assert list(found.values()).count("DataError") > len(found) / 2
