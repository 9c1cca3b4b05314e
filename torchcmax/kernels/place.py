"""A state before a plane, and how events come onto the map from there, compiled for the CPU: the twin of core/state.py."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from torchcmax.kernels.compiling import compiled
from torchcmax.kernels.motion import homography, product, rotated

SIZE = 14  # numbers of a step: turn, shift, angular velocity, velocity, tilt of the plane
NEAR = 1e-5  # px: of the differences of the homography, some 1e-8 of it off


class Place(NamedTuple):
    """A state, the plane, and where the texture lies on it; all float64."""

    R: Any  # [3, 3] camera to world
    t: Any  # [3]
    omega: Any
    velocity: Any
    normal: Any  # [3] of the plane in the world
    across: Any  # [2, 3] directions along the plane, in which its normal tilts
    distance: float
    closest: float
    facing: Any  # [3, 3] turn from the world to the texture
    corner: Any  # [2] px of the texture's first pixel
    seconds: float
    focal: float


@compiled
def units(place):
    """What one px is of each number of a step: [14]."""
    u = np.empty(SIZE)
    away = max(place.distance + (place.normal * place.t).sum(), place.closest)
    u[0:3] = 1 / place.focal
    u[3:6] = away / place.focal
    u[6:9] = 1 / (place.focal * place.seconds)
    u[9:12] = away / (place.focal * place.seconds)
    u[12:14] = 1 / place.focal
    return u


@compiled
def turned(R, w):
    """R exp(w)."""
    result = np.empty((3, 3))
    for i in range(3):
        result[i] = rotated(-w, R[i])  # the rows of R exp(w) are exp(-w) applied to those of R
    return result


@compiled
def placed(x, u, place, H):
    """The warp onto the texture after a step x [14] px: H [K, 3, 3], as State.homography."""
    R = turned(place.R, x[:3] * u[:3])
    t, there, M = place.t.copy(), np.empty((3, 3)), np.empty((3, 3))
    normal = place.normal + x[12] * u[12] * place.across[0] + x[13] * u[13] * place.across[1]
    normal /= np.sqrt((normal * normal).sum())
    for i in range(3):
        t[i] += (place.R[i] * x[3:6] * u[3:6]).sum()
    away = max(place.distance + (normal * t).sum(), place.closest)
    there[0] = (place.omega + x[6:9] * u[6:9]) * place.seconds
    there[1] = (place.velocity + x[9:12] * u[9:12]) * place.seconds / away
    for i in range(3):
        there[2, i] = (R[:, i] * normal).sum()
    for i in range(3):
        for j in range(3):
            M[i, j] = away * R[i, j] - t[i] * there[2, j]
    onto, part = np.empty((3, 3)), np.empty((3, 3))
    product(place.facing, M, onto)
    for i in range(2):
        onto[i] -= place.corner[i] / place.focal * onto[2]
    homography(there, H)
    for k in range(len(H)):
        product(onto, H[k], part)
        H[k] = part


@compiled
def derivatives(x, u, place, terms):
    """dH/dx by differences of numbers that are smooth and in float64: [14, K, 9]."""
    dH, H, first = np.empty((SIZE, terms, 9)), np.empty((terms, 3, 3)), np.empty((terms, 3, 3))
    placed(x, u, place, first)
    near = x.copy()
    for p in range(SIZE):
        near[p] = x[p] + NEAR
        placed(near, u, place, H)
        near[p] = x[p]
        for k in range(terms):
            for i in range(9):
                dH[p, k, i] = (H[k, i // 3, i % 3] - first[k, i // 3, i % 3]) / NEAR
    return dH


@compiled
def at_time(dH, s, D):
    """sum_k s^k dH_k: D [14, 9]."""
    D[:] = 0
    for k in range(dH.shape[1] - 1, -1, -1):
        for p in range(SIZE):
            for i in range(9):
                D[p, i] = D[p, i] * s + dH[p, k, i]


@compiled
def chain(x, u, place, to_H, count):
    """The derivative of <to_H, H> to the first numbers of x, by differences as `derivatives`: [14], the others zero."""
    slope, H = np.zeros(SIZE), np.empty(to_H.shape)
    placed(x, u, place, H)
    first, near = inner(to_H, H), x.copy()
    for p in range(count):
        near[p] = x[p] + NEAR
        placed(near, u, place, H)
        near[p] = x[p]
        slope[p] = (inner(to_H, H) - first) / NEAR
    return slope


@compiled
def inner(a, b):
    """Sum of products of the numbers of two arrays."""
    total, left, right = 0.0, a.reshape(-1), b.reshape(-1)
    for i in range(len(left)):
        total += left[i] * right[i]
    return total
