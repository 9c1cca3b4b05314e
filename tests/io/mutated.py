"""Broken copies of a file, and what becomes of them when they are opened and read: in one child process, with limits on time and memory."""

import json
import subprocess
import sys

import numpy as np

MEMORY = 3 << 30  # bytes of address space beyond what the child has when it begins
PATIENCE = 20  # s for one file
CHILD = """
import json, resource, sys, warnings
from pathlib import Path
import torch
from torchcmax.io import DataError, DataWarning, OpenOptions, open
for extra in ("faery", "rosbags.highlevel", "hdf5plugin"):
    try:
        __import__(extra)
    except ImportError:
        pass
now = int(next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmSize")).split()[1]) << 10
resource.setrlimit(resource.RLIMIT_AS, (now + int(sys.argv[1]), now + int(sys.argv[1])))
for name in sys.stdin:
    name = name.strip()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            for chunk in open(name, OpenOptions(camera="pinhole")).chunks():
                pass
            outcome = "partial" if any(isinstance(one.message, DataWarning) for one in told) else "read"
        except DataError:
            outcome = "DataError"
        except BaseException as error:
            outcome = f"{type(error).__name__}: {error}"[:300]
    print(json.dumps(outcome), flush=True)
"""


def mutations(data, header, count=200, seed=0):
    """So many broken copies of a file's bytes, of which `header` bytes tell what comes behind them."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        broken = bytearray(data)
        if i % 5 == 0:
            del broken[int(rng.integers(0, len(data))) :]
        elif i % 5 == 1:
            del broken[int(rng.integers(0, min(4 * header, len(data)))) :]
        elif i % 5 == 2:
            for _ in range(int(rng.integers(1, 4))):
                broken[int(rng.integers(0, header))] ^= 1 << int(rng.integers(0, 8))
        elif i % 5 == 3:
            for _ in range(int(rng.integers(1, 30))):
                broken[int(rng.integers(0, len(data)))] ^= 1 << int(rng.integers(0, 8))
        else:
            start = int(rng.integers(0, len(data)))
            long = int(rng.integers(1, max(2, len(data) // 10)))
            broken[start : start + long] = (
                rng.integers(0, 256, len(broken[start : start + long]), dtype="u1").tobytes()
                if i % 2
                else bytes(len(broken[start : start + long]))
            )
        yield bytes(broken)


def outcomes(paths):
    """What became of each file: read, partial (with a warning), DataError; anything else is a fault: a traceback, a hang, a death."""
    found, rest = [], [str(path) for path in paths]
    while rest:
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(MEMORY)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        try:
            out, _ = child.communicate("\n".join(rest) + "\n", timeout=PATIENCE + len(rest))
            end = f"died with {child.returncode}"
        except subprocess.TimeoutExpired:
            child.kill()
            out, end = child.communicate()[0], "hangs"
        told = [json.loads(line) for line in out.splitlines()]
        found += told
        rest = rest[len(told) :]
        if rest:
            found.append(end)
            rest = rest[1:]
    return found


def assert_safe(folder, data, header, suffix, count=200):
    """Every broken copy ends in a DataError or is read as far as it can be."""
    paths = []
    for i, broken in enumerate(mutations(data, header, count)):
        paths.append(folder / f"broken_{i:03d}{suffix}")
        paths[-1].write_bytes(broken)
    found = outcomes(paths)
    wrong = {path.name: outcome for path, outcome in zip(paths, found, strict=True) if outcome not in ("read", "partial", "DataError")}
    assert not wrong
    assert len(set(found)) >= 2
    return found
