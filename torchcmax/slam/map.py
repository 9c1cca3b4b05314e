"""The map of a plane: how strong its edges are, in tiles that grow with the camera, and the keyframes that drew it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from torchcmax.core.camera import NEAREST, Canvas
from torchcmax.core.contrast import blur
from torchcmax.core.draw import Ink, draw
from torchcmax.core.match import Chart
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose
from torchcmax.core.state import State
from torchcmax.slam.tiles import CELL, TILE, Box, Layers, apart, at, flat, joined, places, spread

WIDEST = 40  # tiles: a camera that sees more of the plane looks along it
KEPT = 16  # keyframes whose layers are kept
MARGIN = 16.0  # px around what a window sees
GHOSTS = 24, 18, 3  # columns, rows, moments at which a window is asked where its events could be


@dataclass(frozen=True)
class Texture:
    """How votes become the strength of edges."""

    exposure: float = 25.0
    """px of motion along a direction after which a place is known for motion in that direction."""
    least: float = 6.0
    """px of motion that votes are divided by at least, so that a glimpse makes no edge."""
    blur: tuple[float, ...] = (2.0, 0.5)
    """px of blur of the strength that windows are matched to, coarse to fine."""

    def __post_init__(self) -> None:
        if not (self.exposure > 0 and self.least > 0 and self.blur and min(self.blur) >= 0):
            raise ValueError(f"a texture wants an exposure and a least above 0 and blurs of at least 0, got {self}")


@dataclass(frozen=True)
class Keyframe:
    """A window that was drawn.  time µs and state [1] of its middle | seconds [1] | ink [1, N], s from the middle"""

    time: int
    state: State
    seconds: Tensor
    ink: Ink

    def at(self, state: State) -> Keyframe:
        """The same events elsewhere."""
        return replace(self, state=state)


@dataclass(frozen=True)
class Area:
    """A part of the map side by side, and charts of it, coarse to fine."""

    box: Box
    layers: Layers
    charts: tuple[Chart, ...]


@dataclass(frozen=True)
class Drawn:
    """What a keyframe added to a map: its warp H_k [K, 3, 3], where, and the layers."""

    H_k: Tensor
    box: Box
    layers: Layers


@dataclass
class Map:
    """plane [1] | focal px per plane distance | border [M, 3] float32 rays around the sensor's edge

    A map pixel (x, y) is the point of the plane that the ray (x, y, focal) of the world's origin meets, after the turn `view` that
    makes the plane a wall.  tiles: (row, column) -> Layers of TILE px; only what was seen has one, and a new one moves no other.
    """

    plane: Plane
    focal: float
    border: Tensor
    texture: Texture = field(default_factory=Texture)
    tiles: dict[tuple[int, int], Layers] = field(default_factory=dict)
    keyframes: list[Keyframe] = field(default_factory=list)
    number: int = 0
    _area: Area | None = field(default=None, repr=False)
    _sums: dict[tuple[int, int], tuple[float, float]] = field(default_factory=dict, repr=False)
    _drawn: dict[int, Drawn] = field(default_factory=dict, repr=False)

    @cached_property
    def view(self) -> Tensor:
        """[1, 3, 3]"""
        return self.plane.facing()

    @cached_property
    def _empty(self) -> Layers:
        return Layers(self.border.new_zeros(TILE, TILE), self.border.new_zeros(3, TILE // CELL, TILE // CELL))

    @cached_property
    def sensor(self) -> tuple[list[float], list[float]]:
        """The least and the largest x and y of its rays."""
        return self.border[:, :2].amin(0).tolist(), self.border[:, :2].amax(0).tolist()

    def toward(self, pose: Pose) -> Map:
        """The part of it that a camera [1] sees, on one plane: all."""
        return self

    def warp(self, state: State, seconds: Tensor) -> Tensor:
        """How the events of a window [1] come onto the map: H_k [K, 3, 3]."""
        return state.homography(self.plane, seconds, self.view)[0]

    def whole(self) -> Box:
        """All that was ever seen."""
        if not self.tiles:
            return Box(0, 0, 1, 1)
        rows, columns = zip(*self.tiles, strict=True)
        return Box(min(rows), min(columns), max(rows) - min(rows) + 1, max(columns) - min(columns) + 1)

    def box(self, H_k: Tensor) -> Box | None:
        """The tiles that a window can see; None where it looks along the plane."""
        ray = self.border.to(H_k) @ torch.stack([at(H_k, s) for s in (-0.5, 0.0, 0.5)]).mT
        depth = ray[..., 2:]
        xy = (ray[..., :2] / depth * self.focal).flatten(0, 1)
        nearest, x, y, right, bottom = torch.cat([depth.amin()[None], xy.amin(0) - MARGIN, xy.amax(0) + MARGIN]).tolist()
        if not (nearest > NEAREST and max(right - x, bottom - y) < WIDEST * TILE):  # not where one is nan
            return None
        column, row = int(x // TILE), int(y // TILE)
        return Box(row, column, int(bottom // TILE) - row + 1, int(right // TILE) - column + 1)

    def assembled(self, box: Box) -> Layers:
        """Some tiles side by side."""
        found = [self.tiles.get(name, self._empty) for name in box.tiles()]
        return Layers(joined([t.votes for t in found], box), joined([t.exposure for t in found], box))

    def area(self, box: Box) -> Area:
        """The map around a camera, kept until the map changes or the camera leaves it."""
        if self._area is None or not self._area.box.contains(box):
            layers = self.assembled(box)
            self._area = Area(box, layers, self.charts(layers, box, self.texture.blur))
        return self._area

    def charts(self, layers: Layers, box: Box, blurs: tuple[float, ...], typical: float | None = None) -> tuple[Chart, ...]:
        """What windows are matched to, for several blurs; typical: as `strength`."""
        strength = self.strength(layers, typical)[None]
        corner = torch.tensor([box.corner], dtype=torch.float64, device=strength.device)
        return tuple(Chart(blur(strength, sigma), corner, self.view, self.focal) for sigma in blurs)

    def rate(self, layers: Layers) -> Tensor:
        """Votes per px of motion along the direction of most motion: [H, W].

        An edge gives events only where the motion crosses it, and its direction is not known.
        """
        return layers.votes * spread(1 / layers.most.clamp_min(self.texture.least))

    def strength(self, layers: Layers, typical: float | None = None) -> Tensor:
        """The rate, saturated: r / (r + r_0), in 0..1, with the typical rate r_0 of an edge; default: that of this map."""
        rate = self.rate(layers)
        return rate / (rate + max(self.typical() if typical is None else typical, 1e-9))

    def typical(self) -> float:
        """The rate that an event meets on average: sum r^2 / sum r over the map."""
        first, second = self.sums()
        return second / first if first > 0 else 0.0

    def sums(self) -> tuple[float, float]:
        """Of the rates of all pixels, and of their squares."""
        stale = [name for name in self.tiles if name not in self._sums]
        if stale:
            votes, exposure = (torch.stack([getattr(self.tiles[name], layer) for name in stale]) for layer in ("votes", "exposure"))
            rate = self.rate(Layers(votes, exposure)).flatten(1)
            self._sums |= dict(zip(stale, zip(rate.sum(1).tolist(), rate.square().sum(1).tolist(), strict=True), strict=True))
        first, second = (sum(sums[i] for sums in self._sums.values()) for i in (0, 1))
        return first, second

    def draw(self, keyframes: Sequence[Keyframe]) -> None:
        """Add windows, and tiles for them where there are none."""
        seconds = torch.cat([k.seconds for k in keyframes])
        warps = State.join([k.state for k in keyframes]).homography(self.plane.repeated(len(keyframes)), seconds, self.view)
        for keyframe, H_k in zip(keyframes, warps, strict=True):
            self.keyframes.append(keyframe)
            box = self.box(H_k)
            if box is not None:
                self._add(Drawn(H_k, box, self.layers_of(keyframe, H_k, box)))
        self._area = None

    def _add(self, drawn: Drawn) -> None:
        box, added, newest = drawn.box, drawn.layers, len(self.keyframes) - 1
        self._drawn[newest] = drawn
        self._drawn.pop(newest - KEPT, None)
        votes, exposure = apart(added.votes, box), apart(added.exposure, box)
        seen = exposure.flatten(1).any(1).tolist()
        if not any(seen):  # nothing moved
            return
        for name, hit in zip(box.tiles(), seen, strict=True):
            if hit and name not in self.tiles:
                self.tiles[name] = Layers(torch.zeros_like(self._empty.votes), torch.zeros_like(self._empty.exposure))
            if hit:
                self._sums.pop(name, None)
        names = [(i, name) for i, (name, hit) in enumerate(zip(box.tiles(), seen, strict=True)) if hit]
        torch._foreach_add_([self.tiles[name].votes for _, name in names], [votes[i] for i, _ in names])
        torch._foreach_add_([self.tiles[name].exposure for _, name in names], [exposure[i] for i, _ in names])

    def drawn(self, number: int) -> Drawn | None:
        """What a keyframe added, and where; None where it looks along the plane."""
        if number in self._drawn:
            return self._drawn[number]
        keyframe = self.keyframes[number]
        H_k = self.warp(keyframe.state, keyframe.seconds)
        box = self.box(H_k)
        return None if box is None else Drawn(H_k, box, self.layers_of(keyframe, H_k, box))

    def layers_of(self, keyframe: Keyframe, H_k: Tensor, box: Box) -> Layers:
        """What a window adds to these tiles."""
        canvas = box.canvas(self.focal)
        image = draw(H_k[None].to(keyframe.ink.x), keyframe.ink, canvas, torch.zeros(1, dtype=torch.int64, device=H_k.device))[0]
        path = self.path(H_k, canvas.scaled(1 / CELL)).to(image)
        length = path.square().sum(0).sqrt().clamp_min(1e-6)
        exposure = torch.stack([path[0] * path[0], path[0] * path[1], path[1] * path[1]]) / length
        return Layers(image.mul_(spread((exposure[0] + exposure[2] > 0).to(image))), exposure)

    def path(self, H_k: Tensor, canvas: Canvas) -> Tensor:
        """How far on the map the sensor moves in a window over each pixel of a canvas: H_k [K, 3, 3] -> [2, H, W] px; zero where it isn't.

        Divided by the area of a sensor's pixel there: of a near camera more pixels cross an edge.
        """
        y, x = (torch.arange(n, dtype=torch.float32, device=H_k.device) for n in canvas.size)
        x, y = (x - canvas.centre[0])[None] / canvas.focal, (y - canvas.centre[1])[:, None] / canvas.focal
        back, first, last = (m.tolist() for m in (torch.linalg.inv(H_k[0]), at(H_k, -0.5), at(H_k, 0.5)))
        ray = [row[0] * x + row[1] * y + row[2] for row in back]
        front = ray[2].clamp_min(NEAREST)
        u, v = ray[0] / front, ray[1] / front
        low, high = self.sensor
        inside = (ray[2] > NEAREST) & (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1])
        ends = []
        for H in (first, last):
            depth = (H[2][0] * u + H[2][1] * v + H[2][2]).clamp_min(NEAREST)
            ends.append(torch.stack([(row[0] * u + row[1] * v + row[2]) / depth for row in H[:2]]))
        area = float(torch.linalg.det(H_k[0]).abs()) * front**3
        moved: Tensor = (ends[1] - ends[0]) * self.focal / area * inside
        return moved

    def overlap(self, H_k: Tensor, ray: Tensor, area: Area) -> float:
        """The share of the view that is known for the motion of a window: at rays [M, 3] over the sensor."""
        ends = torch.stack([at(H_k, s) for s in (-0.5, 0.0, 0.5)])
        first, middle, last = flat(ray @ ends.mT, self.focal)
        column, row, inside = places(middle, area.box)
        (xx, xy, yy), (x, y) = area.layers.exposure[:, row // CELL, column // CELL], (last - first).T.to(self.border)
        along = (xx * x * x + 2 * xy * x * y + yy * y * y) / (x * x + y * y).clamp_min(1e-12)  # p^T X p / p^T p
        return float(((along >= self.texture.exposure) & inside).double().mean())

    def trusted(self, ink: Ink, H_k: Tensor, area: Area) -> Ink:
        """The events [1, N] that fall where the map is known, before they are matched; the others have weight 0.

        Else a window is drawn away from the border of what is known, where strength fades.
        """
        column, row, inside = places(self.pixels(ink, H_k), area.box)
        strange = (area.layers.most < self.texture.exposure / 2).to(ink.x)
        near = max_pool2d(strange[None], 3, 1, 1)[0]
        return replace(ink, weight=ink.weight * (inside & (near[row // CELL, column // CELL] == 0)))

    def pixels(self, ink: Ink, H_k: Tensor) -> Tensor:
        """Events [1, N] on the map, [N, 2] px."""
        return flat(ink.warped(H_k[None].to(ink.x))[0], self.focal)

    def by_chance(self, ink: Ink, H_k: Tensor, area: Area) -> tuple[Ink, Tensor]:
        """Where events of a window could be, evenly over sensor and time, as many as there are; and what they would bring, [1, H, W].

        The sum of what events find grows when they are drawn together onto strong edges, whatever the motion.  Events that fall
        as often as the strength says, T / (1 - T), bring T^2 / 2 per place; less that, nothing is gained by it.
        """
        low, high = self.sensor
        steps = [(torch.arange(n, device=ink.x.device) + 0.5) / n for n in GHOSTS]
        x, y, s = (part.permute(2, 0, 1).reshape(1, -1).to(ink.x) for part in torch.meshgrid(*steps, indexing="ij"))
        x, y = low[0] + x * (high[0] - low[0]), low[1] + y * (high[1] - low[1])
        points = self.trusted(Ink(x, y, (s - 0.5).contiguous(), torch.ones_like(x)), H_k, area)
        T = area.charts[-1].texture
        ground, rate = (blur(avg_pool2d(part, CELL), 1.5)[0] for part in (T.square() / 2, T / (1 - T).clamp_min(0.05)))
        column, row, _ = places(self.pixels(points, H_k), area.box)
        expected = (rate[row // CELL, column // CELL] * points.weight[0]).sum()
        return replace(points, weight=points.weight * (ink.weight.sum() / expected.clamp_min(1e-9))), spread(ground)[None]
