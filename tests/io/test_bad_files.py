"""Every file that cannot be used is named, with the place in it and what to do."""

import struct
import warnings
import zipfile
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcmax.core.camera import Camera
from torchcmax.io import DataError, DataWarning, Events, OpenOptions, Recording, open, save
from torchcmax.io.text import read_text

CALIB = "200 200 120 90 0 0 0 0 0\n"
GOOD = "0.000001 1 2 0\n0.000002 3 4 1\n0.000003 5 6 1\n"


@pytest.fixture
def folder(tmp_path):
    """Writes a recording as text and returns its folder."""

    def write(events=GOOD, calib=CALIB):
        (tmp_path / "events.txt").write_bytes(events.encode() if isinstance(events, str) else events)
        if calib:
            (tmp_path / "calib.txt").write_text(calib)
        return tmp_path

    return write


def read(path, **options):
    return Events.join(list(open(path, OpenOptions(**{"sensor": (240, 180), **options})).chunks()))


def refused(path, *words, **options):
    with pytest.raises(DataError) as caught:
        read(path, **options)
    for word in (*words, "what to do: "):
        assert word in str(caught.value)
    assert caught.value.remedy
    return caught.value


def test_missing_calibration(folder):
    refused(folder(calib=""), "no calibration", "--camera pinhole", "calib.txt", "fx fy cx cy k1 k2 p1 p2 k3")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("0.1 2 3", "3 columns instead of 4"),
        ("0.1 2 3 1 5", "5 columns instead of 4"),
        ("0.1 two 3 1", "'two' is not a number"),
        ("0.1 1_0 3 1", "'1_0' is not a number"),
        ("nan 2 3 1", "nan is no measurement"),
        ("0.1 -inf 3 1", "-inf is no measurement"),
        ("0.1 -2 3 1", "(-2, 3) is no pixel"),
        ("0.1 2 3.5 1", "(2, 3.5) is no pixel"),
        ("0.1 70000 3 1", "(70000, 3) is no pixel"),
        ("0.1 2 3 2", "polarity 2 is neither 0 nor 1"),
        ("1e30 2 3 1", "1e30 is no time"),
        ("0.1,2,3,1", "1 columns instead of 4"),
    ],
)
def test_a_wrong_line_is_named_and_quoted(folder, line, words):
    error = refused(folder(f"# t x y p\n{GOOD}{line}\n{GOOD}"), words, line, "sed -i '5d'", "events.txt, line 5")
    assert error.place == "line 5"


def test_a_wrong_line_far_down_is_named(folder):
    folder(GOOD * 20 + "0.1 x 3 1\n" + GOOD)
    with pytest.raises(DataError, match="line 61"):
        list(read_text(folder(GOOD * 20 + "0.1 x 3 1\n" + GOOD) / "events.txt", 7, block=50))


@pytest.mark.parametrize("cut", ["0.00", "0.000004 1", "0.000004 1 2", "0.000004 1 2 "])
def test_a_last_line_cut_off_is_found_when_opened(folder, cut):
    with pytest.raises(DataError, match=r"line 4: the last line is cut off(.|\n)*sed -i '\$d'"):
        open(folder(GOOD + cut))


def test_a_last_line_without_its_end_is_whole_with_four_columns(folder):
    assert len(read(folder(GOOD + "0.000004 1 2 1"))) == 4


@pytest.mark.parametrize("chunk", [1, 2, 100])
def test_an_event_off_the_sensor(folder, chunk):
    text = "# here\n\n" + GOOD + "0.000004 240 7 1\n"
    refused(folder(text), "event 4 at pixel (240, 7)", "sensor of 240 x 180", "--sensor W H, at least 241 180", "line 6", chunk=chunk)


UNSORTED = "0.000005 1 1 0\n0.000009 2 1 0\n0.000005 3 1 0\n0.000007 4 1 0\n0.000009 5 1 0\n"


@pytest.mark.parametrize("chunk", [2, 3, 100])
def test_unsorted_events_are_sorted_stably_with_one_warning(folder, chunk):
    with pytest.warns(DataWarning, match="2 of 5 events were out of order and have been sorted, the first at line 3") as caught:
        events = read(folder(UNSORTED), chunk=chunk)
    assert len(caught) == 1
    assert events.x.tolist() == [1, 3, 4, 2, 5]


def test_an_event_too_late_to_be_sorted(folder):
    late = "".join(f"0.00001{i} {i} 1 0\n" for i in range(8)) + "0.000001 9 9 1\n"
    refused(folder(late), "event 9 at 1 us comes after too many later ones", "sort -s -n -k1,1", "line 9", chunk=2)


def test_strict_refuses_unsorted_events(folder):
    refused(folder(UNSORTED), "event 3 is earlier than the one before", "line 3", strict=True, chunk=2)


@pytest.mark.parametrize("chunk", [1, 2, 5])
def test_equal_times_are_kept_in_order_without_a_word_and_refused_by_strict(folder, chunk):
    path = folder("0.1 1 1 0\n0.2 2 1 0\n0.2 1 1 0\n0.2 3 1 0\n")
    assert read(path, chunk=chunk).x.tolist() == [1, 2, 1, 3]
    refused(path, "event 3 is at the same time as the one before", "line 3", strict=True, chunk=chunk)


def test_strict_takes_a_clean_file(folder):
    assert len(read(folder(), strict=True, chunk=1)) == 3


def test_empty_files(folder, tmp_path):
    refused(folder(""), "is empty")
    (tmp_path / "nothing.h5").touch()
    refused(tmp_path / "nothing.h5", "is empty")


def test_a_file_of_comments_has_no_events(folder):
    path = folder("# t x y p\n")
    with pytest.raises(DataError, match="holds 0 events"):
        next(open(path, OpenOptions(sensor=(9, 9))).windows(10))
    with pytest.raises(DataError, match="holds no events"):
        open(path)


def test_fewer_events_than_a_window(folder):
    with pytest.raises(DataError, match=r"holds 3 events, fewer than one window of 1000\n.*--events 3"):
        next(open(folder()).windows(1000))


def test_paths_that_are_no_recordings(tmp_path):
    refused(tmp_path / "nowhere", "there is no such file or folder")
    refused(tmp_path, "folder without a recording; it holds nothing", "events.txt")
    for name in ("a.png", "notes.md", "b", "c", "d"):
        (tmp_path / name).write_text("hello world\n")
    refused(tmp_path, "a.png, b, c, d and 1 more")
    refused(tmp_path / "notes.md", "is not a recording", "hello world")
    (tmp_path / "fake.h5").write_bytes(b"not hdf5 at all")
    refused(tmp_path / "fake.h5", "should be an HDF5 file and is none")


@pytest.mark.parametrize(
    ("calib", "words"),
    [
        ("200 200 120 focal", "'focal' is not a number"),
        ("200 200 120", "holds 3 numbers"),
        ("200 nan 120 90", "finite numbers"),
        ("-200 200 120 90", "positive focal length"),
        ("200 200 120 90 -9 0 0 0 0", "cannot be inverted"),
        ("\n", "holds 0 numbers"),
        ("model: plumb_bob\nfx: 3\n", "fy is missing"),
        ("fx: [1\n", "is no YAML"),
        ("focal: 3\n", "holds focal"),
        ("{fx: a, fy: 2, cx: 3, cy: 4, width: 9, height: 9}", "not a number"),
        ("{fx: 5, fy: 5, cx: 3, cy: 4, width: 9, height: 9, model: eye}", "'eye' is none of"),
        ("{fx: 5, fy: 5, cx: 3, cy: 4, width: 9, height: 9, distortion: [1]}", "wants 5 distortion numbers"),
    ],
)
def test_bad_calibrations(folder, calib, words):
    refused(folder(calib=calib), words, "calib.txt")


def test_a_calibration_or_sensor_given_wrongly(folder, tmp_path):
    refused(folder(), "no such calibration file", camera=str(tmp_path / "none.yaml"))
    refused(folder(), "a sensor of 0 x 5 pixels", sensor=(0, 5))
    refused(folder("0.1 5000 3 1\n"), "beyond every known sensor", "--sensor W H", sensor=None)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.pop("events"), "has no events/t, events/x, events/y, events/p; it holds nothing"),
        (lambda f: f["events"].pop("p"), "has no events/p; it holds events"),
        (lambda f: f["events"].pop("x") and f.create_dataset("events/x", data=[1, 2]), "different lengths"),
        (lambda f: f["events"].pop("t") and f.create_dataset("events/t", data=[0.1, 0.2, 0.3]), "another kind: t: float64"),
        (lambda f: f["events"].pop("x") and f.create_dataset("events/x", data=[[1], [2], [3]]), "another kind"),
        (lambda f: f["events"].pop("x") and f.create_dataset("events/x", data=[1, -2, 3]), "events/x is -2"),
        (lambda f: f["events"].pop("p") and f.create_dataset("events/p", data=[1, 0, 7]), "events/p is 7"),
        (lambda f: f.attrs.update(format="torchcmax", version=99), "newer"),
        (lambda f: f.create_group("groundtruth"), "cannot be read as HDF5"),
    ],
)
def test_bad_hdf5(folder, tmp_path, change, words):
    folder()
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name, data in (("t", [1, 2, 3]), ("x", [1, 2, 3]), ("y", [1, 2, 3]), ("p", [1, 0, 1])):
            file[f"events/{name}"] = np.array(data)
        change(file)
    refused(tmp_path / "e.h5", words, "e.h5")


def noise(count=100_000):
    rng = np.random.default_rng(0)
    x, y = (rng.integers(0, most, count).astype("u2") for most in (240, 180))
    events = Events(np.sort(rng.integers(0, 10**7, count)), x, y, rng.integers(0, 2, count).astype("u1"))
    return Recording(Path("noise"), "noise", Camera.pinhole((180, 240)), lambda: iter([events]))


def test_hdf5_cut_off_or_damaged(tmp_path):
    save(noise(), tmp_path / "a.h5")
    whole = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    refused(tmp_path / "cut.h5", "cannot be read as HDF5")
    middle = len(whole) // 2
    (tmp_path / "bad.h5").write_bytes(whole[:middle] + bytes(b ^ 0x55 for b in whole[middle : middle + 9000]) + whole[middle + 9000 :])
    refused(tmp_path / "bad.h5", "cannot be read as HDF5")


def test_zip_damaged_or_without_a_recording(tmp_path):
    path = tmp_path / "r.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", GOOD * 1000)
        archive.writestr("calib.txt", CALIB)
    whole = path.read_bytes()
    path.write_bytes(whole[:60] + b"\xff\x00\xff" + whole[63:])
    refused(path, "cannot be read")
    path.write_bytes(whole[:-60])
    refused(path, "cannot be read")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    refused(path, "holds no events.txt")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/events.txt", GOOD)
        archive.writestr("b/events.txt", GOOD)
    refused(path, "several recordings, in a/, b/")


def test_zip_with_a_password(tmp_path):
    with zipfile.ZipFile(tmp_path / "r.zip", "w") as archive:
        archive.writestr("events.txt", GOOD)
    data = bytearray((tmp_path / "r.zip").read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        struct.pack_into("<H", data, data.index(mark) + offset, 1)
    (tmp_path / "r.zip").write_bytes(bytes(data))
    refused(tmp_path / "r.zip", "password")


def test_saving_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="is no folder"):
        save(noise(10), tmp_path / "file" / "a.h5")
    (tmp_path / "a.h5").mkdir()
    with pytest.raises(DataError, match="cannot be written"):
        save(noise(10), tmp_path / "a.h5")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.h5", "file"]


def test_saving_to_a_full_disk(tmp_path, monkeypatch):
    """HDF5 that runs into a full disk takes the whole process down, so the room is asked for before each chunk."""
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("usage", (), {"free": 1000}))
    with pytest.raises(DataError, match=r"No space left on device.*\n.*make room on the disk"):
        save(noise(10), tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


def test_saving_a_broken_recording_leaves_nothing_behind(folder, tmp_path):
    recording = open(folder(GOOD + "x y z p\n"), OpenOptions(sensor=(240, 180)))
    (tmp_path / "out").mkdir()
    with pytest.raises(DataError, match="line 4"):
        save(recording, tmp_path / "out" / "a.h5")
    assert not list((tmp_path / "out").iterdir())


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300) | st.text("0123456789. \n\r\t-#e", max_size=200).map(str.encode), st.integers(1, 5))
def test_arbitrary_bytes_raise_nothing_but_data_errors(tmp_path_factory, data, chunk):
    path = tmp_path_factory.mktemp("any") / "events.txt"
    path.write_bytes(data)
    with suppress(DataError), warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        list(open(path, OpenOptions(camera="pinhole", chunk=chunk)).chunks())
