"""Find a camera in a map, without knowing anything of where it is, or near a guess.

A window shows edges; so does the map.  Turned, scaled and tilted in many ways, the window's edges are laid on the coarse map at all
places at once (FFT); where they fit best, the events are matched to the map, ever more finely.  What is found is judged by the normalized
cross-correlation of the window's edges with what the map shows from there (Lewis 1995; masked: Padfield 2012), over what it knows.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from torchcmax import kernels
from torchcmax.core import so3
from torchcmax.core.camera import NEAREST, Canvas
from torchcmax.core.contrast import blur
from torchcmax.core.draw import draw
from torchcmax.core.match import NUMBERS, Chart, Matching, Task, loosely, match
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import SIZE, State
from torchcmax.slam.glimpse import POOL, Glimpse
from torchcmax.slam.map import Map
from torchcmax.slam.tiles import spread
from torchcmax.slam.tracker import SOME

CHUNK = 32  # hypotheses that are correlated at a time
PEAKS = 4  # places of each hypothesis that are kept
SHARP = 1.0  # px of blur of window and map before they are compared
APART = 4.0  # px, rms, that two views must be apart to be two
ELSEWHERE = 30.0  # px, rms, from which on they are of other places
REACH = 2.5  # times the usual height over the plane, up and down, beyond which a keyframe does not say where to search
FLAT = 1e-5  # variance below which there is nothing to correlate


@dataclass(frozen=True)
class Seeking:
    """When a camera is searched for, and what is believed."""

    near: bool = True
    """A window that finds too little is looked for around where it was expected."""
    far: bool = True
    """A lost camera is looked for in the whole map."""
    known: float = 0.4
    """Share of the view that the map must know."""
    around: tuple[float, float] = (30.0, 10.0)
    """px and degrees around the expected place within which a camera is near."""
    accept: float = 0.6
    """Least score of a place: correlation times the root of the share that the map knows."""
    ratio: float = 1.1
    """How many times the score of any other place."""
    confirm: tuple[float, int] = (24.0, 3)
    """px of motion, and windows, after which a place that fits as well as before is believed."""
    wait: float = 0.1
    """s of the recording between a window and the result of the search for it, which goes on beside the tracking."""
    steady: bool = True
    """The result counts after `wait`, however long the search takes, so that every run is the same; else once it is there, and no window
    ever waits, as live cameras want it."""
    again: float = 1.0
    """s at most from one search to the next; they begin at `wait` and double."""

    def __post_init__(self) -> None:
        above = {"wait": self.wait, "ratio": self.ratio, "around": min(self.around)}
        wrong = [f"{name} above 0, got {value}" for name, value in above.items() if not value > 0]
        wrong += [f"{name} of 0 to 1, got {getattr(self, name)}" for name in ("known", "accept") if not 0 <= getattr(self, name) <= 1]
        wrong += [] if min(self.confirm) >= 0 and self.again >= self.wait else ["confirm of at least 0, and again not below wait"]
        if wrong:
            raise ValueError(f"relocalizing wants {wrong[0]}")


@dataclass(frozen=True)
class Relocalizing(Seeking):
    """How a camera is searched for in the map of a plane."""

    cell: int = 12
    """px of the map, each way, that are one in the search of the whole map."""
    turn: float = 15.0
    """degrees from one direction of the image to the next."""
    scale: float = 1.25
    """From one height over the plane to the next; from below the lowest keyframe to above the highest."""
    tilts: tuple[tuple[float, int], ...] = ((0.0, 1), (18.0, 6))
    """degrees from the plane's normal, each in so many directions."""
    candidates: int = 120
    """Places that are looked at more closely."""
    rounds: tuple[tuple[float, int, int], ...] = ((12.0, 800, 120), (6.0, 1500, 60), (3.0, 3000, 40), (1.5, 6000, 12), (0.5, 20000, 6))
    """Of that closer look: blur of the map px, events, places that go on to the next."""
    loose: tuple[float, float] = (6.0, 3.0)
    """px that pose and motion go in a round, one sigma."""
    starts: int = 48
    """Places around the expected one that are tried."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {"cell": self.cell, "candidates": self.candidates, "starts": self.starts}
        above = {"turn": self.turn, "loose": min(self.loose)}
        wrong = [f"{name} of at least 1, got {value}" for name, value in counts.items() if not value >= 1]
        wrong += [f"{name} above 0, got {value}" for name, value in above.items() if not value > 0]
        wrong += [] if self.turn <= 360 and self.scale > 1 else [f"a turn of up to 360 and a scale above 1, got {self.turn}, {self.scale}"]
        wrong += [] if self.tilts and self.rounds else ["tilts and rounds, got none"]
        if wrong:
            raise ValueError(f"relocalizing wants {wrong[0]}")


class Grid:
    """A map made ready for searching, as it is now: a later change of the map does not change it."""

    def __init__(self, m: Map, how: Relocalizing) -> None:
        self.how, self.plane, self.view, self.focal, self.border = how, m.plane, m.view, m.focal, m.border
        self.box = m.whole()
        layers = m.assembled(self.box)
        self.texture = m.strength(layers)
        self.known = spread((layers.most >= m.texture.exposure).to(self.texture)).contiguous()
        height = torch.cat([k.state.seen(m.plane).distance / m.plane.distance for k in m.keyframes])
        self.height = height.clamp(height.median() / REACH, height.median() * REACH)
        self._charts: dict[float, Chart] = {}

    def chart(self, sigma: float) -> Chart:
        """The map blurred by sigma px."""
        if sigma not in self._charts:
            corner = torch.tensor([self.box.corner], dtype=torch.float64)
            self._charts[sigma] = Chart(blur(self.texture[None], sigma), corner, self.view, self.focal)
        return self._charts[sigma]

    def far(self, glimpse: Glimpse) -> Found:
        """Where in the whole map a window fits."""
        return found_at(glimpse, self, searched(glimpse, self), self.how.rounds)

    def near(self, glimpse: Glimpse, expected: State) -> Found:
        """Where around the expected state [1] a window fits."""
        return self.at(glimpse, around(self, expected))

    def at(self, glimpse: Glimpse, pose: Pose) -> Found:
        """What becomes of poses [K]."""
        return found_at(glimpse, self, pose, self.how.rounds)

    def judge(self, glimpse: Glimpse, state: State) -> float:
        """The score of a state [1]."""
        return float(judged(glimpse, self, state)[0][0])

    def seen(self, state: State) -> Tensor:
        """px on the map of points of the sensor's edge, seen from states [K]: [K, M, 2]."""
        return seen_at(self, state)

    @cached_property
    def coarse(self) -> Tensor:
        """What is known, strength there, and its square: [3, H, W] of the search's pixels."""
        strength, known = (avg_pool2d(part[None], self.how.cell, ceil_mode=True)[0] for part in (self.texture, self.known))
        seen = (known > 0.5).to(strength)
        return torch.stack([seen, seen * strength, seen * strength.square()])

    @cached_property
    def hypotheses(self) -> tuple[Tensor, Tensor]:
        """Turns of the camera before the wall that the map is [A, 3, 3], and heights [A] in plane distances, the same ones together."""
        how, low, high = self.how, float(self.height.min()), float(self.height.max())
        steps = max(1, math.ceil(math.log(high / low) / math.log(how.scale) + 1))
        heights = torch.tensor([math.sqrt(high * low) * how.scale ** (i - steps / 2) for i in range(steps + 1)], dtype=torch.float64)
        directions = [(angle, 2 * math.pi * i / count) for angle, count in how.tilts for i in range(count)]
        tilts = torch.tensor(
            [[math.radians(r) * math.cos(a), math.radians(r) * math.sin(a), 0.0] for r, a in directions], dtype=torch.float64
        )
        turns = torch.arange(0, 360, how.turn, dtype=torch.float64).deg2rad()[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        R = (so3.exp(turns)[None] @ so3.exp(tilts)[:, None]).flatten(0, 1)
        return R.repeat(len(heights), 1, 1), heights.repeat_interleave(len(R))


def searched(glimpse: Glimpse, grid: Grid) -> Pose:
    """Poses [K] from which the coarse map looks most as the window does, best first."""
    how, (R, height) = grid.how, grid.hypotheses
    axis = R[:, :, 2]
    middle = height[:, None] * axis[:, :2] / axis[:, 2:]  # where the middle of the image falls, from the camera's foot
    H = torch.cat([height[:, None, None] * R[:, :2] - middle[:, :, None] * R[:, 2:], R[:, 2:]], 1)
    corner = grid.border.double() @ H.mT
    reach = ((corner[..., :2] / corner[..., 2:]).abs().amax((1, 2)) * grid.focal / how.cell).ceil().long() + 1
    parts = [slice(start, start + CHUNK) for start in range(0, len(R), CHUNK)]
    with ThreadPoolExecutor(kernels.threads()) as pool:
        found = list(pool.map(lambda part: _peaks(glimpse, grid, H[part], int(reach[part].max())), parts))
    score, place = (torch.cat([f[i] for f in found]).flatten() for i in (0, 1))
    top = score.topk(min(how.candidates, len(score))).indices
    which, columns = top // PEAKS, grid.coarse.shape[2]
    xy = torch.stack([place[top] % columns, place[top] // columns], -1).double()
    foot = ((xy + 0.5) * how.cell - 0.5 + torch.tensor(grid.box.corner)) / grid.focal - middle[which]
    t = grid.plane.distance[:, None] * torch.cat([foot, (1 - height[which])[:, None]], -1)
    return Pose(grid.view[0].mT @ R[which], t @ grid.view[0])


def _peaks(glimpse: Glimpse, grid: Grid, H: Tensor, half: int) -> tuple[Tensor, Tensor]:
    """The best scores of the window's edges, warped by each H [A, 3, 3], and where on the coarse map: [A, PEAKS]."""
    canvas = Canvas(grid.focal / grid.how.cell, (float(half), float(half)), (2 * half + 1, 2 * half + 1))
    owner = torch.zeros(len(H), dtype=torch.int64)
    votes, area = (draw(H[:, None].float().contiguous(), ink, canvas, owner) for ink in glimpse.points)
    usual = area.sum((1, 2), keepdim=True) / (area > 0).sum((1, 2), keepdim=True)
    covered = (area > 0.3 * usual).to(area)
    score, share = correlated(votes / area.clamp_min(1e-6) * covered, covered, grid.coarse)
    score = torch.where(share > grid.how.known, score * share.clamp(0, 1).sqrt(), -1.0)
    peak = torch.where(score == max_pool2d(score[:, None], 5, 1, 2)[:, 0], score, -1.0)
    best = peak.flatten(1).topk(PEAKS, 1)
    return best.values, best.indices


def correlated(image: Tensor, covered: Tensor, coarse: Tensor) -> tuple[Tensor, Tensor]:
    """Masked normalized cross-correlation, eq. (32) of Padfield 2012, of templates with a map at all places.

    image, covered [A, 2 h + 1, 2 h + 1]: strength, and 1 where there is any | coarse [3, H, W]: known, strength there, its square
    -> correlation [A, H, W] with the template's middle at each pixel, and the share of the template that is known there
    """
    half, (rows, columns) = image.shape[1] // 2, coarse.shape[1:]
    size = fast(rows + 2 * half), fast(columns + 2 * half)
    K, KT, KTT = torch.fft.rfft2(pad(coarse, (half, size[1] - columns - half, half, size[0] - rows - half)))
    image_f, square_f, covered_f = (torch.fft.rfft2(part, s=size).conj() for part in (image, image.square(), covered))

    def over(a: Tensor, b: Tensor) -> Tensor:
        product: Tensor = torch.fft.irfft2(a * b, s=size)[:, :rows, :columns]
        return product

    n = over(covered_f, K)
    one = 1 / n.clamp_min(1e-3)
    T, S = over(covered_f, KT) * one, over(image_f, K) * one
    spread_T, spread_S = over(covered_f, KTT) * one - T * T, over(square_f, K) * one - S * S
    scale = (spread_T.clamp_min(FLAT) * spread_S.clamp_min(FLAT)).rsqrt()
    return (over(image_f, KT) * one - S * T) * scale, n / covered.sum((1, 2))[:, None, None]


def fast(size: int) -> int:
    """The next size that has no prime factor above 5, whose FFT is fast."""
    while True:
        rest = size
        for p in (2, 3, 5):
            while rest % p == 0:
                rest //= p
        if rest == 1:
            return size
        size += 1


def around(grid: Grid, state: State) -> Pose:
    """Poses [starts] around an expected one [1], which is the first: at random, but always the same ones."""
    (px, degrees), count = grid.how.around, grid.how.starts
    step = torch.randn(count, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) / 2
    step[0] = 0
    away = state.seen(grid.plane).distance
    turn, shift = step[:, :3] * math.radians(degrees), step[:, 3:] * px / grid.focal * away
    held = away * torch.stack([-turn[:, 1], turn[:, 0], torch.zeros_like(turn[:, 0])], -1)  # what is in the middle stays there
    return state.pose @ Pose(so3.exp(turn), held + shift)


@dataclass(frozen=True)
class Found:
    """Places where a window fits, best first.

    state [K] | score [K]: correlation times the root of the share known [K] | away [K] px, rms, from what is seen at the first
    """

    state: State
    score: Tensor
    known: Tensor
    away: Tensor

    def __len__(self) -> int:
        return len(self.score)

    @property
    def clear(self) -> float:
        """How many times the best score that of any other place is."""
        others = self.score[1:][self.away[1:] > ELSEWHERE]
        return float(self.score[0] / others.max().clamp_min(1e-9)) if len(others) else math.inf


def found_at(glimpse: Glimpse, grid: Grid, pose: Pose, rounds: tuple[tuple[float, int, int], ...]) -> Found:
    """What becomes of poses [K] when the window is matched to the map from there, coarse to fine."""
    height = grid.plane.seen_from(pose).distance[:, None]
    many = len(height)
    state = State(pose, Motion(glimpse.motion.omega.expand(many, 3), glimpse.motion.velocity * height))
    for sigma, events, keep in rounds:
        state = refined(glimpse, grid, state, sigma, events)
        score, known = judged(glimpse, grid, state, max(SHARP, sigma))
        best = distinct(grid, state, score, keep)
        state, score, known = state[best], score[best], known[best]
    xy = seen_at(grid, state)
    return Found(state, score, known, (xy - xy[:1]).square().sum(-1).mean(-1).sqrt())


def refined(glimpse: Glimpse, grid: Grid, state: State, sigma: float, events: int) -> State:
    """States [K] matched to the map, blurred by sigma px, by some of the window's events."""
    count, how, rows = len(state.pose.t), grid.how, torch.zeros(len(state.pose.t), dtype=torch.int64)
    ink = glimpse.ink.thinned(max(1, -(-glimpse.ink.x.shape[1] // events)))[rows]
    prior, basis = loosely(*how.loose).expand(count, -1, -1), torch.eye(NUMBERS, SIZE, dtype=torch.float64)
    plane, seconds = grid.plane.repeated(count), glimpse.seconds.expand(count)
    task = Task(state, plane, seconds, grid.chart(sigma), ink, glimpse.ink.sample(SOME)[rows], prior, basis)
    return match(torch.zeros(count, SIZE, dtype=torch.float64), task, Matching(every=1).coarse(sigma)).state


def judged(glimpse: Glimpse, grid: Grid, state: State, sigma: float = SHARP) -> tuple[Tensor, Tensor]:
    """Scores [K] of states: the correlation of window and map there, times the root of the share that the map knows; and that share [K]."""
    ray, S = glimpse.pooled(max(POOL, round(sigma)), sigma)
    there = state.placement(grid.plane.repeated(len(state.pose.t)), grid.view).float() @ ray  # [K, 3, N]
    depth = there[:, 2].clamp_min(NEAREST)
    column, row = ((there[:, i] / depth * grid.focal - grid.box.corner[i]).round() for i in (0, 1))
    height, width = grid.box.size
    ahead = (there[:, 2] > NEAREST) & (row >= 0) & (column >= 0) & (row < height) & (column < width)
    place = torch.where(ahead, row * width + column, 0.0).long()
    w, T = grid.known.view(-1)[place] * ahead, grid.chart(sigma).texture.view(-1)[place]
    return compared(S, T, w, grid.how.known)


def compared(S: Tensor, T: Tensor, w: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Scores [K] of a window's strength S [N] and the map's T [K, N] where that is known, w [K, N]; and the share known [K].

    Their correlation times the root of that share; -1 where less than `least` is known.
    """
    n = w.sum(1, keepdim=True).clamp_min(1)
    T, S = (T - (T * w).sum(1, keepdim=True) / n) * w, (S - (S * w).sum(1, keepdim=True) / n) * w
    scale = (T.square().sum(1) / n[:, 0]).clamp_min(FLAT) * (S.square().sum(1) / n[:, 0]).clamp_min(FLAT)
    known = w.mean(1)
    score = (T * S).sum(1) / n[:, 0] * scale.rsqrt() * known.sqrt()
    return torch.where(known > least, score, -1.0), known


def seen_at(grid: Grid, state: State) -> Tensor:
    """Where on the map a few points of the sensor's edge are, seen from states [K]: [K, M, 2] px."""
    ray = grid.border.double()[:: max(1, len(grid.border) // 8)] @ state.placement(grid.plane.repeated(len(state.pose.t)), grid.view).mT
    return ray[..., :2] / ray[..., 2:].clamp_min(NEAREST) * grid.focal


def distinct(grid: Grid, state: State, score: Tensor, keep: int) -> Tensor:
    """Which of the states [K] are the best, at most `keep`, no two of which see the same: indices, best first."""
    order = score.argsort(descending=True)
    xy = seen_at(grid, state)[order]
    other = (xy[:, None] - xy[None]).square().sum(-1).mean(-1) > APART**2
    return order[chosen(other, keep)]


def chosen(other: Tensor, keep: int) -> Tensor:
    """Of things in order, the first, then the next that is another one than all chosen before, at most `keep`: other [K, K] -> indices."""
    alive, kept = torch.ones(len(other), dtype=torch.bool), list[int]()
    for i in range(len(other)):
        if alive[i] and len(kept) < keep:
            kept.append(i)
            alive &= other[i]
    return torch.tensor(kept, dtype=torch.int64)
