"""Contrast as a loss: the sharper the image of warped events, the lower."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor
from torch.nn import Module

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.contrast import CONTRASTS, blur, blur_twin
from torchcmax.core.objective import ContrastName, deformation
from torchcmax.core.warp import still
from torchcmax.core.window import Window
from torchcmax.nn.image import POLARITIES, Polarity, displacement, harmless, images, votes

Against = Literal["scattered", "rest", "nothing"]
Reduction = Literal["mean", "sum", "none"]
UNSCALED = ("michelson",)  # contrasts that are the same of any multiple of an image
WATCHED = 150  # events, evenly spread, over which the guard watches


class ContrastLoss(Module):
    """-log contrast of the image of warped events, plus a guard against event collapse: what `core.estimate` minimizes, as a loss.

    contrast: one of `core.contrast.CONTRASTS` | references: times warped to, shares of the window; contrasts are averaged over them
    polarity: as of `ImageOfWarpedEvents` | blur: px, Gaussian, before the contrast | margin: of the canvas, a share of the sensor's size
    against: what the loss is zero for: `scattered`, events on pixels of their own; `rest`, the same events without motion; `nothing`: the
    plain -contrast of the image as it is, which compares neither between windows nor between sizes
    guard, deformation: weight of the guard, and the factor by which a warp before a plane may change areas before it speaks
    reduction: mean over windows with events, their sum, or none: [B]
    """

    def __init__(
        self,
        camera: Camera,
        contrast: ContrastName = "variance",
        references: tuple[float, ...] = (0.5,),
        polarity: Polarity = "dropped",
        blur: float = 1.0,
        margin: float = 0.25,
        against: Against = "scattered",
        guard: float = 10.0,
        deformation: float = 2.0,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        _check(contrast, references, polarity, against, reduction)
        if not (blur >= 0 and guard >= 0 and deformation > 1):
            raise ValueError(f"a loss wants blur and guard of at least 0, deformation above 1, got {blur}, {guard}, {deformation}")
        self.canvas, self.contrast, self.references, self.polarity = Canvas.around(camera, margin), contrast, references, polarity
        self.blur, self.against, self.guard, self.deformation, self.reduction = blur, against, guard, deformation, reduction

    def forward(
        self,
        window: Window,
        omega: Tensor,
        velocity: Tensor | None = None,
        normal: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Tensor:
        """Windows [B, N] and their motion, as of `nn.image.displacement`; weight [B, N] of events, by default 1 -> [] or [B].

        Differentiable once, to motion, plane and weight.  A window without events has the loss 0.
        """
        with torch.autocast(window.ray.device.type, enabled=False):
            counts, total, cost = votes(window, weight, self.polarity), [], torch.zeros_like(window.ray[:, 0, 0])
            omega, velocity, normal = harmless((counts != 0).flatten(1).any(1), omega, velocity, normal)
            for reference in self.references:
                there = displacement(window, omega, velocity, normal, reference)
                H_k = there.homography()
                total.append(self._contrast(H_k, window, counts, reference))
                if velocity is not None and self.guard > 0:
                    ray, here = watched(window, counts)
                    excess = deformation(there, H_k, ray, reference).abs() - math.log(self.deformation)
                    cost = cost + self.guard * mean_where(excess.clamp_min(0).square(), here.repeat(1, 2)) / len(self.references)
            rest = None
            if self.against == "rest":
                rest = self._contrast(still(H_k.detach()), window, counts, self.references[0])
            return reduced(as_loss(torch.stack(total).mean(0), rest, self.against), cost, counts, self.reduction)

    def _contrast(self, H_k: Tensor, window: Window, counts: Tensor, reference: float) -> Tensor:
        image = images(H_k, window, counts, reference, self.canvas)
        return sharpness(image, counts, self.contrast, self.blur, self.against != "nothing")


def _check(contrast: str, references: tuple[float, ...], polarity: str, against: str, reduction: str) -> None:
    """ValueError where a word is unknown, or there is no reference."""
    known: tuple[tuple[str, str, tuple[str, ...]], ...] = (
        ("contrast", contrast, tuple(CONTRASTS)),
        ("polarity", polarity, POLARITIES),
        ("against", against, ("scattered", "rest", "nothing")),
        ("reduction", reduction, ("mean", "sum", "none")),
    )
    for name, value, words in known:
        if value not in words:
            raise ValueError(f"{name} wants one of {', '.join(words)}, got {value!r}")
    if not references:
        raise ValueError("a loss wants at least one reference")


def sharpness(image: Tensor, counts: Tensor, contrast: str, sigma: float, normalize: bool = True) -> Tensor:
    """Contrast of images [B, C, H, W], the mean over C, in units of what their events, with counts [B, C, N], would give scattered: [B]."""
    channels, (height, width) = image.shape[1], image.shape[2:]
    soft = (blur_twin if torch.compiler.is_compiling() else blur)(image.flatten(0, 1), sigma)
    found = CONTRASTS[contrast](soft).view(-1, channels).mean(1)
    if not normalize or contrast in UNSCALED:
        return found
    energy = counts.square().sum((1, 2)) / (channels * height * width)  # all others are squares of the image
    return found / torch.where(energy > 0, energy, 1.0)


def as_loss(contrast: Tensor, rest: Tensor | None, against: str) -> Tensor:
    """[B] -> [B], lower where sharper."""
    if against == "nothing":
        return -contrast
    tiny = torch.finfo(contrast.dtype).tiny
    loss = -contrast.clamp_min(tiny).log()
    return loss if rest is None else loss + rest.clamp_min(tiny).log()


def reduced(loss: Tensor, cost: Tensor, counts: Tensor, reduction: str) -> Tensor:
    """Losses and costs [B] of windows with events, by their counts [B, C, N]."""
    some = (counts != 0).flatten(1).any(1)
    whole = torch.where(some, loss + cost, 0.0)
    if reduction == "none":
        return whole
    return whole.sum() / (some.sum().clamp_min(1) if reduction == "mean" else 1)


def watched(window: Window, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Rays [B, 3, WATCHED] of events evenly from the first to the last that counts, and whether they do; few are repeated."""
    some = (counts != 0).any(1)
    first = some.logical_not().to(torch.uint8).argsort(dim=1, stable=True)  # those that count, in their order, before the others
    place = torch.arange(WATCHED, device=some.device) * some.sum(1, keepdim=True)
    index = first.gather(1, place.div(WATCHED, rounding_mode="floor"))
    return window.ray.gather(1, index[..., None].expand(-1, -1, 3)).mT, some.gather(1, index).to(window.ray)


def mean_where(value: Tensor, weight: Tensor) -> Tensor:
    """Mean of values [B, M] over those with a weight: [B]."""
    return (value * weight).sum(-1) / weight.sum(-1).clamp_min(1)
