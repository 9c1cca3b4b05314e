"""Find where a camera looks on a globe: orientations of all SO(3), or around a guess, coarse to fine, many at a time.

Nothing but the window's edges and the map is known.  What is found is judged as before a plane: by the normalized cross-correlation of
the window's edges with what the map shows there, where that is known (Lewis 1995; masked: Padfield 2012).
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcmax import kernels
from torchcmax.core import so3
from torchcmax.core.camera import Sphere
from torchcmax.core.match import Matching, Task, loosely, match
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.slam.equirect import smooth
from torchcmax.slam.glimpse import Glimpse
from torchcmax.slam.globe import WALL, Globe
from torchcmax.slam.relocalize import SHARP, Found, Seeking, chosen, compared
from torchcmax.slam.tracker import SOME, basis_of

BLUR = 0.4  # of the distance between two orientations that are tried, the blur of map and window
AT_ONCE = 1 << 21  # points looked up at a time
POOL, DENSE = 3, 1.4  # px of the window, each way, that are one point: at least, and of the blur
APART = 12.0  # px that two places are apart at least
LOOSE = 4.0, 3.0  # px that orientation and angular velocity go when a place is matched to the map, one sigma
TURNS = tuple((x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1))


@dataclass(frozen=True)
class Turning(Seeking):
    """How a camera is searched for on a globe."""

    steps: tuple[float, ...] = (8.0, 4.0, 2.0, 1.0, 0.5)
    """degrees from one orientation that is tried to the next, coarse to fine."""
    keep: tuple[int, ...] = (150, 60, 30, 12, 6)
    """Orientations that go on from each of them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (len(self.steps) == len(self.keep) > 0 and min(self.steps) > 0 and min(self.keep) > 0):
            raise ValueError(f"relocalizing wants as many steps above 0 as numbers to keep, got {self.steps} and {self.keep}")


@dataclass(frozen=True)
class Level:
    """The globe unrolled, blurred: strength, known [H * W] | sphere"""

    strength: Tensor
    known: Tensor
    sphere: Sphere


@dataclass(eq=False)
class Compass:
    """A globe made ready for searching, as it is now: a later change of the globe does not change it."""

    globe: Globe
    how: Turning
    _levels: dict[float, Level] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.globe = self.globe.copy()

    def level(self, sigma: float) -> Level:
        """For images blurred by sigma px."""
        if sigma not in self._levels:
            known, sphere = self.globe.known(), self.globe.sphere
            weight = smooth(known, sigma, sphere).clamp_min(1e-6)
            strength = smooth(self.globe.strength() * known, sigma, sphere) / weight  # of what is known alone
            self._levels[sigma] = Level(strength.reshape(-1).contiguous(), (known * (weight > 0.5)).reshape(-1), sphere)
        return self._levels[sigma]

    # what a seeker asks

    def far(self, glimpse: Glimpse) -> Found:
        """Where on the whole globe a window fits."""
        return self._finer(glimpse, orientations(self.how.steps[0]), 0)

    def near(self, glimpse: Glimpse, expected: State) -> Found:
        """Where around the expected state [1] a window fits."""
        degrees = max(self.how.around[1], math.degrees(self.how.around[0] / self.globe.focal))
        first = next((i for i, step in enumerate(self.how.steps) if step <= degrees / 2), len(self.how.steps) - 1)
        step, many = self.how.steps[first], math.ceil(degrees / self.how.steps[first])
        side = torch.arange(-many, many + 1, dtype=torch.float64) * math.radians(step)
        grid = torch.cartesian_prod(side, side, side)
        return self._finer(glimpse, expected.pose.R @ so3.exp(grid[grid.norm(dim=-1) <= math.radians(degrees) * 1.01]), first)

    def at(self, glimpse: Glimpse, pose: Pose) -> Found:
        """What becomes of poses [K]."""
        return self._finer(glimpse, pose.R, min(1, len(self.how.steps) - 1))

    def judge(self, glimpse: Glimpse, state: State) -> float:
        """The score of a state [1]."""
        return float(self.scores(glimpse, state.pose.R, SHARP)[0][0])

    def seen(self, state: State) -> Tensor:
        """Points of the sensor's edge on the sphere, px: [K, M, 3], as rays times the focal length."""
        ray = self.globe.border.double()[:: max(1, len(self.globe.border) // 8)]
        found: Tensor = ray / ray.norm(dim=-1, keepdim=True) @ state.pose.R.mT * self.globe.focal
        return found

    # how

    def _finer(self, glimpse: Glimpse, R: Tensor, first: int) -> Found:
        """Orientations [K, 3, 3] that are tried at one step, those that fit best around at the next, and at last matched to the map."""
        turns = torch.tensor(TURNS, dtype=torch.float64)
        for i in range(first, len(self.how.steps)):
            step = math.radians(self.how.steps[i])
            if i > first:
                R = (R[:, None] @ so3.exp(turns * step)).flatten(0, 1)
            score, _ = self.scores(glimpse, R, max(SHARP, BLUR * step * self.globe.focal))
            apart = 0.7 * step if i == first else 1.5 * step  # later ones are of basins, of which one place is enough
            apart = apart if i < len(self.how.steps) - 1 else max(apart, APART / self.globe.focal)
            R = R[distinct(R, score, self.how.keep[i], apart)]
        state = State.join([self._matched(glimpse, one) for one in R.split(1)])
        score, known = self.scores(glimpse, state.pose.R, SHARP)
        order = distinct(state.pose.R, score, len(score), APART / self.globe.focal)
        state, score, known = state[order], score[order], known[order]
        xyz = self.seen(state)
        return Found(state, score, known, (xyz - xyz[:1]).square().sum(-1).mean(-1).sqrt())

    def _matched(self, glimpse: Glimpse, R: Tensor) -> State:
        """One orientation [1, 3, 3], with the window's angular velocity, matched to the map."""
        nowhere = torch.zeros(1, 3, dtype=torch.float64)
        state = State(Pose(R, nowhere), Motion(glimpse.motion.omega, nowhere))
        facet = self.globe.facing(state.pose)  # kept ones would be shared by threads, and make a search depend on the one before
        box = facet.box(facet.warp(state, glimpse.seconds))
        if box is None:
            return state
        basis, prior = basis_of("rotation", "full"), loosely(*LOOSE)[None]
        for chart in facet.area(box).charts:
            task = Task(state, WALL, glimpse.seconds, chart, glimpse.ink, glimpse.ink.sample(SOME), prior, basis)
            state = match(torch.zeros(1, 6, dtype=torch.float64), task, Matching(every=1)).state
        return state

    def scores(self, glimpse: Glimpse, R: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
        """Of orientations [K, 3, 3]: the correlation of window and map, blurred by sigma px, times the root of the share that is
        known, and that share: [K], [K]."""
        level = self.level(sigma)
        ray, S = glimpse.pooled(max(POOL, math.ceil(DENSE * sigma)), sigma)
        parts = R.float().split(max(1, AT_ONCE // len(S)))
        with ThreadPoolExecutor(kernels.threads()) as pool:
            found = list(pool.map(lambda part: self._correlated(ray, S, part, level), parts))
        score, known = (torch.cat([f[i] for f in found]) for i in (0, 1))
        return score, known

    def _correlated(self, ray: Tensor, S: Tensor, R: Tensor, level: Level) -> tuple[Tensor, Tensor]:
        height, width = level.sphere.size
        column, row = (part.round().long() for part in level.sphere.place(*(R @ ray).unbind(1)))  # [K, N] each
        place = row.clamp(0, height - 1) * width + column % width
        return compared(S, level.strength[place], level.known[place], self.how.known)


def orientations(degrees: float) -> Tensor:
    """Of all SO(3), about so far from each other: directions on a Fibonacci spiral, each with all turns about it: [K, 3, 3]."""
    step = math.radians(degrees)
    count = math.ceil(4 * math.pi / step**2)
    i = torch.arange(count, dtype=torch.float64) + 0.5
    y = 1 - 2 * i / count
    lon = i * math.pi * (3 - math.sqrt(5))
    flat = (1 - y * y).sqrt()
    z = torch.stack([flat * lon.sin(), y, flat * lon.cos()], -1)
    side = torch.zeros_like(z).scatter_(1, z.abs().argmin(1, keepdim=True), 1.0)
    x = torch.nn.functional.normalize(torch.linalg.cross(side, z), dim=-1)
    base = torch.stack([x, torch.linalg.cross(z, x), z], -1)
    many = math.ceil(2 * math.pi / step)
    roll = torch.zeros(many, 3, dtype=torch.float64)
    roll[:, 2] = torch.arange(many, dtype=torch.float64) * (2 * math.pi / many)
    found: Tensor = (base[:, None] @ so3.exp(roll)).flatten(0, 1)
    return found


def distinct(R: Tensor, score: Tensor, keep: int, apart: float) -> Tensor:
    """Which orientations [K, 3, 3] are the best, at most `keep`, no two of which are nearer than `apart` rad: indices, best first."""
    order = score.argsort(descending=True)[: 20 * keep]
    flat = R[order].flatten(1)
    trace = flat @ flat.mT
    other = trace < 1 + 2 * math.cos(apart)
    return order[chosen(other, keep)]
