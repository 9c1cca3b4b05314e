"""What one window shows by itself, to be found in a map: how strong its edges are, seen from its middle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import blur
from torchcmax.core.draw import Ink, draw
from torchcmax.core.pose import Motion
from torchcmax.core.warp import TERMS, polynomial
from torchcmax.core.window import Window

POOL = 2  # px of the window, each way, that are one point when it is laid on a map
SOFT = 0.7  # px of blur of the window before its strength is taken


@dataclass(frozen=True)
class Glimpse:
    """What one window shows by itself.

    seconds [1] | motion [1] at its middle, velocity in distances of the plane then | ink [1, N] | canvas: as large as the sensor
    strength [H, W] of its edges there, 0..1 | inside [H, W]: 1 on the sensor
    """

    seconds: Tensor
    motion: Motion
    ink: Ink
    canvas: Canvas
    strength: Tensor
    inside: Tensor

    @classmethod
    def of(cls, window: Window, motion: Motion, normal: Tensor, canvas: Canvas, border: Tensor) -> Glimpse:
        """From the motion [1] that makes a window [1] sharp before a plane with this normal [1, 3]."""
        return cls.drawn(Ink.of(window, window.weight), window.duration.double(), motion, normal, canvas, border)

    @classmethod
    def drawn(cls, ink: Ink, seconds: Tensor, motion: Motion, normal: Tensor, canvas: Canvas, border: Tensor) -> Glimpse:
        """Of events [1, N] that last `seconds` [1]."""
        H_k = polynomial(motion.omega * seconds[:, None], motion.velocity * seconds[:, None], normal, TERMS)
        image = blur(draw(H_k.to(ink.x), ink, canvas, torch.zeros(1, dtype=torch.int64)), SOFT)[0]
        typical = image.square().sum() / image.sum().clamp_min(1e-9)
        low, high = border[:, :2].amin(0), border[:, :2].amax(0)
        x, y = axes_of(canvas)
        inside = ((y >= low[1]) & (y <= high[1]))[:, None] & ((x >= low[0]) & (x <= high[0]))
        return cls(seconds, motion, ink, canvas, image / (image + typical.clamp_min(1e-9)), inside.to(image))

    def pooled(self, pool: int, sigma: float = 0.0) -> tuple[Tensor, Tensor]:
        """Points on the sensor, a square of `pool` px each: rays [3, N] and strength [N], of the image blurred by sigma px."""
        soft = blur(self.strength[None], sigma)[0] if sigma else self.strength
        strength, inside = (avg_pool2d(part[None], pool)[0] for part in (soft, self.inside))
        x, y = (
            axis[: n // pool * pool].view(-1, pool).mean(1) for axis, n in zip(axes_of(self.canvas), self.canvas.size[::-1], strict=True)
        )
        keep = inside > 0.5
        x, y = x.expand_as(strength)[keep], y[:, None].expand_as(strength)[keep]
        ray = torch.stack([x, y, torch.ones_like(x)])
        return ray, strength[keep]

    @cached_property
    def points(self) -> tuple[Ink, Ink]:
        """The image as points to draw: with its strength as weight, and with one."""
        ray, strength = self.pooled(POOL)
        x, y, one = (part[None].contiguous() for part in ray)
        return Ink(x, y, torch.zeros_like(x), strength[None].contiguous()), Ink(x, y, torch.zeros_like(x), one)


def axes_of(canvas: Canvas) -> tuple[Tensor, Tensor]:
    """The coordinates of a canvas' columns and rows as rays (x, y, 1)."""
    (height, width), (x, y) = canvas.size, canvas.centre
    return (torch.arange(width, dtype=torch.float32) - x) / canvas.focal, (torch.arange(height, dtype=torch.float32) - y) / canvas.focal
