"""Minimize many small problems at once, each row by itself: quasi-Newton with its own history and its own line search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Objective = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""x [A, P], rows [A] -> value [A], gradient [A, P]: line i depends on x[i] alone and belongs to problem rows[i]."""


@dataclass(frozen=True)
class Stop:
    """When a row is done, and how far it may step.  px are lengths in the metric of `minimize`."""

    tolerance: float = 0.01
    """px: a row is done when its full step would be shorter."""
    iterations: int = 40
    """Accepted steps at most."""
    trials: int = 12
    """Evaluations of one line search at most."""
    longest: float = 6.0
    """px: longest step."""
    armijo: float = 1e-4
    """Share of the promised decrease that a step must bring."""
    wolfe: float = 0.9
    """Share of the slope that may be left after a step."""


@dataclass(frozen=True)
class Minimum:
    """Where each row ended: x [B, P] | value [B] | iterations, evaluations [B] int | converged [B] bool | trace [B, T].

    trace holds the value after every round of evaluations; the last value stays when a row is done before the others.
    """

    x: Tensor
    value: Tensor
    iterations: Tensor
    evaluations: Tensor
    converged: Tensor
    trace: Tensor


def minimize(objective: Objective, x: Tensor, metric: Tensor | None = None, stop: Stop | None = None) -> Minimum:
    """Quasi-Newton (BFGS) from x, row by row; a row that is done is no longer evaluated.

    x [B, P] | metric [B, P, P] positive definite: squared length of a step, and the first guess of the curvature's shape

    It is L-BFGS whose history is never cut: at P <= 12 the inverse Hessian is smaller than the vectors L-BFGS keeps.
    Line search by bracketing to the weak Wolfe conditions (Nocedal & Wright, Numerical Optimization, ch. 3 and 6).
    """
    stop = stop or Stop()
    batch, size = x.shape
    metric = torch.eye(size).to(x).expand(batch, -1, -1) if metric is None else metric
    everyone = torch.arange(batch, device=x.device)
    x, (value, gradient) = x.clone(), objective(x, everyone)
    inverse = torch.linalg.inv(metric)
    step, _, limit = _aim(gradient, inverse, metric, stop)
    length = limit / stop.longest  # the scale is not known yet: try one pixel
    low, high = torch.zeros_like(value), torch.full_like(value, torch.inf)
    iterations, evaluations, trials = torch.zeros_like(everyone), torch.ones_like(everyone), torch.zeros_like(everyone)
    converged = gradient.abs().amax(-1) == 0
    done, trace = converged | ~value.isfinite(), [value.clone()]

    while not done.all():
        rows = (~done).nonzero()[:, 0]
        d, a, f, g, m = step[rows], length[rows], value[rows], gradient[rows], metric[rows]
        trial = x[rows] + a[:, None] * d
        f_new, g_new = objective(trial, rows)
        evaluations[rows] += 1
        slope, slope_new = (g * d).sum(-1), (g_new * d).sum(-1)
        slack = 4 * torch.finfo(x.dtype).eps * f.abs()
        too_long = ~(f_new <= f + stop.armijo * a * slope + slack)  # also where f_new is nan
        too_short = ~too_long & (slope_new < stop.wolfe * slope) & (a < limit[rows])
        good = ~too_long & ~too_short

        took = rows[good]
        first = iterations[took] == 0
        inverse[took] = _update(inverse[took], a[good, None] * d[good], g_new[good] - g[good], first)
        x[took], value[took], gradient[took] = trial[good], f_new[good], g_new[good]
        step[took], length[took], limit[took] = _aim(gradient[took], inverse[took], metric[took], stop)
        low[took], high[took], trials[took] = 0, torch.inf, 0
        iterations[took] += 1

        again = rows[~good]
        low[again] = torch.where(too_short, a, low[rows])[~good]
        high[again] = torch.where(too_long, a, high[rows])[~good]
        parabola = -slope * a * a / (2 * (f_new - f - slope * a))  # lowest point through f, slope and f_new
        length[again] = _between(parabola[~good], low[again], high[again], limit[again])
        trials[again] += 1

        reach = torch.where(good, length[rows], high[rows]) * _norm(step[rows], m)
        converged[rows] = reach < stop.tolerance
        spent = (iterations[rows] >= stop.iterations) | (trials[rows] >= stop.trials)
        done[rows] = converged[rows] | spent
        trace.append(value.clone())
    return Minimum(x, value, iterations, evaluations, converged, torch.stack(trace, 1))


def _norm(step: Tensor, metric: Tensor) -> Tensor:
    """Length of steps in px: step [B, P] | metric [B, P, P] -> [B]."""
    return (step[:, None] @ metric @ step[:, :, None])[:, 0, 0].clamp_min(0).sqrt()


def _aim(gradient: Tensor, inverse: Tensor, metric: Tensor, stop: Stop) -> tuple[Tensor, Tensor, Tensor]:
    """The quasi-Newton step, the length of it to try first, and the length never to pass."""
    step = -(inverse @ gradient[..., None])[..., 0]
    limit = stop.longest / _norm(step, metric).clamp_min(torch.finfo(step.dtype).tiny)
    return step, limit.clamp_max(1.0), limit


def _between(guess: Tensor, low: Tensor, high: Tensor, limit: Tensor) -> Tensor:
    """The next length to try: the guess, kept off the ends of the bracket; twice the last while there is no upper end."""
    bracketed = low + torch.minimum(torch.maximum((guess - low) / (high - low), guess.new_tensor(0.1)), guess.new_tensor(0.5)) * (
        high - low
    )
    return torch.where(high.isinf(), torch.minimum(2 * low, limit), bracketed.nan_to_num(0.5))


def _update(inverse: Tensor, s: Tensor, y: Tensor, first: Tensor) -> Tensor:
    """BFGS update (6.17) of the inverse Hessian [B, P, P] by step s and change of gradient y [B, P]; none where s.y <= 0."""
    sy = (s * y).sum(-1)
    yHy = (y[:, None] @ inverse @ y[:, :, None])[:, 0, 0]
    usable = (sy > 0) & (yHy > 0)
    scale = torch.where(first & usable, sy / torch.where(usable, yHy, 1.0), 1.0)  # (6.20): the first step sets the scale
    inverse = inverse * scale[:, None, None]
    rho = torch.where(usable, 1 / torch.where(usable, sy, 1.0), 0.0)[:, None, None]
    eye = torch.eye(s.shape[-1]).to(s)
    left = eye - rho * s[:, :, None] * y[:, None]
    updated = left @ inverse @ left.mT + rho * s[:, :, None] * s[:, None]
    return torch.where(usable[:, None, None], updated, inverse)
