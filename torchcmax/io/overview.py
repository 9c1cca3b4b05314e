"""What a recording holds, and what is odd about it, in one pass."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from torchcmax.io.checked import Reordered
from torchcmax.io.errors import DataError, DataNote, DataWarning
from torchcmax.io.recording import Recording

GAP = 50_000  # us without an event that are worth telling
PEAK = 10_000  # us: bin of the peak rate
SHOWN = 60  # bins of the rate over time, at most
FINE = 60_000  # bins counted while the duration is not known yet
LISTED_GAPS, LISTED_PIXELS = 20, 10
HOT_RATIO, HOT_COUNT = 50, 1000  # a hot pixel has more than both: times the median of the active pixels, and events


@dataclass(frozen=True)
class Calibration:
    """fx, fy, cx, cy in px; distortion as the model wants it."""

    model: str
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]


@dataclass(frozen=True)
class Truth:
    """The time that the ground truth spans."""

    first_us: int
    last_us: int
    poses: int


@dataclass(frozen=True)
class Summary:
    """sensor is (width, height) px, plane (nx, ny, nz, d) as in plane.txt.

    Times in µs, rates in events per second; gaps are (start, length), hot pixels (x, y, events).
    """

    recording: str
    sensor: tuple[int, int]
    sensor_guessed: bool
    calibration: Calibration
    truth: Truth | None
    plane: tuple[float, ...] | None
    count: int
    first: int
    last: int
    duration: int
    on_share: float
    mean_rate: float
    peak_rate: float
    bin: int
    rates: list[float]
    gaps: list[tuple[int, int]]
    gap_count: int
    gap_total: int
    equal_times: int
    out_of_order: int
    hot_pixels: list[tuple[int, int, int]]
    hot_count: int
    problems: list[str]

    def __str__(self) -> str:
        """A page to read: one line per number, and the rate over time as bars."""
        top = max(self.rates)
        lens, truth = self.calibration, self.truth
        distortion = ", ".join(f"{k:.6g}" for k in lens.distortion)
        lines = [
            f"recording     {self.recording}",
            f"sensor        {self.sensor[0]} x {self.sensor[1]}{', guessed from the events' if self.sensor_guessed else ''}",
            f"calibration   fx {lens.fx:g} fy {lens.fy:g} cx {lens.cx:g} cy {lens.cy:g} px, {lens.model} {distortion}",
            f"truth         {'none' if truth is None else f'{truth.poses} poses, {_span(truth.first_us, truth.last_us)}'}",
            f"plane         {'none' if self.plane is None else 'normal {:.4f} {:.4f} {:.4f}, distance {:.4f} m'.format(*self.plane)}",
            f"events        {self.count}, {self.on_share:.1%} ON",
            f"time          {_span(self.first, self.last)}, {self.duration * 1e-6:.6f} s long",
            f"rate          {self.mean_rate * 1e-6:.3f} Mev/s, at most {self.peak_rate * 1e-6:.3f} Mev/s over {PEAK // 1000} ms",
            f"equal times   {self.equal_times}",
            f"out of order  {self.out_of_order}",
            f"gaps          {self.gap_count} of more than {GAP // 1000} ms, {self.gap_total * 1e-6:.3f} s in all",
            *(f"              {length * 1e-3:.1f} ms from {start * 1e-6:.6f} s" for start, length in self.gaps),
            f"hot pixels    {self.hot_count}",
            *(f"              ({x}, {y}): {events} events" for x, y, events in self.hot_pixels),
            f"rate in bins of {self.bin * 1e-3:g} ms, Mev/s:",
            *(f"{i * self.bin * 1e-6:12.4f} s {rate * 1e-6:8.3f} {'#' * round(40 * rate / top)}" for i, rate in enumerate(self.rates)),
            *(f"problem: {problem}" for problem in self.problems),
        ]
        return "\n".join(lines)


def _span(first: int, last: int) -> str:
    return f"{first * 1e-6:.6f} s to {last * 1e-6:.6f} s"


@dataclass
class _Rate:
    """Events per bin since `first` µs.  Bins grow tenfold whenever there would be more than FINE of them."""

    first: int
    bin: int = 1
    counts: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    peak: int = 0
    open_bin: tuple[int, int] = (0, 0)  # number and events of the 10 ms bin that may still grow

    def add(self, t: np.ndarray) -> None:
        """t [M] µs, increasing."""
        elapsed = t - self.first
        while elapsed[-1] // self.bin >= FINE:
            self.counts, self.bin = _grouped(self.counts, 10), self.bin * 10
        counts = np.bincount(elapsed // self.bin)
        counts[: len(self.counts)] += self.counts
        self.counts = counts
        place = elapsed // PEAK
        start = np.flatnonzero(np.concatenate([[True], place[1:] != place[:-1]]))
        length = np.diff(np.append(start, len(place)))
        if place[0] == self.open_bin[0]:
            length[0] += self.open_bin[1]
        self.peak, self.open_bin = max(self.peak, int(length.max())), (int(place[-1]), int(length[-1]))

    def shown(self) -> tuple[int, list[float]]:
        """At most SHOWN bins of 1, 2 or 5 times a power of ten µs: their width in µs, and events per second in each."""
        group = next(n * 10**k for k in range(6) for n in (1, 2, 5) if -(-len(self.counts) // (n * 10**k)) <= SHOWN)
        width = group * self.bin
        return width, (_grouped(self.counts, group) * (1e6 / width)).tolist()


def _grouped(counts: np.ndarray, group: int) -> np.ndarray:
    """Sums of `group` neighbours; the last may have fewer."""
    return np.add.reduceat(counts, np.arange(0, len(counts), group)) if len(counts) else counts


def summary(recording: Recording) -> Summary:
    """One pass over all events, a chunk at a time.  A recording without events is a DataError."""
    height, width = recording.camera.size
    pixels, on, equal, count = np.zeros(height * width, np.int64), 0, 0, 0
    gaps: list[tuple[int, int]] = []
    gap_count = gap_total = last = 0
    rate: _Rate | None = None
    with _told() as told:
        for chunk in recording.chunks():
            rate = rate or _Rate(int(chunk.t[0]))
            step = np.diff(chunk.t, prepend=last if count else chunk.t[0] - 1)
            wide = np.flatnonzero(step > GAP)
            gaps += [(int(chunk.t[i] - step[i]), int(step[i])) for i in wide[: LISTED_GAPS - len(gaps)]]
            gap_count, gap_total = gap_count + len(wide), gap_total + int(step[wide].sum())
            equal += int((step == 0).sum())
            pixels += np.bincount(chunk.y.astype(np.int64) * width + chunk.x, minlength=height * width)
            rate.add(chunk.t)
            on, count, last = on + int((chunk.p > 0).sum()), count + len(chunk), int(chunk.t[-1])
    if rate is None:
        raise DataError(recording.path, "holds no events", "record or copy it again")
    duration = last - rate.first
    mean = count * 1e6 / duration if duration else 0.0
    peak = rate.peak * 1e6 / PEAK if duration >= PEAK else mean
    late = sum(warning.count for warning in told if isinstance(warning, Reordered))
    hot = _hot(pixels)
    listed = [(int(i % width), int(i // width), int(pixels[i])) for i in hot[:LISTED_PIXELS]]
    time = count, rate.first, last, duration
    found = Summary(
        *_known(recording), *time, on / count, mean, peak, *rate.shown(), gaps, gap_count, gap_total, equal, late, listed, len(hot), []
    )
    found.problems.extend([*map(str, told), *_problems(found)])
    return found


def _known(recording: Recording) -> tuple[str, tuple[int, int], bool, Calibration, Truth | None, tuple[float, ...] | None]:
    """What a summary begins with, known before the events are read."""
    camera, truth, plane = recording.camera, recording.truth, recording.plane
    calibration = Calibration(camera.model, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)
    span = None if truth is None else Truth(int(truth.time[0]), int(truth.time[-1]), len(truth))
    numbers = None if plane is None else (*plane.normal[0].tolist(), plane.distance[0].item())
    return recording.name, (camera.size[1], camera.size[0]), recording.guessed, calibration, span, numbers


@contextmanager
def _told() -> Iterator[list[DataWarning]]:
    """Collects DataWarnings instead of showing them; they are part of the summary.  Others are passed on."""
    told: list[DataWarning] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DataWarning)
        warnings.simplefilter("ignore", DataNote)  # the summary counts equal times by itself
        yield told
    for warning in caught:
        if isinstance(warning.message, DataWarning):
            told.append(warning.message)
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)


def _hot(pixels: np.ndarray) -> np.ndarray:
    """Pixels that fire far more than the others, the worst first: events per pixel [P] -> indices."""
    active = pixels[pixels > 0]
    hot = np.flatnonzero((pixels > HOT_RATIO * np.median(active)) & (pixels > HOT_COUNT))
    return hot[np.argsort(-pixels[hot], kind="stable")]


def _problems(found: Summary) -> list[str]:
    """What a user should know before trusting results, in plain words."""
    problems = []
    if found.sensor_guessed:
        width, height = found.sensor
        problems.append(f"the sensor's size, {width} x {height}, is guessed from the events: if it is another, give --sensor WIDTHxHEIGHT")
    if found.truth is not None and not found.truth.first_us <= found.first <= found.last <= found.truth.last_us:
        spans = _span(found.truth.first_us, found.truth.last_us), _span(found.first, found.last)
        problems.append(f"the truth does not cover the events: the truth spans {spans[0]}, the events {spans[1]}")
    if not found.duration:
        problems.append("all events have the same time: time stamps are missing")
    elif found.duration > 1e11 and found.mean_rate < 10:
        problems.append(f"fewer than 10 events per second over {found.duration / 3.6e9:.0f} hours: are its times really in seconds?")
    if found.equal_times > 0.99 * found.count:
        problems.append(f"{found.equal_times} of {found.count} events have the time of the one before: time stamps are coarse")
    if not 0.02 < found.on_share < 0.98:
        problems.append(f"{found.on_share:.1%} of the events are ON: polarity may be missing or broken")
    if found.gap_count:
        total, share = found.gap_total * 1e-6, found.gap_total / found.duration
        problems.append(f"{found.gap_count} gaps of more than {GAP // 1000} ms without an event, {total:.2f} s in all ({share:.0%})")
    if found.hot_count:
        x, y, events = found.hot_pixels[0]
        problems.append(f"{found.hot_count} hot pixels, the worst ({x}, {y}) with {events} events")
    return problems
