"""Warp events by the motion of a camera, and vote them into images."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import Module

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.draw import Ink, draw
from torchcmax.core.model import Displacement
from torchcmax.core.vote import vote
from torchcmax.core.warp import monomials, warp
from torchcmax.core.window import Window

Polarity = Literal["dropped", "signed", "split"]
POLARITIES = ("dropped", "signed", "split")


def displacement(window: Window, omega: Tensor, velocity: Tensor | None, normal: Tensor | None, reference: float) -> Displacement:
    """Motion over windows in the frame of the camera at `reference`, a share of the window; in the precision of the events.

    omega [B, 3] rad/s | velocity [B, 3] plane distances/s | normal [B, 3] of the plane, unit, all in the frame of the camera at the
    window's first event; without a velocity the camera only turns, without a normal the plane is a wall straight ahead
    """
    like = window.ray
    _check_shapes(len(like), omega, velocity, normal)
    seconds = window.duration[:, None].to(like)
    turn = omega.to(like) * seconds
    facing = torch.zeros_like(turn)
    facing[:, 2] = -1
    facing = facing if normal is None else normal.to(like)
    if velocity is None:  # a turn is the same in the frame of every moment
        return Displacement(turn, torch.zeros_like(turn), facing)
    return Displacement(turn, velocity.to(like) * seconds, facing).seen_at(reference)


def _check_shapes(windows: int, omega: Tensor, velocity: Tensor | None, normal: Tensor | None) -> None:
    for name, vector in (("omega", omega), ("velocity", velocity), ("normal", normal)):
        if vector is not None and vector.shape != (windows, 3):
            raise ValueError(f"{name} wants [B, 3] = [{windows}, 3], got {[*vector.shape]}")


def harmless(some: Tensor, omega: Tensor, velocity: Tensor | None, normal: Tensor | None) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """The motion, at rest before a wall where a window has no events, some [B], so that what stands there leaves no trace in gradients."""
    _check_shapes(len(some), omega, velocity, normal)
    here = some[:, None]
    wall = None if normal is None else torch.zeros_like(normal)
    if wall is not None:
        wall[:, 2] = -1
    return (
        torch.where(here, omega, 0.0),
        None if velocity is None else torch.where(here, velocity, 0.0),
        None if normal is None or wall is None else torch.where(here, normal, wall),
    )


class Warp(Module):
    """Where events are seen from the camera at `reference`, eq. (2.6), (2.10), (2.14): a thin shell over `core.warp`.

    reference: 0 the time of the window's first event, 1 of its last | margin: of the canvas, a share of the sensor's size
    """

    def __init__(self, camera: Camera, reference: float = 0.5, margin: float = 0.25) -> None:
        super().__init__()
        self.canvas, self.reference = Canvas.around(camera, margin), reference

    def forward(self, window: Window, omega: Tensor, velocity: Tensor | None = None, normal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Windows [B, N] and their motion, as of `displacement` -> xy [B, N, 2] px of the canvas, and which are before the camera [B, N].

        Points of events behind the camera mean nothing.
        """
        with torch.autocast(window.ray.device.type, enabled=False):
            there = displacement(window, omega, velocity, normal, self.reference)
            return _points(there.homography(), window, self.reference, self.canvas)


class ImageOfWarpedEvents(Module):
    """The image of warped events, eq. (2.1): a thin shell over `core.draw`.

    polarity: dropped, every event votes 1; signed, +1 or -1; split, brighter and darker events apart
    """

    def __init__(self, camera: Camera, polarity: Polarity = "dropped", reference: float = 0.5, margin: float = 0.25) -> None:
        super().__init__()
        if polarity not in POLARITIES:
            raise ValueError(f"polarity wants one of {', '.join(POLARITIES)}, got {polarity!r}")
        self.canvas, self.reference, self.polarity = Canvas.around(camera, margin), reference, polarity

    def forward(
        self,
        window: Window,
        omega: Tensor,
        velocity: Tensor | None = None,
        normal: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Tensor:
        """Windows [B, N], their motion as of `displacement`, and what events count [B, N], by default 1 -> [B, C, H, W], C = 2 for split.

        Differentiable once, to motion, plane and weight.  Padded events, of polarity 0, count nothing whatever their weight.
        """
        with torch.autocast(window.ray.device.type, enabled=False):
            there = displacement(window, omega, velocity, normal, self.reference)
            return images(there.homography(), window, votes(window, weight, self.polarity), self.reference, self.canvas)


def votes(window: Window, weight: Tensor | None, polarity: Polarity) -> Tensor:
    """What each event counts: [B, C, N], C = 2 for split, brighter first."""
    sign = window.polarity.to(window.ray)
    if weight is not None:
        if weight.shape != sign.shape:
            raise ValueError(f"weight wants [B, N] = {[*sign.shape]}, got {[*weight.shape]}")
        sign = sign * weight.to(sign)
    if polarity == "signed":
        return sign[:, None]
    size = sign * window.polarity.sign().to(sign)
    return size[:, None] if polarity == "dropped" else torch.stack([size * (window.polarity > 0), size * (window.polarity < 0)], 1)


def images(H_k: Tensor, window: Window, weight: Tensor, reference: float, canvas: Canvas) -> Tensor:
    """Events warped by H_k [B, K, 3, 3] to `reference` and voted with weights [B, C, N] -> [B, C, H, W].

    By the kernels of `core.draw` where nothing but the motion has a gradient, else by plain operations, which can be compiled too.
    """
    if torch.compiler.is_compiling() or weight.requires_grad or window.ray.requires_grad or window.dt.requires_grad:
        xy, seen = _points(H_k, window, reference, canvas)
        return torch.stack([vote(xy, one * seen, canvas.size) for one in weight.unbind(1)], 1)
    owner = torch.arange(len(H_k), device=H_k.device)
    return torch.stack([draw(H_k, Ink.of(window, one, reference), canvas, owner) for one in weight.unbind(1)], 1)


def _points(H_k: Tensor, window: Window, reference: float, canvas: Canvas) -> tuple[Tensor, Tensor]:
    ray = warp(H_k, monomials(window.ray, window.phase - reference)).mT
    seen = canvas.sees(ray)
    return canvas.pixels(torch.where(seen[..., None], ray, ray.new_ones(3))), seen
