"""The camera's clock against the drives': by the velocity that the camera saw, or by the rate of its events."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import correlate, find_peaks

from torchcmax.rig.errors import Rejected

Method = Literal["velocity", "rate"]
STEP = 0.005  # s: of the grid on which the clocks are first laid on each other
SHARE = 0.4  # of the most motion that any offset has in common, below which one is not looked at
PROMINENCE = 0.05  # of a peak of the correlation that counts as another offset
NEAR, FINE = 0.025, 0.0025  # s: about the best of the grid, where the offset is looked for first, and how finely
KNOTS = 40  # of the gain along the path: how much texture there is to see
AGAIN = 1.9  # times the range of places that the path is long, at least, for gain and speed to be told apart
WAYS = np.array([0.003, 0.01, 0.03, 0.1])  # of the range: after turning round, events come again as 1 - exp(-way / one of these)
FAR = 1e9  # m: of no turning
STEADY = 0.1  # of the fastest: windows in which the drives are slower at either end are left out, as most of their events are of one end
BLOCKS = 5  # of the run, each left out once
CLEAR, FASTEST, SURE = 0.3, 200e-6, 1e-3  # peak to side at least; drift and sigma, s, at most
WIDEST, KNOWN = 500e-6, 20e-6  # drift that is looked for, and the sigma below which it is told
LONGEST = 6 * 3600.0  # s between the camera's first and last window
TRUSTED = 3.0  # times the 90 % quantile: what is faster is no velocity


@dataclass(frozen=True)
class Driven:
    """What the drives did.  time [K] s, increasing | velocity [K, D], of the camera in its frame | place [K] on the axis that moves."""

    time: np.ndarray
    velocity: np.ndarray
    place: np.ndarray


@dataclass(frozen=True)
class Seen:
    """What the camera saw in windows.  start, end [W] s of its clock, increasing | value [W, D]: velocities, or [W, 1] events a second."""

    start: np.ndarray
    end: np.ndarray
    value: np.ndarray

    def __getitem__(self, keep: np.ndarray) -> Seen:
        return Seen(self.start[keep], self.end[keep], self.value[keep])


@dataclass(frozen=True)
class ClockModel:
    """t_camera = offset + (1 + drift) t_drive.

    offset s | sigma: its standard deviation at mid-run, s, of chance alone: how late the camera reports, by velocity some 0.3 ms, by rate
    the time of a pixel, is within the offset
    drift_sigma: of the drift.  One that is not known to 20 ppm is not told, and 0; this is then how far from 0 it may be
    peak_to_side: by which share other offsets correlate less
    reason: why it is not accepted, empty where it is
    """

    offset: float
    drift: float
    sigma: float
    drift_sigma: float
    method: str
    peak_to_side: float
    reason: str = ""

    @property
    def accepted(self) -> bool:
        return not self.reason

    def camera(self, time: np.ndarray) -> np.ndarray:
        """Of the drives' clock -> of the camera's."""
        return self.offset + (1 + self.drift) * time

    def sigma_within(self, seconds: float) -> float:
        """Standard deviation, s, of the camera's time so long before or after mid-run."""
        return math.hypot(self.sigma, self.drift_sigma * seconds)

    def demand(self) -> None:
        """Rejected where it is not accepted."""
        if self.reason:
            raise Rejected(f"the clocks could not be aligned: {self.reason}")


def align(driven: Driven, seen: Seen, method: Method) -> ClockModel:
    """The camera's clock may begin anywhere; the pattern of the motion must not repeat itself."""
    seen = _usable(seen)
    if (span := seen.end.max(initial=-np.inf) - seen.start.min(initial=np.inf)) > LONGEST:
        return _unknown(method, f"the camera's times go over {span:.0f} s, more than {LONGEST:.0f} s: some of them are wrong")
    if not np.ptp(driven.place) or len(seen.start) < 10 * BLOCKS or not seen.value.any():
        return _unknown(method, f"the drives moved by {np.ptp(driven.place):.3g}, and the camera saw {len(seen.start)} windows with motion")
    first, clear = _first(driven, seen, method)
    fit = _Fit(driven, seen, method)
    blocks = fit.blocks(first)
    if clear < -CLEAR:
        return _unknown(method, "the camera saw the opposite motion: look at camera, moves and direction in the configuration")
    if max(block.sum() for block in blocks) > len(seen.start) - 10 * BLOCKS / 2:
        return _unknown(method, "the camera saw a small part of the run only: record it all")
    if method == "velocity":
        fit = fit.only(fit.steady(fit.best(first, 0.0)[0]))
        blocks = fit.blocks(first)
    shift, drift, chance = fit.best(first, WIDEST)
    parts = np.array([fit.only(~block).best(shift, WIDEST)[:2] for block in blocks])
    spread = np.sqrt((BLOCKS - 1) * parts.var(0))  # delete-a-group jackknife, Shao and Tu 1995, 2.3
    sigma, drift_sigma = np.maximum(spread, chance)
    found, surely = drift, np.inf if abs(drift) > 0.99 * WIDEST else abs(drift) - 2 * drift_sigma  # where it is looked for, it ends
    if drift_sigma > KNOWN:
        shift, drift, _ = fit.best(first, 0.0)
        drift_sigma = math.hypot(found, drift_sigma)
    if method == "rate":  # what depends on how a sensor is thought to turn round is not known
        sigma = max(sigma, abs(_Fit(driven, seen, method, WAYS[:0]).best(first, 0.0)[0] - shift))
    often = np.abs(np.diff(driven.place)).sum() / np.ptp(driven.place)
    reason = _reason(clear, found, surely, sigma, often if method == "rate" else np.inf)
    return ClockModel(float(shift - drift * fit.middle), float(drift), float(sigma), float(drift_sigma), method, clear, reason)


def _unknown(method: Method, reason: str) -> ClockModel:
    return ClockModel(0.0, 0.0, np.inf, np.inf, method, 0.0, reason)


def _reason(clear: float, drift: float, surely: float, sigma: float, often: float) -> str:
    """surely: what the drift is above, but for one run in forty."""
    if clear < CLEAR:
        return f"another offset fits about as well (peak to side {clear:.2f}, wanted {CLEAR}): run the sync pattern, which never repeats"
    if often < AGAIN:
        return "one pass does not tell speed from texture by the rate of events: run the sync pattern, or align by velocity"
    if surely > FASTEST:
        return f"one clock would be {drift * 1e6:.0f} ppm faster, more than {FASTEST * 1e6:.0f} ppm: is it the recording of this run?"
    if not sigma <= SURE:
        return (
            f"the offset is known to {sigma * 1e3:.2f} ms only, wanted is {SURE * 1e3:.0f} ms: run the sync pattern, or align by velocity"
        )
    return ""


def _usable(seen: Seen) -> Seen:
    """Without windows that know nothing, or are faster than can be."""
    size = np.linalg.norm(seen.value, axis=1)
    keep = np.isfinite(size) & (seen.end > seen.start)
    seen, size = seen[keep], size[keep]
    return seen[size <= TRUSTED * np.quantile(size, 0.9)] if len(size) else seen


def _path(driven: Driven, method: Method) -> np.ndarray:
    """Integral of what the camera sees of the motion, from the start: of velocity, or of speed: -> [K, D]."""
    rate = driven.velocity if method == "velocity" else np.linalg.norm(driven.velocity, axis=1, keepdims=True)
    steps = (rate[1:] + rate[:-1]) / 2 * np.diff(driven.time)[:, None]
    return np.concatenate([np.zeros((1, rate.shape[1])), steps.cumsum(0)])


def _interpolated(time: np.ndarray, driven: Driven, path: np.ndarray) -> np.ndarray:
    """The path [K, D] at any time [N]: -> [N, D].  Before and after the run the drives rest."""
    return np.stack([np.interp(time, driven.time, column) for column in path.T], -1)


def _first(driven: Driven, seen: Seen, method: Method) -> tuple[float, float]:
    """Offset at which what the drives did and what the camera saw correlate best, on a grid; and by which share others do less.

    Whatever the camera saw counts for every offset, also before and after the run, where the drives rested: a part of the run that is
    repeated fits elsewhere too, and leaves the rest unexplained.  The share is negative where the opposite motion would correlate better.
    """
    start = driven.time[0]
    edges = np.arange(start, driven.time[-1] + STEP, STEP)
    done = np.diff(_interpolated(edges, driven, _path(driven, method)), axis=0) / STEP
    grid = np.arange(seen.start[0], seen.end[-1], STEP) + STEP / 2
    at = np.searchsorted(seen.start, grid, side="right") - 1
    there = (grid < seen.end[at]).astype(float)[:, None]
    saw = seen.value[at] * there

    def common(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Sums over all that two grids have in common, for every offset."""
        total: np.ndarray = np.sum([correlate(b[:, k], a[:, k], method="fft") for k in range(a.shape[1])], axis=0)
        return total

    ones, count = np.ones_like(done), there.repeat(done.shape[1], 1)
    product, driven2, seen2 = common(done, saw), common(done**2, count), common(ones, saw**2)
    if method == "rate":  # what has no gain is noise of the sensor, the same all the time
        n = common(ones, count).clip(0.5)
        mean_done, mean_saw = common(done, count) / n, common(ones, saw) / n
        product, driven2, seen2 = product - n * mean_done * mean_saw, driven2 - n * mean_done**2, seen2 - n * mean_saw**2
    enough = (driven2 > SHARE * driven2.max()) & (seen2 > SHARE * seen2.max())
    score = np.where(enough, product / np.sqrt(np.where(enough, driven2 * seen2.max(), 1.0)), 0.0)
    best = int(score.argmax())
    peaks = find_peaks(np.concatenate([[0.0], score, [0.0]]), prominence=PROMINENCE)[0] - 1
    side = max(score[peaks[peaks != best]].max(initial=0.0), -score.min() if method == "velocity" else 0.0)
    offset = grid[0] - STEP / 2 - start + (best - len(done) + 1) * STEP
    return float(offset), float(1 - side / max(score[best], 1e-9))


def _since_turning(place: np.ndarray) -> np.ndarray:
    """Way since the last change of direction: [K] -> [K], without end before the first.  A rest changes nothing."""
    step = np.diff(place, prepend=place[0])
    way, moving = np.abs(step).cumsum(), np.flatnonzero(step)
    turns = moving[1:][np.sign(step[moving[1:]]) != np.sign(step[moving[:-1]])]
    last = np.searchsorted(turns, np.arange(len(place)), side="right")
    since: np.ndarray = way - np.append(-FAR, way[turns - 1])[last]
    return since


class _Fit:
    """Least squares of shift and drift, t_camera = shift + t_drive + drift (t_drive - middle), with the gain for each solved."""

    def __init__(self, driven: Driven, seen: Seen, method: Method, ways: np.ndarray = WAYS) -> None:
        self.driven, self.seen, self.method, self.path, self.ways = driven, seen, method, _path(driven, method), ways
        speed = np.linalg.norm(driven.velocity, axis=1)
        moving = driven.time[speed > 0.01 * speed.max()]
        self.middle = float(moving[0] + moving[-1]) / 2
        self.knots = np.linspace(driven.place.min(), driven.place.max(), KNOTS)
        self.turned = _since_turning(driven.place)

    def only(self, keep: np.ndarray) -> _Fit:
        return _Fit(self.driven, self.seen[keep], self.method)

    def steady(self, shift: float) -> np.ndarray:
        """Windows in which the drives neither rest nor turn round: [W] bool."""
        t0, t1 = self.seen.start - shift, self.seen.end - shift
        speed = np.linalg.norm(self.driven.velocity, axis=1)
        slowest = np.minimum(*(np.interp(t, self.driven.time, speed) for t in (t0, t1)))
        way = np.interp(t1, self.driven.time, self.driven.place) - np.interp(t0, self.driven.time, self.driven.place)
        keep: np.ndarray = (slowest > STEADY * speed.max()) & (np.interp(t1, self.driven.time, self.turned) > np.abs(way))
        return keep

    def best(self, near: float, widest: float) -> tuple[float, float, np.ndarray]:
        """Shift, drift, and the standard deviations [2] that the residuals would let expect."""
        tries = near + np.arange(-NEAR, NEAR + FINE / 2, FINE)
        begin = tries[int(np.argmin([np.square(self.residual(s, 0.0)).sum() for s in tries]))]

        def scaled(x: np.ndarray) -> np.ndarray:
            return self.residual(begin + (x[0] - 1) * 1e-3, (x[1] - 1) * 1e-4 if widest else 0.0)

        most = np.array([2 * FINE / 1e-3, widest / 1e-4] if widest else [2 * FINE / 1e-3])
        found = least_squares(scaled, np.ones_like(most), "3-point", (1 - most, 1 + most), diff_step=0.1)
        variance = 2 * found.cost / max(len(found.fun) - KNOTS, 1)
        chance = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)) * variance)
        return float(begin + (found.x[0] - 1) * 1e-3), float(found.x[1] - 1) * 1e-4 if widest else 0.0, chance * [1e-3, 1e-4][: len(most)]

    def residual(self, shift: float, drift: float) -> np.ndarray:
        """What no gain explains: [W D]."""
        t0, t1 = (self.middle + (t - shift - self.middle) / (1 + drift) for t in (self.seen.start, self.seen.end))
        mean = np.diff([_interpolated(t, self.driven, self.path) for t in (t0, t1)], axis=0)[0] / (t1 - t0)[:, None]
        if self.method == "velocity":
            design = mean.reshape(-1, 1)
        else:
            place = np.interp((t0 + t1) / 2, self.driven.time, self.driven.place)
            hats = (1 - np.abs(place[:, None] - self.knots) / (self.knots[1] - self.knots[0])).clip(0)
            turned = np.interp((t0 + t1) / 2, self.driven.time, self.turned)[:, None]
            again = np.exp(-turned / (self.ways * (self.knots[-1] - self.knots[0])))
            design = np.concatenate([mean * hats, mean * again, np.ones_like(mean)], 1)
        value = self.seen.value.reshape(-1)
        if self.method == "rate":  # as counts scatter, by their root
            weight = np.maximum(value / np.quantile(value, 0.9), 0.1) ** -0.5
            design, value = design * weight[:, None], value * weight
        normal = design.T @ design + 1e-9 * np.trace(design.T @ design) / design.shape[1] * np.eye(design.shape[1])
        left: np.ndarray = value - design @ np.linalg.solve(normal, design.T @ value)
        return left

    def blocks(self, shift: float) -> list[np.ndarray]:
        """Windows in consecutive parts with as much change of speed each: BLOCKS times [W] bool."""
        time = (self.seen.start + self.seen.end) / 2 - shift
        change = np.abs(np.diff(self.driven.velocity, axis=0)).sum(1).cumsum()
        part = np.interp(time, self.driven.time[1:], change / change[-1]) * BLOCKS
        number = np.minimum(part.astype(int), BLOCKS - 1)
        return [number == k for k in range(BLOCKS)]
