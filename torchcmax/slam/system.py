"""Tracking and mapping as a whole: recordings in, one track for each window out; the only file that knows the order of things."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Literal, Protocol

import torch
from torch import Tensor

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.draw import Ink
from torchcmax.core.estimate import Search
from torchcmax.core.objective import Look
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.core.state import State
from torchcmax.core.window import Window
from torchcmax.slam.map import Keyframe, Map, Texture
from torchcmax.slam.mapper import Mapping, first_plane, rebased, settled
from torchcmax.slam.tracker import Belief, Front, ModelName, Sight, Step, Tracking, basis_of, front, rays_of, speed, step

Status = Literal["start", "ok", "weak", "lost"]
KNOWN = 0.5  # share of the usual strength below which a window is weak
RECENT = 50  # windows that say what is usual
PATIENCE = 0.25  # s of weak windows after which the camera is lost
FIRST_SIGMA = 0.005, 0.2  # of the last start window: rad and plane distances, rad/s and distances/s
SAME = 1e-6  # share by which the focal length of a map and of the camera before it may differ
BORDER = 4  # px from one ray of the sensor's edge to the next


class Source(Protocol):
    """Consecutive windows of a recording, whose size the caller decides: as io.Stream."""

    def look(self, events: int, seconds: float) -> Window | None:
        """The next window, without going past it; None at the end."""

    def skip(self, events: int) -> None:
        """Goes past the first events of what was last looked at."""


@dataclass(frozen=True)
class Slam:
    """How a camera is tracked before a plane, and the plane mapped."""

    model: ModelName = "planar"
    """planar: six degrees of freedom; translation or rotation: what the camera is known to do."""
    start: Look = field(default_factory=lambda: Look(contrast="gradient_magnitude"))
    """How windows are looked at before there is a map."""
    tracking: Tracking = field(default_factory=Tracking)
    """How windows are tracked."""
    mapping: Mapping = field(default_factory=Mapping)
    """How the map is made."""
    texture: Texture = field(default_factory=Texture)
    """How votes become the strength of edges."""


@dataclass(frozen=True)
class Track:
    """What became of one window.

    recording, index: which it is | window [1, N] | time µs of its middle | state [1] there | normal [1, 3] of the plane, in the
    camera's frame | contrast_zero, contrast: at rest and with its motion | overlap: share of the view that the map knows |
    strength: of the edges that its events meet, 0..1 | keyframe: the one its pose hangs on | drawn: whether it became that keyframe |
    map: as it is now, and goes on changing
    """

    recording: int
    index: int
    window: Window
    time: int
    state: State
    normal: Tensor
    contrast_zero: float
    contrast: float
    overlap: float
    strength: float
    status: Status
    evaluations: int
    converged: bool
    keyframe: int
    drawn: bool
    map: Map


class TooShort(ValueError):
    """A recording that ends before there is anything to begin with."""


class System:
    """Cameras before their planes.  All of one batch have the same sensor; each is tracked as it would be alone."""

    def __init__(self, cameras: Sequence[Camera], options: Slam | None = None, maps: Sequence[Map] | None = None) -> None:
        """maps: tracked against, and left as they are; None: each camera makes its own."""
        self.options = options or Slam()
        self.canvas = Canvas.around(cameras[0], self.options.tracking.search.margin)
        if any(Canvas.around(camera, self.options.tracking.search.margin) != self.canvas for camera in cameras):
            raise ValueError("recordings of one batch want the same sensor and focal length; track others in a batch of their own")
        if maps is not None and len(maps) != len(cameras):
            raise ValueError(f"{len(cameras)} cameras want as many maps, got {len(maps)}")
        for m in maps or ():
            if abs(m.focal - self.canvas.focal) > SAME * m.focal:
                raise ValueError(f"the map wants the sensor that drew it: focal length {m.focal:.2f} px, not {self.canvas.focal:.2f} px")
        given: Sequence[Map | None] = maps or [None] * len(cameras)
        self._runs = [_Run(i, camera, self.canvas, self.options, m) for i, (camera, m) in enumerate(zip(cameras, given, strict=True))]

    @property
    def maps(self) -> list[Map]:
        """One for each recording; ValueError before its first plane."""
        return [run.map for run in self._runs]

    def trajectory(self, recording: int = 0) -> Trajectory:
        """Poses at the middles of all windows, as the keyframes that they hang on are now."""
        return self._runs[recording].trajectory()

    def run(self, sources: Sequence[Source]) -> Iterator[Track]:
        """The windows of every recording, side by side, to the end of the longest; then all keyframes are optimized once more."""
        for run, source in zip(self._runs, sources, strict=True):
            yield from run.begin(source)
        while turn := [(run, window) for run in self._runs if (window := run.next()) is not None]:
            seen = []
            for run, window in turn:
                before = run.predicted(window)
                if sight := run.sight(window, before):
                    seen.append((run, window, before, sight))
                else:
                    yield run.hold(window)
            if seen:
                found = self._step(seen)
                yield from (run.follow(window, found, i) for i, (run, window, _, _) in enumerate(seen))
        for run in self._runs:
            run.finish()

    def _step(self, seen: Sequence[tuple[_Run, Window, Belief, Sight]]) -> Step:
        _, windows, before, sights = zip(*seen, strict=True)
        return step(Window.join(windows), self.canvas, Belief.join(before), sights, self.options.tracking, self.options.model)


class _Run:
    """One recording on its way."""

    def __init__(self, number: int, camera: Camera, canvas: Canvas, options: Slam, given: Map | None) -> None:
        self.number, self.canvas, self.options, self.given = number, canvas, options, given
        rays = camera.rays()
        edge = torch.cat([rays[0], rays[-1], rays[:, 0], rays[:, -1]])[::BORDER]
        self.border, self.rays = edge.float(), rays_of(camera)
        self._map = given
        self.index, self.fresh, self.new = 0, 0, 0
        self.usual: deque[float] = deque(maxlen=RECENT)
        self.weak_since: int | None = None
        self.hung: list[tuple[int, int, Pose]] = []  # time, keyframe, pose in its frame

    @property
    def map(self) -> Map:
        if self._map is None:
            raise ValueError("there is no map before the first plane is found")
        return self._map

    def window(self, state: State, plane: Plane) -> Window | None:
        """The next window: as long as the image takes to move by the displacement wanted."""
        how = self.options.tracking
        seconds = min(how.seconds, how.displacement / max(speed(state, plane, self.rays, self.canvas.focal), 1e-6))
        found = self.source.look(how.most, seconds)
        if found is not None and found.ray.shape[1] < how.fewest and seconds < how.seconds:
            found = self.source.look(how.fewest, how.seconds)
        if found is not None:
            self.source.skip(found.ray.shape[1])
        return found

    def next(self) -> Window | None:
        return self.window(self.belief.state, self.map.plane)

    def begin(self, source: Source) -> Iterator[Track]:
        """The first windows, together, make the first plane and map."""
        self.source = source
        windows, fronts = self._first_windows()
        if len(windows) < min(2, self.options.mapping.first):
            raise TooShort(f"recording {self.number} holds too few events to begin: {len(windows)} windows, at least 2 are wanted")
        if self.given is not None:
            yield from self._on_map(windows, fronts)
            return
        how, free = self.options.mapping, (self.options.model != "translation", self.options.model != "rotation")
        solved = rebased(first_plane(windows, [f.motion for f in fronts], self.canvas.focal, how, free=free).frames)
        self.start_plane = solved.plane
        self._map = Map(solved.plane, self.canvas.focal, self.border, self.options.texture, number=self.number)
        self._map.draw([keyframe_of(window, solved.state[i : i + 1]) for i, window in enumerate(windows)])
        for _ in range(self.options.mapping.settle):
            self._settle(None)
        for i, (window, alone) in enumerate(zip(windows, fronts, strict=True)):
            yield self._track(window, self.map.keyframes[i].state, alone, 0, "start", 1.0, float("nan"), i, int(alone.evaluations[0]))
        sigma = torch.tensor([FIRST_SIGMA[0]] * 6 + [FIRST_SIGMA[1]] * 6, dtype=torch.float64)
        last = self.map.keyframes[-1]
        self.belief = Belief(torch.tensor([last.time]), last.state, sigma.square().diag()[None])

    def _on_map(self, windows: list[Window], fronts: list[Front]) -> Iterator[Track]:
        """The first windows on a given map: the camera is looked for at every keyframe, and where its events find most is begun."""
        wide = torch.tensor([0.1] * 6 + [2.0] * 6, dtype=torch.float64).square().diag()[None]
        time, found = middle_of(windows[0]), []
        for keyframe in self.map.keyframes:
            here = Belief(time, State(keyframe.state.pose, Motion(*(torch.zeros(1, 3, dtype=torch.float64) for _ in range(2)))), wide)
            if sight := self.sight(windows[0], here):
                found.append(self._alone(windows[0], here, sight))
        if not found:
            raise ValueError("the given map has no keyframe from which its plane could be seen")
        best = max(found, key=lambda one: float(one.match.strength[0]))
        self.belief = replace(best.after, covariance=best.before.covariance)
        for window in windows:
            before = self.predicted(window)
            if sight := self.sight(window, before):
                yield self.follow(window, self._alone(window, before, sight), 0)
            else:
                yield self.hold(window)

    def _alone(self, window: Window, before: Belief, sight: Sight) -> Step:
        return step(window, self.canvas, before, [sight], self.options.tracking, self.options.model)

    def _first_windows(self) -> tuple[list[Window], list[Front]]:
        """Windows and what they show alone, before a wall at distance one."""
        wall = Plane(torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64), torch.ones(1, dtype=torch.float64))
        zero, eye = torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)[None]
        how = replace(self.options.tracking, look=self.options.start, search=Search((4.0, 2.0, 1.0), margin=self.canvas_margin))
        state = State(Pose(eye, zero), Motion(zero, zero))
        first = self.source.look(how.most, how.seconds)
        if first is None:
            return [], []
        state = replace(state, motion=front(first, self.canvas, state, wall, how, self.options.model).motion)
        windows: list[Window] = []
        fronts: list[Front] = []
        how = replace(how, search=Search((2.0, 1.0), margin=self.canvas_margin))
        while len(windows) < self.options.mapping.first and (window := self.window(state, wall)) is not None:
            alone = front(window, self.canvas, state, wall, how, self.options.model)
            state = replace(state, motion=alone.motion)
            windows.append(window)
            fronts.append(alone)
        return windows, fronts

    @property
    def canvas_margin(self) -> float:
        return self.options.tracking.search.margin

    def predicted(self, window: Window) -> Belief:
        """What is known of the camera at the window's middle before it is looked at."""
        return self.belief.at(middle_of(window), self.options.tracking.acceleration)

    def sight(self, window: Window, belief: Belief) -> Sight | None:
        """What the camera sees of the map from where it is believed to be; None where it looks along the plane."""
        return Sight.of(self.map, belief.state, window.duration.double())

    def hold(self, window: Window) -> Track:
        """A window that cannot be tracked: the camera stays where it was."""
        zero = torch.zeros(1, 3, dtype=torch.float64)
        at = middle_of(window)
        state = State(self.belief.state.pose, Motion(zero, zero))
        self.belief = Belief(at, state, self.belief.at(at, self.options.tracking.acceleration).covariance)
        nothing = torch.full((1,), torch.nan)
        alone = Front(state.motion, nothing, nothing, torch.zeros(1), torch.zeros(1, dtype=torch.bool))
        return self._track(window, state, alone, 0, "lost", 0.0, 0.0, len(self.map.keyframes) - 1, 0)

    def follow(self, window: Window, found: Step, row: int) -> Track:
        """A window that was tracked: its status, and what it does to the map."""
        self.belief = found.after[row : row + 1]
        strength = float(found.match.strength[row])
        sight = self.sight(window, self.belief)
        overlap = self.map.overlap(sight.H_k, self.rays, sight.area) if sight else 0.0
        status = self._status(strength, int(self.belief.time[0])) if sight else "lost"
        if status != "ok":
            self.belief = found.before[row : row + 1]
        drawn = status == "ok" and overlap < self.options.mapping.overlap and self.given is None
        if drawn:
            self.map.draw([keyframe_of(window, self.belief.state)])
            self._optimize()
        evaluations = int(found.front.evaluations[row] + found.match.evaluations[row])
        return self._track(
            window, self.belief.state, found.front, row, status, overlap, strength, len(self.map.keyframes) - 1, evaluations, drawn
        )

    def _status(self, strength: float, time: int) -> Status:
        if not self.usual or strength > KNOWN * median(self.usual):
            self.usual.append(strength)
            self.weak_since = None
            return "ok"
        self.weak_since = time if self.weak_since is None else self.weak_since
        return "lost" if (time - self.weak_since) * 1e-6 > PATIENCE else "weak"

    def _optimize(self) -> None:
        """A joint optimization after every few new keyframes, while the map is young."""
        how = self.options.mapping
        self.fresh, self.new = self.fresh + 1, self.new + 1
        if self.fresh >= how.every and self.new <= how.until:
            self.fresh = 0
            self._settle(how.last)

    def _settle(self, last: int | None) -> None:
        """One round; the camera goes with the newest keyframe."""
        before = self.map.keyframes[-1].state.pose
        basis = basis_of(self.options.model, "full")
        self._map = settled(self.map, self.start_plane, self.options.mapping, self.options.tracking.matching, last, basis).map
        if self.index:
            pose = self.map.keyframes[-1].state.pose @ before.inverse() @ self.belief.state.pose
            self.belief = replace(self.belief, state=replace(self.belief.state, pose=pose))

    def finish(self) -> None:
        """All keyframes once more."""
        if self.given is None:
            for _ in range(self.options.mapping.final):
                self._settle(None)

    def _track(
        self, window: Window, state: State, alone: Front, row: int, status: Status, overlap: float, strength: float, keyframe: int,
        evaluations: int, drawn: bool = False,
    ) -> Track:  # fmt: skip
        time = int(middle_of(window)[0])
        anchor = self.map.keyframes[keyframe].state.pose
        self.hung.append((time, keyframe, anchor.inverse() @ state.pose))
        track = Track(
            self.number, self.index, window, time, state, self.map.plane.seen_from(state.pose).normal, float(alone.zero[row]),
            float(alone.contrast[row]), overlap, strength, status, evaluations, bool(alone.converged[row]), keyframe,
            drawn or status == "start", self.map,
        )  # fmt: skip
        self.index += 1
        return track

    def trajectory(self) -> Trajectory:
        poses = [self.map.keyframes[keyframe].state.pose @ pose for _, keyframe, pose in self.hung]
        every = Pose(torch.cat([p.R for p in poses]), torch.cat([p.t for p in poses]))
        return Trajectory(torch.tensor([time for time, _, _ in self.hung]), every)


def keyframe_of(window: Window, state: State) -> Keyframe:
    """A window [1] with the state of its middle, to be drawn."""
    return Keyframe(int(middle_of(window)[0]), state, window.duration.double(), Ink.of(window, window.weight))


def middle_of(window: Window) -> Tensor:
    """[B] µs"""
    return window.start + (window.duration.double() * 5e5).round().long()
