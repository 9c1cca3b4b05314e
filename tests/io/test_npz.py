import builtins
import subprocess
import sys

import numpy as np
import pytest

from torchcmax.io import DataError, DataNote, OpenOptions, npz, open

N = 5000
T, X, Y, P = np.arange(N) * 137, np.arange(N) % 300, np.arange(N) % 200, np.arange(N) % 2
TABLE = np.rec.fromarrays([T, X, Y, P], names="t,x,y,p")
FORMS = {
    "plain": {"t": T, "x": X, "y": Y, "p": P},
    "seconds": {"ts": T / 1e6, "xs": X.astype("u2"), "ys": Y.astype("u2"), "ps": P.astype(bool)},
    "signed": {"timestamps": T, "x": X, "y": Y, "polarities": 2 * P - 1},
    "table": {"events": np.array(TABLE)},
    "other names": {"events": np.array(np.rec.fromarrays([P, T, Y, X], names="polarity,timestamp,ys,xs"))},
    "only one": {"arr_0": np.array(TABLE)},
}
ROWS = {
    "txyp": np.stack([T, X, Y, P], 1),
    "xytp": np.stack([X, Y, T / 1e6, 2 * P - 1], 1),
    "xypt": np.stack([X, Y, P, T], 1).astype("f4"),
    "ptxy": np.asfortranarray(np.stack([P, T, X, Y], 1)),
    "seconds by columns": np.asfortranarray(np.stack([T / 1e6, X, Y, P], 1)),
    "other way round": np.stack([X, Y, T, P]),
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


def read(path, **options):
    recording = open(path, OpenOptions(camera="pinhole", chunk=700, **options))
    chunks = list(recording.chunks())
    for name, wanted in (("t", T), ("x", X), ("y", Y), ("p", P)):
        np.testing.assert_array_equal(np.concatenate([getattr(chunk, name) for chunk in chunks]), wanted)
    assert recording.count == N


@pytest.mark.parametrize("rows", ROWS)
@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_tables_without_names_are_told_by_their_values(tmp_path, rows, write):
    write(tmp_path / "a.npz", events=ROWS[rows], other=np.zeros(3))
    with pytest.warns(DataNote, match="columns without names"):
        read(tmp_path / "a.npz")


@pytest.mark.parametrize("rows", ROWS)
def test_npy_files_of_numbers_are_read(tmp_path, rows):
    np.save(tmp_path / "a.npy", ROWS[rows])
    with pytest.warns(DataNote, match="columns without names"):
        read(tmp_path / "a.npy")


@pytest.mark.parametrize("form", ["table", "other names"])
def test_npy_files_with_names_are_read(tmp_path, form):
    np.save(tmp_path / "a.npy", FORMS[form]["events"])
    read(tmp_path / "a.npy")


def test_an_npy_file_cut_off_is_named(tmp_path):
    np.save(tmp_path / "a.npy", np.array(TABLE))
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="ends before its events do"):
        read(tmp_path / "a.npy")


@pytest.mark.parametrize(
    "rows",
    [
        np.stack([T[::-1], X, Y, P], 1),  # no time
        np.stack([T, np.arange(N), Y, P], 1),  # two times
        np.stack([T, X, Y, X], 1),  # no polarity
        np.stack([T, X % 2, Y, P], 1),  # two polarities
        np.stack([T, X + 0.5, Y, P], 1),  # no pixel
        np.stack([T, X, Y, np.where(P == 0, np.nan, P)], 1),
        np.stack([X, Y, T, P], 1)[:1],
    ],
)
def test_a_table_without_names_that_leaves_a_doubt_is_refused(tmp_path, rows):
    np.save(tmp_path / "a.npy", rows)
    with pytest.raises(DataError, match="do not tell which is which"):
        npz.contents(tmp_path / "a.npy")


def test_an_array_that_is_no_table_of_events_is_not_taken_for_one(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((7, 5)))
    with pytest.raises(DataError, match="is not a recording"):
        open(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", np.zeros((7, 5)))
    with pytest.raises(DataError, match="has no events"):
        open(tmp_path / "a.npz")


def test_decimal_times_without_fractions_are_microseconds_and_told(tmp_path):
    np.savez(tmp_path / "a.npz", **FORMS["plain"] | {"t": T.astype("f8")})
    with pytest.warns(DataNote, match="taken to be in us"):
        read(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": T[:-1]}, "different lengths"),
        ({"x": X - 1}, "x is -1"),
        ({"x": X + 0.5}, "no whole number"),
        ({"t": T * 1e6 + 0.5}, "no seconds"),
        ({"t": np.where(T > 9e4, np.nan, T / 1e6)}, "t is nan"),
        ({"t": np.array(["a", "b"] * (N // 2))}, "t is of the kind <U1"),
        ({"t": np.full(N, 2**64 - 5, "u8")}, f"t is {2**64 - 5}"),
        ({"p": P * 2}, "p is 2"),
        ({"p": P * 0.5}, "p is 0.5"),
        ({"x": X.reshape(-1, 1)}, "different lengths"),
        ({"x": X.astype("c16")}, "x is of the kind complex128"),
        ({"x": np.zeros(N, "M8[us]")}, "x is of the kind datetime64"),
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


@pytest.mark.parametrize(
    "write",
    [
        lambda path: np.savez(path, **FORMS["plain"]),
        lambda path: np.savez_compressed(path, events=ROWS["seconds by columns"]),
        lambda path: np.save(path, FORMS["table"]["events"][:500]),
    ],
    ids=["npz", "compressed", "npy"],
)
def test_200_damaged_files_end_in_a_data_error_or_are_read(tmp_path, write):
    with builtins.open(tmp_path / "a.npz", "wb") as stream:
        write(stream)
    command = [sys.executable, "-W", "ignore", "-c", LOOP, str(tmp_path / "a.npz"), str(tmp_path / "b.npz")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
