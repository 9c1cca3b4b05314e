"""Every file that cannot be used is named, with the place in it and what to do."""

import gzip
import os
import struct
import warnings
import zipfile
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import CALIB, GOOD, noise, read, refused

from torchcmax.io import DataError, DataNote, DataWarning, OpenOptions, open, save
from torchcmax.io.text import read_text


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
        ("-5e12 2 3 1", "-5e12 is no time"),
        ("0.1,2,3,1", "1 columns instead of 4"),
    ],
)
def test_a_wrong_line_is_named_and_quoted(folder, line, words):
    error = refused(folder(f"# t x y p\n{GOOD}{line}\n{GOOD}"), words, line, "sed -i '5d'", "events.txt, line 5")
    assert error.place == "line 5"


@pytest.mark.parametrize("first", ["a,b,c,d", "1 2 3", '{"t": 1}', "0.1 2 3 7"])
@pytest.mark.parametrize("end", ["", "\n"])
def test_a_file_of_another_form_is_told_the_form_and_not_to_drop_lines(folder, first, end):
    error = refused(
        folder(f"# comment\n{first}\n{first}{end}"), "its first line is no event", first, "t x y p, separated by blanks", "line 2"
    )
    assert "sed" not in str(error)


def test_a_wrong_line_in_a_zip_is_to_be_dropped_outside_of_it(tmp_path):
    for text, place in ((GOOD + "x\n" + GOOD, "line 4"), (GOOD + "0.1", "line 4: the last line is cut off")):
        with zipfile.ZipFile(tmp_path / "r.zip", "w") as archive:
            archive.writestr("events.txt", text)
            archive.writestr("calib.txt", CALIB)
        assert "sed" not in str(refused(tmp_path / "r.zip", place, f"unpack {tmp_path / 'r.zip'}, drop the line"))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (gzip.compress(GOOD.encode()), "is compressed with gzip\n  what to do: unpack it first: gunzip"),
        (GOOD.encode("utf-16"), "is not plain text"),
        (GOOD.encode("utf-16-be"), "is not plain text"),
        (b"\x7fELF\0\0", "is not plain text"),
    ],
    ids=["gzip", "utf-16", "utf-16-be", "a program"],
)
def test_files_that_are_no_plain_text(folder, tmp_path, data, words):
    refused(folder(data), words, "events.txt")
    (tmp_path / "events.txt").write_text(GOOD)
    for name in ("calib.txt", "groundtruth.txt"):
        (tmp_path / name).write_bytes(data)
        refused(tmp_path, words, name)
        (tmp_path / name).write_text(CALIB)


def test_gzip_and_utf16_are_known_by_any_name(tmp_path):
    (tmp_path / "events.txt.gz").write_bytes(gzip.compress(GOOD.encode()))
    refused(tmp_path / "events.txt.gz", "gunzip < events.txt.gz")
    (tmp_path / "my events").write_bytes(GOOD.encode("utf-16"))
    refused(tmp_path / "my events", "iconv -f UTF-16 -t UTF-8 'my events'")


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
    refused(
        folder(text),
        "event 4 at pixel (240, 7)",
        "sensor of 240 x 180",
        "at least --sensor 241x180, or drop the event",
        "line 6",
        chunk=chunk,
    )


UNSORTED = "0.000005 1 1 0\n0.000009 2 1 0\n0.000005 3 1 0\n0.000007 4 1 0\n0.000009 5 1 0\n"


@pytest.mark.parametrize("chunk", [2, 3, 100])
def test_unsorted_events_are_sorted_stably_with_one_warning(folder, chunk):
    with pytest.warns(DataWarning, match="2 of 5 events were out of order and have been sorted, the first at line 3") as caught:
        events = read(folder(UNSORTED), chunk=chunk)
    assert len([one for one in caught if isinstance(one.message, DataWarning)]) == 1
    assert events.x.tolist() == [1, 3, 4, 2, 5]


def test_an_event_too_late_to_be_sorted(folder):
    late = "".join(f"0.00001{i} {i} 1 0\n" for i in range(8)) + "0.000001 9 9 1\n"
    refused(folder(late), "event 9 at 1 us comes after too many later ones", "sort -s -n -k1,1", "line 9", chunk=2)


def test_strict_refuses_unsorted_events(folder):
    refused(folder(UNSORTED), "event 3 is earlier than the one before", "line 3", strict=True, chunk=2)


@pytest.mark.parametrize("chunk", [1, 2, 5])
def test_equal_times_are_kept_in_order_with_a_note_and_refused_by_strict(folder, chunk):
    path = folder("0.1 1 1 0\n0.2 2 1 0\n0.2 1 1 0\n0.2 3 1 0\n")
    with pytest.warns(DataNote, match="2 of 4 events have the time of the one before; they stay in the order of the file"):
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
        next(open(path, OpenOptions(sensor=(240, 180))).windows(10))
    with pytest.raises(DataError, match="holds no events"):
        open(path)


def test_fewer_events_than_a_window(folder):
    with pytest.raises(DataError, match=r"holds 3 events, fewer than one window of 1000\n.*--events 3"):
        next(open(folder()).windows(1000))


def test_paths_that_are_no_recordings(tmp_path):
    refused(tmp_path / "nowhere", "there is no such file or folder")
    (tmp_path / "link").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe")
    for odd in ("/dev/null", tmp_path / "link", tmp_path / "pipe"):
        refused(odd, "is no regular file")
    for name in ("link", "pipe"):
        (tmp_path / name).unlink()
    refused(tmp_path, "folder without a recording; it holds nothing", "events.txt")
    for name in ("a.png", "notes.md", "b", "c", "d"):
        (tmp_path / name).write_text("hello world\n")
    refused(tmp_path, "a.png, b, c, d and 1 more")
    refused(tmp_path / "notes.md", "is not a recording", "hello world")
    (tmp_path / "fake.h5").write_bytes(b"not hdf5 at all")
    refused(tmp_path / "fake.h5", "should be an HDF5 file and is none")


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
