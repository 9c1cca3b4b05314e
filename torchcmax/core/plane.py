"""The plane n . x + d = 0; n looks at the camera, so (0, 0, -1) with d = 1 is a wall at depth one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.pose import Pose


@dataclass(frozen=True)
class Plane:
    """normal [B, 3], unit | distance [B], positive."""

    normal: Tensor
    distance: Tensor

    @classmethod
    def join(cls, parts: Sequence[Plane]) -> Plane:
        """Several planes together."""
        return cls(torch.cat([p.normal for p in parts]), torch.cat([p.distance for p in parts]))

    @classmethod
    def tilted(cls, tilt: Tensor) -> Plane:
        """Plane at distance one whose normal is (0, 0, -1) tilted: tilt [B, 2] rad, any value is a plane.

        Two angles about the image's axes, full rank at the fronto-parallel plane, where the angles of eq. (A.13) are singular.
        """
        w = torch.cat([tilt, torch.zeros_like(tilt[:, :1])], -1)
        return cls(-so3.exp(w)[..., 2], torch.ones_like(tilt[:, 0]))

    def repeated(self, count: int) -> Plane:
        """The plane [1] for so many cameras."""
        return Plane(self.normal.expand(count, 3), self.distance.expand(count))

    def tilt(self) -> Tensor:
        """The two angles that `tilted` wants for this normal: -> [B, 2] rad."""
        x, y, z = self.normal.double().unbind(-1)  # atan2 of float32 rounds differently in another batch
        sine = torch.hypot(x, y)
        angle = torch.atan2(sine, -z)
        ratio = torch.where(sine < 1e-9, 1.0, angle / torch.where(sine < 1e-9, 1.0, sine))
        return torch.stack([ratio * y, -ratio * x], -1).to(self.normal)

    def seen_from(self, pose: Pose) -> Plane:
        """The same plane in the camera's frame: n_c = R_cw n_w, d_c = d_w + t_wc . n_w, before eq. (2.10)."""
        normal = (pose.R.mT @ self.normal[..., None])[..., 0]
        return Plane(normal, self.distance + (pose.t * self.normal).sum(-1))

    def across(self) -> Tensor:
        """Two directions along the plane, orthogonal to each other and to the normal: [B, 2, 3]."""
        return self.facing()[:, :2]

    def leaning(self, step: Tensor) -> Plane:
        """The plane whose normal goes by a small step [B, 2] rad along `across`, at the same distance."""
        normal = self.normal + (step[:, :, None] * self.across()).sum(1)
        return Plane(torch.nn.functional.normalize(normal, dim=-1), self.distance)

    def facing(self) -> Tensor:
        """Rotation that turns the normal to (0, 0, -1), eq. (2.12), (2.13): [B, 3, 3]."""
        z = torch.zeros_like(self.normal)
        z[..., 2] = -1
        k = so3.hat(torch.linalg.cross(self.normal, z))
        cos = (self.normal * z).sum(-1)[..., None, None]
        return torch.eye(3, dtype=z.dtype, device=z.device) + k + k @ k / (1 + cos)
