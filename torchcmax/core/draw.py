"""The image of warped events: events + homographies + canvas -> image, with the gradient to the homographies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcmax import kernels
from torchcmax.core.camera import Screen
from torchcmax.core.vote import vote, vote_scatter
from torchcmax.core.warp import TERMS, monomials, warp
from torchcmax.core.window import Window

ALIGNED = 16  # windows are padded to a multiple, since a matrix product rounds otherwise where rows begin off a cache line


@dataclass(frozen=True)
class Ink:
    """Windows made ready for many warps: ray (x, y, 1), time s from the reference in window lengths, weight; all [W, N].

    The weight is 0 for padding.
    """

    x: Tensor
    y: Tensor
    s: Tensor
    weight: Tensor

    def __post_init__(self) -> None:
        shapes = {part.shape for part in (self.x, self.y, self.s, self.weight)}
        if len(shapes) != 1 or self.x.ndim != 2:
            raise ValueError(f"ink wants x, y, s and weight [W, N], got {', '.join(str([*shape]) for shape in sorted(shapes))}")

    @classmethod
    def of(cls, window: Window, weight: Tensor, reference: float = 0.5) -> Ink:
        """weight [W, N] that events vote with | reference: the time warped to, 0 the window's first event, 1 its last."""
        parts = window.ray[..., 0], window.ray[..., 1], window.phase - reference, weight
        return cls(*(part.contiguous() for part in parts))

    @classmethod
    def join(cls, parts: Sequence[Ink]) -> Ink:
        """Windows of different lengths together, the shorter ones padded with weight 0."""
        longest = max(part.x.shape[-1] for part in parts)
        return cls(*(torch.cat([pad(getattr(p, f.name), (0, longest - p.x.shape[-1])) for p in parts]) for f in fields(cls)))

    def __getitem__(self, index: slice | Tensor) -> Ink:
        """Some of the windows."""
        return Ink(*(getattr(self, f.name)[index] for f in fields(self)))

    def thinned(self, step: int) -> Ink:
        """Every step-th event of each window."""
        return Ink(*(getattr(self, f.name)[:, ::step].contiguous() for f in fields(self))) if step > 1 else self

    def sample(self, count: int) -> Ink:
        """`count` events of each window, evenly from its first to its last; repeated where a window has fewer."""
        events = (self.weight != 0).sum(-1, keepdim=True)
        index = (torch.arange(count, device=events.device) * events).div(count, rounding_mode="floor")
        return Ink(*(getattr(self, f.name).gather(-1, index) for f in fields(self)))

    def warped(self, H_k: Tensor) -> Tensor:
        """All events as rays of the reference camera, by Horner's scheme: H_k [W, K, 3, 3] -> [W, N, 3] in its precision."""
        ray, s = self.ray.to(H_k), self.s.to(H_k)[:, None]
        total = H_k[:, -1] @ ray
        for k in range(H_k.shape[1] - 2, -1, -1):
            total = torch.addcmul(H_k[:, k] @ ray, total, s)
        return total.mT

    @cached_property
    def ray(self) -> Tensor:
        """[W, 3, N]"""
        return torch.stack([self.x, self.y, torch.ones_like(self.x)], 1)

    @cached_property
    def aligned(self) -> tuple[Tensor, Tensor]:
        """For the plain torch path: basis [W, 3K, N] of `monomials` and weight [W, N], padded to a multiple of ALIGNED."""
        spare = (0, -self.weight.shape[-1] % ALIGNED)
        return monomials(pad(self.ray, spare).mT, pad(self.s, spare), TERMS), pad(self.weight, spare)


def draw_twin(H_k: Tensor, ink: Ink, canvas: Screen, owner: Tensor) -> Tensor:
    """The readable twin of `draw`, in plain torch operations."""
    basis, weight = ink.aligned
    return canvas.folded(_framed(vote_scatter, H_k, basis[owner], weight[owner], canvas))


def draw(H_k: Tensor, ink: Ink, canvas: Screen, owner: Tensor) -> Tensor:
    """Warp events and vote them into images, eq. (2.1): one image for each homography.

    H_k [A, K, 3, 3] | ink of W windows | owner [A] int: the window that each homography belongs to -> [A, H, W]

    Differentiable to H_k, once. On the CPU each row is computed by itself, in the cache and the same in any batch.
    """
    if H_k.ndim != 4 or H_k.shape[2:] != (3, 3) or owner.shape != H_k.shape[:1]:
        raise ValueError(f"draw wants H_k [A, K, 3, 3] and owner [A], got {[*H_k.shape]} and {[*owner.shape]}")
    if ink.x.is_cuda and torch.are_deterministic_algorithms_enabled():
        return draw_twin(H_k, ink, canvas, owner)
    if kernels.drawing(ink.x, kernels.frame(canvas)) is not None:
        return canvas.folded(_Kernel.apply(H_k, ink, canvas, owner))
    basis, weight = ink.aligned
    rows = [(H_k, basis[owner], weight[owner])]
    if not ink.x.is_cuda:
        rows = [(H_k[i : i + 1].clone(), basis[w : w + 1], weight[w : w + 1]) for i, w in enumerate(owner.tolist())]
    return canvas.folded(torch.cat([_framed(vote, *row, canvas) for row in rows]))


def _framed(how: Any, H_k: Tensor, basis: Tensor, weight: Tensor, canvas: Screen) -> Tensor:
    """Votes into a frame that is one pixel wider on all sides than the canvas, -> [A, H + 2, W + 2]."""
    ray = warp(H_k, basis).mT
    seen = canvas.sees(ray)
    xy = canvas.pixels(torch.where(seen[..., None], ray, ray.new_ones(3)))
    image: Tensor = how(xy + 1, weight * seen, (canvas.size[0] + 2, canvas.size[1] + 2))
    return image


class _Kernel(torch.autograd.Function):
    """`_framed` by the kernels of a device, for all rows at once."""

    @staticmethod
    def forward(ctx: Any, H_k: Tensor, ink: Ink, canvas: Screen, owner: Tensor) -> Tensor:
        ctx.save_for_backward(H_k, owner)
        ctx.ink, ctx.canvas = ink, canvas
        image: Tensor = _kernel(ink).votes(H_k, ink, canvas, owner)
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        H_k, owner = ctx.saved_tensors
        return _kernel(ctx.ink).slopes(H_k, ctx.ink, ctx.canvas, owner, gradient), None, None, None


def _kernel(ink: Ink) -> Any:
    return kernels.drawing(ink.x)


def draw_sum(H_k: Tensor, ink: Ink, canvas: Screen) -> Tensor:
    """`draw` of many windows into one image: H_k [W, K, 3, 3] | ink of W windows -> [1, H, W].  Differentiable to H_k, once."""
    if H_k.ndim != 4 or len(H_k) != len(ink.x):
        raise ValueError(f"draw_sum wants H_k [W, K, 3, 3] for ink of {len(ink.x)} windows, got {[*H_k.shape]}")
    if kernels.drawing(ink.x, kernels.frame(canvas)) is not None and not ink.x.is_cuda:
        return canvas.folded(_Sum.apply(H_k, ink, canvas))
    return draw(H_k, ink, canvas, torch.arange(len(H_k), device=H_k.device)).sum(0, keepdim=True)


class _Sum(torch.autograd.Function):
    """The frame of all windows together by the kernels of the CPU."""

    @staticmethod
    def forward(ctx: Any, H_k: Tensor, ink: Ink, canvas: Screen) -> Tensor:
        ctx.save_for_backward(H_k)
        ctx.ink, ctx.canvas = ink, canvas
        image: Tensor = _kernel(ink).votes_sum(H_k, ink, canvas)
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (H_k,) = ctx.saved_tensors
        return _kernel(ctx.ink).slopes_sum(H_k, ctx.ink, ctx.canvas, gradient), None, None
