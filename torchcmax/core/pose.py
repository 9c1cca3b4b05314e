"""Poses of a camera, the constant-velocity motion between them, and a trajectory of them in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchcmax.core import so3


@dataclass(frozen=True)
class Pose:
    """Camera pose: x_reference = R @ x_camera + t.  R [..., 3, 3] | t [..., 3] in plane distances (or metres, for ground truth)."""

    R: Tensor
    t: Tensor

    def __matmul__(self, other: Pose) -> Pose:
        """First `other`, then this one: (R1 R2, R1 t2 + t1)."""
        return Pose(self.R @ other.R, (self.R @ other.t[..., None])[..., 0] + self.t)

    def inverse(self) -> Pose:
        """The reference seen from the camera."""
        R = self.R.mT
        return Pose(R, -(R @ self.t[..., None])[..., 0])

    def __getitem__(self, index: Any) -> Pose:
        return Pose(self.R[index], self.t[index])


@dataclass(frozen=True)
class Motion:
    """Constant velocity within a window, in the frame of its reference camera.

    omega [B, 3] rad/s | velocity [B, 3] plane distances / s
    """

    omega: Tensor
    velocity: Tensor

    def at(self, dt: Tensor) -> Pose:
        """Pose after dt seconds, eq. (2.7), (2.8): dt [B, N] -> Pose [B, N]."""
        return Pose(so3.exp(self.omega[:, None] * dt[..., None]), self.velocity[:, None] * dt[..., None])

    def following(self, pose: Pose, dt: Tensor) -> Pose:
        """The pose dt seconds on, eq. (2.15), (2.16): pose [B] | dt [B] s -> Pose [B]."""
        return pose @ self.at(dt[:, None])[:, 0]


@dataclass(frozen=True)
class Trajectory:
    """Poses T_wc at times.  time [M] int64 µs, increasing | pose [M], float64."""

    time: Tensor
    pose: Pose

    def __post_init__(self) -> None:
        if len(self.time) < 2:
            raise ValueError(f"a trajectory wants at least two poses, got {len(self.time)}")

    def __len__(self) -> int:
        return len(self.time)

    def _bracket(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Index of the pose before each time, and the time's place between that pose and the next, 0..1."""
        outside = (time < self.time[0]) | (time > self.time[-1])
        if outside.any():
            first, last = self.time[0].item(), self.time[-1].item()
            raise ValueError(f"the trajectory covers {first}..{last} us, asked for {time[outside][0].item()} us")
        i = (torch.searchsorted(self.time, time, right=True) - 1).clamp(0, len(self) - 2)
        return i, (time - self.time[i]).double() / (self.time[i + 1] - self.time[i])

    def at(self, time: Tensor) -> Pose:
        """Poses between the given ones: on the straight line, and at constant angular velocity.  time [B] µs -> Pose [B]."""
        i, a = self._bracket(time)
        before, after = self.pose[i], self.pose[i + 1]
        turn = so3.exp(a[:, None] * so3.log(before.R.mT @ after.R))
        return Pose(before.R @ turn, torch.lerp(before.t, after.t, a[:, None]))

    def motion(self, start: Tensor, duration: Tensor) -> Motion:
        """Mean velocity over windows, in the camera frame at their start: start [B] µs | duration [B] s -> Motion [B], units of t."""
        end = start + (duration * 1e6).round().long()
        step = self.at(start).inverse() @ self.at(end)
        seconds = (end - start).clamp_min(1).double()[:, None] * 1e-6  # a window without duration has no motion, and no nan
        return Motion(so3.log(step.R) / seconds, step.t / seconds)
