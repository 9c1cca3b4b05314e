import warnings

import h5py
import numpy as np
import pytest
from hdf5samples import LAYOUTS, N, P, T, X, Y, columns, compound, dsec, event_utils, index, m3ed, mvsec, plain

from torchcmax.io import DataError, OpenOptions, open, save
from torchcmax.io.errors import DataNote, DataWarning
from torchcmax.io.layouts import layout_of

PINHOLE = OpenOptions(camera="pinhole", chunk=700)


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
    with pytest.warns(DataNote, match="davis/right/events is left out"):
        open(tmp_path / "mvsec.h5", PINHOLE)


def file_of(tmp_path, write, name="a.h5"):
    with h5py.File(tmp_path / name, "w") as file:
        write(file)
    return tmp_path / name


def test_decimal_times_that_are_no_seconds_are_refused(tmp_path):
    path = file_of(tmp_path, lambda file: columns(file.create_group("events"), "ts", "xs", "ys", "ps", T * 1e6 + 0.5))
    with pytest.raises(DataError, match="no seconds"):
        open(path, PINHOLE)


def test_decimal_times_without_fractions_are_microseconds_and_told(tmp_path):
    path = file_of(tmp_path, lambda file: columns(file.create_group("events"), "ts", "xs", "ys", "ps", T.astype("f8")))
    with pytest.warns(DataNote, match="taken to be in us"):
        recording = open(path, PINHOLE)
    np.testing.assert_array_equal(joined(list(recording.chunks()), "t"), T)


def test_the_calibration_of_m3ed_is_read(tmp_path):
    path = file_of(tmp_path, m3ed)
    with h5py.File(path) as file:
        lens = layout_of(path, file).lens
    assert (lens.numbers, lens.model, lens.sensor) == ((1000, 1001, 640, 360), "plumb_bob", (1280, 720))
    assert lens.distortion == (-0.1, 0.01, 0.001, 0.002, 0)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("distortion_model", "spline", "distortion spline"),
        ("camera_model", "omni", "camera model omni"),
        ("intrinsics", [1.0], "intrinsics"),
    ],
)
def test_a_calibration_of_m3ed_that_cannot_be_used_is_told_and_another_taken(tmp_path, name, value, words):
    path = file_of(tmp_path, m3ed)
    with h5py.File(path, "a") as file:
        del file[f"prophesee/left/calib/{name}"]
        file[f"prophesee/left/calib/{name}"] = value
    with pytest.warns(DataWarning, match=f"its calibration is left out, .*{words}"):
        assert open(path, PINHOLE).camera.size == (720, 1280)
    with pytest.warns(DataWarning), pytest.raises(DataError, match="no calibration"):
        open(path)


def test_the_other_distortion_of_kalibr_in_m3ed(tmp_path):
    path = file_of(tmp_path, m3ed)
    with h5py.File(path, "a") as file:
        del file["prophesee/left/calib/distortion_model"]
        file["prophesee/left/calib/distortion_model"] = b"equidistant"
    with h5py.File(path) as file:
        lens = layout_of(path, file).lens
    assert (lens.model, lens.distortion, lens.sensor) == ("kannala_brandt", (-0.1, 0.01, 0.001, 0.002), (1280, 720))


@pytest.mark.parametrize(
    ("resolution", "images", "size"),
    [((260, 346), 5, (260, 346)), ((260, 346, 3), 5, (260, 346)), ((259, 345), 0, (260, 346)), ((259, 345), 5, (259, 345))],
)
def test_the_size_that_event_utils_writes(tmp_path, resolution, images, size):
    def write(file):
        event_utils(file)
        file.attrs.update(sensor_resolution=resolution, num_imgs=images)

    assert open(file_of(tmp_path, write), PINHOLE).camera.size == size


def test_a_file_of_the_layout_of_dsec_with_events_beyond_its_sensor_is_no_dsec(tmp_path):
    def write(file):
        dsec(file)
        file["events/x"][:300] = 1279

    assert open(file_of(tmp_path, write), PINHOLE).camera.size == (720, 1280)


def poses():
    """Four poses T_wc that turn about y and move: [4, 4, 4]."""
    found = np.tile(np.eye(4), (4, 1, 1))
    for i, angle in enumerate([0, 0.1, 0.25, 0.3]):
        found[i, :3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        found[i, :3, 3] = [i, 0.5 * i, -i * i]
    return found


TRUTHS = {
    "mvsec": (mvsec, "a_data.hdf5", "a_gt.hdf5", {"davis/left/pose": poses(), "davis/left/pose_ts": [1.5, 1.6, 1.7, 1.800001]}),
    "m3ed": (m3ed, "a_data.h5", "a_pose_gt.h5", {"Cn_T_C0": np.linalg.inv(poses()), "ts": [1.5e6, 1.6e6, 1.7e6, 1.800001e6]}),
}


@pytest.mark.parametrize("name", TRUTHS)
@pytest.mark.filterwarnings("ignore::torchcmax.io.DataNote")
def test_the_ground_truth_beside_a_file_is_read(tmp_path, name):
    write, data, beside, truth = TRUTHS[name]
    path = file_of(tmp_path, write, data)
    assert open(path, PINHOLE).truth is None
    with h5py.File(tmp_path / beside, "w") as file:
        for one, numbers in truth.items():
            file[one] = numbers
    found = open(path, PINHOLE).truth
    assert found.time.tolist() == [1_500_000, 1_600_000, 1_700_000, 1_800_001]
    np.testing.assert_allclose(found.pose.R, poses()[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(found.pose.t, poses()[:, :3, 3], atol=1e-12)
    matrix = next(iter(truth))
    for wrong, words in ((poses() * 2, "no rotation"), (poses()[:, :3], "not \\(M, 4, 4\\)")):
        with h5py.File(tmp_path / beside, "a") as file:
            del file[matrix]
            file[matrix] = wrong
        with pytest.raises(DataError, match=words) as caught:
            open(path, PINHOLE)
        assert caught.value.path == tmp_path / beside


@pytest.mark.parametrize("offset", [0, 5])
@pytest.mark.parametrize("time", [2**63 + 7, 2**64 - 5, 2**61])
def test_times_beyond_all_range_are_refused(tmp_path, time, offset):
    def write(file):
        columns(file.create_group("events"), time=np.full(N, time, "u8"))
        file["ms_to_idx"], file["t_offset"] = index(), offset

    with pytest.raises(DataError, match=f"t is {time}"):
        list(open(file_of(tmp_path, write), PINHOLE).chunks())


WRONG = {
    "group": lambda file, name: file.create_group(name),
    "text": lambda file, name: file.create_dataset(name, data="long"),
    "texts": lambda file, name: file.create_dataset(name, data=[b"ab", b"c"]),
    "nothing": lambda file, name: file.create_dataset(name, data=h5py.Empty("i8")),
    "none": lambda file, name: file.create_dataset(name, data=np.zeros(0)),
    "nan": lambda file, name: file.create_dataset(name, data=np.nan),
    "huge": lambda file, name: file.create_dataset(name, data=np.array([2**64 - 1] * 4, "u8")),
    "decimal": lambda file, name: file.create_dataset(name, data=[[0.5, np.inf]]),
    "table": lambda file, name: file.create_dataset(name, data=np.zeros(4, [("a", "i4")])),
    "complex": lambda file, name: file.create_dataset(name, data=np.ones((4, 4), "c16")),
    "long": lambda file, name: file.create_dataset(name, (1 << 50,), "i8", chunks=(1024,)),
    "link": lambda file, name: file.__setitem__(name, h5py.SoftLink("/nowhere")),
}


def our_own(file):
    """As `save` writes it."""
    plain(file)
    file.attrs.update(format="torchcmax", version=2, name="", width=300, height=200, model="plumb_bob", fx=200, fy=200, cx=150, cy=100)
    file["index"], file["plane"] = T[:1], [0.0, 0, -1, 2]
    file["truth/t"], file["truth/p"], file["truth/q"] = [1, 2], np.zeros((2, 3)), [[0.0, 0, 0, 1]] * 2


WHOLE = {name: write for name, (write, _, _) in LAYOUTS.items()} | {"plain": plain, "our own": our_own}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.filterwarnings("ignore::torchcmax.io.DataNote", "ignore::torchcmax.io.DataWarning")
def test_anything_else_in_place_of_anything_ends_in_a_data_error(tmp_path, name, wrong):
    whole, names = file_of(tmp_path, WHOLE[name], "whole.h5").read_bytes(), []
    with h5py.File(tmp_path / "whole.h5") as file:
        file.visit(names.append)
    assert len(names) >= 1
    for i, one in enumerate(names):
        path = tmp_path / f"{i}.h5"
        path.write_bytes(whole)
        with h5py.File(path, "a") as file:
            del file[one]
            WRONG[wrong](file, one)
        try:
            recording = open(path, PINHOLE)
            recording.since(int(T[2500]))
            chunks = list(recording.chunks())
        except DataError:
            continue
        for column, wanted in (("x", X), ("y", Y), ("p", P)):
            np.testing.assert_array_equal(joined(chunks, column), wanted, err_msg=one)  # what it said beside the events only


@pytest.mark.parametrize("pieces", [{}, {"chunks": (500,)}, {"chunks": (500,), "compression": "gzip"}])
@pytest.mark.parametrize("length", [N + 500, 1 << 50])
def test_a_table_longer_than_what_is_stored_is_refused(tmp_path, pieces, length):
    def write(file):
        compound("CD/events")(file)
        table = file["CD/events"][:]
        del file["CD/events"]
        data = file.create_dataset("CD/events", (length,), table.dtype, **pieces)
        if pieces:
            data[:N] = table

    with pytest.raises(DataError, match="are stored"):
        open(file_of(tmp_path, write), PINHOLE)


@pytest.mark.parametrize("column", range(4))
def test_a_table_without_names_that_leaves_a_doubt_is_refused(tmp_path, column):
    rows = np.stack([T, X, Y, P], 1).astype("f8")
    rows[:, column] = [T[::-1], np.arange(N), Y + 0.5, P * 2][column]
    with pytest.raises(DataError, match="do not tell which is which"):
        open(file_of(tmp_path, lambda file: file.create_dataset("events", data=rows)), PINHOLE)


def test_a_filter_that_is_none_for_events_is_not_tried(tmp_path):
    hdf5plugin = pytest.importorskip("hdf5plugin", reason="hdf5plugin is an extra: pip install 'torchcmax[io]'")
    path = file_of(tmp_path, event_utils)
    with h5py.File(path, "a") as file:
        del file["events/ts"]
        file.create_dataset("events/ts", data=T / 1e6, chunks=(500,), **hdf5plugin.Zfp(reversible=True))
    with pytest.raises(DataError, match="filter 32013, which is none for events"):
        open(path, PINHOLE)


@pytest.mark.filterwarnings("ignore::torchcmax.io.DataNote")
def test_a_folder_with_a_recording_and_its_truth_is_one_recording(tmp_path):
    write, data, beside, truth = next(iter(TRUTHS.values()))
    file_of(tmp_path, write, data)
    with h5py.File(tmp_path / beside, "w") as file:
        for one, numbers in truth.items():
            file[one] = numbers
    assert len(open(tmp_path, PINHOLE).truth) == 4
