"""How far tracks are from the recording's truth: as it looks while they come, and when all are there."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.score import Score, Similarity, errors, inside, rotation, score, similarity
from torchcmax.track import Tracks


@dataclass(frozen=True)
class Judged:
    """The score with the plane's angle | curves: errors at each time, µs | truth: at the poses' times, in their world and unit."""

    error: dict[str, Any]
    curves: dict[int, dict[str, float]]
    truth: Trajectory


class Judge:
    """The error against the recording's truth, where it has one: as it looks while the run goes on, and at the end."""

    def __init__(self, tracks: Tracks) -> None:
        self.truth, self.plane, self.options = tracks.recording.truth, tracks.recording.plane, tracks.options
        self.turning = self.options.slam.model == "rotation"
        self.first: Similarity | None = None

    def live(self, time: Tensor, pose: Pose, plane: Plane) -> list[dict[str, float]]:
        """Errors of the next poses [M] at times [M] µs, with the first of all laid on the truth; nothing where truth tells nothing.

        plane [1]: of the map; its distance from the first pose is as many metres as the truth's
        """
        truth, found = self.truth, [dict[str, float]() for _ in time]
        known = torch.zeros_like(time, dtype=torch.bool) if truth is None else (truth.time[0] <= time) & (time <= truth.time[-1])
        if truth is None or not known.any():
            return found
        there, pose = truth.at(time[known]), on_cpu(pose)[known]
        if self.first is None:
            self.first = self._laid(pose, there, plane)
        here = self.first @ pose
        turns = torch.rad2deg(so3.log(there.R.mT @ here.R).norm(dim=-1)).tolist()
        for i, turn, apart in zip(known.nonzero()[:, 0].tolist(), turns, (here.t - there.t).norm(dim=-1).tolist(), strict=True):
            found[i]["error/live_orientation_deg"] = turn
            if self.plane is not None and not self.turning:
                found[i]["error/live_percent_of_distance"] = 100 * apart / self.plane.distance[0].item()
        return found

    def _laid(self, pose: Pose, there: Pose, plane: Plane) -> Similarity:
        """The first pose on the truth's."""
        scale = torch.ones((), dtype=torch.float64)
        if self.plane is not None:
            scale = self.plane.seen_from(there).distance[0] / plane.seen_from(pose).distance[0]
        R = there.R[0] @ pose.R[0].mT
        return Similarity(R, there.t[0] - scale * (R @ pose.t[0]), scale)

    def final(self, trajectory: Trajectory, normal: Tensor) -> Judged | None:
        """All of it after the best similarity; None where truth tells nothing.

        normal [1, 3]: of the plane, in the trajectory's world
        """
        start, end = (None if t is None else round(t * 1e6) for t in (self.options.begin, self.options.end))
        if self.truth is None:
            return None
        try:
            found: Score = score(trajectory, self.truth, self.plane, start, end, self.turning)
            kept = inside(trajectory, self.truth, start, end)
        except ValueError:  # the truth is of another time
            return None
        there = self.truth.at(kept.time)
        best = (rotation if self.turning else similarity)(kept.pose, there)
        position, orientation = errors(kept, self.truth, best)
        curves = {t: {"error/final_orientation_deg": value} for t, value in zip(kept.time.tolist(), orientation.tolist(), strict=True)}
        angle = None
        if self.plane is not None and not self.turning:
            for curve, value in zip(curves.values(), (100 * position / self.plane.distance[0]).tolist(), strict=True):
                curve["error/final_percent_of_distance"] = value
            true, own = self.plane.normal[0], best.R @ normal[0].cpu().double()
            angle = float(torch.rad2deg(torch.atan2(torch.linalg.cross(own, true).norm(), own @ true)))
        laid = best.back(there)
        truth = Trajectory(kept.time, Pose(laid.R, torch.zeros_like(laid.t)) if self.turning else laid)
        return Judged(asdict(found) | {"plane_deg": angle}, curves, truth)


def on_cpu(pose: Pose) -> Pose:
    """Poses in float64, as the truth is."""
    return Pose(pose.R.detach().cpu().double(), pose.t.detach().cpu().double())
