"""Ground truth from wherever it stands: a file of poses, or a recording that has its own."""

from __future__ import annotations

import re
from pathlib import Path

from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.io.calibration import LARGEST
from torchcmax.io.errors import DataError
from torchcmax.io.member import not_a_file, reading
from torchcmax.io.opening import OpenOptions, open
from torchcmax.io.trajectory import EUROC, TUM, read_euroc, read_plane, read_trajectory

HEAD = 1 << 16  # bytes in which a first line of poses ends
ANY = OpenOptions(camera="pinhole", sensor=(LARGEST, LARGEST))  # neither calibration nor events are looked at
REMEDY = f"give --truth FILE: lines {TUM}, EuRoC's csv ({EUROC}), or a recording with ground truth"


def read_truth(path: Path | str) -> tuple[Trajectory, Plane | None]:
    """T_wc and, where it is known, the plane [1] of the same world, in metres.

    path: text as of the Event Camera Dataset and TUM, EuRoC's csv, each with plane.txt beside it or without; or a recording
    """
    path = Path(path)
    form = _form(path) if path.is_file() else None
    if form is None:
        if not path.exists():
            raise DataError(path, not_a_file(path, "file or folder"), REMEDY)
        recording = open(path, ANY)
        if recording.truth is None:
            raise DataError(path, "has no ground truth", REMEDY)
        return recording.truth, recording.plane
    plane = path.parent / "plane.txt"
    return (read_euroc if form == "euroc" else read_trajectory)(path), read_plane(plane) if plane.is_file() else None


def _form(path: Path) -> str | None:
    """euroc, tum, or None: by the first line of numbers, eight or more."""
    with reading(path), path.open("rb") as stream:
        head = stream.read(HEAD)
    if b"\0" in head:
        return None
    for line in head.decode("utf-8-sig", "replace").split("\n"):
        words = [word for word in re.split(r"[,\s]+", line.strip()) if word]
        if not words or line.lstrip().startswith("#"):
            continue
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            continue  # names of columns
        if len(numbers) < 8:
            return None
        return "euroc" if "," in line else "tum"
    return None
