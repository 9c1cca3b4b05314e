"""The tables that `track` writes: a line for each window, and one for each keyframe."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.pose import Pose
from torchcmax.core.state import State
from torchcmax.folder import COLUMNS, WHOLE, cell
from torchcmax.slam.system import Placement, Track
from torchcmax.slam.tracker import World

POSE = "tx ty tz qx qy qz qw".split()
SIGNS = "overlap strength supported doubt weakest weakest_share".split()
TABLE = (*COLUMNS, "time_us", *POSE, "status", "reason", *SIGNS, "map", "keyframe")
KEYFRAMES = ("number", "time_us", *POSE, *(f"{name}_{axis}" for name in ("omega", "v") for axis in "xyz"), "events")
ROUND = WHOLE | {"time_us", "map", "keyframe", "number"}
Row = dict[str, Any]


def row(track: Track) -> Row:
    """One line of windows.csv, in TABLE, with the pose as it is now but for its rotation; nan where there is no such number."""
    window, state, signs = track.window, track.state, track.signs
    parts = state.motion.omega, state.motion.velocity, track.normal, state.pose.t
    numbers = torch.cat([part.detach().double() for part in parts], -1)[0].tolist()
    start = int(window.start[0])
    gain = track.contrast / track.contrast_zero if track.contrast_zero else math.nan
    values = (
        *(track.index, start, start + round(float(window.duration[0]) * 1e6), int((window.polarity != 0).sum())),
        *(track.contrast_zero, track.contrast, gain, *numbers[:9], track.evaluations, track.converged),
        *(track.time, *numbers[9:], math.nan, math.nan, math.nan, math.nan),
        *(track.status, track.reason, signs.overlap, signs.strength, signs.supported, signs.doubt, signs.weakest, signs.share),
        *(track.map.number, track.keyframe),
    )
    return dict(zip(TABLE, values, strict=True))


def set_poses(lines: Sequence[Row], pose: Pose) -> None:
    """Poses [M] into as many lines."""
    for line, numbers in zip(lines, pose_row(pose).tolist(), strict=True):
        line.update(zip(POSE, numbers, strict=True))


def set_placements(lines: Sequence[Row], placements: Sequence[Placement]) -> None:
    """Where each window belongs in the end: nowhere, for a lost one, or in the world of its map."""
    placed = [(line, p) for line, p in zip(lines, placements, strict=False) if p.site is not None]
    for line, p in zip(lines, placements, strict=False):
        line.update(dict.fromkeys((*POSE, "map"), math.nan), status=p.status, keyframe=p.keyframe)
        if p.site is not None:
            line.update(map=p.site.map.number)
    if placed:
        pose = State.join([p.there() for _, p in placed]).pose
        set_poses([line for line, _ in placed], Pose(pose.R.cpu(), pose.t.cpu()))


def pose_row(pose: Pose) -> Tensor:
    """Poses [M] as POSE: [M, 7] float64."""
    return torch.cat([pose.t.double(), so3.to_quaternion(pose.R.double())], -1)


def cells(line: Row) -> list[str]:
    """A line of a table as text."""
    return [value if isinstance(value, str) else cell(value, name in ROUND) for name, value in line.items()]


def keyframe_rows(m: World) -> list[Row]:
    """Lines of keyframes.csv, as the keyframes are now."""
    state = State.join([keyframe.state for keyframe in m.keyframes])
    numbers = torch.cat([pose_row(state.pose), state.motion.omega.double(), state.motion.velocity.double()], -1).tolist()
    return [
        dict(zip(KEYFRAMES, (number, keyframe.time, *line, int((keyframe.ink.weight != 0).sum())), strict=True))
        for number, (keyframe, line) in enumerate(zip(m.keyframes, numbers, strict=True))
    ]


def write_table(name: Path, columns: tuple[str, ...], lines: list[Row]) -> None:
    """A table as CSV."""
    with name.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(cells(line) for line in lines)
