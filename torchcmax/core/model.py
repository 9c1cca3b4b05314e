"""Motion models: how a few parameters become the motion of a window, and its polynomial homography."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.warp import TERMS, polynomial

CLOSEST = 0.02  # plane distances that a camera can come near its plane; nearer is nonsense that the guard punishes


@dataclass(frozen=True)
class Displacement:
    """What the camera does in one window, in the frame of its reference camera, before a plane at distance one.

    turn [A, 3] rad per window | shift [A, 3] plane distances per window | normal [A, 3], unit, towards the camera
    """

    turn: Tensor
    shift: Tensor
    normal: Tensor

    def seen_at(self, phase: float) -> Displacement:
        """The same motion in the frame of the camera at another time, a share of the window after the reference.

        The velocity is constant in one frame and so in the other; the plane turns and comes nearer, as in `Plane.seen_from`.
        """
        R_t = so3.exp(-phase * self.turn)  # of the reference, seen from the new frame
        distance = (1 + phase * (self.shift * self.normal).sum(-1, keepdim=True)).clamp_min(CLOSEST)
        return Displacement(self.turn, (R_t @ self.shift[..., None])[..., 0] / distance, (R_t @ self.normal[..., None])[..., 0])

    def homography(self) -> Tensor:
        """H_k [A, K, 3, 3] of the warp to the reference camera; its s is the share of the window since the reference."""
        return polynomial(self.turn, self.shift, self.normal, TERMS)

    def twin(self) -> Displacement:
        """The other motion and plane with the same image motion: velocity and normal change places.

        The image moves by the matrix w^ - v n^T; its symmetric part does not tell v from n, and the turn makes up the rest:
        w' = w - n x v. Exact at the reference time; the shift keeps its length and the plane faces the camera.
        """
        length = self.shift.norm(dim=-1, keepdim=True)
        still = length == 0
        direction = torch.where(still, self.normal, self.shift / torch.where(still, 1.0, length))
        side = torch.where(direction[:, 2:] > 0, -1.0, 1.0)
        turn = self.turn - torch.linalg.cross(self.normal, self.shift)
        return Displacement(turn, side * length * self.normal, side * direction)


@dataclass(frozen=True)
class Model(ABC):
    """Parameters x [A, P] in pixels of displacement over the window; row i belongs to window owner[i].

    focal px | normal [W, 3]: the known plane of every window in the frame of its first event, None where it isn't known
    start [W, P] px: where each window's search begins, as after the window before; None: at rest
    """

    focal: float
    normal: Tensor | None = None
    start: Tensor | None = None
    size: ClassVar[int] = 0
    free_plane: ClassVar[bool] = False
    """Whether the plane is among the parameters, so that it has a twin."""
    has_plane: ClassVar[bool] = True

    @abstractmethod
    def displacement(self, x: Tensor, owner: Tensor) -> Displacement:
        """The motion in the frame of the camera at the window's first event."""

    def at_reference(self, x: Tensor, owner: Tensor, reference: float) -> Displacement:
        """The same motion in the frame of the camera at `reference`, a share of the window."""
        return self.displacement(x, owner).seen_at(reference)

    def homography(self, x: Tensor, owner: Tensor, reference: float) -> Tensor:
        """H_k [A, K, 3, 3] of the warp to the camera at `reference`."""
        return self.at_reference(x, owner, reference).homography()

    @abstractmethod
    def parameters(self, displacement: Displacement) -> Tensor:
        """The x that `displacement` gives back as this motion, as far as the model has it: [A, P]."""

    def wall(self, x: Tensor, owner: Tensor) -> Tensor:
        """The known plane of each row, or the fronto-parallel one: -> normal [A, 3]."""
        if self.normal is not None:
            return self.normal.to(x)[owner]
        normal = x.new_zeros(len(x), 3)
        normal[:, 2] = -1
        return normal


class Rotation(Model):
    """Angular velocity alone, eq. (2.4): x = turn * focal."""

    size = 3
    has_plane = False

    def displacement(self, x: Tensor, owner: Tensor) -> Displacement:
        return Displacement(x / self.focal, torch.zeros_like(x), self.wall(x, owner))

    def at_reference(self, x: Tensor, owner: Tensor, reference: float) -> Displacement:
        return self.displacement(x, owner)  # a turn is the same in the frame of every moment

    def parameters(self, displacement: Displacement) -> Tensor:
        return displacement.turn * self.focal


class Translation(Model):
    """Velocity alone before a known or fronto-parallel plane, eq. (2.6) with R = I: x = shift * focal."""

    size = 3

    def displacement(self, x: Tensor, owner: Tensor) -> Displacement:
        return Displacement(torch.zeros_like(x), x / self.focal, self.wall(x, owner))

    def parameters(self, displacement: Displacement) -> Tensor:
        return displacement.shift * self.focal


class PlanarKnown(Model):
    """Six degrees of freedom before a known or fronto-parallel plane, eq. (2.10): x = (turn, shift) * focal."""

    size = 6

    def displacement(self, x: Tensor, owner: Tensor) -> Displacement:
        return Displacement(x[:, :3] / self.focal, x[:, 3:] / self.focal, self.wall(x, owner))

    def parameters(self, displacement: Displacement) -> Tensor:
        return torch.cat([displacement.turn, displacement.shift], -1) * self.focal


class Planar(Model):
    """Six degrees of freedom and the plane's normal, eq. (2.6): x = (turn, shift, two tilts) * focal.

    The tilts step on the sphere from the fronto-parallel plane, where the angles of eq. (A.13) are singular.
    """

    size = 8
    free_plane = True

    def displacement(self, x: Tensor, owner: Tensor) -> Displacement:
        x = x / self.focal
        return Displacement(x[:, :3], x[:, 3:6], Plane.tilted(x[:, 6:]).normal)

    def parameters(self, displacement: Displacement) -> Tensor:
        tilt = Plane(displacement.normal, torch.ones_like(displacement.normal[:, 0])).tilt()
        return torch.cat([displacement.turn, displacement.shift, tilt], -1) * self.focal


MODELS: dict[str, type[Model]] = {"rotation": Rotation, "translation": Translation, "planar": Planar}
