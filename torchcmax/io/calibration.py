"""Calibration files and sensor sizes -> Camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from torchcmax.core.camera import MODELS, Camera
from torchcmax.io.errors import DataError
from torchcmax.io.member import Member, text_lines
from torchcmax.io.recording import Events

SENSORS = ((128, 128), (240, 180), (304, 240), (346, 260), (480, 360), (640, 480), (1280, 720))  # width, height px, smallest first
OFF_CENTRE = 0.15  # of the sensor: how far from the middle a principal point is believed to be; 0.12 in the ECD
LARGEST = 10_000  # px: no event camera is wider
ECD_FORM = "one line of fx fy cx cy k1 k2 p1 p2 k3"
YAML_KEYS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")


@dataclass(frozen=True)
class Lens:
    """What a calibration file says: fx, fy, cx, cy px; sensor (width, height) px where it says that too."""

    file: str
    numbers: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    model: str = "plumb_bob"
    sensor: tuple[int, int] | None = None

    def camera(self, sensor: tuple[int, int]) -> Camera:
        """The camera on a sensor of (width, height); a lens that cannot be inverted there is a DataError."""
        width, height = _believable(self.file, sensor)
        fx, fy, cx, cy = self.numbers
        try:
            camera = Camera((height, width), fx, fy, cx, cy, self.distortion, self.model)
            camera.rays()
        except ValueError as error:
            raise DataError(
                self.file, str(error), f"calibrate again, or check the numbers ({ECD_FORM}) and the size (--sensor W H)"
            ) from error
        return camera


def pinhole(file: str, sensor: tuple[int, int]) -> Camera:
    """A stand-in where no calibration is known, on a sensor of (width, height) px."""
    width, height = _believable(file, sensor)
    return Camera.pinhole((height, width))


def _believable(file: str, sensor: tuple[int, int]) -> tuple[int, int]:
    if not all(1 <= side <= LARGEST for side in sensor):
        raise DataError(file, f"a sensor of {sensor[0]} x {sensor[1]} pixels", f"give its true size: --sensor W H, each 1 to {LARGEST}")
    return sensor


def read_lens(file: Member) -> Lens:
    """A calibration file: the ECD's line of numbers, or YAML with model, width, height, fx, fy, cx, cy, distortion."""
    if isinstance(file, Path) and not file.is_file():
        raise DataError(file, "there is no such calibration file", f"give a file with {ECD_FORM}, or the word pinhole: --camera FILE")
    lines = text_lines(file)
    return _yaml_lens(file, lines) if any(":" in line for _, line in lines) else _ecd_lens(file, lines)


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


def _yaml_lens(file: Member, lines: list[tuple[int, str]]) -> Lens:
    """Our own form; distortion may be left out for none."""
    wants = f"it wants {', '.join(YAML_KEYS)} (model: {' or '.join(MODELS)})"
    with file.open("r", encoding="utf-8", errors="backslashreplace") as stream:
        text = stream.read()
    try:
        found = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise DataError(str(file), f"is no YAML: {error}", wants) from error
    if not isinstance(found, dict) or not set(found) <= set(YAML_KEYS):
        raise DataError(str(file), f"holds {', '.join(map(str, found)) if isinstance(found, dict) else found}", wants)
    try:
        fx, fy, cx, cy = (float(found[key]) for key in ("fx", "fy", "cx", "cy"))
        model = str(found.get("model", "plumb_bob"))
        distortion = tuple(float(number) for number in found.get("distortion") or [0.0] * MODELS.get(model, 0))
        sensor = int(found["width"]), int(found["height"])
    except KeyError as error:
        raise DataError(str(file), f"{error.args[0]} is missing", wants) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(str(file), f"something is not a number: {error}", wants) from error
    return Lens(str(file), (fx, fy, cx, cy), distortion, model, sensor)


def guess_sensor(path: str, lens: Lens | None, events: Callable[[], Iterator[Events]]) -> tuple[int, int]:
    """Sensor (width, height) where no file tells it.  Reads all events once, a chunk at a time, for their largest coordinates.

    Of the known sensors that hold every event: the smallest with the lens's principal point near its middle, else the one
    with it nearest to its middle.  Nearest alone would take the ECD's 240 x 180, whose principal point is off, for 304 x 240.
    """
    width = height = 0
    for chunk in events():
        width, height = max(width, int(chunk.x.max()) + 1), max(height, int(chunk.y.max()) + 1)
    if not width:
        raise DataError(path, "holds no events", "record or copy it again")
    fitting = [sensor for sensor in SENSORS if sensor[0] >= width and sensor[1] >= height]
    if not fitting:
        problem = f"holds an event beyond every known sensor: the events cover {width} x {height} pixels"
        raise DataError(path, problem, "give the sensor's true size: --sensor W H")
    if lens is None:
        return fitting[0]
    near = [sensor for sensor in fitting if _off_centre(lens, sensor) <= OFF_CENTRE]
    return near[0] if near else min(fitting, key=lambda sensor: _off_centre(lens, sensor))


def _off_centre(lens: Lens, sensor: tuple[int, int]) -> float:
    """How far the principal point is from the middle, as a share of the sensor."""
    (_, _, cx, cy), (width, height) = lens.numbers, sensor
    return max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
