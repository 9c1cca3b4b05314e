"""How good a panorama is by itself, without truth, as the literature measures it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcmax.core.camera import Sphere
from torchcmax.slam.equirect import cosines, smooth

SIGMA = 1.0  # px of blur before gradients are taken


@dataclass(frozen=True)
class Quality:
    """seen_share: of the sphere | event_area, event_area_sr: px, and steradians, that hold events, 1 - exp(-votes) of each counted

    gradient_magnitude: mean square of the gradient of the votes, where something was seen.  Of two panoramas of the same events the one
    with less area and more gradient is the sharper one.
    """

    seen_share: float
    event_area: float
    event_area_sr: float
    gradient_magnitude: float


def quality(votes: Tensor, seen: Tensor, sphere: Sphere) -> Quality:
    """Of a panorama: votes [H, W] of its events, unsigned, as many as a pixel of the equator would have; seen [H, W] bool.

    Event area and gradient magnitude as Gallego et al., Focus Is All You Need (CVPR 2019), tab. 1, integrated over the sphere; the two by
    which Guo and Gallego judge maps (CMax-SLAM, T-RO 2024).
    """
    if votes.shape != sphere.size or seen.shape != votes.shape:
        raise ValueError(f"quality wants votes and seen {[*sphere.size]}, got {[*votes.shape]} and {[*seen.shape]}")
    width = cosines(sphere).to(votes)
    area = width.expand_as(votes)
    held = float((area * (1 - torch.exp(-votes.clamp_min(0)))).sum())
    soft = smooth(votes, SIGMA, sphere)
    down = (soft[2:] - soft[:-2]) / 2
    east = (soft.roll(-1, 1) - soft.roll(1, 1))[1:-1] / 2 / width[1:-1]
    inner, where = area[1:-1], (seen[2:] & seen[:-2] & seen[1:-1]).to(votes)
    steep = float(((down.square() + east.square()) * inner * where).sum() / (inner * where).sum().clamp_min(1e-9))
    whole = float(area.sum())
    return Quality(float((area * seen).sum()) / whole, held, held / whole * 4 * math.pi, steep)
