"""Equirectangular images without seam, poles included: where their pixels look, how wide they are, and how they are blurred and sampled."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import conv1d

from torchcmax.core.camera import Sphere

NARROW = 0.8  # cosine of the elevation beyond which votes are spread along their row
ROUND = 0.5  # px of blur that a vote has on the equator by being bilinear, and should have everywhere


def directions(sphere: Sphere) -> Tensor:
    """Unit rays of its pixels: [H, W, 3] float64."""
    height, width = sphere.size
    lat, lon = elevations(sphere)[:, None], (torch.arange(width, dtype=torch.float64) - sphere.centre[0]) / sphere.focal
    flat = lat.cos()
    return torch.stack([flat * lon.sin(), lat.sin().expand(height, width), flat * lon.cos()], -1)


def elevations(sphere: Sphere) -> Tensor:
    """Of its rows, down, rad: [H] float64."""
    return (torch.arange(sphere.height, dtype=torch.float64) - sphere.centre[1]) / sphere.focal


@lru_cache(maxsize=8)
def cosines(sphere: Sphere) -> Tensor:
    """How wide pixels are, as a share of the equator's, row by row: [H, 1] float32."""
    return elevations(sphere).cos().float()[:, None]


def tangents(ray: Tensor) -> Tensor:
    """East and south, the directions of rows and columns, at unit rays [..., 3]: [..., 2, 3]."""
    x, y, z = ray.unbind(-1)
    flat = (x * x + z * z).sqrt().clamp_min(1e-9)
    east = torch.stack([z / flat, torch.zeros_like(x), -x / flat], -1)
    return torch.stack([east, torch.stack([-y * x / flat, flat, -y * z / flat], -1)], -2)


def grid_at(ray: tuple[Tensor, Tensor, Tensor], sphere: Sphere) -> Tensor:
    """Where rays x, y, z [h, w] are on a `bordered` image, as grid_sample wants it: [1, h, w, 2] in -1..1."""
    parts = zip(sphere.place(*ray), sphere.size[::-1], strict=True)
    return torch.stack([(place + 1) * (2 / (size + 1)) - 1 for place, size in parts], -1)[None]


def bordered(image: Tensor, sphere: Sphere) -> Tensor:
    """With one pixel more on each side, from beyond the seam and the poles: [..., H, W] -> [1, C, H + 2, W + 2]."""
    part = image.reshape(-1, *image.shape[-2:])
    half = sphere.height
    rows = torch.cat([part[:, :1].roll(half, -1), part, part[:, -1:].roll(half, -1)], 1)
    return torch.cat([rows[:, :, -1:], rows, rows[:, :, :1]], 2)[None]


def steady(votes: Tensor, sphere: Sphere) -> Tensor:
    """Votes spread along the rows near the poles, as wide as they are elsewhere: [H, W] -> [H, W].

    A pixel there is narrow, and few votes fall on each.
    """
    cosine = cosines(sphere)[:, 0]
    rows = ((cosine < NARROW) & (votes.sum(1) > 0)).nonzero()[:, 0]
    if not len(rows):
        return votes
    sigma = ROUND * (1 / cosine[rows].square() - 1).sqrt()
    votes = votes.clone()
    votes[rows] = around(votes[rows], sigma[:, None]).clamp_min_(0)  # rounding
    return votes


def around(rows: Tensor, sigma: Tensor) -> Tensor:
    """Rows that close on themselves, blurred by discrete Gaussians of sigma [R, 1] px: [..., R, W] -> [..., R, W].

    Their transfer function is exp(sigma^2 (cos w - 1)) (Lindeberg 1990): as narrow as they may be, they are nowhere negative.
    """
    width = rows.shape[-1]
    wave = 2 * math.pi * torch.arange(width // 2 + 1, dtype=rows.dtype) / width
    soft: Tensor = torch.fft.irfft(torch.fft.rfft(rows) * torch.exp(sigma.square() * (wave.cos() - 1)), n=width)
    return soft


def smooth(image: Tensor, sigma: float, sphere: Sphere) -> Tensor:
    """Blurred by a Gaussian of sigma px on the sphere, everywhere the same: [H, W] -> [H, W].

    Along each row, wider where pixels are narrower; then across the rows, on over the poles half way round.
    """
    height, width = sphere.size
    image = around(image, sigma / cosines(sphere))
    reach = min(height, math.ceil(4 * sigma))
    over = image.roll(width // 2, -1).flip(-2)
    padded = torch.cat([over[height - reach :], image, over[:reach]])
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=image.dtype) / sigma).square())
    soft: Tensor = conv1d(padded.T[:, None], (kernel / kernel.sum())[None, None])[:, 0].T
    return soft
