"""One recording on its way: start, tracking, loss, new local maps, and their joining; the only file that knows the order of things."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import median

import torch
from torch import Tensor

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.draw import Ink
from torchcmax.core.estimate import Search
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.core.state import State
from torchcmax.core.window import Window
from torchcmax.slam.atlas import Similarity, fitting
from torchcmax.slam.glimpse import Glimpse
from torchcmax.slam.globe import WALL
from torchcmax.slam.map import Keyframe, Map
from torchcmax.slam.mapper import first_plane, rebased, settled
from torchcmax.slam.options import Panorama, Slam
from torchcmax.slam.record import ALONG, FEW, GAP, NOISE, UNSURE, Placement, Signs, Site, Status, Track
from torchcmax.slam.relocalize import Grid
from torchcmax.slam.seek import Searchable, Searching, Seeker
from torchcmax.slam.sense import decided, name_of
from torchcmax.slam.tracker import (
    Belief,
    Front,
    Sight,
    Step,
    World,
    basis_of,
    before_plane,
    covariance_of,
    doubt,
    front,
    rays_of,
    speed,
    step,
)
from torchcmax.slam.windows import Seen, Source, Windows

FIRST_SIGMA = 0.005, 0.005, 0.2, 0.2  # of the last start window: turn, shift, angular velocity, velocity
FOUND_SIGMA = 0.01, 0.01, 0.3, 0.3  # of a camera that was found near
RESTING, ADRIFT = 0.1, 4.0  # s in which a camera can come to rest, and px that it could go in them before it is asked where it is
REST = 0.05  # rad/s and distances/s that a still camera may move, one sigma
BORDER = 4  # px from one ray of the sensor's edge to the next
LEAST = 0.5  # share of the first windows that are enough where the camera comes to rest
TRAIL = 64  # windows of a lost camera that are kept, to be tracked when it is found
ROUNDS = 2  # of joint optimization where two maps are joined


class TooShort(ValueError):
    """A recording that ends before there is anything to begin with."""


@dataclass(frozen=True)
class Gathered:
    """A window that waits for a plane, with what it shows alone; the number of its placement; the share of events that are no noise."""

    window: Window
    front: Front
    number: int
    supported: float


class Run:
    """A camera on its way."""

    windows: Windows  # where it is begun
    least = 2  # windows that a map can be made from

    def __init__(self, number: int, camera: Camera, canvas: Canvas, options: Slam | Panorama, given: World | None) -> None:
        self.number, self.canvas, self.options, self.given = number, canvas, options, given
        self.camera, self.sensor = camera, Canvas.around(camera, 0.0)
        rays = camera.rays()
        edge = torch.cat([rays[0], rays[-1], rays[:, 0], rays[:, -1]])[::BORDER]
        self.border, self.rays = edge.float(), rays_of(camera)
        self.sites: list[Site] = [] if given is None else [self._site(given)]
        self.site: Site | None = None  # where the camera is; None while it is lost
        self.last: Site | None = self.sites[0] if self.sites else None  # where it was last
        self.belief: Belief | None = None
        self.placements: list[Placement] = []
        self.gathered: list[Gathered] = []
        self.trail: deque[tuple[Seen, Placement]] = deque(maxlen=TRAIL)  # windows since the camera was lost
        self.early: list[tuple[Seen, Front | None]] = []  # windows before there is anything to tell of them
        self.motion: Motion | None = None  # before a wall, while there is no map
        self.seeker: Seeker | None = None
        self.grid: tuple[World, int, Searchable] | None = None
        self.weak_since: int | None = None  # µs, of windows that met few edges; and of those of which it was unsure where
        self.unsure_since: int | None = None
        self.adrift: int | None = None  # µs, since when it may have gone on where there was only noise
        self.rested = 0  # µs of noise since `weak_since`, which nobody holds against it
        self.index = self.losses = self.recoveries = self.joins = 0

    # windows

    def begin(self, source: Source) -> None:
        """The windows that `next` gives come from here."""
        self.windows = Windows(source, self.camera, self.options, self.rays, self.canvas.focal)

    def next(self) -> Seen | None:
        """The next window: as long as the image takes to move by the displacement wanted."""
        if self.site is not None:
            return self.windows.past(self.windows.sized(self._belief.state, self.site.map.plane))
        if self.motion is None:
            first = self.windows.longest()
            if first is None or first.noise:
                return self.windows.past(first)
            self.motion = self.shown(first.window).motion
        return self.windows.past(self.windows.sized(replace(still(rest()), motion=self.motion), WALL))

    def shown(self, window: Window) -> Front:
        """What a window shows alone, before a wall, from the last motion on."""
        blur, state = ((4.0, 2.0, 1.0), still(rest())) if self.motion is None else ((2.0, 1.0), replace(still(rest()), motion=self.motion))
        search = Search(blur, margin=self.options.tracking.search.margin)
        how = replace(self.options.tracking, look=self.options.start, search=search)
        return front(window, self.canvas, state, WALL, how, self.options.model)

    # before a map, and lost

    def wander(self, seen: Seen, reason: str = "") -> Iterator[Track]:
        """A window while there is no map to track it on: gathered for a new one, and searched for in the old one."""
        window = seen.window
        alone = None if seen.noise else self.shown(window)
        self.placements.append(Placement(seen.time, "lost" if self.sites else "still"))
        if not seen.noise:
            self.trail.append((seen, self.placements[-1]))
        number, early = len(self.placements) - 1, self.index == 0
        if early:
            self.early.append((seen, alone))
        else:
            yield self._lost(seen, alone, reason)
        if alone is None:  # at rest: what was gathered is enough for a map, or forgotten
            if len(self.gathered) >= max(2, LEAST * self.options.mapping.first):
                yield from self._begin()
            elif self.gathered:
                for placement in self.placements:
                    placement.status = placement.status if placement.site else "lost"
            self.gathered, self.motion = [], None
            return
        self.motion = alone.motion
        if self.options.atlas or not self.sites:
            self.gathered.append(Gathered(window, alone, number, seen.supported))
        full = max(len(self.gathered), len(self.early)) >= self.options.mapping.first
        if self._seek(window, alone.motion, WALL.normal) or (early and self.given is not None and full):
            yield from self._early_tracks()  # it is on the given map, or not near where that was drawn from
        elif len(self.gathered) >= self.options.mapping.first:
            yield from self._begin()

    def _begin(self) -> Iterator[Track]:
        """The gathered windows make a first plane and map."""
        how, model = self.options.mapping, self.options.model
        gathered, self.gathered = self._moving(self.gathered), []
        windows, motions = [g.window for g in gathered], [g.front.motion for g in gathered]
        free = (model != "translation", model != "rotation")
        solved = rebased(first_plane(windows, motions, self.canvas.focal, how, free=free).frames)
        number = 1 + max((site.map.number for site in self.sites), default=-1)
        m = self._blank(solved.plane, number)
        m.draw([keyframe_of(window, solved.state[i : i + 1]) for i, window in enumerate(windows)])
        self.site = self._site(m)
        self.sites.append(self.site)
        for _ in range(how.settle):
            self._settle(self.site, None)
        keyframes = self.site.map.keyframes
        for i, g in enumerate(gathered):
            self.placements[g.number].hang(self.site, i, keyframes[i].state, "start")
        first = still(keyframes[0].state.later(-keyframes[0].seconds / 2).pose)
        last = still(keyframes[-1].state.later(keyframes[-1].seconds / 2).pose)
        for number, placement in enumerate(self.placements):  # at rest until it began to move, or from then on
            if placement.site is None and placement.status == "still":
                before = number < gathered[0].number
                placement.hang(self.site, 0 if before else len(keyframes) - 1, first if before else last, "still")
        rests = gathered[-1].number < len(self.placements) - 1  # only noise came behind them
        self.belief = Belief(torch.tensor([keyframes[-1].time]), last if rests else keyframes[-1].state, covariance_of(FIRST_SIGMA))
        self._anew(self.site)
        yield from self._early_tracks()

    def _moving(self, gathered: list[Gathered]) -> list[Gathered]:
        """Without those at the end that the camera mostly rests in: a map would take the little that they show for any motion."""
        usual = self.options.sensing.weak * median(g.supported for g in gathered)
        last = max(i for i, g in enumerate(gathered) if g.supported >= usual)
        for g in gathered[last + 1 :]:
            self.placements[g.number].status = "still"
        return gathered[: last + 1]

    def _early_tracks(self) -> Iterator[Track]:
        """What was kept back is told."""
        early, self.early = self.early, []
        for (seen, alone), placement in zip(early, self.placements, strict=False):
            if placement.site is None:
                yield self._lost(seen, alone, NOISE if seen.noise else "")
            else:
                reason = NOISE if placement.status == "still" else ""
                yield self._track(seen, placement, Signs(seen.supported, 1.0), reason, alone, drawn=placement.status == "start")

    def _lost(self, seen: Seen, alone: Front | None, reason: str) -> Track:
        """A window of a camera of which nothing is known: it stays where it was."""
        state = still(rest() if self.belief is None else self.belief.state.pose)
        site = self.last or self._site(self._blank(WALL))
        return self._track(seen, Placement(seen.time, "lost", site), Signs(seen.supported, 0.0, 0.0), reason, alone, state=state)

    def lose(self) -> None:
        """From now on nothing is believed of where the camera is, nor of the windows before in which it met few edges, or was unsure, or
        seemed to be at rest."""
        since = self.unsure_since if self.weak_since is None else self.weak_since
        since = self.adrift if self.adrift is not None else since
        for placement in self.placements[::-1]:
            if since is None or placement.time < since:
                break
            placement.lose()
        self._anew(None)
        self.trail.clear()
        self.losses += 1

    def _seek(self, window: Window, motion: Motion, normal: Tensor) -> bool:
        """Looks for the camera in the first map, while it is not there; whether it was found."""
        if not self.sites or self.site is self.sites[0] or not self.options.relocalizing.far:
            return False
        if self.seeker is None:
            how = self.options
            searching = Searching(how.relocalizing, how.tracking, how.model, how.sensing.certain)
            self.seeker = Seeker(self.sites[0].map, self._searchable(self.sites[0].map), self.canvas, self.sensor, self.rays, searching)
            if self.given is not None and self.index == 0:
                self.seeker.guess(window, motion, normal)
        found = self.seeker.offer(window, motion, normal)
        if found is None:
            return False
        self.seeker.close()
        self.seeker = None
        self._arrive(self.sites[0], found)
        return True

    def _arrive(self, home: Site, now: Belief) -> None:
        """The camera was found: what it drew meanwhile is joined, or its way here is tracked backwards, and it goes on in the first map."""
        if self.site is not None:
            self._join(home, self.site, now)
        else:
            self.belief = now
            self._trace(home, now)
        self._anew(home)
        self.recoveries += 1

    def _anew(self, site: Site | None) -> None:
        """From now on the camera is here, and nothing is held against it."""
        self.site, self.last, self.gathered, self.motion = site, site or self.last, [], None
        self.weak_since = self.unsure_since = None
        self.adrift, self.rested = None, 0

    def _trace(self, home: Site, now: Belief) -> None:
        """The windows before a camera was found, the last one first, as long as they fit."""
        least = self.options.sensing.weak * median(home.usual) if home.usual else 0.0
        for seen, placement in reversed(self.trail):
            before = now.at(seen.window.middle, self.options.tracking.acceleration)
            sight = self.sight(home, seen.window, before)
            if sight is None:
                return
            found = step(seen.window, self.canvas, before, [sight], self.options.tracking, self.options.model)
            now, strength = found.after, float(found.match.strength[0])
            if strength <= least or doubt(now, home.map.plane, self.rays, self.canvas.focal) >= self.options.sensing.certain:
                return
            placement.hang(home, nearest(home.map, now.state.pose), now.state, "ok")

    def _join(self, home: Site, local: Site, now: Belief) -> None:
        """Two maps become one, where what the second one drew fits the first; a given map stays as it is, and is only told where."""
        similarity = Similarity.between(self._belief.state, local.map.plane, now.state, home.map.plane)
        self.belief = now
        there = [(p, similarity.state(p.there())) for p in self.placements if p.site is local]
        keyframes = fitting(local.map, similarity, home.map, self._grid(home), self.sensor)
        if keyframes is None:
            return
        if self.given is None:
            home.map.draw(keyframes)
        for placement, state in there:
            placement.hang(home, nearest(home.map, state.pose), state, placement.status)
        for _ in range(ROUNDS if self.given is None else 0):
            self._settle(home, len(keyframes), moving=True)
        self.sites.remove(local)
        self.joins += 1

    # on a map

    @property
    def _belief(self) -> Belief:
        """What is believed, where there is a map."""
        if self.belief is None:
            raise ValueError("nothing is known of the camera before the first plane is found")
        return self.belief

    def predicted(self, window: Window) -> Belief:
        """What is known of the camera at the window's middle before it is looked at."""
        return self._belief.at(window.middle, self.options.tracking.acceleration)

    def sight(self, site: Site, window: Window, belief: Belief) -> Sight | None:
        """What the camera sees of a map from where it is believed to be; None where it looks along the plane."""
        return Sight.of(site.map, belief.state, window.duration.double())

    def hold(self, site: Site, seen: Seen) -> Track:
        """A window of noise: the camera stays where it was.

        If it was moving, it may be the view that has nothing: the next window must fit there as a found place would.
        """
        if self.adrift is None and speed(self._belief.state, site.map.plane, self.rays, self.canvas.focal) * RESTING > ADRIFT:
            self.adrift = seen.time
        self.rested += round(float(seen.window.duration[0]) * 1e6)
        last = self._belief.at(seen.window.start, self.options.tracking.acceleration)  # where it was when the noise began
        state, covariance = still(last.state.pose), last.covariance.clone()
        covariance[:, 6:] = covariance[:, :, 6:] = 0
        covariance[:, range(6, 12), range(6, 12)] = REST**2
        self.belief = Belief(seen.window.middle, state, covariance)
        return self._track(seen, self._placed(site, seen, "still"), Signs(seen.supported), NOISE)

    def blind(self, seen: Seen, reason: str = ALONG) -> Iterator[Track]:
        """A window of a camera that is lost from now on."""
        self.lose()
        yield from self.wander(seen, reason)

    def follow(self, site: Site, seen: Seen, found: Step, row: int, before: Sight) -> Iterator[Track]:
        """A window that was tracked, from what was seen before: its status, and what it does to the map."""
        self.belief, strength = found.after[row : row + 1], float(found.match.strength[row])
        tells = self.options.tracking.matching.objective == "lookup"  # how sure it is
        unsure = doubt(self.belief, site.map.plane, self.rays, self.canvas.focal) if tells else float("nan")
        fits = self.adrift is None or self._fits(site, seen.window)
        status, reason = self._status(site, strength if fits else 0.0, unsure, seen.time)
        self.adrift = None if status == "ok" else self.adrift
        if reason == FEW:  # keep to what was predicted, or to where it is found near, which is believed when the next window fits there
            met = found.after if self._meets(site, strength) else found.before
            self.belief = self._near(site, seen.window, found, row) or met[row : row + 1]
        sight = self._refined(site, seen.window, before, reason)
        if sight is None or status == "lost":
            yield from self.blind(seen, ALONG if sight is None else reason)
            return
        overlap = sight.map.overlap(sight.H_k, self.rays, sight.area)
        drawn = status == "ok" and overlap < self.options.mapping.overlap and self.given is None
        if drawn:
            site.map.draw([keyframe_of(seen.window, self._belief.state)])
            self._optimize(site)
        share, directions = decided(found.information[row], found.prior[row])
        signs = Signs(seen.supported, overlap, strength, unsure, name_of(directions[:, 0], found.free), float(share[0]))
        evaluations = int(found.match.evaluations[row])
        yield self._track(seen, self._placed(site, seen, status), signs, reason, found.front, row, evaluations, drawn)
        if status == "ok":
            motion, there = before_plane(self._belief.state, site.map.plane)
            self._seek(seen.window, motion, there.normal)

    def _fits(self, site: Site, window: Window) -> bool:
        """Whether a window looks as the map does where the camera is believed to be."""
        state = self._belief.state
        motion, there = before_plane(state, site.map.plane)
        glimpse = Glimpse.of(window, motion, there.normal, self.sensor, self.border)
        return self._grid(site).judge(glimpse, state) >= self.options.relocalizing.accept

    def _meets(self, site: Site, strength: float) -> bool:
        """Whether a window meets as many edges as is usual."""
        return not site.usual or strength > self.options.sensing.weak * median(site.usual)

    def _status(self, site: Site, strength: float, unsure: float, time: int) -> tuple[Status, str]:
        """Of a window that was tracked, and why it is not ok."""
        how = self.options.sensing
        if self._meets(site, strength):
            site.usual.append(strength)
            self.weak_since, self.rested = None, 0
            if not unsure >= how.certain:
                self.unsure_since = None
                return "ok", ""
            self.unsure_since = time if self.unsure_since is None else self.unsure_since
            return "lost" if unsure >= how.hopeless else "weak", UNSURE
        if self.weak_since is None:
            self.weak_since, self.rested = time, 0
        return "lost" if (time - self.weak_since - self.rested) * 1e-6 > how.patience else "weak", FEW

    def _near(self, site: Site, window: Window, found: Step, row: int) -> Belief | None:
        """A camera that met too little is looked for around where it was expected."""
        how, before = self.options.relocalizing, found.before[row : row + 1]
        if not how.near:
            return None
        shown = State(before.state.pose, Motion(found.front.motion.omega[row : row + 1], found.front.motion.velocity[row : row + 1]))
        motion, there = before_plane(shown, site.map.plane)
        places = self._grid(site).near(Glimpse.of(window, motion, there.normal, self.sensor, self.border), before.state)
        sure = float(places.score[0]) >= how.accept and places.clear >= how.ratio
        return Belief(before.time, places.state[:1], covariance_of(FOUND_SIGMA)) if sure else None

    def _grid(self, site: Site) -> Searchable:
        """The map made ready for searching, kept until it changes."""
        kept = self.grid
        if kept is None or kept[0] is not site.map or kept[1] != len(site.map.keyframes):
            self.grid = kept = site.map, len(site.map.keyframes), self._searchable(site.map)
        return kept[2]

    def _optimize(self, site: Site) -> None:
        """A joint optimization after every few new keyframes, while the map is young."""
        how = self.options.mapping
        site.fresh, site.new = site.fresh + 1, site.new + 1
        if site.fresh >= how.every and site.new <= how.until:
            site.fresh = 0
            self._settle(site, how.last, moving=True)

    def _settle(self, site: Site, last: int | None, moving: bool = False) -> None:
        """One round; a camera that is moving there goes with the newest keyframe."""
        before = site.map.keyframes[-1].state.pose
        site.map = self._round(site, last)
        if moving:
            pose = site.map.keyframes[-1].state.pose @ before.inverse() @ self._belief.state.pose
            self.belief = replace(self._belief, state=replace(self._belief.state, pose=pose))

    # what is of a plane, and not of a sphere

    def _refined(self, site: Site, window: Window, before: Sight, reason: str) -> Sight | None:
        """What the camera sees from where it is now believed to be."""
        return self.sight(site, window, self._belief)

    def _blank(self, plane: Plane, number: int = 0) -> World:
        """A map without anything."""
        return Map(plane, self.canvas.focal, self.border, self.options.texture, number=number)

    def _round(self, site: Site, last: int | None) -> World:
        """The map after a round of joint optimization of the last keyframes; None: of all."""
        assert isinstance(site.map, Map)
        assert isinstance(self.options, Slam)
        how, basis = self.options, basis_of(self.options.model, "full")
        return settled(site.map, site.start, how.mapping, how.tracking.matching, last, basis).map

    def _searchable(self, m: World) -> Searchable:
        """The map made ready for searching."""
        assert isinstance(m, Map)
        assert isinstance(self.options, Slam)
        return Grid(m, self.options.relocalizing)

    # the end

    def finish(self) -> Iterator[Track]:
        """A map of what there is, where there is none, then all keyframes once more."""
        if not self.sites:
            if len(self.gathered) < min(self.least, self.options.mapping.first):
                few = f"{len(self.gathered)} windows that show motion, it wants at least {self.least}"
                raise TooShort(f"recording {self.number} holds too few events to begin: {few}")
            yield from self._begin()
        yield from self._early_tracks()
        if self.seeker is not None:
            self.seeker.close()
            self.seeker = None
        if self.given is None:
            counts = {id(site): sum(p.site is site for p in self.placements) for site in self.sites}
            self.sites.sort(key=lambda site: -counts[id(site)])  # the first one, if others are as large
            for site in self.sites:
                for _ in range(self.options.mapping.final):
                    self._settle(site, None)

    @property
    def map(self) -> World:
        """The main one: the first, and at the end the one that most windows belong to."""
        if not self.sites:
            raise ValueError("there is no map before the first plane is found")
        return self.sites[0].map

    def trajectory(self) -> Trajectory:
        """Poses at the middles of the windows that belong to the main map, as the keyframes that they hang on are now."""
        here = [p for p in self.placements if self.sites and p.site is self.sites[0]]
        if len(here) < 2:
            raise ValueError(f"a trajectory wants at least two windows on the map, got {len(here)}")
        return Trajectory(torch.tensor([p.time for p in here]), State.join([p.there() for p in here]).pose)

    # telling

    def _site(self, m: World) -> Site:
        return Site(m, m.plane, deque(maxlen=self.options.sensing.recent))

    def _placed(self, site: Site, seen: Seen, status: Status) -> Placement:
        placement = Placement(seen.time, status)
        placement.hang(site, nearest(site.map, self._belief.state.pose), self._belief.state, status)
        self.placements.append(placement)
        return placement

    def _track(
        self, seen: Seen, placement: Placement, signs: Signs, reason: str = "", alone: Front | None = None, row: int = 0,
        evaluations: int = 0, drawn: bool = False, state: State | None = None,
    ) -> Track:  # fmt: skip
        """What is told of a window; state: of a lost one."""
        assert placement.site is not None
        m, state = placement.site.map, state or placement.there()
        zero = contrast = float("nan")
        converged = False
        if alone is not None:
            zero, contrast, converged = float(alone.zero[row]), float(alone.contrast[row]), bool(alone.converged[row])
            evaluations += int(alone.evaluations[row])
        normal = m.plane.seen_from(state.pose).normal if isinstance(m, Map) else torch.full_like(state.pose.t, torch.nan)
        track = Track(
            self.number, self.index, seen.window, seen.time, state, normal, zero, contrast, signs, placement.status,
            GAP if seen.gap and placement.status == "lost" else reason, evaluations, converged, placement.keyframe, drawn, m,
        )  # fmt: skip
        self.index += 1
        return track


def rest() -> Pose:
    """Where the world begins: [1]."""
    return Pose(torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))


def still(pose: Pose) -> State:
    """A camera [1] that does not move."""
    zero = torch.zeros(1, 3, dtype=torch.float64)
    return State(pose, Motion(zero, zero))


def nearest(m: World, pose: Pose) -> int:
    """The keyframe whose camera is nearest to one [1], in plane distances and radians."""
    state = State.join([keyframe.state for keyframe in m.keyframes])
    away, turned = (state.pose.t - pose.t).norm(dim=-1) / m.plane.distance, (state.pose.R - pose.R).flatten(1).norm(dim=-1) / 2**0.5
    return int((away + turned).argmin())


def keyframe_of(window: Window, state: State) -> Keyframe:
    """A window [1] with the state of its middle, to be drawn."""
    return Keyframe(int(window.middle[0]), state, window.duration.double(), Ink.of(window, window.weight))
