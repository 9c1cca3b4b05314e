"""The search of a lost camera in a map that it knows: it goes on beside the tracking, and believes nothing before the camera has moved."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from statistics import mean
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torchcmax.core.camera import Canvas
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.core.window import Window
from torchcmax.slam.glimpse import Glimpse
from torchcmax.slam.relocalize import Found, Seeking
from torchcmax.slam.tracker import Belief, ModelName, Sight, Tracking, World, before_plane, covariance_of, doubt, speed, step

LIKELY = 0.6  # share of `accept` that a place must score to be followed
MOST = 4  # places that are followed at a time
SIGMA = 0.02, 0.01, 0.5, 0.5  # of a place that was found: turn rad, shift, angular velocity rad/s, velocity distances/s
SAME = 8.0  # px that places are apart at least
BETTER = 1.02  # times the score that a place nearby must have to be taken instead
RECENT = 5  # windows that make the score of a place
FORGET = 0.3  # share of `accept` below which a place is given up at once


@dataclass
class Candidate:
    """A place that is followed: what is believed of a camera there, its scores, and px of motion since it was found."""

    belief: Belief
    scores: list[float]
    moved: float = 0.0

    @property
    def score(self) -> float:
        """The mean of the last windows."""
        return mean(self.scores[-RECENT:])


class Searching(NamedTuple):
    """The options of a seeker; certain: px that the image may be off where a camera is found, one sigma."""

    how: Seeking
    tracking: Tracking
    model: ModelName
    certain: float


class Searchable(Protocol):
    """A map made ready for searching: as relocalize.Grid."""

    def far(self, glimpse: Glimpse) -> Found:
        """Where in the whole map a window fits."""

    def near(self, glimpse: Glimpse, expected: State) -> Found:
        """Where around the expected state [1] a window fits."""

    def at(self, glimpse: Glimpse, pose: Pose) -> Found:
        """What becomes of poses [K]."""

    def judge(self, glimpse: Glimpse, state: State) -> float:
        """The score of a state [1]."""

    def seen(self, state: State) -> Tensor:
        """px on the map of points of the sensor's edge, seen from states [K]: [K, M, 2]."""


class Seeker:
    """Looks for a camera in one map.  A search goes on in a thread of its own beside the tracking."""

    def __init__(self, m: World, grid: Searchable, canvas: Canvas, sensor: Canvas, rays: Tensor, options: Searching) -> None:
        """grid: of the map | canvas: of the search for motion | sensor: one as large as that | rays [M, 3]: a grid over it"""
        self.map, self.canvas, self.sensor, self.rays = m, canvas, sensor, rays
        self.how, self.tracking, self.model, self.certain = options
        self.grid = grid
        self.candidates: list[Candidate] = []
        self.pool = ThreadPoolExecutor(1, "torchcmax-seek")
        self.flight: Future[Found] | None = None
        self.began = self.next = 0  # µs
        self.pause = self.how.wait
        self.since: list[Window] = []
        self.searches = 0

    def guess(self, window: Window, motion: Motion, normal: Tensor) -> None:
        """Begins with the places of the keyframes, where a window fits there; `offer` of the same window comes next."""
        poses = [k.state.pose for k in self.map.keyframes]
        glimpse = Glimpse.of(window, motion, normal, self.sensor, self.map.border)
        every = Pose(torch.cat([p.R for p in poses]), torch.cat([p.t for p in poses]))
        self.candidates = self._kept(self.grid.at(glimpse, every), window)

    def offer(self, window: Window, motion: Motion, normal: Tensor) -> Belief | None:
        """The next window [1], with what it shows alone before a plane with this normal; where the camera is, once that is sure."""
        start = int(window.start[0])
        self.candidates = self._merged(self._followed(self.candidates, window))
        if self.flight is not None:
            self.since.append(window)
            if start - self.began >= self.how.wait * 1e6 and (self.how.steady or self.flight.done()):
                self._land()
        likely = bool(self.candidates) and self.candidates[0].score >= self.how.accept
        if self.flight is None and self.how.far and start >= self.next and not likely:
            glimpse = Glimpse.of(window, motion, normal, self.sensor, self.map.border)
            self.flight, self.began, self.since = self.pool.submit(self.grid.far, glimpse), start, [window]
            self.searches += 1
        best = self._sure()
        return None if best is None else self._polished(best, window)

    def _land(self) -> None:
        """What a search found, followed through the windows that came meanwhile, beside what is followed already."""
        assert self.flight is not None
        fresh = self._kept(self.flight.result(), self.since[0])
        for window in self.since:
            fresh = self._followed(fresh, window)
        self.flight, self.since = None, []
        self.pause = self.how.wait if fresh else min(2 * self.pause, self.how.again)
        self.next = self.began + round(self.pause * 1e6)
        self.candidates = self._merged(self.candidates + fresh)

    def _kept(self, found: Found, window: Window) -> list[Candidate]:
        """The best places, as candidates."""
        time, likely = window.middle, LIKELY * self.how.accept
        scores = [score for score in found.score.tolist()[:MOST] if score >= likely]
        return [Candidate(Belief(time, found.state[i : i + 1], covariance_of(SIGMA)), [score]) for i, score in enumerate(scores)]

    def _followed(self, candidates: list[Candidate], window: Window) -> list[Candidate]:
        """Each place, one window on, or at the window that it was found by, without those that fit no more."""
        alive: list[Candidate] = []
        for one in candidates:
            before = one.belief.at(window.middle, self.tracking.acceleration)
            sight = Sight.of(self.map, before.state, window.duration.double())
            if sight is None:
                continue
            found = step(window, self.canvas, before, [sight], self.tracking, self.model)
            score = self.judge(window, found.after.state)
            moved = speed(found.after.state, self.map.plane, self.rays, self.canvas.focal) * float(window.duration[0])
            after = Candidate(found.after, [*one.scores, score], one.moved + moved)
            if score >= FORGET * self.how.accept and after.score >= LIKELY * self.how.accept:
                alive.append(after)
        return alive

    def _merged(self, candidates: list[Candidate]) -> list[Candidate]:
        """Best first, and of those that fell together the best, with all that was seen of it."""
        kept: list[Candidate] = []
        for one in sorted(candidates, key=lambda one: -one.score):
            same = next((other for other in kept if self.apart(one.belief.state, other.belief.state) <= SAME), None)
            if same is None:
                kept.append(one)
            elif one.moved > same.moved:  # the place has been followed for longer
                same.moved, same.scores = one.moved, [*one.scores, same.scores[-1]]
        return kept[:MOST]

    def judge(self, window: Window, state: State) -> float:
        """The score of a window [1] at a state [1]."""
        motion, there = before_plane(state, self.map.plane)
        return self.grid.judge(Glimpse.of(window, motion, there.normal, self.sensor, self.map.border), state)

    def apart(self, one: State, other: State) -> float:
        """px, rms, between what two cameras [1] see."""
        xy = self.grid.seen(State.join([one, other]))
        return float((xy[0] - xy[1]).square().sum(-1).mean().sqrt())

    def _sure(self) -> Candidate | None:
        """The best place, where the camera has moved and it still fits well, and better than any other."""
        if not self.candidates:
            return None
        best, *others = self.candidates
        px, windows = self.how.confirm
        enough = best.moved >= px and len(best.scores) > windows and best.score >= self.how.accept
        clear = all(best.score >= self.how.ratio * other.score for other in others)
        return best if enough and clear and self.doubt(best) < self.certain else None

    def doubt(self, one: Candidate) -> float:
        """px that the image may be off at a place, one sigma."""
        return doubt(one.belief, self.map.plane, self.rays, self.canvas.focal)

    def _polished(self, best: Candidate, window: Window) -> Belief:
        """The best place, or a better one around it."""
        motion, there = before_plane(best.belief.state, self.map.plane)
        near = self.grid.near(Glimpse.of(window, motion, there.normal, self.sensor, self.map.border), best.belief.state)
        if float(near.score[0]) < BETTER * best.scores[-1]:
            return best.belief
        return Belief(best.belief.time, near.state[:1], covariance_of(SIGMA))

    def close(self) -> None:
        """Ends the thread."""
        self.pool.shutdown(wait=False, cancel_futures=True)
