"""The sensor's size: told by files, or guessed from the events."""

import struct

import pytest
from samples import ECD

from torchcmax.io import DataError, DataWarning, OpenOptions, open


def sensor_of(folder, **options):
    height, width = open(folder, OpenOptions(**options)).camera.size
    return width, height


def test_the_sensor_is_told_by_options_then_a_picture_then_the_events(tmp_path):
    (tmp_path / "events.txt").write_text("0.1 100 2 1\n")
    (tmp_path / "calib.txt").write_text(ECD)
    assert sensor_of(tmp_path) == (240, 180)
    assert sensor_of(tmp_path, camera="pinhole") == (128, 128)
    (tmp_path / "events.txt").write_text("0.1 300 2 1\n")
    assert sensor_of(tmp_path) == (304, 240)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "frame_1.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + struct.pack(">II", 320, 200))
    assert sensor_of(tmp_path) == (320, 200)
    assert sensor_of(tmp_path, sensor=(250, 190)) == (250, 190)
    (tmp_path / "images" / "frame_0.png").write_bytes(b"no picture")
    assert sensor_of(tmp_path) == (304, 240)


@pytest.mark.parametrize("camera", ["", "pinhole"])
def test_a_stray_event_makes_no_larger_sensor_but_is_refused(tmp_path, camera):
    lines = [f"0.{i:06d} {i % 120} {i % 90} 1\n" for i in range(2000)]
    lines[1000] = "0.001000 300 20 1\n"
    (tmp_path / "events.txt").write_text("".join(lines))
    (tmp_path / "calib.txt").write_text(ECD)
    size = (128, 128) if camera else (240, 180)
    with pytest.warns(DataWarning, match=f"taken to be {size[0]} x {size[1]}, though 1 of 2000 .*--sensor 301x{size[1]} or more"):
        recording = open(tmp_path, OpenOptions(camera=camera))
    assert recording.camera.size == size[::-1]
    assert recording.guessed
    with pytest.raises(DataError, match=r"line 1001: event 1001 at pixel \(300, 20\)(.|\n)*at least --sensor 301x"):
        list(recording.chunks())
    assert not open(tmp_path, OpenOptions(camera=camera, sensor=(304, 240))).guessed


def test_many_events_beyond_make_a_larger_sensor(tmp_path):
    (tmp_path / "events.txt").write_text("".join(f"0.{i:06d} {i % 300} 20 1\n" for i in range(2000)))
    (tmp_path / "calib.txt").write_text(ECD)
    assert sensor_of(tmp_path) == (304, 240)
