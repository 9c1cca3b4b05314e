"""Ground truth of a run: poses and velocities of the camera from the drives' encoders."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from torchcmax.rig.axis import Chain, quantum
from torchcmax.rig.clock import ClockModel
from torchcmax.rig.config import Axis, Rig
from torchcmax.rig.errors import Refused
from torchcmax.rig.record import write_whole

TRUTH, BY_DRIVES, TWIST, SAID = "groundtruth.txt", "groundtruth_driveclock.txt", "twist.txt", "truth.json"
SAMPLES, ORDER = 21, 3  # of the filter that velocities are read from
ENDED = "complete"  # the status of a run that ended normally


@dataclass(frozen=True)
class Encoded:
    """What the encoders told.  time [K] s of the drives' clock, at even steps | place [K, A] m, rad | status: how the run ended"""

    time: np.ndarray
    place: np.ndarray
    status: str
    simulated: bool
    repeatability: dict[str, float] | None = None  # as of `repeatability`


def write_truth(folder: Path, rig: Rig, encoded: Encoded, clock: ClockModel | None) -> dict[str, Any]:
    """Poses, velocities and what is known of them into the folder -> what truth.json says.

    groundtruth.txt, in the camera's clock, only where that clock is accepted and the run ended normally; an older one goes away.
    Refused where there are too few samples, which truth.json then says.
    """
    enough = len(encoded.time) >= SAMPLES
    known = enough and clock is not None and clock.accepted and encoded.status == ENDED
    said: dict[str, Any] = {
        "status": encoded.status,
        "simulated": encoded.simulated,
        "configuration": rig.digest,
        "truth": known,
        "sigma_x": {axis.name: sigma(axis) for axis in rig.axes},
        "sigma_t": clock.sigma_within(float(np.ptp(encoded.time)) / 2) if clock is not None and known else None,
        "clock": None if clock is None else told(clock),
        "repeatability": encoded.repeatability,
    }
    head = f"# configuration {rig.digest}{', simulated' if encoded.simulated else ''}; "
    (folder / TRUTH).unlink(missing_ok=True)  # while it is written anew, there is none
    time, clock_name = encoded.time, "the drives' clock"
    if enough:
        poses = Chain(rig).pose(encoded.place)
        write_whole(folder / BY_DRIVES, _poses(head + clock_name, time, poses))
        if clock is not None and known:
            time, clock_name = clock.camera(time), "the camera's clock"
        inner, v, omega = motion(rig, encoded)
        columns = "t vx vy vz wx wy wz, camera's frame, s, m/s and rad/s"
        write_whole(folder / TWIST, _lines(f"{head}{clock_name}; {columns}", time[inner], np.concatenate([v, omega], 1), ".9g"))
    write_whole(folder / SAID, json.dumps(said, indent=2) + "\n")
    if not enough:
        raise Refused(f"{folder}: {len(encoded.time)} samples of the encoders are too few for velocities, wanted are {SAMPLES}")
    if known:
        write_whole(folder / TRUTH, _poses(head + clock_name, time, poses))
    return said


def sigma(axis: Axis) -> float:
    """Standard deviation of a position, m or rad: rounding to the encoder's quantum, and the whole backlash."""
    return math.hypot(quantum(axis) / math.sqrt(12), axis.transmission.backlash)


def told(clock: ClockModel) -> dict[str, Any]:
    """A clock model as JSON: what is not known is null."""
    values = asdict(clock) | {"accepted": clock.accepted}
    return {name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in values.items()}


def _poses(head: str, time: np.ndarray, poses: np.ndarray) -> str:
    """Poses T_wc [K, 4, 4] as TUM."""
    rows = np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()], 1)
    return _lines(f"{head}; t tx ty tz qx qy qz qw, camera to world, s and m", time, rows, ".12f")


def motion(rig: Rig, encoded: Encoded) -> tuple[slice, np.ndarray, np.ndarray]:
    """Velocities in the camera's frame, from a cubic through the samples around each: which samples, v m/s and omega rad/s [M, 3].

    The ends, which lack samples on one side, are left out.
    """
    step = (encoded.time[-1] - encoded.time[0]) / (len(encoded.time) - 1)
    place, rate = (savgol_filter(encoded.place, SAMPLES, ORDER, deriv, step, axis=0) for deriv in (0, 1))
    inner = slice(SAMPLES // 2, -(SAMPLES // 2))
    return inner, *Chain(rig).twist(place[inner], rate[inner])


def repeatability(rig: Rig, place: np.ndarray, cycles: Sequence[tuple[int, int]]) -> dict[str, float] | None:
    """Of each axis, m or rad: the largest standard deviation, over the cycles, of where it was at the same time; None of a single one.

    place [K, A] | cycles: first and last sample of each
    """
    length = min((last - first for first, last in cycles), default=0)
    if len(cycles) < 2 or length < 1:
        return None
    again = np.stack([place[first : first + length] for first, _ in cycles])
    return {axis.name: float(spread) for axis, spread in zip(rig.axes, again.std(0, ddof=1).max(0), strict=True)}


def _lines(head: str, time: np.ndarray, rows: np.ndarray, form: str) -> str:
    lines = [" ".join([f"{t:.6f}", *(format(v, form) for v in row)]) for t, row in zip(time.tolist(), rows.tolist(), strict=True)]
    return "\n".join([head, *lines]) + "\n"
