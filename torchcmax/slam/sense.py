"""What a window says of itself: whether it holds more than noise, and which directions of motion its events decide."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcmax.core.camera import Canvas
from torchcmax.core.window import Window

NAMES = [f"{name}_{axis}" for name in ("turn", "shift", "omega", "v") for axis in "xyz"]


@dataclass(frozen=True)
class Sensing:
    """When a window is still, weak or lost."""

    still: bool = True
    """Windows of noise hold the pose; else they are tracked as all others."""
    slice: float = 0.01
    """s within which events of neighbouring pixels support each other."""
    noise: float = 0.08
    """Share of the events, beyond what chance would bring, that are supported: a window with less is noise."""
    dense: float = 0.5
    """Share that chance would support from which on nothing is said: so many events are no noise."""
    weak: float = 0.5
    """Share of the usual strength below which a window is weak."""
    certain: float = 1.0
    """px that the image may be off, one sigma: a window whose place is less certain is weak."""
    hopeless: float = 30.0
    """px from which on the camera is lost."""
    recent: int = 50
    """Windows that say what is usual."""
    patience: float = 0.25
    """s of weak windows, or of no events at all, after which the camera is lost."""

    def __post_init__(self) -> None:
        if not (
            self.slice > 0
            and 0 <= self.noise < 1
            and 0 < self.dense <= 1
            and 0 <= self.weak <= 1
            and self.recent >= 1
            and self.patience > 0
        ):
            raise ValueError(f"sensing wants slice, patience and recent above 0 and shares of 0 to 1, got {self}")


def support(window: Window, canvas: Canvas, seconds: float) -> tuple[float, float]:
    """The share of the events of a window [1] that have another one on one of the eight pixels around, within the same slice of time;
    and the share that would, were they anywhere (Delbruck 2008's background activity filter, as a number)."""
    (height, width), count = canvas.size, max(1, math.ceil(float(window.duration[0]) / seconds))
    xy = canvas.pixels(window.ray[0]).round().long()
    x, y = xy[:, 0].clamp(0, width - 1), xy[:, 1].clamp(0, height - 1)
    place = ((window.phase[0] * count).long().clamp_max(count - 1) * height + y) * width + x
    weight = window.weight[0]
    image = weight.new_zeros(count * height * width).index_add_(0, place, weight).view(count, height, width)
    near = around(around(image, 1), 2) - image
    events = weight.sum().clamp_min(1)
    supported = float(((near.view(-1)[place] > 0.5) * weight).sum() / events)
    return supported, 1 - math.exp(-8 * float(events) / image.numel())


def around(image: Tensor, dim: int) -> Tensor:
    """Each number with the two beside it along a dimension."""
    count = image.shape[dim]
    total = image.clone()
    total.narrow(dim, 1, count - 1).add_(image.narrow(dim, 0, count - 1))
    total.narrow(dim, 0, count - 1).add_(image.narrow(dim, 1, count - 1))
    return total


def beyond_chance(supported: float, chance: float) -> float:
    """0 where events are as often supported as by chance, 1 where all are."""
    return max(0.0, supported - chance) / max(1 - chance, 1e-9)


def decided(information: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """How much of each direction of a step the events decide, and not the prediction: information, prior [12, 12].

    -> shares [12] from weakest to strongest, 0 where only the prediction speaks, and the directions [12, 12], a column each: the
    eigenvectors of the information in the metric of what is known with it.
    """
    L = torch.linalg.cholesky(information + prior)
    half = torch.linalg.solve_triangular(L, information, upper=False)
    share, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(L, half.mT, upper=False))
    directions = torch.linalg.solve_triangular(L.mT, vectors, upper=True)
    return share.clamp(0, 1), directions / directions.norm(dim=0)


def name_of(direction: Tensor) -> str:
    """The number of a step that a direction [12] has most of."""
    return NAMES[int(direction.abs().argmax())]
