"""Text files of poses (TUM, EuRoC), planes and velocities."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.io.errors import DataError
from torchcmax.io.events import LATEST
from torchcmax.io.member import LARGE, SMALL, Member, text_lines, text_of

TUM = "t tx ty tz qx qy qz qw"
EUROC = "t[ns],px,py,pz,qw,qx,qy,qz, and more that is not read"
VELOCITY = "t[s]  v_x v_y v_z [m/s]  w_x w_y w_z [rad/s]   (body frame = camera frame)"
FARTHEST = 1e100  # what is larger overflows when squared
PLANE = "nx ny nz d   with n.X + d = 0 in the world frame, n unit and towards the camera, d > 0"


def read_trajectory(file: Member) -> Trajectory:
    """T_wc from lines `t tx ty tz qx qy qz qw`, t in seconds -> Trajectory in int64 µs and float64, at least two poses."""
    rows = _rows(file, 8, f"a line is {TUM}", LARGE)
    table = np.array([values for _, values in rows]).reshape(-1, 8)
    return checked_trajectory(str(file), table[:, 0] * 1e6, table[:, 1:4], table[:, 4:], lambda i: f"line {rows[i][0]}")


def read_euroc(file: Member) -> Trajectory:
    """Poses from EuRoC's csv: lines `t[ns],px,py,pz,qw,qx,qy,qz,...` -> Trajectory as of `read_trajectory`.

    Of state_groundtruth_estimate0 (17 columns) or a motion capture system (8), Burri et al., IJRR 2016.  Whole ns are rounded to µs.
    """
    lines = text_lines(text_of(file, LARGE))
    if lines and not lines[0][1][:1].isdigit():
        lines = lines[1:]  # the names of the columns, where no # marks them
    time, rows = [], []
    for number, line in lines:
        words = line.split(",")
        try:
            nano = Decimal(words[0].strip())
            rows.append([float(word) for word in words[1:8]])
        except (ValueError, ArithmeticError) as error:
            raise DataError(str(file), f"not all are numbers: {line[:80]!r}", f"a line is {EUROC}", f"line {number}") from error
        known = nano.is_finite() and -1000 * LATEST < nano < 1000 * LATEST
        if known and nano != nano.to_integral_value():
            remedy = f"a line is {EUROC}; a table in seconds with qw last wants blanks between its columns: tr ',' ' '"
            raise DataError(str(file), f"its time is no whole number of nanoseconds: {line[:80]!r}", remedy, f"line {number}")
        time.append(round(nano / 1000) if known else LATEST)  # which is refused below
        if len(rows[-1]) < 7:
            raise DataError(str(file), f"{len(words)} columns: {line[:80]!r}", f"a line is {EUROC}", f"line {number}")
    table = np.array(rows).reshape(-1, 7)
    return checked_trajectory(str(file), np.array(time, np.int64), table[:, :3], table[:, [4, 5, 6, 3]], lambda i: f"line {lines[i][0]}")


def checked_trajectory(file: str, time: np.ndarray, p: np.ndarray, q: np.ndarray, place: Callable[[int], str]) -> Trajectory:
    """Poses from any file: time [M] µs | p [M, 3] m | q [M, 4], x y z w -> Trajectory; place: pose, from 0 -> where it stands."""
    wants = f"a pose is {TUM}, the quaternion of length 1 with qw last"

    def refuse(wrong: np.ndarray, problem: str, remedy: str) -> None:
        if wrong.any():
            raise DataError(file, problem, remedy, place(int(wrong.argmax())))

    if time.ndim != 1 or p.shape != (len(time), 3) or q.shape != (len(time), 4):
        raise DataError(file, f"has poses of shapes t {time.shape}, p {p.shape}, q {q.shape}", f"{wants}: shapes (M,), (M, 3), (M, 4)")
    if len(time) < 2:
        raise DataError(file, f"holds {len(time)} poses", f"a trajectory wants at least 2; {wants}")
    known = (time > -LATEST) & (time < LATEST) & (abs(p) < FARTHEST).all(1) & np.isfinite(q).all(1)
    refuse(~known, "a number out of all range", wants)
    refuse(abs(np.linalg.norm(q, axis=1) - 1) > 0.01, "qx qy qz qw is no unit quaternion", wants)
    micro = (time if time.dtype.kind in "iu" else np.rint(time)).astype(np.int64)
    backward = np.concatenate([[False], micro[1:] <= micro[:-1]])
    refuse(backward, "time does not increase", "sort the poses by time and keep one per time; lines of text: sort -n -u -k1,1")
    position, quaternion = (torch.from_numpy(numbers.astype(np.float64)) for numbers in (p, q))
    return Trajectory(torch.from_numpy(micro), Pose(so3.from_quaternion(quaternion), position))


def _rows(file: Member, columns: int, remedy: str, most: int) -> list[tuple[int, list[float]]]:
    """Lines of numbers with their line numbers, from a file of at most so many bytes."""
    rows = []
    for number, line in text_lines(text_of(file, most)):
        words = line.split()
        try:
            values = [float(word) for word in words]
        except ValueError as error:
            raise DataError(str(file), f"not all are numbers: {line[:80]!r}", remedy, f"line {number}") from error
        if len(values) != columns:
            raise DataError(str(file), f"{len(values)} columns instead of {columns}: {line[:80]!r}", remedy, f"line {number}")
        rows.append((number, values))
    return rows


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Poses as TUM text, time with all its microseconds: units of t as they are."""
    rotation = so3.to_quaternion(trajectory.pose.R.double())
    _write(path, f"# {TUM}", trajectory.time, torch.cat([trajectory.pose.t.double(), rotation], -1), lambda value: f"{value:.12f}")


def write_velocity(path: Path, time: Tensor, motion: Motion) -> None:
    """Velocities in the camera frame: time [M] µs | motion [M], in m/s and rad/s."""
    _write(path, f"# {VELOCITY}", time, torch.cat([motion.velocity, motion.omega], -1).double(), lambda value: f"{value:.9g}")


def _write(path: Path, header: str, time: Tensor, values: Tensor, form: Callable[[float], str]) -> None:
    """Lines of a time, µs -> s with six decimals and no rounding, and numbers."""
    lines = [header]
    for t, row in zip(time.tolist(), values.tolist(), strict=True):
        sign, (seconds, micro) = "-" if t < 0 else "", divmod(abs(t), 1_000_000)
        lines.append(" ".join([f"{sign}{seconds}.{micro:06d}", *map(form, row)]))
    _write_text(path, "\n".join(lines) + "\n")


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise DataError(path, f"cannot be written: {error.strerror}", "choose another folder, or make room on the disk") from error


def read_plane(file: Member) -> Plane:
    """The plane n . x + d = 0 of the world from a line `nx ny nz d` -> Plane [1], float64, metres."""
    rows = _rows(file, 4, f"it wants one line: {PLANE}", SMALL)
    if len(rows) != 1:
        raise DataError(str(file), f"holds {len(rows)} lines of numbers", f"it wants one line: {PLANE}")
    number, values = rows[0]
    return checked_plane(str(file), np.array(values), f"line {number}")


def checked_plane(file: str, numbers: np.ndarray, place: str) -> Plane:
    """The plane from any file: numbers [4], nx ny nz d -> Plane [1], float64, metres."""
    known = numbers.shape == (4,) and np.isfinite(numbers).all()
    if not known or abs(np.linalg.norm(numbers[:3]) - 1) > 1e-3 or numbers[3] <= 0:
        raise DataError(file, f"{numbers.tolist()} is no unit normal with a positive distance", f"it wants {PLANE}", place)
    table = torch.from_numpy(numbers.astype(np.float64))[None]
    return Plane(table[:, :3], table[:, 3])


def write_plane(path: Path, plane: Plane) -> None:
    """The first plane [B] as text, metres or plane distances as it is."""
    numbers = [*plane.normal[0].tolist(), plane.distance[0].item()]
    _write_text(path, f"# {PLANE}\n{' '.join(repr(number) for number in numbers)}\n")
