"""The search for the sharpest image of one window, compiled for the CPU: the twin of core/objective.py and core/minimize.py."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from torchcmax.kernels.compiling import compiled
from torchcmax.kernels.events import draw, draw_slopes
from torchcmax.kernels.image import CONTRASTS, blur, border, contrast
from torchcmax.kernels.motion import chained, homography_at, lean, metric, strain

MICHELSON = CONTRASTS.index("michelson")


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
def sharpness(H, code, scene):
    """The normalized contrast of one image."""
    scene.frames[0] = 0
    rows = draw(H, scene.events, scene.lens, scene.frames[0].reshape(-1))
    return develop(code, scene.kernel, scene.frames, scene.line, rows) / energy_of(scene.events[3], code, scene.frames)


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
def noted(trace, count, value):
    """The trace with one more value, in more room where there is none left."""
    if count == len(trace):
        trace = np.concatenate((trace, np.empty(count)))
    trace[count] = value
    return trace


@compiled
def search(x, look, scene, stop, terms):
    """Minimize from x [P]: -> x, value, iterations, evaluations, converged, trace [T] as core.minimize."""
    G = metric(x, look, scene.normal, scene.some, terms)
    plain, H = inverted(G), np.empty((terms, 3, 3), scene.lens.dtype)
    inverse, eps = plain.copy(), np.finfo(scene.lens.dtype).eps
    energy = energy_of(scene.events[3], look.contrast, scene.frames)
    value, developed = value_at(x, look, scene, energy, H)
    gradient = slope_at(x, developed, look, scene, H)
    trace = noted(np.empty(64), 0, value)
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
        if good:
            scaled |= learn(inverse, near - x, gradient_new - gradient, not scaled)
            x, value, gradient = near, value_new, gradient_new
            iterations, trials, low, high = iterations + 1, 0, 0.0, np.inf
            step, limit, length = aimed(inverse, gradient, G, scaled, stop)
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
        trace, evaluations = noted(trace, evaluations, value), evaluations + 1
        done = converged or iterations >= stop.iterations or trials >= stop.trials
    return x, value, iterations, evaluations, converged, trace[:evaluations]
