"""What the map is made of: a first plane from several windows together, keyframes, and their joint optimization."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchcmax import kernels
from torchcmax.core.draw import Ink
from torchcmax.core.joint import Frames, Joint, Solved, optimize_chain
from torchcmax.core.match import NUMBERS, Match, Matching, Task, lookup, loosely, match, units
from torchcmax.core.model import Displacement
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import SIZE, State
from torchcmax.core.window import Window
from torchcmax.slam.map import Area, Keyframe, Map
from torchcmax.slam.tracker import SOME

ROUGH = 10.0  # tolerances that are enough to tell the twin plane
WORSE = 0.95  # share of what the newest keyframe met in the image of the others that it must meet after a joint optimization
MOST_TILT = 0.05  # rad in a round
LOOSE = 5.0, 2.0  # px: how far the pose and the motion of a keyframe go in a round, one sigma
Free = tuple[bool, bool]


@dataclass(frozen=True)
class Keyframing:
    """How a map is begun, drawn, and optimized."""

    first: int = 16
    """Windows that the first map is estimated from."""
    joint: Joint = field(default_factory=Joint)
    """How it is estimated from them."""
    thinned: int = 6000
    """Events of each of them that are used at most."""
    settle: int = 16
    """Rounds of joint optimization of the first keyframes."""
    overlap: float = 0.8
    """A window of which less is known becomes a keyframe."""
    every: int = 8
    """Keyframes from one joint optimization to the next."""
    last: int = 12
    """Keyframes that are optimized at a time."""
    until: int = 30
    """New keyframes after which the joint optimization waits for the end."""
    final: int = 1
    """Rounds of joint optimization of all keyframes at the end."""

    def __post_init__(self) -> None:
        least = {"first": 1, "thinned": 2, "every": 1, "last": 1, "settle": 0, "until": 0, "final": 0}
        wrong = [f"{name} of at least {n}, got {getattr(self, name)}" for name, n in least.items() if getattr(self, name) < n]
        wrong += [] if 0 <= self.overlap <= 1 else [f"an overlap of 0 to 1, got {self.overlap}"]
        if wrong:
            raise ValueError(f"mapping wants {wrong[0]}")


@dataclass(frozen=True)
class Mapping(Keyframing):
    """How the map of a plane is made."""

    tilt: float = 10.0
    """degrees: what the first plane may be off, one sigma."""
    doubt: float = 10.0
    """How many times less certain the plane is than its events say, as what biases it is the same in all of them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("tilt", "doubt"):
            if not getattr(self, name) > 0:
                raise ValueError(f"mapping wants {name} above 0, got {getattr(self, name)}")


def thinned(ink: Ink, most: int) -> Ink:
    """At most so many events of each window, evenly."""
    return ink.thinned(max(1, -(-ink.x.shape[-1] // most)))


def first_plane(
    windows: Sequence[Window],
    motions: Sequence[Motion],
    focal: float,
    how: Keyframing,
    start: Plane | None = None,
    free: Free = (True, True),
) -> Solved:
    """Consecutive windows before one plane, from their own motions [1] before a wall: all motions and the plane together.

    One window has two planes that explain it as well, the second being the first's velocity (Displacement.twin).  So from the
    twin of what was found the search is begun once more, less exactly; where that ends sharper, it is the plane.
    start [1]: the plane to begin with; default: the wall | free: what the camera is known to do, as Frames
    """
    count, middle = len(windows), len(windows) // 2
    inks = Ink.join([thinned(Ink.of(w, w.weight), how.thinned) for w in windows])
    seconds = torch.cat([w.duration for w in windows]).double()
    motion = Motion(torch.cat([m.omega for m in motions]), torch.cat([m.velocity for m in motions]))
    rest = Pose(torch.eye(3, dtype=torch.float64).expand(count, 3, 3), torch.zeros(count, 3, dtype=torch.float64))
    frames = Frames(State(rest, motion), seconds, inks, start or Plane.tilted(torch.zeros(1, 2, dtype=torch.float64)), free)
    found = optimize_chain(frames, focal, how.joint, middle)
    rough = replace(how.joint, stop=replace(how.joint.stop, tolerance=ROUGH * how.joint.stop.tolerance))
    rival = optimize_chain(replace(frames, plane=twin_of(found.frames, middle)), focal, rough, middle)
    return optimize_chain(rival.frames, focal, how.joint, middle) if rival.contrast > found.contrast else found


def twin_of(frames: Frames, middle: int) -> Plane:
    """The other plane [1] that explains the middle window."""
    state, seconds = frames.state[middle : middle + 1], frames.seconds[middle : middle + 1, None]
    there = state.seen(frames.plane)
    shift = state.motion.velocity * seconds / there.distance[:, None]
    return Plane(Displacement(state.motion.omega * seconds, shift, there.normal).twin().normal, frames.plane.distance)


def rebased(frames: Frames) -> Frames:
    """In the world of the camera at the first window's first event, whose distance from the plane is one."""
    first = frames.state[:1].later(-frames.seconds[:1] / 2).pose
    plane = frames.plane.seen_from(first)
    back = first.inverse()
    count, scale = len(frames), plane.distance
    pose = Pose(back.R.expand(count, 3, 3), back.t.expand(count, 3)) @ frames.state.pose
    state = State(Pose(pose.R, pose.t / scale), Motion(frames.state.motion.omega, frames.state.motion.velocity / scale))
    return replace(frames, state=state, plane=Plane(plane.normal, torch.ones_like(scale)))


@dataclass(frozen=True)
class Settled:
    """A map after a round of joint optimization, by how much its plane tilted, rad [2], and whether the newest keyframe is for it.

    accepted: else the map is the old one
    """

    map: Map
    tilt: Tensor
    accepted: bool


def settled(m: Map, start: Plane, how: Mapping, matching: Matching, last: int | None = None, basis: Tensor | None = None) -> Settled:
    """One round of joint optimization: each of the last keyframes [k] finds its place in the map of all others, and the plane tilts.

    12 k + 2 numbers; the first keyframe stays, and with it the world.  The tilt is the step that its events want, given that
    every keyframe would follow (Schur's complement), and that it was `start`, more or less.  basis [14, M]: how keyframes may move.
    Where the newest keyframe then finds less in the image of the others than before, the old map stays.
    """
    count = len(m.keyframes)
    free = range(max(1, count - (last or count)), count)
    matching = replace(matching, objective="lookup")
    m.typical()  # now, as the threads share it
    with ThreadPoolExecutor(kernels.threads()) as pool:
        found = dict(zip(free, pool.map(lambda i: _placed(m, i, matching, basis), free), strict=True))
    matches = {i: one for i, one in found.items() if one is not None}
    normal, push = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for one in matches.values():
        normal += one.normal
        push += one.push
    drift = (m.plane.across() @ (m.plane.normal - start.normal)[..., None])[0, :, 0] * m.focal  # px, from the first plane
    certain = (1 / (math.pi / 180 * how.tilt * m.focal)) ** 2
    doubt = how.doubt**2
    tilt = -torch.linalg.solve(normal / doubt + certain * torch.eye(2, dtype=torch.float64), push / doubt + certain * drift)
    tilt = tilt * (MOST_TILT * m.focal / tilt.norm().clamp_min(MOST_TILT * m.focal))
    keyframes = list(m.keyframes)
    for i, one in matches.items():
        x = one.match.x[:, :SIZE] - one.pull @ tilt
        keyframes[i] = keyframes[i].at(keyframes[i].state.moved(x * one.size[:, :SIZE]))
    fresh = Map(m.plane.leaning(tilt[None] / m.focal), m.focal, m.border, m.texture, number=m.number)
    fresh.draw(keyframes)
    if explained(fresh, count - 1, matching, m.typical()) < WORSE * explained(m, count - 1, matching, m.typical()):
        return Settled(m, torch.zeros_like(tilt), False)
    return Settled(fresh, tilt / m.focal, True)


def explained(m: Map, number: int, matching: Matching, typical: float) -> float:
    """The mean strength that a keyframe's events meet in the image of the others, where that is known; 0 where it is nowhere.

    typical: the rate of an edge, the same for maps that are to be compared
    """
    found = among_others(m, number, typical)
    return 0.0 if found is None else met(m, m.keyframes[number], *found, matching)


def met(m: Map, keyframe: Keyframe, area: Area, H_k: Tensor, matching: Matching) -> float:
    """The mean strength that a keyframe's events meet in an area of a map, by its warp H_k [K, 3, 3], where that is known."""
    few = m.trusted(keyframe.ink.thinned(matching.every), H_k, area)
    strength = lookup(area.charts[0].texture, m.pixels(few, H_k)[None] - area.charts[0].corner.to(few.x))[0][0]
    return float((strength * few.weight[0]).sum() / few.weight.sum().clamp_min(1))


def among_others(m: Map, number: int, typical: float | None = None) -> tuple[Area, Tensor] | None:
    """What all the others drew around a keyframe, and its warp H_k [K, 3, 3] there; None where it looks along the plane."""
    own = m.drawn(number)
    if own is None:
        return None
    layers = m.assembled(own.box) - own.layers
    return Area(own.box, layers, m.charts(layers, own.box, m.texture.blur[-1:], typical)), own.H_k


@dataclass(frozen=True)
class _Placed:
    """A keyframe in the map of the others.  normal [2, 2], push [2]: what it says about the tilt | pull [12, 2]: how it follows."""

    match: Match
    size: Tensor
    normal: Tensor
    push: Tensor
    pull: Tensor


def _placed(m: Map, number: int, matching: Matching, basis: Tensor | None) -> _Placed | None:
    task, keyframe = before_others(m, number, matching, basis), m.keyframes[number]
    if task is None:
        return None
    found = match(torch.zeros(1, task.basis.shape[1], dtype=torch.float64), task, matching)
    A, slope = (found.information + task.prior)[0], found.slope[0]
    B = task.basis[:SIZE]
    pull = B @ torch.linalg.solve(B.mT @ A[:SIZE, :SIZE] @ B, B.mT @ A[:SIZE, SIZE:])
    normal, push = A[SIZE:, SIZE:] - A[SIZE:, :SIZE] @ pull, slope[SIZE:] - pull.mT @ slope[:SIZE]
    return _Placed(found, units(keyframe.state, m.plane, keyframe.seconds, m.focal), normal, push, pull)


def before_others(m: Map, number: int, matching: Matching, basis: Tensor | None = None) -> Task | None:
    """A keyframe before the map of all others; None where nothing of them is in its view."""
    found = among_others(m, number)
    return None if found is None else before(m, m.keyframes[number], *found, matching, basis)


def before(m: Map, keyframe: Keyframe, area: Area, H_k: Tensor, matching: Matching, basis: Tensor | None = None) -> Task | None:
    """A keyframe before an area of a map, by its warp H_k [K, 3, 3]; None where nothing of it is in its view."""
    few = m.trusted(keyframe.ink.thinned(matching.every), H_k, area)
    if not few.weight.any():
        return None
    ghosts, ground = m.by_chance(few, H_k, area)
    basis = torch.eye(NUMBERS, SIZE, dtype=torch.float64) if basis is None else basis
    (chart,) = area.charts
    loose = loosely(*LOOSE)[None]
    return Task(keyframe.state, m.plane, keyframe.seconds, chart, few, keyframe.ink.sample(SOME), loose, basis, ghosts, ground)
