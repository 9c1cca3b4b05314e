"""The search for the sharpest image of one window, compiled for the CPU: the twin of core/objective.py and core/minimize.py."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from torchcmax.kernels.compiling import compiled
from torchcmax.kernels.events import draw, draw_slopes
from torchcmax.kernels.image import CONTRASTS, blur, border, contrast

ROTATION, TRANSLATION, PLANAR_KNOWN, PLANAR = range(4)
STEP = 1e-3  # px: of the central differences of the homography, which is smooth and in float64
MICHELSON = CONTRASTS.index("michelson")


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


class Stop(NamedTuple):
    """As core.minimize.Stop."""

    tolerance: float
    iterations: int
    trials: int
    longest: float
    armijo: float
    wolfe: float


class Scene(NamedTuple):
    """A window and where it is drawn.  dtype of all but the normal: that of the events."""

    events: Any  # x, y, s, weight [N]
    some: Any  # the same of a sample [M]
    normal: Any  # [3] float64, of the known plane
    lens: Any
    kernel: Any  # taps of the blur
    frames: Any  # [3, H + 2, W + 2] scratch
    line: Any  # [W + 2 + 2 radius] scratch


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
def metric(x, look, scene, terms):
    """core.objective.metric: [P, P]."""
    px, py, s, weight = scene.some
    parameters, count = len(x), len(px)
    J = np.empty((parameters, 2, count))
    for p in range(parameters):
        J[p] = 0
        for side in (1.0, -1.0):
            near = x.copy()
            near[p] += side
            H, _ = homography_at(near, look, scene.normal, terms)
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


@compiled
def inverted(G):
    """Inverse of a positive definite matrix by Gauss and Jordan, so that scipy is not needed."""
    left, right = G.copy(), np.eye(len(G))
    for p in range(len(G)):
        pivot = left[p, p]
        left[p] /= pivot
        right[p] /= pivot
        for q in range(len(G)):
            factor = left[q, p]
            if q != p:
                left[q] -= factor * left[p]
                right[q] -= factor * right[p]
    return right


@compiled
def energy_of(weight, code, frames):
    """Contrast of events that each lie on a pixel of their own, as core.contrast.normalized; Michelson's knows no scale."""
    total = weight.dtype.type(0)
    for i in range(len(weight)):
        total += weight[i] * weight[i]
    if total == 0 or code == MICHELSON:
        return 1.0
    return float(total) / ((frames.shape[1] - 2) * (frames.shape[2] - 2))


@compiled
def homography_at(x, look, known, terms):
    """The warp of x [P] to the reference camera: -> H [K, 3, 3], and turn, shift and normal there, [3, 3]."""
    there, H = np.empty((3, 3)), np.empty((terms, 3, 3))
    motion(x, look, known, there)
    homography(there, H)
    return H, there


@compiled
def develop(code, kernel, frames, line, rows):
    """The contrast of the votes in these rows of frames[0]; its derivative to the blurred image is left in frames[2]."""
    votes, blurred, radius, (first, last) = frames[0], frames[1], len(kernel) - 1, rows
    border(votes)
    blurred[: max(first - radius, 1)] = 0  # rows that no vote reaches: a third of them, as the canvas is wider than the sensor
    blurred[min(last + radius, len(votes) - 1) :] = 0
    blur(votes, kernel, line, blurred, (first - radius, last + radius))
    border(blurred)
    return contrast(code, blurred, frames[2], votes)


@compiled
def develop_slope(kernel, frames, line, rows):
    """The derivative of `develop` to the votes, right after it: left in frames[0], in these rows, which had votes."""
    blur(frames[2], kernel, line, frames[0], rows)
    border(frames[0])


@compiled
def sharpness(H, events, lens, kernel, code, frames, line):
    """The normalized contrast of one image."""
    frames[0] = 0
    rows = draw(H, events, lens, frames[0].reshape(-1))
    return develop(code, kernel, frames, line, rows) / energy_of(events[3], code, frames)


@compiled
def value_at(x, look, scene, energy, H):
    """-log contrast + guard at x; the contrast and the rows with votes are for `slope_at`, and so are H [K, 3, 3] and scene.frames."""
    exact, there = homography_at(x, look, scene.normal, len(H))
    H[:] = exact
    scene.frames[0] = 0
    rows = draw(H, scene.events, scene.lens, scene.frames[0].reshape(-1))
    sharp = develop(look.contrast, scene.kernel, scene.frames, scene.line, rows)
    return strain(there, exact, look, scene.some) + lean(there, look) - np.log(sharp / energy), (sharp, rows)


@compiled
def slope_at(x, developed, look, scene, H):
    """The derivative of `value_at`, right after it: -> [P]."""
    to_H = np.zeros(H.shape)
    sharp, rows = developed
    develop_slope(scene.kernel, scene.frames, scene.line, rows)
    draw_slopes(H, scene.events, scene.lens, scene.frames[0].reshape(-1), to_H)
    to_H /= -sharp
    return chained(x, to_H, look, scene.normal, scene.some)


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
def evaluate(x, look, scene, terms):
    """Value and derivative at x."""
    H = np.empty((terms, 3, 3), scene.lens.dtype)
    value, developed = value_at(x, look, scene, energy_of(scene.events[3], look.contrast, scene.frames), H)
    return value, slope_at(x, developed, look, scene, H)


@compiled
def length_in(step, G):
    """px: length of a step [P] in the metric."""
    return np.sqrt(max((step * (G * step).sum(1)).sum(), 0.0))


@compiled
def learn(inverse, s, y, first):
    """BFGS update of the inverse Hessian in place, as core.minimize; whether there was something to learn."""
    sy, Hy = (s * y).sum(), (inverse * y).sum(1)
    yHy = (y * Hy).sum()
    if not (sy > 0 and yHy > 0):
        return False
    if first:
        inverse *= sy / yHy
        Hy *= sy / yHy
        yHy = sy
    for i in range(len(s)):
        for j in range(len(s)):
            inverse[i, j] += (1 + yHy / sy) * s[i] * s[j] / sy - (Hy[i] * s[j] + s[i] * Hy[j]) / sy
    return True


@compiled
def aimed(inverse, gradient, G, scaled, stop):
    """A new step, the longest share of it, and the share to try first: core.minimize."""
    step = -(inverse * gradient).sum(1)
    limit = stop.longest / max(length_in(step, G), 1e-300)
    return step, limit, min(limit, 1.0) if scaled else limit / max(1.0, stop.longest)


@compiled
def narrowed(length, low, high, limit, guess):
    """The next length to try: the guess, kept off the ends of the bracket, or twice as far while it is open."""
    if np.isinf(high):
        return min(2 * length, limit)
    share = (guess - low) / (high - low)
    return low + (high - low) * (min(max(share, 0.1), 0.5) if np.isfinite(share) else 0.1)


@compiled
def search(x, look, scene, stop, terms):
    """Minimize from x [P]: -> x, value, iterations, evaluations, converged, trace [T] as core.minimize."""
    G = metric(x, look, scene, terms)
    plain, H = inverted(G), np.empty((terms, 3, 3), scene.lens.dtype)
    inverse, eps = plain.copy(), np.finfo(scene.lens.dtype).eps
    energy = energy_of(scene.events[3], look.contrast, scene.frames)
    trace = np.empty(1 + stop.iterations * (stop.trials + 1))
    value, developed = value_at(x, look, scene, energy, H)
    gradient = slope_at(x, developed, look, scene, H)
    trace[0] = value
    iterations, trials, evaluations, scaled = 0, 0, 1, False
    converged = np.abs(gradient).max() == 0
    done = converged or not np.isfinite(value)
    step, limit, length = aimed(inverse, gradient, G, scaled, stop)
    low, high = 0.0, np.inf
    while not done:
        near = x + length * step
        value_new, developed = value_at(near, look, scene, energy, H)
        slope = (gradient * step).sum()
        good = value_new <= value + stop.armijo * length * slope + 4 * eps * abs(value)
        gradient_new, guess = gradient, -slope * length * length / (2 * (value_new - value - slope * length))
        too_long = not good
        if good:
            gradient_new = slope_at(near, developed, look, scene, H)
            good = not ((gradient_new * step).sum() < stop.wolfe * slope and length < limit)
        trace[evaluations] = value
        evaluations += 1
        if good:
            scaled |= learn(inverse, near - x, gradient_new - gradient, not scaled)
            x, value, gradient = near, value_new, gradient_new
            iterations, trials, low, high = iterations + 1, 0, 0.0, np.inf
            step, limit, length = aimed(inverse, gradient, G, scaled, stop)
            trace[evaluations - 1] = value
            converged = scaled and length * length_in(step, G) < stop.tolerance
            if converged:  # the last step is as good as sure, and not evaluated
                x = x + length * step
        else:
            low, high, trials = (low, length, trials + 1) if too_long else (length, high, trials + 1)
            length = narrowed(length, low, high, limit, guess)
            if high * length_in(step, G) < stop.tolerance:
                converged = not scaled
                if scaled:  # perhaps the curvature was wrong: once more without it
                    inverse, scaled, trials, low, high = plain.copy(), False, 0, 0.0, np.inf
                    step, limit, length = aimed(inverse, gradient, G, scaled, stop)
        done = converged or iterations >= stop.iterations or trials >= stop.trials
    return x, value, iterations, evaluations, converged, trace[:evaluations]
