"""Windows of events as images that networks take, as they came or compensated.

Every function takes windows [B, N], a canvas, and H_k [B, K, 3, 3] of `core.warp` where events are to be moved first to its reference,
a share of the window.  Events of polarity 0 count nothing, so padding changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchcmax.core.camera import Canvas
from torchcmax.core.vote import vote
from torchcmax.core.warp import monomials, warp
from torchcmax.core.window import Window

P = ParamSpec("P")
T = TypeVar("T")


def exact(function: Callable[P, T]) -> Callable[P, T]:
    """In the precision of the events, whatever autocast says; the first argument has a window, or is one."""

    @wraps(function)
    def inner(*given: P.args, **named: P.kwargs) -> T:
        subject: Any = given[0]
        with torch.autocast(getattr(subject, "window", subject).ray.device.type, enabled=False):
            return function(*given, **named)

    return inner


@exact
def event_count(window: Window, canvas: Canvas, H_k: Tensor | None = None, reference: float = 0.5) -> Tensor:
    """How many events each pixel has, brighter and darker apart, between pixels bilinear: -> [B, 2, H, W]."""
    xy, seen = _points(window, canvas, H_k, reference)
    return torch.stack([vote(xy, window.weight * seen * (window.polarity * sign > 0), canvas.size) for sign in (1, -1)], 1)


@exact
def voxel_grid(window: Window, canvas: Canvas, bins: int = 5, H_k: Tensor | None = None, reference: float = 0.5) -> Tensor:
    """Polarities in `bins` moments spread evenly over the window, bilinear in time and between pixels (Zhu et al., CVPR 2019).

    -> [B, bins, H, W].  Differentiable once to H_k.
    """
    if bins < 2:
        raise ValueError(f"a voxel grid wants at least 2 bins, got {bins}")
    xy, seen = _points(window, canvas, H_k, reference)
    moment = window.phase * (bins - 1)
    sign = window.polarity.to(xy) * seen
    return torch.stack([vote(xy, sign * (1 - (moment - i).abs()).clamp_min(0), canvas.size) for i in range(bins)], 1)


@exact
def time_surface(window: Window, canvas: Canvas, tau: float = 0.03, H_k: Tensor | None = None, reference: float = 0.5) -> Tensor:
    """exp(-age / tau) of the last event at the nearest pixel, seen from the window's last event, brighter and darker apart.

    tau: s | -> [B, 2, H, W], 0 where there was none (Lagorce et al., PAMI 2017)
    """
    if not tau > 0:
        raise ValueError(f"a time surface wants a tau above 0, got {tau}")
    (height, width), batch = canvas.size, len(window)
    xy, seen = _points(window, canvas, H_k, reference)
    x, y = xy.detach().round().unbind(-1)
    inside = seen & (x >= 0) & (x < width) & (y >= 0) & (y < height) & (window.polarity != 0)
    pixel = (y * width + x).where(inside, 0.0).long() + (window.polarity < 0) * (height * width)
    fresh = torch.exp((window.dt - window.duration[:, None]) / tau).where(inside, 0.0)
    surface = fresh.new_zeros(batch, 2 * height * width).scatter_reduce(1, pixel, fresh, "amax")
    return surface.view(batch, 2, height, width)


def _points(window: Window, canvas: Canvas, H_k: Tensor | None, reference: float) -> tuple[Tensor, Tensor]:
    """Where events are seen, px [B, N, 2], and which are before the camera [B, N]."""
    if H_k is not None and len(H_k) != len(window):
        raise ValueError(f"H_k wants a row for each of {len(window)} windows, got {len(H_k)}")
    ray = window.ray if H_k is None else warp(H_k.to(window.ray), monomials(window.ray, window.phase - reference)).mT
    seen = canvas.sees(ray)
    return canvas.pixels(torch.where(seen[..., None], ray, ray.new_ones(3))), seen
