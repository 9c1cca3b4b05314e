import warnings

import h5py
import numpy as np
import pytest

from torchcmax.io import DataError, OpenOptions, open, save
from torchcmax.io.errors import DataNote

N = 5000
T = np.arange(N, dtype=np.int64) * 137 + 1000
X, Y, P = np.arange(N) % 300, np.arange(N) % 200, np.arange(N) % 2
PINHOLE = OpenOptions(camera="pinhole", chunk=700)


def index():
    return np.searchsorted(T, np.arange(T[-1] // 1000 + 2) * 1000)


def columns(group, t="t", x="x", y="y", p="p", time=T):
    for name, data in ((t, time), (x, X.astype("u2")), (y, Y.astype("u2")), (p, P.astype("u1"))):
        group[name] = data


def dsec(file):
    columns(file.create_group("events"), time=T.astype("u4"))
    file["ms_to_idx"], file["t_offset"] = index(), 51648500000


def tumvie(file):
    columns(file.create_group("events"))
    file["ms_to_idx"] = index()


def mvsec(file):
    for side in ("left", "right"):
        file[f"davis/{side}/events"] = np.stack([X, Y, T / 1e6, 2.0 * P - 1], 1)


def m3ed(file):
    group = file.create_group("prophesee/left")
    columns(group)
    group["ms_map_idx"] = index()
    group["calib/intrinsics"], group["calib/resolution"] = [1000.0, 1000, 640, 360], [1280, 720]
    group["calib/distortion_coeffs"] = [-0.1, 0.01, 0, 0]


def compound(name):
    def write(file):
        table = np.zeros(N, [("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")])
        table["x"], table["y"], table["p"], table["t"] = X, Y, P, T
        file[name] = table
        file.attrs["geometry"] = "640x480"

    return write


def event_utils(file):
    columns(file.create_group("events"), "ts", "xs", "ys", "ps", T / 1e6)
    file.attrs["sensor_resolution"] = (260, 346)


LAYOUTS = {
    "dsec": (dsec, (480, 640), 51648500000),
    "tumvie": (tumvie, None, 0),
    "mvsec": (mvsec, (260, 346), 0),
    "m3ed": (m3ed, (720, 1280), 0),
    "tonic": (compound("events"), (480, 640), 0),
    "metavision": (compound("CD/events"), (480, 640), 0),
    "event_utils": (event_utils, (260, 346), 0),
}


def written(tmp_path, name):
    with h5py.File(tmp_path / f"{name}.h5", "w") as file:
        LAYOUTS[name][0](file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataNote)
        return open(tmp_path / f"{name}.h5", PINHOLE)


def joined(chunks, name):
    return np.concatenate([getattr(chunk, name) for chunk in chunks])


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_comes_back_exactly(tmp_path, name):
    recording = written(tmp_path, name)
    _, size, offset = LAYOUTS[name]
    chunks = list(recording.chunks())
    for column, wanted in (("t", T + offset), ("x", X), ("y", Y), ("p", P)):
        np.testing.assert_array_equal(joined(chunks, column), wanted)
    assert recording.count == N
    assert size is None or recording.camera.size == size


@pytest.mark.parametrize("name", ["dsec", "tumvie", "m3ed"])
def test_a_stretch_by_the_index_equals_the_slow_way(tmp_path, name):
    recording = written(tmp_path, name)
    for time in (T + LAYOUTS[name][2])[[0, 1, 7, 2500, N - 1]]:
        before, rest = recording.since(int(time))
        np.testing.assert_array_equal(joined(list(rest), "t"), T[before:] + LAYOUTS[name][2])
        assert np.searchsorted(T + LAYOUTS[name][2], time) - 10 <= before <= np.searchsorted(T + LAYOUTS[name][2], time)


def test_our_own_file_is_entered_at_the_piece_before_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr("torchcmax.io.hdf5.STORED", 512)
    save(written(tmp_path, "tumvie"), tmp_path / "own.h5")
    recording = open(tmp_path / "own.h5", OpenOptions(chunk=700))
    for i in (0, 1, 511, 512, 513, 2500, N - 1):
        before, rest = recording.since(int(T[i]))
        assert max(i - 512, 0) <= before <= i
        np.testing.assert_array_equal(joined(list(rest), "t"), T[before:])


def test_an_index_that_does_not_fit_is_named(tmp_path):
    save(written(tmp_path, "tumvie"), tmp_path / "own.h5")
    with h5py.File(tmp_path / "own.h5", "a") as file:
        del file["index"]
        file["index"] = [1, 2, 3]
    with pytest.raises(DataError, match="index of 3 times does not fit"):
        open(tmp_path / "own.h5").since(5)


def test_our_first_version_still_opens(tmp_path):
    save(written(tmp_path, "tumvie"), tmp_path / "own.h5")
    with h5py.File(tmp_path / "own.h5", "a") as file:
        del file["index"]
        file.attrs["version"] = 1
    before, rest = open(tmp_path / "own.h5").since(int(T[2500]))
    assert before == 0
    np.testing.assert_array_equal(joined(list(rest), "t"), T)


def test_the_camera_that_is_not_read_is_told(tmp_path):
    written(tmp_path, "mvsec")
    with pytest.warns(DataNote, match="the left one is read"):
        open(tmp_path / "mvsec.h5", PINHOLE)


def test_decimal_times_that_are_no_seconds_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        columns(file.create_group("events"), "ts", "xs", "ys", "ps", T * 1e6)
    with pytest.raises(DataError, match="no seconds"):
        open(tmp_path / "a.h5", PINHOLE)
