"""Calibrations that cannot be used, or not be believed, are refused, and so are texts beyond all size."""

import zipfile

import pytest
from samples import CALIB, GOOD, refused


def test_missing_calibration(folder):
    refused(folder(calib=""), "no calibration", "--camera pinhole", "calib.txt", "fx fy cx cy k1 k2 p1 p2 k3")


@pytest.mark.parametrize(
    ("calib", "words"),
    [
        ("200 200 120 focal", "'focal' is not a number"),
        ("200 200 120", "holds 3 numbers"),
        ("200 nan 120 90", "finite numbers"),
        ("20 200 120 90", "focal length of 20, 200 px"),
        ("200 25000 120 90", "focal length of 200, 25000 px"),
        ("200 200 240 90", "principal point (240, 90) is outside the sensor of 240 x 180"),
        ("200 200 120 -1", "principal point (120, -1) is outside the sensor"),
        ("200 200 120 90 " * 100_000, "has more than 1 MiB"),
        ("-200 200 120 90", "positive focal length"),
        ("200 200 120 90 -9 0 0 0 0", "cannot be inverted"),
        ("\n", "holds 0 numbers"),
        ("model: plumb_bob\nfx: 3\n", "fy is missing"),
        ("fx: [1\n", "is no YAML"),
        ("focal: 3\n", "holds focal"),
        ("fx: 2001-99-99\n", "is no YAML"),
        ("fx: " + "[" * 2000, "is no YAML"),
        ("- " + "bread " * 99 + "\n- a: b\n", "holds ['bread"),
        ("{fx: 9, fy: 9, cx: 3, cy: 4, width: 9}", "width or height is missing"),
        ("{fx: a, fy: 2, cx: 3, cy: 4, width: 9, height: 9}", "fx is 'a', not a number"),
        ("{fx: 9, fy: true, cx: 3, cy: 4, width: 9, height: 9}", "fy is True, not a number"),
        ("{fx: 9, fy: 9, cx: 3, cy: 4, width: true, height: 9}", "width is True, not a number"),
        ("{fx: 9, fy: 9, cx: 3, cy: 4, width: 9, height: 9.5}", "height is 9.5"),
        ("{fx: 9, fy: 9, cx: 3, cy: 4, width: .inf, height: 9}", "width is inf"),
        ("{fx: 9, fy: 9, cx: 3, cy: 4, width: 9, height: 9, distortion: 5}", "distortion is 5, not a list of numbers"),
        ("{fx: 9, fy: 9, cx: 3, cy: 4, width: 9, height: 9, distortion: [a]}", "distortion is 'a', not a number"),
        ("{fx: 5, fy: 5, cx: 3, cy: 4, width: 9, height: 9, model: eye}", "'eye' is none of"),
        ("{fx: 5, fy: 5, cx: 3, cy: 4, width: 9, height: 9, distortion: [1]}", "wants 5 distortion numbers"),
    ],
)
def test_bad_calibrations(folder, calib, words):
    refused(folder(calib=calib), words, "calib.txt")


def test_texts_in_a_zip_are_read_to_a_bound(tmp_path):
    for name, words in (("calib.txt", "more than 1 MiB"), ("plane.txt", "more than 1 MiB"), ("groundtruth.txt", "more than 100 MiB")):
        with zipfile.ZipFile(tmp_path / "r.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("events.txt", GOOD)
            if name != "calib.txt":
                archive.writestr("calib.txt", CALIB)
            with archive.open(name, "w", force_zip64=True) as file:
                for _ in range(101 if "100" in words else 2):
                    file.write(b" " * (1 << 20))
        refused(tmp_path / "r.zip", words, name)


def test_a_calibration_or_sensor_given_wrongly(folder, tmp_path):
    refused(folder(), "no such calibration file", camera=str(tmp_path / "none.yaml"))
    refused(folder(), "is no regular file", camera="/dev/null")
    refused(folder(), "events.txt: a sensor of 0 x 5 pixels", "--sensor 240x180", sensor=(0, 5))
    refused(folder("0.1 5000 3 1\n"), "beyond every known sensor", "at least --sensor 5001x4", sensor=None)
