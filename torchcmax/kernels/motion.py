"""Motion models, guard and metric, compiled for the CPU: the twins of core/model.py, core/warp.py and core/objective.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcmax.kernels.compiling import compiled

ROTATION, TRANSLATION, PLANAR_KNOWN, PLANAR = range(4)
STEP = 1e-3  # px: of the central differences of the homography, which is smooth and in float64


class Look(NamedTuple):
    """What is maximized, in numbers."""

    model: int  # ROTATION ... PLANAR
    focal: float
    reference: float  # share of the window
    contrast: int  # place in image.CONTRASTS
    deformation: float
    guard: float
    tilt: float
    closest: float  # plane distances
    grazing: float  # sine
    nearest: float  # depth
    ridge: float


@compiled
def product(a, b, result):
    """result = a b for 3 x 3 matrices."""
    for i in range(3):
        for j in range(3):
            result[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@compiled
def rotated(w, v):
    """exp(w) v, eq. (2.8)."""
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    sine = 1 - angle * angle / 6 if angle < 1e-3 else np.sin(angle) / angle
    half = 0.5 if angle < 1e-3 else np.sin(angle / 2) / angle
    once = np.array([w[1] * v[2] - w[2] * v[1], w[2] * v[0] - w[0] * v[2], w[0] * v[1] - w[1] * v[0]])
    twice = np.array([w[1] * once[2] - w[2] * once[1], w[2] * once[0] - w[0] * once[2], w[0] * once[1] - w[1] * once[0]])
    cosine = 0.5 - angle * angle / 24 if angle < 1e-3 else 2 * half * half
    return v + sine * once + cosine * twice


@compiled
def motion(x, look, known, there):
    """x [P] px -> turn, shift, normal in the frame of the reference camera, there [3, 3]: core.model."""
    there[:] = 0
    there[2] = known
    if look.model != TRANSLATION:
        there[0] = x[:3] / look.focal
    if look.model == TRANSLATION:
        there[1] = x[:3] / look.focal
    if look.model >= PLANAR_KNOWN:
        there[1] = x[3:6] / look.focal
    if look.model == PLANAR:
        tilt = np.array([x[6] / look.focal, x[7] / look.focal, 0.0])
        there[2] = rotated(tilt, np.array([0.0, 0.0, -1.0]))
    if look.model == ROTATION:
        return
    back = -look.reference * there[0]
    distance = 1 + look.reference * (there[1] * there[2]).sum()
    there[1] = rotated(back, there[1]) / max(distance, look.closest)
    there[2] = rotated(back, there[2])


@compiled
def homography(there, H):
    """turn, shift, normal -> H [K, 3, 3]: core.warp.polynomial."""
    turn, shift, normal = there[0], there[1], there[2]
    k = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    line, power, next_power, part = np.empty((3, 3)), np.eye(3), np.empty((3, 3)), np.empty((3, 3))
    along = (normal * shift).sum()
    for i in range(3):
        for j in range(3):
            line[i, j] = (along if i == j else 0.0) - shift[i] * normal[j]
    H[0] = power
    for i in range(1, len(H)):
        product(line, power, part)
        product(k, power, next_power)
        power[:] = next_power / i
        H[i] = power + part


@compiled
def strain(there, H, look, some):
    """What core.objective.penalty watches over at some events: how areas change, and whether a free plane faces them."""
    if look.model == ROTATION:
        return 0.0
    x, y, _, _ = some
    most, total = np.log(look.deformation), 0.0
    along = (there[1] * there[2]).sum()
    for end in (-look.reference, 1 - look.reference):
        distance = max(1 + end * along, look.nearest)
        a = b = c = 0.0
        for k in range(len(H) - 1, -1, -1):
            a, b, c = a * end + H[k, 2, 0], b * end + H[k, 2, 1], c * end + H[k, 2, 2]
        for i in range(len(x)):
            depth = max(a * x[i] + b * y[i] + c, look.nearest)
            square, cube = distance * distance, depth * depth * depth
            if square > look.deformation * cube or cube > look.deformation * square:  # a logarithm for the few that need it
                total += (abs(np.log(square / cube)) - most) ** 2
    cost = look.guard * total / (2 * len(x))
    if look.model == PLANAR:
        n, away = there[2], -np.inf
        for i in range(len(x)):
            away = max(away, n[0] * x[i] + n[1] * y[i] + n[2])
        cost += look.guard * max(away + look.grazing, 0.0) ** 2
    return cost


@compiled
def lean(there, look):
    """The weak pull of core.objective.penalty on a free plane."""
    return look.tilt * 2 * (1 + there[2, 2]) if look.model == PLANAR else 0.0


@compiled
def homography_at(x, look, known, terms):
    """The warp of x [P] to the reference camera: -> H [K, 3, 3], and turn, shift and normal there, [3, 3]."""
    there, H = np.empty((3, 3)), np.empty((terms, 3, 3))
    motion(x, look, known, there)
    homography(there, H)
    return H, there


@compiled
def chained(x, to_H, look, known, some):
    """The derivative of <to_H, H> + guard to x, by central differences of both, which are smooth: -> [P]."""
    H, there = homography_at(x, look, known, len(to_H))
    strained = strain(there, H, look, some) > 0  # where it is zero, so is its derivative
    result = np.zeros(len(x))
    for p in range(len(x)):
        for side in (1.0, -1.0):
            near = x.copy()
            near[p] += side * STEP
            H, there = homography_at(near, look, known, len(to_H))
            cost = (to_H * H).sum() + lean(there, look) + (strain(there, H, look, some) if strained else 0.0)
            result[p] += side * cost / (2 * STEP)
    return result


@compiled
def metric(x, look, known, some, terms):
    """core.objective.metric: [P, P]."""
    px, py, s, weight = some
    parameters, count = len(x), len(px)
    J = np.empty((parameters, 2, count))
    for p in range(parameters):
        J[p] = 0
        for side in (1.0, -1.0):
            near = x.copy()
            near[p] += side
            H, _ = homography_at(near, look, known, terms)
            for i in range(count):
                ray = np.zeros(3)
                for k in range(terms - 1, -1, -1):
                    for r in range(3):
                        ray[r] = ray[r] * s[i] + H[k, r, 0] * px[i] + H[k, r, 1] * py[i] + H[k, r, 2]
                scale = side * look.focal / 2 / max(ray[2], look.nearest) * (weight[i] != 0)
                J[p, 0, i] += ray[0] * scale
                J[p, 1, i] += ray[1] * scale
    G = np.empty((parameters, parameters))
    for p in range(parameters):
        for q in range(parameters):
            G[p, q] = (J[p] * J[q]).sum() / count
    ridge = look.ridge * max(np.trace(G) / parameters, np.finfo(px.dtype).eps)
    for p in range(parameters):
        G[p, p] += ridge
    return G
