"""Images from warped events: the Dirac delta of eq. (2.1) as a bilinear vote (fig. A.1), with its gradient (A.3), (A.14)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchcmax import kernels

BILINEAR, ZEROS, ALIGN_CORNERS = 0, 0, True  # how aten spells the options of grid_sample


def _check(xy: Tensor, weight: Tensor) -> None:
    if xy.ndim != 3 or xy.shape[-1] != 2 or weight.shape != xy.shape[:2]:
        raise ValueError(f"vote wants xy [B, N, 2] and weight [B, N], got {[*xy.shape]} and {[*weight.shape]}")


def vote_scatter(xy: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
    """The readable twin of `vote`: differentiable any number of times, and repeatable on CUDA.

    xy [B, N, 2] px (x right, y down) | weight [B, N], zero for padding | size (H, W) -> [B, H, W]
    """
    _check(xy, weight)
    batch, (height, width) = len(xy), size
    corner = xy.detach().floor()
    fx, fy = (xy - corner).unbind(-1)  # the gradient flows through these areas alone
    left, top = corner.clamp(-2, max(size) + 1).long().unbind(-1)

    image = xy.new_zeros(batch, height * width)
    for dx, wx in ((0, 1 - fx), (1, fx)):
        for dy, wy in ((0, 1 - fy), (1, fy)):
            x, y = left + dx, top + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            pixel = (y * width + x).where(inside, 0)
            image = image.scatter_add(1, pixel, (wx * wy * weight).where(inside, 0))
    return image.view(batch, height, width)


def vote(xy: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
    """Sum weights into the four pixels around each point; the part of a vote that falls outside is dropped.

    xy [B, N, 2] px (x right, y down) | weight [B, N], zero for padding | size (H, W) -> [B, H, W]

    The bilinear vote is the adjoint of the bilinear look-up, which torch has as the backward pass of grid_sample, several
    times faster than four scatters. It has one derivative; where a second is wanted, or determinism on CUDA, take the twin.
    """
    _check(xy, weight)
    if xy.is_cuda and torch.are_deterministic_algorithms_enabled():
        return vote_scatter(xy, weight, size)
    image: Tensor = _Vote.apply(xy, weight, size)
    return image


def vote_moved(xy: Tensor, motion: Tensor, s: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
    """`vote` of points that go on in a straight line, xy + s motion.

    xy, motion [B, N, 2] px | s, weight [B, N] | size (H, W) -> [B, H, W].  By the CPU's kernels, where it has any; differentiable once.
    """
    _check(xy, weight)
    if motion.shape != xy.shape or s.shape != weight.shape:
        raise ValueError(f"vote_moved wants motion [B, N, 2] and s [B, N] as xy and weight, got {[*motion.shape]} and {[*s.shape]}")
    if _kernels(xy, weight, size) is None or xy.requires_grad or s.requires_grad:
        return vote_moved_twin(xy, motion, s, weight, size)
    image: Tensor = _VoteMoved.apply(xy, motion.to(xy), s.to(xy), weight, size)
    return image


def vote_moved_twin(xy: Tensor, motion: Tensor, s: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
    """The readable twin of `vote_moved`."""
    return vote(torch.addcmul(xy, motion, s[..., None]), weight, size)


class _VoteMoved(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, xy: Tensor, motion: Tensor, s: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
        ctx.save_for_backward(xy, motion, s, weight)
        ctx.fast = _kernels(xy, weight, size)
        image: Tensor = ctx.fast.vote_moved(xy, motion, s, weight, size)
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor | None, None, Tensor | None, None]:
        to_motion, to_weight = ctx.fast.vote_moved_slopes(*ctx.saved_tensors, gradient, ctx.needs_input_grad[1:4:2])
        return None, to_motion, None, to_weight, None


def _kernels(xy: Tensor, weight: Tensor, size: tuple[int, int]) -> Any:
    """The CPU's for such points and such an image, None where there are none, or torch.compile looks on."""
    alike = xy.device.type == weight.device.type == "cpu" and xy.dtype == weight.dtype
    return kernels.drawing(xy, (size[0] + 2) * (size[1] + 2)) if alike and not torch.compiler.is_compiling() else None


class _Vote(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, xy: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
        ctx.save_for_backward(xy, weight)
        ctx.size = size
        return votes(xy, weight, size)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        xy, weight = ctx.saved_tensors
        to_xy = slopes(gradient, xy, weight) if ctx.needs_input_grad[0] else None
        to_weight = None
        if ctx.needs_input_grad[1]:
            to_weight = torch.grid_sampler_2d(gradient[:, None], _grid(xy, ctx.size), BILINEAR, ZEROS, ALIGN_CORNERS)[:, 0, 0]
        return to_xy, to_weight, None


def votes(xy: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
    """`vote` without its derivative; xy [B, N, 2] | weight [B, N] | size (H, W) -> [B, H, W]."""
    canvas = xy.new_zeros(1).expand(len(xy), 1, *size)
    image: Tensor = torch.ops.aten.grid_sampler_2d_backward(
        weight[:, None, None], canvas, _grid(xy, size), BILINEAR, ZEROS, ALIGN_CORNERS, [True, False]
    )[0]
    return image[:, 0]


def slopes(gradient: Tensor, xy: Tensor, weight: Tensor) -> Tensor:
    """The derivative of `vote` to the points: weight x slope of dL/dI [B, H, W] at each of them, (A.3), -> [B, N, 2]."""
    size = gradient.shape[1:]
    to_grid: Tensor = torch.ops.aten.grid_sampler_2d_backward(
        weight[:, None, None], gradient[:, None].contiguous(), _grid(xy, size), BILINEAR, ZEROS, ALIGN_CORNERS, [False, True]
    )[1]
    return to_grid[:, 0] * _grid_scale(xy, size)


def _grid_scale(xy: Tensor, size: tuple[int, ...]) -> Tensor:
    height, width = size
    return xy.new_tensor([2 / (width - 1), 2 / (height - 1)])


def _grid(xy: Tensor, size: tuple[int, ...]) -> Tensor:
    """Pixels to the coordinates -1..1 of grid_sample: [B, N, 2] -> [B, 1, N, 2]."""
    return (xy * _grid_scale(xy, size) - 1)[:, None]
