"""What a window says of itself: whether it holds more than noise, and which directions of motion its events decide."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcmax.core.camera import Camera
from torchcmax.core.window import Window

PARTS = 3  # slices of a busy window that are looked at
NAMES = [f"{name}_{axis}" for name in ("turn", "shift", "omega", "v") for axis in "xyz"]


@dataclass(frozen=True)
class Sensing:
    """When a window is still, weak or lost."""

    still: bool = True
    """Windows of noise hold the pose; else they are tracked as all others."""
    slice: float = 0.01
    """s within which events of neighbouring pixels support each other; less, where there are many."""
    busy: float = 0.04
    """Events per pixel in a slice at most, so that few of them are supported by chance."""
    noise: float = 0.08
    """Share of the events, beyond what chance would bring, that are supported: a window with less is noise."""
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
        above, shares = (self.slice, self.busy, self.certain, self.hopeless, self.patience), (self.noise, self.weak)
        if not (min(above) > 0 and self.recent >= 1 and all(0 <= share <= 1 for share in shares)):
            raise ValueError(
                f"sensing wants slice, busy, certain, hopeless, patience and recent above 0, and noise and weak of 0 to 1, got {self}"
            )


def support(window: Window, camera: Camera, how: Sensing) -> tuple[float, float]:
    """The share of the events of a window [1] that have another one on one of the eight pixels around, within the same slice of time;
    and the share that would, were they anywhere (Delbruck 2008's background activity filter, as a number).

    Of a busy window, the middle.
    """
    (height, width), pixels = camera.size, camera.size[0] * camera.size[1]
    most = max(2, int(PARTS * how.busy * pixels))
    first = max(0, (window.dt.shape[1] - most) // 2)
    ray, time, weight = (part[0, first : first + most] for part in (window.ray, window.dt, window.weight))
    seconds = float(time[-1] - time[0])
    count = max(1, math.ceil(seconds / how.slice), math.ceil(len(time) / (how.busy * pixels)))
    xy = camera.project(ray.double()).round().long()
    x, y = xy[:, 0].clamp(0, width - 1), xy[:, 1].clamp(0, height - 1)
    slot = ((time - time[0]) * (count / max(seconds, 1e-9))).long().clamp_max(count - 1)
    place = (slot * height + y) * width + x
    image = weight.new_zeros(count * height * width).index_add_(0, place, weight).view(count, height, width)
    near = around(around(image, 1), 2) - image
    events = weight.sum().clamp_min(1)
    supported = float(((near.view(-1)[place] > 0.5) * weight).sum() / events)
    return supported, 1 - math.exp(-8 * float(events) / (count * pixels))


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
    """How much of each direction of a step the events decide, and not the prediction: information, prior [F, F].

    -> shares [F] from weakest to strongest, 0 where only the prediction speaks, and the directions [F, F], a column each: the
    eigenvectors of the information in the metric of what is known with it.
    """
    L, failed = torch.linalg.cholesky_ex(information + prior)
    if failed:  # of a camera that is nowhere, numbers may be anything
        return torch.zeros_like(information[0]), torch.eye(len(information)).to(information)
    half = torch.linalg.solve_triangular(L, information, upper=False)
    share, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(L, half.mT, upper=False))
    directions = torch.linalg.solve_triangular(L.mT, vectors, upper=True)
    return share.clamp(0, 1), directions / directions.norm(dim=0)


def name_of(direction: Tensor, free: Tensor) -> str:
    """The number of a step that a direction [F] has most of, of those that are free [F]."""
    return NAMES[int(free[direction.abs().argmax()])]
