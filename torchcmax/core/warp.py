"""The one warp of the package: a ray meets the plane and is seen from the reference camera."""

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose

TERMS = 6  # of the power series of exp: 0.00006 px off at 0.2 rad from the reference, 0.005 px at 0.4 rad


def transfer(ray: Tensor, pose: Pose, plane: Plane) -> Tensor:
    """Carry rays of posed cameras through the plane to the reference camera, eq. (2.6), (2.10), (2.14).

    ray [B, N, 3] | pose [B, N] or [B, 1] | plane [B], in the reference frame -> [B, N, 3], up to scale

    It is x' ~ (I + t n^T / d)^-1 R x; Sherman-Morrison gives the inverse, so no matrix is inverted.
    """
    n, d = plane.normal[:, None], plane.distance[:, None, None]
    x = (pose.R @ ray[..., None])[..., 0]
    depth = d + (n * pose.t).sum(-1, keepdim=True)  # distance of the moved camera to the plane
    return x - pose.t * (n * x).sum(-1, keepdim=True) / depth


def polynomial(turn: Tensor, shift: Tensor, normal: Tensor, terms: int = TERMS) -> Tensor:
    """The homography of `transfer` as a polynomial of time, H(s) = sum_k H_k s^k, for constant velocity.

    turn [B, 3] rad per window | shift [B, 3] plane distances per window | normal [B, 3] unit -> H_k [B, K, 3, 3]

    s is the time from the reference in window lengths. Without the division by the depth, which is common to the three
    coordinates, (2.6) is [(1 + s n.v) I - s v n^T] exp(s w^): a line times the power series of the exponential.
    """
    eye = torch.eye(3, dtype=turn.dtype, device=turn.device)
    line = (normal * shift).sum(-1)[:, None, None] * eye - shift[:, :, None] * normal[:, None]
    power, powers = eye.expand_as(line), []
    k = so3.hat(turn)
    for i in range(terms):
        powers.append(power)
        power = k @ power / (i + 1)
    series = torch.stack(powers, 1)
    return torch.cat([series[:, :1], series[:, 1:] + line[:, None] @ series[:, :-1]], 1)


def still(like: Tensor) -> Tensor:
    """The homographies that leave every ray where it is, as many as there are: like [B, K, 3, 3] -> H_k [B, K, 3, 3]."""
    H_k = torch.zeros_like(like)
    H_k[:, 0] = torch.eye(3).to(H_k)
    return H_k


def monomials(ray: Tensor, s: Tensor, terms: int = TERMS) -> Tensor:
    """What a polynomial homography is multiplied with: ray [B, N, 3] | s [B, N] -> [B, 3K, N], row 3k + i is s^k ray_i."""
    rows = [ray.mT]
    for _ in range(terms - 1):
        rows.append(rows[-1] * s[:, None])
    return torch.cat(rows, 1)


def warp(H_k: Tensor, basis: Tensor) -> Tensor:
    """Rays of the reference camera, up to scale: H_k [B, K, 3, 3] | basis [B, 3K, N] of `monomials` -> [B, 3, N]."""
    return H_k.transpose(1, 2).flatten(2) @ basis
