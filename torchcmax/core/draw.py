"""The image of warped events: events + homographies + canvas -> image, with the gradient to the homographies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcmax.core.camera import Canvas
from torchcmax.core.vote import slopes, vote_scatter, votes
from torchcmax.core.warp import TERMS, monomials, warp
from torchcmax.core.window import Window

ALIGNED = 16  # windows are padded to a multiple, since a matrix product rounds otherwise where rows begin off a cache line
NEAREST = 1e-3  # depth of a warped ray below which it counts as behind the camera


@dataclass(frozen=True)
class Ink:
    """Windows made ready for many warps: basis [W, 3K, N] of `monomials` | weight [W, N], 0 for padding."""

    basis: Tensor
    weight: Tensor

    @classmethod
    def of(cls, window: Window, weight: Tensor, reference: float = 0.5) -> Ink:
        """weight [W, N] that events vote with | reference: the time warped to, 0 the window's first event, 1 its last."""
        basis = monomials(window.ray, window.phase - reference, TERMS)
        spare = (0, -weight.shape[-1] % ALIGNED)
        return cls(pad(basis, spare), pad(weight, spare))

    def sample(self, count: int) -> Ink:
        """`count` events of each window, evenly from its first to its last; repeated where a window has fewer."""
        events = (self.weight != 0).sum(-1, keepdim=True)
        index = (torch.arange(count, device=events.device) * events).div(count, rounding_mode="floor")
        basis = self.basis.gather(-1, index[:, None].expand(-1, self.basis.shape[1], -1))
        return Ink(basis, self.weight.gather(-1, index))


def draw_twin(H_k: Tensor, ink: Ink, canvas: Canvas, owner: Tensor) -> Tensor:
    """The readable twin of `draw`, in plain torch operations."""
    ray = warp(H_k, ink.basis[owner]).mT
    ahead = ray[..., 2] > NEAREST
    xy = canvas.pixels(torch.where(ahead[..., None], ray, ray.new_ones(3)))
    return vote_scatter(xy, ink.weight[owner] * ahead, canvas.size)


def draw(H_k: Tensor, ink: Ink, canvas: Canvas, owner: Tensor) -> Tensor:
    """Warp events and vote them into images, eq. (2.1): one image for each homography.

    H_k [A, K, 3, 3] | ink of W windows | owner [A] int: the window that each homography belongs to -> [A, H, W]

    Differentiable to H_k, once. On the CPU each row is computed by itself, in the cache and the same in any batch.
    """
    if ink.basis.is_cuda and torch.are_deterministic_algorithms_enabled():
        return draw_twin(H_k, ink, canvas, owner)
    image: Tensor = _Draw.apply(H_k.transpose(1, 2).flatten(2), ink, canvas, owner)
    return image


def _portions(ink: Ink, owner: Tensor) -> list[tuple[slice, Tensor, Tensor]]:
    """Rows to compute together, with their basis and weight: one at a time on the CPU, all at once on a GPU."""
    if ink.basis.is_cuda:
        return [(slice(None), ink.basis[owner], ink.weight[owner])]
    return [(slice(i, i + 1), ink.basis[w : w + 1], ink.weight[w : w + 1]) for i, w in enumerate(owner.tolist())]


def _project(flat: Tensor, basis: Tensor, weight: Tensor, canvas: Canvas) -> tuple[Tensor, Tensor, Tensor]:
    """flat [A, 3, 3K] -> focal / depth [A, 1, N], offset from the canvas' centre [A, 2, N] px, weight [A, N] or 0 if behind."""
    ray = flat.clone() @ basis  # a copy begins on a cache line, see ALIGNED
    ahead = ray[:, 2:] > NEAREST
    scale = canvas.focal / torch.where(ahead, ray[:, 2:], 1.0)
    return scale, ray[:, :2] * scale, weight * ahead[:, 0]


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, flat: Tensor, ink: Ink, canvas: Canvas, owner: Tensor) -> Tensor:
        image, projected = flat.new_empty(len(flat), *canvas.size), []
        for rows, basis, weight in _portions(ink, owner):
            scale, offset, weight = _project(flat[rows], basis, weight, canvas)
            image[rows] = votes(offset.mT + flat.new_tensor(canvas.centre), weight, canvas.size)
            projected.append((rows, basis, weight, scale, offset))
        ctx.canvas, ctx.projected = canvas, projected
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        result = []
        for rows, basis, weight, scale, offset in ctx.projected:
            slope = slopes(gradient[rows], offset.mT + offset.new_tensor(ctx.canvas.centre), weight).mT
            to_ray = torch.cat([slope, -(slope * offset).sum(1, keepdim=True) / ctx.canvas.focal], 1) * scale
            result.append(to_ray @ basis.mT)
        return torch.cat(result), None, None, None
