"""A smooth path through the poses of a file, for a simulated camera to follow."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.pose import Motion, Pose, Trajectory


@dataclass(frozen=True)
class Path:
    """Cubic from pose to pose, its velocity without jumps.  Before the first pose and after the last it goes on as it is there.

    start: µs of the first pose | time [M] s since then | pose [M] | rate [M, 6]: of position, m/s of the world, and the camera's own rad/s
    """

    start: int
    time: Tensor
    pose: Pose
    rate: Tensor

    @classmethod
    def through(cls, trajectory: Trajectory) -> Path:
        """The path through all poses."""
        start, pose = int(trajectory.time[0]), trajectory.pose
        time = (trajectory.time - start).double() * 1e-6
        length = time.diff()[:, None]
        slope = _between(pose[:-1], pose[1:]) / length  # of each stretch
        inner = (slope[:-1] * length[1:] + slope[1:] * length[:-1]) / (length[:-1] + length[1:])  # of the parabola through three poses
        return cls(start, time, pose, torch.cat([slope[:1], inner, slope[-1:]]))

    def at(self, time: Tensor) -> tuple[Pose, Motion]:
        """T_wc, m, and velocity in the camera's frame: time [K] s since the first pose -> [K], [K]."""
        inside = time.clamp(self.time[0], self.time[-1])
        i = (torch.searchsorted(self.time, inside, right=True) - 1).clamp(0, len(self.time) - 2)
        before, length = self.pose[i], (self.time[i + 1] - self.time[i])[:, None]
        step, first, last = _between(before, self.pose[i + 1]), self.rate[i], self.rate[i + 1].clone()
        last[:, 3:] = torch.linalg.solve(so3.right_jacobian(step[:, 3:]), last[:, 3:])  # of the rotation vector from the pose before
        shift, rate = _hermite((inside - self.time[i])[:, None] / length, length, step, first, last)
        turn = so3.exp(shift[:, 3:])
        there = Pose(before.R @ turn, before.t + shift[:, :3])
        omega, beyond = (so3.right_jacobian(shift[:, 3:]) @ rate[:, 3:, None])[..., 0], (time - inside)[:, None]
        there = Pose(there.R @ so3.exp(omega * beyond), there.t + rate[:, :3] * beyond)
        return there, Motion(omega, (there.R.mT @ rate[:, :3, None])[..., 0])


def _between(before: Pose, after: Pose) -> Tensor:
    """How far, in the world, and by which rotation vector: [M], [M] -> [M, 6]."""
    return torch.cat([after.t - before.t, so3.log(before.R.mT @ after.R)], -1)


def _hermite(u: Tensor, length: Tensor, step: Tensor, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """The cubic from 0 to `step` with these rates at its ends, and its own: u 0..1, length s [K, 1] | [K, 6] -> [K, 6], [K, 6]."""
    a, b = length * first - step, length * last - step  # by how much its ends are faster than the straight line
    value = step * u + u * (1 - u) * (a * (1 - u) - b * u)
    rate = step + (1 - 2 * u) * (a * (1 - u) - b * u) - u * (1 - u) * (a + b)
    return value, rate / length
