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

    def __post_init__(self) -> None:
        if not (self.tolerance > 0 and self.longest > 0 and min(self.iterations, self.trials) >= 1 and 0 < self.armijo < self.wolfe < 1):
            raise ValueError(f"stop wants a tolerance, lengths and counts above 0, and 0 < armijo < wolfe < 1, got {self}")


@dataclass(frozen=True)
class Minimum:
    """Where each row ended: x [B, P] | value [B] | iterations, evaluations [B] int | converged [B] bool | trace [B, T].

    trace holds the lowest value after each evaluation, nan after the row's own last one.
    """

    x: Tensor
    value: Tensor
    iterations: Tensor
    evaluations: Tensor
    converged: Tensor
    trace: Tensor


class _Rows:
    """The state of every row: its point, its curvature, and the bracket of its line search."""

    def __init__(self, x: Tensor, value: Tensor, gradient: Tensor, metric: Tensor, stop: Stop) -> None:
        self.x, self.value, self.gradient, self.metric, self.stop = x.clone(), value, gradient, metric, stop
        self.plain = torch.linalg.inv(metric)  # inverse Hessian as long as nothing is known of the curvature
        self.inverse = self.plain.clone()
        self.step = torch.zeros_like(x)
        self.length, self.limit, self.low, self.high = (torch.zeros_like(value) for _ in range(4))
        self.iterations, self.trials = (torch.zeros_like(value, dtype=torch.int64) for _ in range(2))
        self.evaluations = torch.ones_like(self.trials)
        self.scaled, self.converged = torch.zeros_like(value, dtype=torch.bool), gradient.abs().amax(-1) == 0
        self.done = self.converged | ~value.isfinite()
        self.aim(torch.arange(len(x), device=x.device))

    def aim(self, rows: Tensor) -> None:
        """A new step for these rows and the length of it to try first: all of it, or one px while the scale is not known."""
        step = -(self.inverse[rows] @ self.gradient[rows][..., None])[..., 0]
        limit = self.stop.longest / _norm(step, self.metric[rows]).clamp_min(torch.finfo(step.dtype).tiny)
        self.step[rows], self.limit[rows] = step, limit
        self.length[rows] = torch.where(self.scaled[rows], limit.clamp_max(1.0), limit / max(1.0, self.stop.longest))
        self.low[rows], self.high[rows], self.trials[rows] = 0, torch.inf, 0

    def accept(self, rows: Tensor, x: Tensor, value: Tensor, gradient: Tensor) -> None:
        """The step was good: learn the curvature from it, and aim again."""
        self.inverse[rows], usable = _update(self.inverse[rows], x - self.x[rows], gradient - self.gradient[rows], ~self.scaled[rows])
        self.x[rows], self.value[rows], self.gradient[rows] = x, value, gradient
        self.scaled[rows] = self.scaled[rows] | usable
        self.iterations[rows] += 1
        self.aim(rows)

    def shrink(self, rows: Tensor, guess: Tensor, too_long: Tensor) -> None:
        """The length was wrong: narrow the bracket, and try the guess, kept off its ends, or twice as far while it is open."""
        length = self.length[rows]
        self.low[rows] = torch.where(too_long, self.low[rows], length)
        self.high[rows] = torch.where(too_long, length, self.high[rows])
        low, high = self.low[rows], self.high[rows]
        share = ((guess - low) / (high - low)).nan_to_num(0.0).clamp(0.1, 0.5)
        closed = low + share * torch.where(high.isinf(), 0.0, high - low)
        self.length[rows] = torch.where(high.isinf(), torch.minimum(2 * length, self.limit[rows]), closed)
        self.trials[rows] += 1

    def judge(self, rows: Tensor) -> None:
        """Which rows are done: the full step is shorter than the tolerance, or so is the bracket along their own gradient."""
        tolerance, norm = self.stop.tolerance, _norm(self.step[rows], self.metric[rows])
        fresh = self.trials[rows] == 0
        small = fresh & self.scaled[rows] & (self.length[rows] * norm < tolerance)
        stuck = ~fresh & (self.high[rows] * norm < tolerance)
        again = rows[stuck & self.scaled[rows]]  # perhaps the curvature was wrong: once more without it
        self.inverse[again], self.scaled[again] = self.plain[again], False
        self.aim(again)
        self.converged[rows] = small | (stuck & ~torch.isin(rows, again))
        spent = (self.iterations[rows] >= self.stop.iterations) | (self.trials[rows] >= self.stop.trials)
        self.done[rows] = self.converged[rows] | spent


def minimize(objective: Objective, x: Tensor, metric: Tensor | None = None, stop: Stop | None = None) -> Minimum:
    """Quasi-Newton (BFGS) from x, row by row; a row that is done is no longer evaluated.

    x [B, P] | metric [B, P, P] positive definite: squared length of a step, and the first guess of the curvature's shape

    It is L-BFGS whose history is never cut: at P <= 12 the inverse Hessian is smaller than the vectors L-BFGS keeps.
    Line search by bracketing to the weak Wolfe conditions (Nocedal & Wright, Numerical Optimization, ch. 3 and 6).
    """
    stop = stop or Stop()
    metric = torch.eye(x.shape[-1]).to(x).expand(len(x), -1, -1) if metric is None else metric
    state = _Rows(x, *objective(x, torch.arange(len(x), device=x.device)), metric, stop)
    trace = [state.value.clone()]
    while not state.done.all():
        rows = (~state.done).nonzero()[:, 0]
        length, step, value = state.length[rows], state.step[rows], state.value[rows]
        x_new = state.x[rows] + length[:, None] * step
        value_new, gradient_new = objective(x_new, rows)
        state.evaluations[rows] += 1
        slope, slope_new = (state.gradient[rows] * step).sum(-1), (gradient_new * step).sum(-1)
        slack = 4 * torch.finfo(x.dtype).eps * value.abs()
        too_long = ~(value_new <= value + stop.armijo * length * slope + slack)  # also where it is nan
        good = ~too_long & ~((slope_new < stop.wolfe * slope) & (length < state.limit[rows]))  # else it is too short
        parabola = -slope * length * length / (2 * (value_new - value - slope * length))  # through both values and the slope
        state.accept(rows[good], x_new[good], value_new[good], gradient_new[good])
        state.shrink(rows[~good], parabola[~good], too_long[~good])
        state.judge(rows)
        trace.append(torch.full_like(state.value, torch.nan).index_copy(0, rows, state.value[rows]))
    return Minimum(state.x, state.value, state.iterations, state.evaluations, state.converged, torch.stack(trace, 1))


def _norm(step: Tensor, metric: Tensor) -> Tensor:
    """Length of steps in px: step [B, P] | metric [B, P, P] -> [B]."""
    return (step[:, None] @ metric @ step[:, :, None])[:, 0, 0].clamp_min(0).sqrt()


def _update(inverse: Tensor, s: Tensor, y: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """BFGS update (6.17) of the inverse Hessian [B, P, P] by step s and change of gradient y [B, P], and where there was one.

    Nothing is learned where s.y <= 0; the first time the scale is set too, (6.20).
    """
    sy = (s * y).sum(-1)
    yHy = (y[:, None] @ inverse @ y[:, :, None])[:, 0, 0]
    usable = (sy > 0) & (yHy > 0)
    scale = torch.where(first & usable, sy / torch.where(usable, yHy, 1.0), 1.0)
    inverse = inverse * scale[:, None, None]
    rho = torch.where(usable, 1 / torch.where(usable, sy, 1.0), 0.0)[:, None, None]
    left = torch.eye(s.shape[-1]).to(s) - rho * s[:, :, None] * y[:, None]
    updated = left @ inverse @ left.mT + rho * s[:, :, None] * s[:, None]
    return torch.where(usable[:, None, None], updated, inverse), usable
