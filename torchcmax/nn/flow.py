"""Contrast as a loss of dense optical flow, with what keeps a learned flow from collapsing the events."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import Module
from torch.nn.functional import grid_sample

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.objective import ContrastName
from torchcmax.core.vote import vote_moved
from torchcmax.core.window import Window
from torchcmax.nn.image import Polarity, votes
from torchcmax.nn.loss import Against, Reduction, _check, as_loss, reduced, sharpness

SMALLEST = 0.05  # factor of area below which the guard no longer looks: there its logarithm is steep enough
SOFT = 1e-3  # px, of the Charbonnier norm


class FlowContrastLoss(Module):
    """-log contrast of events that follow a dense flow, plus smoothness and a guard against event collapse.

    The flow lies on the undistorted sensor, `canvas`: px of displacement over the whole window, x right and y down, at the place where an
    event was seen; events follow it in a straight line.  A flow that is free at every pixel can draw all events of a neighbourhood into
    a point or line, which no camera sees and every contrast rewards (event collapse, Shiba et al. 2022).  Three things are built in
    against it: several reference times, of which a collapse sharpens one and blurs the others (as Zhu et al., CVPR 2019); the guard on
    how much the flow changes areas, as in `core.objective`; and smoothness.

    contrast, polarity, blur, against, reduction: as of `ContrastLoss` | references: times warped to, shares of the window
    smoothness: weight of the mean Charbonnier norm of the flow's gradient, log contrast per px a px
    guard, deformation: weight, log contrast per (log area)^2, and the factor by which the flow may change areas before it speaks
    margin: around the sensor, a share of its size, so that events that leave the image are not lost
    """

    def __init__(
        self,
        camera: Camera,
        contrast: ContrastName = "variance",
        references: tuple[float, ...] = (0.0, 0.5, 1.0),
        polarity: Polarity = "dropped",
        blur: float = 1.0,
        margin: float = 0.1,
        against: Against = "scattered",
        smoothness: float = 0.1,
        guard: float = 10.0,
        deformation: float = 2.0,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        _check(contrast, references, polarity, against, reduction)
        if not (blur >= 0 and smoothness >= 0 and guard >= 0 and deformation > 1):
            raise ValueError("a loss wants blur, smoothness and guard of at least 0 and a deformation above 1")
        self.canvas, self.around = Canvas.around(camera, 0.0), Canvas.around(camera, margin)
        self.contrast, self.references, self.polarity, self.against = contrast, references, polarity, against
        self.blur, self.smoothness, self.guard, self.deformation, self.reduction = blur, smoothness, guard, deformation, reduction

    def forward(self, window: Window, flow: Tensor, weight: Tensor | None = None) -> Tensor:
        """Windows [B, N] and a flow [B, 2, H, W] px over each; weight [B, N] of events, by default 1 -> [] or [B].

        Differentiable once, to flow and weight.  A window without events has the loss 0.
        """
        if flow.shape != (len(window), 2, *self.canvas.size):
            raise ValueError(f"flow wants [B, 2, H, W] = {[len(window), 2, *self.canvas.size]}, got {[*flow.shape]}")
        with torch.autocast(window.ray.device.type, enabled=False):
            counts, here = votes(window, weight, self.polarity), self.around.pixels(window.ray)
            flow = torch.where((counts != 0).flatten(1).any(1)[:, None, None, None], flow.to(window.ray), 0.0)
            moved = sampled(flow, self.canvas.pixels(window.ray))
            total = torch.stack([self._contrast(window, here, moved, counts, reference) for reference in self.references]).mean(0)
            rest = None
            if self.against == "rest":
                rest = self._contrast(window, here, torch.zeros_like(moved), counts, 0.0)
            return reduced(as_loss(total, rest, self.against), self._cost(flow), counts, self.reduction)

    def image(self, window: Window, flow: Tensor, weight: Tensor | None = None, reference: float = 0.5) -> Tensor:
        """The image of events that followed the flow to a reference time: [B, C, H, W] of the sensor with its margin."""
        counts, moved = votes(window, weight, self.polarity), sampled(flow.to(window.ray), self.canvas.pixels(window.ray))
        return self._image(window, self.around.pixels(window.ray), moved, counts, reference)

    def _contrast(self, window: Window, here: Tensor, moved: Tensor, counts: Tensor, reference: float) -> Tensor:
        image = self._image(window, here, moved, counts, reference)
        return sharpness(image, counts, self.contrast, self.blur, self.against != "nothing")

    def _image(self, window: Window, here: Tensor, moved: Tensor, counts: Tensor, reference: float) -> Tensor:
        since = reference - window.phase
        return torch.stack([vote_moved(here, moved, since, one, self.around.size) for one in counts.unbind(1)], 1)

    def _cost(self, flow: Tensor) -> Tensor:
        """Smoothness and guard: [B]."""
        cost = torch.zeros_like(flow[:, 0, 0, 0])
        right, down = flow.roll(-1, 3) - flow, flow.roll(-1, 2) - flow  # the last column and row of which mean nothing
        if self.smoothness > 0:
            length = ((right.square() + down.square()).sum(1) + SOFT**2).sqrt()
            cost = cost + self.smoothness * (length[:, :-1, :-1].mean((1, 2)) - SOFT)
        if self.guard > 0:  # in squares of 2 by 2 pixels side by side, so that every pixel is in one
            (ux, vx), (uy, vy) = (step[:, :, :-1:2, :-1:2].unbind(1) for step in (right, down))
            trace, area = ux + vy, ux * vy - uy * vx
            for reach in (max(self.references), min(self.references) - 1):  # to the farthest references from both ends of the window
                excess = (1 + reach * trace + reach**2 * area).clamp_min(SMALLEST).log().abs() - math.log(self.deformation)
                cost = cost + self.guard / 2 * excess.clamp_min(0).square().mean((1, 2))
        return cost


def sampled(flow: Tensor, xy: Tensor) -> Tensor:
    """The flow [B, 2, H, W] at points [B, N, 2] px, between pixels bilinear, beyond the image that of its border: -> [B, N, 2]."""
    height, width = flow.shape[2:]
    grid = xy * xy.new_tensor([2 / (width - 1), 2 / (height - 1)]) - 1
    return grid_sample(flow, grid[:, None], padding_mode="border", align_corners=True)[:, :, 0].mT.contiguous()
