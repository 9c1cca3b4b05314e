"""Rotations: hat (2.9), exponential map (2.8), logarithm and quaternions, smooth at zero."""

import torch
from torch import Tensor

SMALL = 1e-4  # rad^2: below it the series is exact to the last bit of float64


def hat(w: Tensor) -> Tensor:
    """Cross-product matrix, eq. (2.9): w [..., 3] -> [..., 3, 3]."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).view(*w.shape[:-1], 3, 3)


def _sine_ratios(w: Tensor) -> tuple[Tensor, Tensor]:
    """sin θ/θ and (1 − cos θ)/θ² for w [..., 3] -> each [..., 1, 1]."""
    theta2 = (w * w).sum(-1)[..., None, None]
    small = theta2 < SMALL
    theta = torch.where(small, 1.0, theta2).sqrt()  # keeps the unused branch free of nan gradients
    half = (theta / 2).sin() / theta
    a = torch.where(small, 1 - theta2 / 6 * (1 - theta2 / 20), theta.sin() / theta)
    return a, torch.where(small, 0.5 - theta2 / 24 * (1 - theta2 / 30), 2 * half * half)


def _third_ratio(w: Tensor, a: Tensor) -> Tensor:
    """(θ − sin θ)/θ³ for w [..., 3], from a = sin θ/θ -> [..., 1, 1]."""
    theta2 = (w * w).sum(-1)[..., None, None]
    small = theta2 < SMALL
    return torch.where(small, 1 / 6 - theta2 / 120 * (1 - theta2 / 42), (1 - a) / torch.where(small, 1.0, theta2))


def exp(w: Tensor) -> Tensor:
    """Rotation matrix of a rotation vector, eq. (2.8): w [..., 3] rad -> [..., 3, 3]."""
    a, b = _sine_ratios(w)
    k = hat(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + a * k + b * (k @ k)


def right_jacobian(w: Tensor) -> Tensor:
    """J with exp(w + dw) = exp(w) exp(J dw), the first-order step of eq. (A.8): w [..., 3] rad -> [..., 3, 3]."""
    a, b = _sine_ratios(w)
    k, c = hat(w), _third_ratio(w, a)
    return torch.eye(3, dtype=w.dtype, device=w.device) - b * k + c * (k @ k)


def to_quaternion(R: Tensor) -> Tensor:
    """Unit quaternion (x, y, z, w), w >= 0: R [..., 3, 3] -> [..., 4].

    Of the four algebraically equal rows the one with the largest pivot is taken, so nothing is divided by a small number.
    """
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    xy, yz, zx = R[..., 0, 1] + R[..., 1, 0], R[..., 1, 2] + R[..., 2, 1], R[..., 2, 0] + R[..., 0, 2]
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    rows = torch.stack(
        [
            torch.stack([1 + xx - yy - zz, xy, zx, wx], -1),
            torch.stack([xy, 1 - xx + yy - zz, yz, wy], -1),
            torch.stack([zx, yz, 1 - xx - yy + zz, wz], -1),
            torch.stack([wx, wy, wz, 1 + xx + yy + zz], -1),
        ],
        -2,
    )
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*R.shape[:-2], 1, 4)
    q = torch.nn.functional.normalize(rows.gather(-2, best)[..., 0, :], dim=-1)
    return torch.where(q[..., 3:] < 0, -q, q)


def from_quaternion(q: Tensor) -> Tensor:
    """Rotation matrix of a quaternion (x, y, z, w), of any length but zero: q [..., 4] -> [..., 3, 3]."""
    q = torch.nn.functional.normalize(q, dim=-1)
    k = hat(q[..., :3])
    return torch.eye(3, dtype=q.dtype, device=q.device) + 2 * (q[..., 3, None, None] * k + k @ k)


def log(R: Tensor) -> Tensor:
    """Rotation vector of a rotation matrix, the inverse of eq. (2.8), length at most π: R [..., 3, 3] -> [..., 3] rad."""
    q = to_quaternion(R)
    sine, cosine = q[..., :3].norm(dim=-1, keepdim=True), q[..., 3:]
    small = sine < 1e-6  # there the angle is 2 |q| to the last bit
    safe = torch.where(small, 1.0, sine)
    return q[..., :3] * torch.where(small, 2.0, 2 * torch.atan2(safe, cosine) / safe)
