"""Calibration files and sensor sizes -> Camera."""

from __future__ import annotations

import reprlib
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchcmax.core.camera import MODELS, Camera
from torchcmax.io.errors import DataError, DataWarning
from torchcmax.io.events import Events
from torchcmax.io.lensfiles import in_our_words, yaml_of
from torchcmax.io.member import Member, not_a_file, text_lines, text_of

SENSORS = ((128, 128), (240, 180), (304, 240), (346, 260), (480, 360), (640, 480), (1280, 720))  # width, height px, smallest first
OFF_CENTRE = 0.15  # of the sensor: how far from the middle a principal point is believed to be; 0.12 in the ECD
STRAY_COUNT, STRAY_SHARE = 100, 1e-3  # fewer events than either, and no more than a tenth of all, are no reason for a larger sensor
FOCAL = (0.1, 100.0)  # sensor widths: focal lengths beyond are no lens, but another unit or a mistake
LARGEST = 10_000  # px: no event camera is wider
ECD_FORM = "one line of fx fy cx cy k1 k2 p1 p2 k3"
NUMBERS = ("fx", "fy", "cx", "cy")
YAML_KEYS = ("model", "width", "height", *NUMBERS, "distortion")


@dataclass(frozen=True)
class Lens:
    """What a calibration file says: fx, fy, cx, cy px; sensor (width, height) px where it says that too."""

    file: str
    numbers: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    model: str = "plumb_bob"
    sensor: tuple[int, int] | None = None

    def camera(self, sensor: tuple[int, int]) -> Camera:
        """The camera on a sensor of (width, height); a lens that cannot be there, or not be inverted, is a DataError."""
        (width, height), (fx, fy, cx, cy) = sensor, self.numbers
        try:
            camera = Camera((height, width), fx, fy, cx, cy, self.distortion, self.model)
            if not all(FOCAL[0] * width <= f <= FOCAL[1] * width for f in (fx, fy)):
                raise ValueError(
                    f"a focal length of {fx:g}, {fy:g} px is not within {FOCAL[0]:g} to {FOCAL[1]:g} widths of the {width} px sensor"
                )
            if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
                raise ValueError(f"the principal point ({cx:g}, {cy:g}) is outside the sensor of {width} x {height} pixels")
            camera.rays()
        except ValueError as error:
            remedy = f"calibrate again, or check the numbers ({ECD_FORM}) and the size (--sensor 240x180)"
            raise DataError(self.file, str(error), remedy) from error
        return camera


def checked_size(file: str, width: Any, height: Any) -> tuple[int, int]:
    """Width and height of a sensor, px, wherever they were told; DataError that names the wrong one."""
    wants = f"width and height are whole numbers of pixels, 1 to {LARGEST}, as in --sensor 240x180"
    sizes = {"width": _number(file, "width", width, wants), "height": _number(file, "height", height, wants)}
    for key, size in sizes.items():
        if not (size.is_integer() and 1 <= size <= LARGEST):
            raise DataError(file, f"a sensor of {width} x {height} pixels: {key} is {size:g}", wants)
    return int(sizes["width"]), int(sizes["height"])


def _number(file: str, key: str, value: Any, wants: str) -> float:
    """A number from YAML or HDF5; true and false are none."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(file, f"{key} is {reprlib.repr(value)}, not a number", wants) from error


def read_lens(file: Member) -> Lens:
    """A calibration file: the ECD's line of numbers, or YAML with model, width, height, fx, fy, cx, cy, distortion."""
    if isinstance(file, Path) and not file.is_file():
        problem = not_a_file(file, "calibration file")
        raise DataError(file, problem, f"give a file with {ECD_FORM}, or the word pinhole: --camera FILE")
    text = text_of(file)
    lines = text_lines(text)
    return _yaml_lens(file, text) if any(":" in line for _, line in lines) else _ecd_lens(file, lines)


def _ecd_lens(file: Member, lines: list[tuple[int, str]]) -> Lens:
    """fx fy cx cy, then nothing, or k1 k2 p1 p2, or k1 k2 p1 p2 k3."""
    words = [(number, word) for number, line in lines for word in line.split()]
    values = []
    for number, word in words:
        try:
            values.append(float(word))
        except ValueError as error:
            raise DataError(str(file), f"{word[:40]!r} is not a number", f"it wants {ECD_FORM}", f"line {number}") from error
    if len(values) not in (4, 8, 9):
        raise DataError(str(file), f"holds {len(values)} numbers", f"it wants {ECD_FORM}, of which k3, or all after cy, may be left out")
    fx, fy, cx, cy, *distortion = values
    return Lens(str(file), (fx, fy, cx, cy), tuple(distortion + [0.0] * (5 - len(distortion))))


def _yaml_lens(file: Member, text: str) -> Lens:
    """Our own form, of which model and distortion may be left out, or that of another tool (lensfiles.py)."""
    wants = f"it wants {', '.join(YAML_KEYS)} (model: {' or '.join(MODELS)})"
    try:
        found = yaml_of(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # the second: a date that is none; the third: nested a thousand deep
        raise DataError(str(file), f"is no YAML: {error}", wants) from error
    found = in_our_words(str(file), found)
    if not isinstance(found, dict) or not set(found) <= set(YAML_KEYS):
        raise DataError(str(file), f"holds {', '.join(map(str, found)) if isinstance(found, dict) else reprlib.repr(found)}", wants)
    lens = told_lens(str(file), found, wants)
    if not {"width", "height"} <= set(found):
        raise DataError(str(file), "width or height is missing", wants)
    return replace(lens, sensor=checked_size(str(file), found["width"], found["height"]))


def told_lens(file: str, found: Mapping[str, Any], wants: str) -> Lens:
    """The lens from named numbers; without model it is plumb_bob, without distortion there is none.  Its sensor is not looked at."""
    missing = [key for key in NUMBERS if key not in found]
    if missing:
        raise DataError(file, f"{missing[0]} is missing", wants)
    fx, fy, cx, cy = (_number(file, key, found[key], wants) for key in NUMBERS)
    model = str(found.get("model", "plumb_bob"))
    listed = found.get("distortion")
    if listed is None or listed == []:
        listed = [0.0] * MODELS.get(model, 0)
    if not isinstance(listed, list):
        raise DataError(file, f"distortion is {reprlib.repr(listed)}, not a list of numbers", wants)
    return Lens(file, (fx, fy, cx, cy), tuple(_number(file, "distortion", number, wants) for number in listed), model)


def guess_sensor(path: str, lens: Lens | None, events: Callable[[], Iterator[Events]]) -> tuple[int, int]:
    """Sensor (width, height) where no file tells it.  Reads all events once, a chunk at a time.

    Of the known sensors that hold all events but a stray few: the smallest with the lens's principal point near its middle, else
    the one with it nearest to its middle.  Nearest alone would take the ECD's 240 x 180, whose principal point is off, for 304 x 240.
    """
    count, covered, beyond = 0, (0, 0), np.zeros(len(SENSORS), np.int64)
    for chunk in events():
        count += len(chunk)
        covered = max(covered[0], int(chunk.x.max()) + 1), max(covered[1], int(chunk.y.max()) + 1)
        beyond += [np.count_nonzero((chunk.x >= width) | (chunk.y >= height)) for width, height in SENSORS]
    if not count:
        raise DataError(path, "holds no events", "record or copy it again")
    few = (beyond < max(STRAY_COUNT, STRAY_SHARE * count)) & (beyond <= count / 10)
    near = [i for i, sensor in enumerate(SENSORS) if few[i] and (lens is None or _off_centre(lens, sensor) <= OFF_CENTRE)]
    if near:
        width, height = SENSORS[near[0]]
        if beyond[near[0]]:
            text = f"{path}: the sensor is taken to be {width} x {height}, though {beyond[near[0]]} of {count} events lie beyond it"
            larger = f"{max(width, covered[0])}x{max(height, covered[1])}"
            warnings.warn(DataWarning(f"{text}; if it is larger, tell its size: --sensor {larger} or more"), stacklevel=2)
        return width, height
    fitting = [sensor for sensor, missed in zip(SENSORS, beyond, strict=True) if not missed]
    if lens is None or not fitting:
        problem = f"holds an event beyond every known sensor: the events cover {covered[0]} x {covered[1]} pixels"
        raise DataError(path, problem, f"give the sensor's true size, at least --sensor {covered[0]}x{covered[1]}")
    return min(fitting, key=lambda sensor: _off_centre(lens, sensor))


def _off_centre(lens: Lens, sensor: tuple[int, int]) -> float:
    """How far the principal point is from the middle, as a share of the sensor."""
    (_, _, cx, cy), (width, height) = lens.numbers, sensor
    return max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
