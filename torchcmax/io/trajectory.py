"""Text files of poses (TUM), planes and velocities."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.io.errors import DataError
from torchcmax.io.member import Member, text_lines

TUM = "t tx ty tz qx qy qz qw"
VELOCITY = "t[s]  v_x v_y v_z [m/s]  w_x w_y w_z [rad/s]   (body frame = camera frame)"
PLANE = "nx ny nz d   with n.X + d = 0 in the world frame, n unit and towards the camera, d > 0"


def read_trajectory(file: Member) -> Trajectory:
    """T_wc from lines `t tx ty tz qx qy qz qw`, t in seconds -> Trajectory in int64 µs and float64, at least two poses."""
    rows = _rows(file, 8, f"a line is {TUM}")
    if len(rows) < 2:
        raise DataError(str(file), f"holds {len(rows)} poses", f"a trajectory wants at least 2 lines of {TUM}")
    table = np.array([values for _, values in rows])
    time = np.rint(table[:, 0] * 1e6).astype(np.int64)
    length = np.linalg.norm(table[:, 4:], axis=1)
    lines = [number for number, _ in rows]
    _refuse(file, lines, abs(length - 1) > 0.01, "qx qy qz qw is no unit quaternion", f"a line is {TUM}, the quaternion with qw last")
    backward = np.concatenate([[False], time[1:] <= time[:-1]])
    _refuse(file, lines, backward, "time does not increase", "sort the lines by time and keep one per time: sort -n -u -k1,1")
    pose = Pose(so3.from_quaternion(torch.from_numpy(table[:, 4:])), torch.from_numpy(table[:, 1:4].copy()))
    return Trajectory(torch.from_numpy(time), pose)


def _refuse(file: Member, lines: list[int], wrong: np.ndarray, problem: str, remedy: str) -> None:
    """DataError at the first line that is wrong, if one is."""
    if wrong.any():
        raise DataError(str(file), problem, remedy, f"line {lines[int(wrong.argmax())]}")


def _rows(file: Member, columns: int, remedy: str) -> list[tuple[int, list[float]]]:
    """Lines of numbers with their line numbers."""
    rows = []
    for number, line in text_lines(file):
        words = line.split()
        try:
            values = [float(word) for word in words]
        except ValueError as error:
            raise DataError(str(file), f"not all are numbers: {line[:80]!r}", remedy, f"line {number}") from error
        if len(values) != columns:
            raise DataError(str(file), f"{len(values)} columns instead of {columns}: {line[:80]!r}", remedy, f"line {number}")
        if not np.isfinite(values).all() or abs(values[0]) > 9e12:
            raise DataError(str(file), f"a number out of all range: {line[:80]!r}", remedy, f"line {number}")
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
    rows = _rows(file, 4, f"it wants one line: {PLANE}")
    if len(rows) != 1:
        raise DataError(str(file), f"holds {len(rows)} lines of numbers", f"it wants one line: {PLANE}")
    number, values = rows[0]
    if abs(np.linalg.norm(values[:3]) - 1) > 1e-3 or values[3] <= 0:
        raise DataError(str(file), f"{values} is no unit normal with a positive distance", f"it wants {PLANE}", f"line {number}")
    table = torch.tensor([values], dtype=torch.float64)
    return Plane(table[:, :3], table[:, 3])


def write_plane(path: Path, plane: Plane) -> None:
    """The first plane [B] as text, metres or plane distances as it is."""
    numbers = [*plane.normal[0].tolist(), plane.distance[0].item()]
    _write_text(path, f"# {PLANE}\n{' '.join(repr(number) for number in numbers)}\n")
