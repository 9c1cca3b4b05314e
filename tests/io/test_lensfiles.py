"""Calibrations of other tools."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchcmax.io.calibration import Lens, read_lens
from torchcmax.io.errors import DataError, DataNote

KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: {model}
  distortion_coeffs: [-0.3, 0.1, 0.01, 0.02]
  intrinsics: [200.5, 201.5, 119.5, 89.5]
  resolution: [240, 180]
"""
MATRIX = """image_width: 240
image_height: 180
camera_matrix: {tag}
  rows: 3
  cols: 3
  data: [200.5, 0, 119.5, 0, 201.5, 89.5, 0, 0, 1]
distortion_coefficients: {tag}
  rows: 1
  cols: 5
  data: [-0.3, 0.1, 0.01, 0.02, 0]
"""
DSEC = """intrinsics:
  cam0: {camera_matrix: [200.5, 201.5, 119.5, 89.5], distortion_coeffs: [-0.3, 0.1, 0.01, 0.02], resolution: [240, 180]}
  camRect0: {}
"""


def read(folder: Path, text: str) -> Lens:
    file = folder / "lens.yaml"
    file.write_text(text)
    return read_lens(file)


def holds_the_numbers(lens: Lens) -> bool:
    numbers, distortion = (200.5, 201.5, 119.5, 89.5), (-0.3, 0.1, 0.01, 0.02, 0.0)
    return (lens.numbers, lens.distortion, lens.model, lens.sensor) == (numbers, distortion, "plumb_bob", (240, 180))


@pytest.mark.parametrize(
    "text",
    [
        KALIBR.format(model="radtan"),
        "distortion_model: plumb_bob\n" + MATRIX.format(tag=""),
        "%YAML:1.0\n---\n" + MATRIX.format(tag="!!opencv-matrix"),
    ],
)
def test_the_same_lens_is_read_from_every_tool(tmp_path: Path, text: str) -> None:
    assert holds_the_numbers(read(tmp_path, text))


def test_of_dsecs_cameras_the_first_is_taken_and_the_others_are_named(tmp_path: Path) -> None:
    with pytest.warns(DataNote, match="camRect0"):
        assert holds_the_numbers(read(tmp_path, DSEC))


def test_an_equidistant_lens_is_kannala_brandt(tmp_path: Path) -> None:
    lens = read(tmp_path, KALIBR.format(model="equidistant"))
    assert (lens.model, lens.distortion) == ("kannala_brandt", (-0.3, 0.1, 0.01, 0.02))


@pytest.mark.parametrize("text", [KALIBR.format(model="fov"), KALIBR.format(model="rational_polynomial")])
def test_another_distortion_is_refused_with_what_is_supported(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError, match="supported"):
        read(tmp_path, text)


def test_a_rational_polynomial_without_its_last_terms_is_plumb_bob(tmp_path: Path) -> None:
    text = "distortion_model: rational_polynomial\n" + MATRIX.format(tag="")
    assert holds_the_numbers(read(tmp_path, text))
    longer = text.replace("cols: 5\n  data: [-0.3, 0.1, 0.01, 0.02, 0]", "cols: 8\n  data: [-0.3, 0.1, 0.01, 0.02, 0, 0, {}, 0]")
    assert holds_the_numbers(read(tmp_path, longer.format("0")))
    with pytest.raises(DataError, match="rational_polynomial"):
        read(tmp_path, longer.format("0.1"))


def test_a_model_that_nobody_names_is_told(tmp_path: Path) -> None:
    with pytest.warns(DataNote, match="plumb_bob is taken"):
        assert holds_the_numbers(read(tmp_path, MATRIX.format(tag="")))
