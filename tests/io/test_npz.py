import subprocess
import sys

import numpy as np
import pytest

from torchcmax.io import DataError, OpenOptions, npz, open

N = 5000
T, X, Y, P = np.arange(N) * 137, np.arange(N) % 300, np.arange(N) % 200, np.arange(N) % 2
TABLE = np.rec.fromarrays([T, X, Y, P], names="t,x,y,p")
FORMS = {
    "plain": {"t": T, "x": X, "y": Y, "p": P},
    "seconds": {"ts": T / 1e6, "xs": X.astype("u2"), "ys": Y.astype("u2"), "ps": P.astype(bool)},
    "signed": {"timestamps": T, "x": X, "y": Y, "polarities": 2 * P - 1},
    "table": {"events": np.array(TABLE)},
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_every_form_comes_back_exactly(tmp_path, form, write):
    write(tmp_path / "a.npz", width=320, height=240, **FORMS[form])
    recording = open(tmp_path / "a.npz", OpenOptions(camera="pinhole", chunk=700))
    chunks = list(recording.chunks())
    for name, wanted in (("t", T), ("x", X), ("y", Y), ("p", P)):
        np.testing.assert_array_equal(np.concatenate([getattr(chunk, name) for chunk in chunks]), wanted)
    assert recording.count == N
    assert recording.camera.size == (240, 320)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": T[:-1]}, "different lengths"),
        ({"x": X - 1}, "x is -1"),
        ({"x": X + 0.5}, "no whole number"),
        ({"t": T * 1e6}, "no seconds"),
        ({"t": np.array([object()] * N)}, "cannot be read as npz"),
    ],
)
def test_what_cannot_be_is_named(tmp_path, change, words):
    np.savez(tmp_path / "a.npz", **FORMS["plain"] | change)
    with pytest.raises(DataError, match=words):
        list(npz.contents(tmp_path / "a.npz").events(700))


LOOP = """
import sys, numpy as np
from pathlib import Path
from torchcmax.io import DataError, npz
whole, path, draw = Path(sys.argv[1]).read_bytes(), Path(sys.argv[2]), np.random.default_rng(0)
for i in range(200):
    data = bytearray(whole)
    if i % 2:
        data = data[: int(draw.integers(4, len(data)))]
    else:
        for at in draw.integers(0, len(data), 5):
            data[at] = int(draw.integers(256))
    path.write_bytes(data)
    try:
        list(npz.contents(path).events(700))
    except DataError:
        pass
"""


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_200_damaged_files_end_in_a_data_error_or_are_read(tmp_path, write):
    write(tmp_path / "a.npz", **FORMS["plain"])
    command = [sys.executable, "-W", "ignore", "-c", LOOP, str(tmp_path / "a.npz"), str(tmp_path / "b.npz")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
