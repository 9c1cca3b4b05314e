"""Files much larger than the memory that may be used are read as a stream, in a process of their own."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

ROOM = 8 << 30  # bytes free on the disk
MEMORY = 1_500_000_000  # bytes that may be resident at any time, with torch
BLOCK = 1 << 20  # events written at once
READ = """
import json, sys
from pathlib import Path
from torchcmax.io import OpenOptions, open
count, last = 0, None
for chunk in open(sys.argv[1], OpenOptions(camera="pinhole", sensor=(240, 180))).chunks():
    count, last = count + len(chunk), [int(getattr(chunk, name)[-1]) for name in "txyp"]
told = Path("/proc/self/status").read_text().splitlines()
peak = next(line for line in told if line.startswith("VmHWM"))  # ru_maxrss would be the parent's, where that is larger
print(json.dumps([count, last, int(peak.split()[1]) * 1024]))
"""
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")]


@pytest.fixture
def folder(tmp_path):
    if shutil.disk_usage(tmp_path).free < ROOM:
        pytest.skip("less than 8 GB free on the disk")
    yield tmp_path
    shutil.rmtree(tmp_path)


def block(i):
    """The events i * BLOCK to (i + 1) * BLOCK: t us, x, y, p."""
    number = np.arange(i * BLOCK, (i + 1) * BLOCK)
    return number * 2, number % 240, number % 180, number % 7 % 2


def assert_streamed(path, events):
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", READ, str(path)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    count, last, resident = json.loads(done.stdout)
    number = events - 1
    assert (count, last) == (events, [number * 2, number % 240, number % 180, number % 7 % 2])
    assert resident < MEMORY


def test_a_text_file_of_100_mb(folder):
    blocks = 6
    with (folder / "events.txt").open("wb") as file:
        for i in range(blocks):
            t, x, y, p = (column.tolist() for column in block(i))
            file.write(b"".join(b"%d.%06d %d %d %d\n" % (*divmod(a, 10**6), b, c, d) for a, b, c, d in zip(t, x, y, p, strict=True)))
    assert (folder / "events.txt").stat().st_size > 100e6
    assert_streamed(folder / "events.txt", blocks * BLOCK)


def test_an_hdf5_file_of_3_gb(folder):
    blocks = 90
    with h5py.File(folder / "events.h5", "w") as file:
        columns = [file.create_dataset(f"events/{name}", (blocks * BLOCK,), "i8", chunks=(BLOCK,)) for name in "txyp"]
        for i in range(blocks):
            for column, data in zip(columns, block(i), strict=True):
                column.id.write_direct_chunk((i * BLOCK,), data)  # past HDF5's cache
    assert (folder / "events.h5").stat().st_size > 3e9
    assert_streamed(folder / "events.h5", blocks * BLOCK)
