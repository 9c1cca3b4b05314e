"""Minimize many small problems at once, each row by itself: quasi-Newton with its own history and its own line search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Objective = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""x [A, P], rows [A] -> value [A], gradient [A, P]: line i depends on x[i] alone and belongs to problem rows[i].

The value may be less precise than x; how precise its type is decides which differences are taken for noise.
"""


@dataclass(frozen=True)
class Stop:
    """When a row is done, and how far it may step.  px are lengths in the metric of `minimize`."""

    tolerance: float = 0.01
    """px: a row is done when its full step is shorter; that step is taken without another evaluation."""
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

    A converged row's last step is not evaluated: its value is that of the point before.
    trace holds the lowest value after each evaluation, nan after the row's own last one.
    """

    x: Tensor
    value: Tensor
    iterations: Tensor
    evaluations: Tensor
    converged: Tensor
    trace: Tensor


class _Rows:
    """The state of every row: its point, its curvature, and the bracket of its line search.

    Every method works on all rows at once and chooses by masks, so that a GPU needs not be waited for.
    """

    def __init__(self, x: Tensor, value: Tensor, gradient: Tensor, metric: Tensor, stop: Stop, inverse: Tensor | None) -> None:
        self.x, self.value, self.gradient, self.metric, self.stop = x.clone(), value, gradient, metric, stop
        self.known = inverse is not None  # else the metric is the inverse Hessian's shape, and its scale is to be found
        self.plain = self.inverse = torch.linalg.inv(metric) if inverse is None else inverse
        self.step = torch.zeros_like(x)
        self.length = self.low = self.high = torch.zeros_like(x[:, 0])
        self.iterations = self.trials = torch.zeros_like(value, dtype=torch.int64)
        self.scaled, self.fresh = torch.full_like(value, self.known, dtype=torch.bool), torch.ones_like(value, dtype=torch.bool)
        self.converged = gradient.abs().amax(-1) == 0
        self.done = self.converged | ~value.isfinite()
        self.aim(~self.done)

    def aim(self, rows: Tensor) -> None:
        """A new step for these rows and the length of it to try first: all of it, or one px while the scale is not known."""
        self.step = torch.where(rows[:, None], -(self.inverse @ self.gradient[..., None])[..., 0], self.step)
        self.norm = _norm(self.step, self.metric)
        self.limit = self.stop.longest / self.norm.clamp_min(torch.finfo(self.step.dtype).tiny)
        first = torch.where(self.scaled, self.limit.clamp_max(1.0), self.limit / max(1.0, self.stop.longest))
        self.length = torch.where(rows, first, self.length)
        self.low, self.high = self.low.masked_fill(rows, 0), self.high.masked_fill(rows, torch.inf)
        self.trials = self.trials.masked_fill(rows, 0)

    def shrink(self, guess: Tensor, too_long: Tensor) -> None:
        """Were the length wrong: narrow the bracket, and try the guess, kept off its ends, or twice as far while it is open."""
        self.low = torch.where(too_long, self.low, self.length)
        self.high = torch.where(too_long, self.length, self.high)
        width, unbounded = self.high - self.low, self.high.isinf()
        share = ((guess - self.low) / width).nan_to_num(0.0).clamp(0.1, 0.5)
        closed = self.low + share * width.masked_fill(unbounded, 0)
        self.length = torch.where(unbounded, torch.minimum(2 * self.length, self.limit), closed)
        self.trials = self.trials + 1

    def accept(self, rows: Tensor, x: Tensor, value: Tensor, gradient: Tensor) -> None:
        """The step of these rows was good: learn the curvature from it."""
        inverse, usable = _update(self.inverse, x - self.x, gradient - self.gradient, ~self.scaled)
        usable = rows & usable
        self.inverse = torch.where(usable[:, None, None], inverse, self.inverse)
        self.x, self.gradient = (torch.where(rows[:, None], *both) for both in ((x, self.x), (gradient, self.gradient)))
        self.value = torch.where(rows, value, self.value)
        self.scaled, self.fresh = self.scaled | usable, self.fresh & ~usable
        self.iterations = self.iterations + rows

    def forget(self, rows: Tensor) -> None:
        """Perhaps the curvature of these rows was wrong: once more without it."""
        self.inverse = torch.where(rows[:, None, None], self.plain, self.inverse)
        self.scaled, self.fresh = self.scaled & ~rows | self.known, self.fresh | rows

    def judge(self, good: Tensor, stuck: Tensor) -> None:
        """Which rows are done: the full step is shorter than the tolerance, or nothing can be done where they are stuck."""
        small = good & self.scaled & (self.length * self.norm < self.stop.tolerance)
        self.x = torch.where(small[:, None], self.x + self.length[:, None] * self.step, self.x)  # as good as sure, and not evaluated
        self.converged = self.converged | small | (stuck & ~self.done)
        spent = (self.iterations >= self.stop.iterations) | (self.trials >= self.stop.trials)
        self.done = self.done | self.converged | spent


def minimize(
    objective: Objective, x: Tensor, metric: Tensor | None = None, stop: Stop | None = None, inverse: Tensor | None = None
) -> Minimum:
    """Quasi-Newton (BFGS) from x, row by row; a row that is done is no longer evaluated.

    x [B, P] | metric [B, P, P] positive definite: squared length of a step, and the first guess of the curvature's shape
    inverse [B, P, P]: of the Hessian, where something is known of it and of its scale

    It is L-BFGS whose history is never cut: at P <= 12 the inverse Hessian is smaller than the vectors L-BFGS keeps.
    Line search by bracketing to the weak Wolfe conditions (Nocedal & Wright, Numerical Optimization, ch. 3 and 6).
    """
    stop = stop or Stop()
    metric = _eye(x).expand(len(x), -1, -1) if metric is None else metric
    state = _Rows(x, *objective(x, torch.arange(len(x), device=x.device)), metric, stop, inverse)
    trace, evaluations = [state.value], torch.ones_like(state.iterations)
    while len(rows := (going := ~state.done).nonzero()[:, 0]):  # the one line of a round that waits for a GPU
        value, length, step = state.value, state.length, state.step
        x_new = state.x + length[:, None] * step
        found = objective(x_new[rows], rows)
        value_new, gradient_new = (old.index_copy(0, rows, new) for old, new in zip((value, state.gradient), found, strict=True))
        slope, slope_new = (state.gradient * step).sum(-1), (gradient_new * step).sum(-1)
        slack = 4 * torch.finfo(value.dtype).eps * value.abs()
        too_long = ~(value_new <= value + stop.armijo * length * slope + slack)  # also where it is nan
        good = going & ~too_long & ~((slope_new < stop.wolfe * slope) & (length < state.limit))  # else it is too short
        parabola = -slope * length * length / (2 * (value_new - value - slope * length))  # through both values and the slope
        state.shrink(parabola, too_long)
        stuck = ~good & (state.high * state.norm < stop.tolerance)  # the bracket is shorter than the tolerance
        again = stuck & ~state.fresh
        state.accept(good, x_new, value_new, gradient_new)
        state.forget(again)
        state.aim(good | again)
        state.judge(good, stuck & ~again)
        evaluations = evaluations + going
        trace.append(torch.where(going, state.value, torch.nan))
    return Minimum(state.x, state.value, state.iterations, evaluations, state.converged, torch.stack(trace, 1))


def _eye(like: Tensor) -> Tensor:
    """The identity [P, P] for vectors [B, P], made where they are: a copy to a GPU would wait for it."""
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)


def _norm(step: Tensor, metric: Tensor) -> Tensor:
    """Length of steps in px: step [B, P] | metric [B, P, P] -> [B]."""
    return (step[:, None] @ metric @ step[:, :, None])[:, 0, 0].clamp_min(0).sqrt()


def _update(inverse: Tensor, s: Tensor, y: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """BFGS update (6.17) of the inverse Hessian [B, P, P] by step s and change of gradient y [B, P], and where there is one.

    Nothing is learned where s.y <= 0, and what stands there is not to be used; the first time the scale is set too, (6.20).
    """
    sy = (s * y).sum(-1)
    yHy = (y[:, None] @ inverse @ y[:, :, None])[:, 0, 0]
    inverse = inverse * torch.where(first, sy / yHy, 1.0)[:, None, None]
    rho_s = (1 / sy)[:, None, None] * s[:, :, None]
    left = _eye(s) - rho_s * y[:, None]
    return left @ inverse @ left.mT + rho_s * s[:, None], (sy > 0) & (yHy > 0)
