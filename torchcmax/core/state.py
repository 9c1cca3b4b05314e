"""Where a camera is before a plane, how it moves, and how its events meet the map on that plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.warp import TERMS, polynomial

SIZE = 12  # numbers of a state: turn, shift, angular velocity, velocity
CLOSEST = 0.02  # plane distances that a camera can come near its plane


@dataclass(frozen=True)
class State:
    """The middle of a window.  pose T_wc [B] | motion [B] in the camera's frame, rad/s and distances/s of the world's plane."""

    pose: Pose
    motion: Motion

    def __getitem__(self, index: Any) -> State:
        return State(self.pose[index], Motion(self.motion.omega[index], self.motion.velocity[index]))

    @classmethod
    def join(cls, parts: Sequence[State]) -> State:
        """Several cameras together."""
        R, t, omega, velocity = zip(*((s.pose.R, s.pose.t, s.motion.omega, s.motion.velocity) for s in parts), strict=True)
        return cls(Pose(torch.cat(R), torch.cat(t)), Motion(torch.cat(omega), torch.cat(velocity)))

    def moved(self, p: Tensor) -> State:
        """A small step p [B, 12] in the camera's frame: turn rad, shift distances, change of angular velocity and velocity."""
        turn, shift, spin, push = p.split(3, -1)
        pose = self.pose @ Pose(so3.exp(turn), shift)
        return State(pose, Motion(self.motion.omega + spin, self.motion.velocity + push))

    def step_to(self, other: State) -> Tensor:
        """The p of `moved` that leads to another state: [B, 12]."""
        between = self.pose.inverse() @ other.pose
        rates = other.motion.omega - self.motion.omega, other.motion.velocity - self.motion.velocity
        return torch.cat([so3.log(between.R), between.t, *rates], -1)

    def later(self, dt: Tensor) -> State:
        """dt [B] s on with constant velocity, eq. (2.15), (2.16), which is constant in the world and turns in the camera's frame."""
        step = self.motion.at(dt[:, None])[:, 0]
        velocity = (step.R.mT @ self.motion.velocity[..., None])[..., 0]
        return State(self.pose @ step, Motion(self.motion.omega, velocity))

    def stepping(self, dt: Tensor) -> Tensor:
        """How a small step now is a small step dt [B] s later: F [B, 12, 12] with `later` moved by F p for `moved` by p.

        To first order in p, as eq. (A.8).
        """
        back = so3.exp(-self.motion.omega * dt[:, None])
        gain = dt[:, None, None]
        F = torch.zeros(len(dt), SIZE, SIZE, dtype=back.dtype, device=back.device)
        F[:, :3, :3] = back
        F[:, :3, 6:9] = so3.right_jacobian(self.motion.omega * dt[:, None]) * gain
        F[:, 3:6, :3] = -back @ so3.hat(self.motion.velocity) * gain
        F[:, 3:6, 3:6] = back
        F[:, 3:6, 9:] = back * gain
        F[:, 6:9, 6:9] = torch.eye(3, dtype=back.dtype, device=back.device)
        F[:, 9:, 9:] = back
        F[:, 9:, 6:9] = so3.hat((back @ self.motion.velocity[..., None])[..., 0]) @ F[:, :3, 6:9]
        return F

    def seen(self, plane: Plane) -> Plane:
        """The world's plane as the camera sees it."""
        found = plane.seen_from(self.pose)
        return Plane(found.normal, found.distance.clamp_min(CLOSEST))

    def placement(self, plane: Plane, view: Tensor | None = None) -> Tensor:
        """Rays of the camera to rays of the world's origin that meet the plane in the same point: M [B, 3, 3].

        X_w = λ R r + t with λ = d_c / (-n_c . r), so X_w ~ (d_c R - t n_c^T) r.
        view [B, 3, 3]: a turn after it, as `Plane.facing`, (2.13).
        """
        there = self.seen(plane)
        M = there.distance[:, None, None] * self.pose.R - self.pose.t[:, :, None] * there.normal[:, None]
        return M if view is None else view @ M

    def homography(self, plane: Plane, seconds: Tensor, view: Tensor | None = None) -> Tensor:
        """Events of a window that lasts `seconds` [B] to rays of the world's origin: H_k [B, K, 3, 3], s from the window's middle."""
        there, span = self.seen(plane), seconds[:, None]
        shift = self.motion.velocity * span / there.distance[:, None]
        return self.placement(plane, view)[:, None] @ polynomial(self.motion.omega * span, shift, there.normal, TERMS)
