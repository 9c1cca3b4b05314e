"""The map of a camera that only turns: an equirectangular sphere, and the planes that touch it where the camera looks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from torchcmax.core.camera import Sphere
from torchcmax.core.draw import draw_sum
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose
from torchcmax.slam.equirect import bordered, cosines, directions, grid_at, steady, tangents
from torchcmax.slam.map import MARGIN, Keyframe, Map, Texture
from torchcmax.slam.tiles import CELL, TILE, Box, Layers, at, spread

SPACING = 15.0  # degrees from the middle of a facet up to which a camera is tracked on it
WIDEST = 75.0  # degrees from the middle of a facet beyond which there is nothing on it: it is four times as long there as on the sphere
KEPT = 8  # facets that are kept
AHEAD = 0.05  # least z of a unit ray that a camera sees
WALL = Plane.tilted(torch.zeros(1, 2, dtype=torch.float64))
"""Any plane at distance one: what a camera that only turns sees does not depend on it."""


@dataclass(kw_only=True)
class Facet(Map):
    """A plane that touches the sphere, with what the globe shows there: the map of a plane for a camera that only turns.

    turn [1, 3, 3]: of a camera that looks straight at it | globe: layers are taken from there, and kept in no tiles
    """

    turn: Tensor
    globe: Globe = field(repr=False)
    _kept: tuple[Box, tuple[Tensor, Tensor, Tensor]] | None = field(default=None, repr=False)

    @cached_property
    def view(self) -> Tensor:
        """[1, 3, 3]"""
        return self.turn.mT

    def typical(self) -> float:
        """The rate that an event meets on average, anywhere on the sphere."""
        return self.globe.typical()

    def box(self, H_k: Tensor) -> Box | None:
        """The tiles that a window can see; None where it looks elsewhere."""
        ray = (self.border.to(H_k) @ torch.stack([at(H_k, s) for s in (-0.5, 0.0, 0.5)]).mT).flatten(0, 1)
        reach = math.radians(WIDEST)
        side, most = ray[:, :2].norm(dim=-1), self.focal * math.tan(reach)
        away = torch.atan2(side, ray[:, 2])
        if not float(away.amin()) < reach:  # not where one is nan
            return None
        xy = ray[:, :2] * (away.clamp_max(reach).tan() * self.focal / side.clamp_min(1e-12))[:, None]
        low, high = (xy.amin(0) - MARGIN).clamp_min(-most).tolist(), (xy.amax(0) + MARGIN).clamp_max(most).tolist()
        column, row = (int(x // TILE) for x in low)
        return Box(row, column, int(high[1] // TILE) - row + 1, int(high[0] // TILE) - column + 1)

    def assembled(self, box: Box) -> Layers:
        """What the globe shows on some tiles."""
        return self.of(self.globe.layers, box)

    def of(self, layers: Layers, box: Box) -> Layers:
        """The layers of a globe as they look on some tiles: votes and px of motion are those on the sphere."""
        sphere, cells = self.globe.sphere, Sphere(layers.exposure.shape[1])
        fine, coarse, A = self._places(box)
        votes = grid_sample(bordered(layers.votes, sphere), fine, align_corners=True)[0, 0]
        xx, xy, yy = grid_sample(bordered(layers.exposure, cells), coarse, mode="nearest", align_corners=True)[0]
        (a, b), (c, d) = (row.unbind(-1) for row in A.unbind(-2))
        pairs = ((a, c), (a, c)), ((a, c), (b, d)), ((b, d), (b, d))
        turned = [p * q * xx + (p * s + r * q) * xy + r * s * yy for (p, r), (q, s) in pairs]
        return Layers(votes, torch.stack(turned))

    def _places(self, box: Box) -> tuple[Tensor, Tensor, Tensor]:
        """Where pixels and cells of some tiles are on the sphere, as grid_sample wants it, and how steps on the facet are steps there."""
        if self._kept is None or self._kept[0] != box:
            sphere, R = self.globe.sphere, self.turn[0].float()
            coarse = self._world(box, CELL, R)
            places = grid_at(self._world(box, 1, R), sphere), grid_at(coarse, Sphere(sphere.height // CELL)), steps(coarse, R)
            self._kept = box, places
        return self._kept[1]

    def _world(self, box: Box, cell: int, R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x, y and z [h, w] of the rays of the middles of its squares of `cell` px, not of unit length."""
        x, y = (
            (torch.arange(n // cell, dtype=torch.float32) * cell + (cell - 1) / 2 + first) / self.focal
            for n, first in zip(box.size[::-1], box.corner, strict=True)
        )
        first, second, third = (torch.add(row[0] * x, (row[1] * y + row[2])[:, None]) for row in R)
        return first, second, third


def steps(world: tuple[Tensor, Tensor, Tensor], R: Tensor) -> Tensor:
    """How steps along x and y of a facet are steps east and south, but for their length: at rays (x, y, z) [h, w] -> [h, w, 2, 2]."""
    A = tangents(torch.nn.functional.normalize(torch.stack(world, -1), dim=-1)) @ R[:, :2]  # east and south are across the ray
    found: Tensor = A / (A.square().sum((-1, -2), keepdim=True) / 2).sqrt()
    return found


@dataclass(eq=False)
class Globe:
    """focal px per radian | border [M, 3] float32 rays around the sensor's edge | keyframes, whose positions are all zero

    layers: votes [H, W] on an equirectangular sphere, as many as a pixel of the equator would have, and exposure
    [3, H / CELL, W / CELL] px of motion, east-east, east-south, south-south.  The world is that of the camera at the first event.
    """

    focal: float
    border: Tensor
    texture: Texture = field(default_factory=Texture)
    keyframes: list[Keyframe] = field(default_factory=list)
    number: int = 0
    facets: list[Facet] = field(default_factory=list, repr=False)  # the one that was looked at last comes last
    plane: ClassVar[Plane] = WALL
    _typical: float | None = None

    @cached_property
    def sphere(self) -> Sphere:
        """Its pixels are as wide as the sensor's in the middle of the image; rows in whole cells."""
        return Sphere(2 * CELL * max(1, round(math.pi * self.focal / (2 * CELL))))

    @cached_property
    def layers(self) -> Layers:
        """Nothing, to begin with."""
        (height, width), new = self.sphere.size, self.border.new_zeros
        return Layers(new(height, width), new(3, height // CELL, width // CELL))

    @cached_property
    def field_of_view(self) -> float:
        """rad, from the middle of the image to the farthest corner."""
        ray = self.border.double()
        return float(torch.atan2(ray[:, :2].norm(dim=-1), ray[:, 2]).max())

    @cached_property
    def _cells(self) -> tuple[Tensor, Tensor]:
        """Unit rays of the cells [N, 3], and east and south there [N, 2, 3]."""
        ray = directions(Sphere(self.sphere.height // CELL)).float().view(-1, 3)
        return ray, tangents(ray)

    def draw(self, keyframes: Sequence[Keyframe]) -> None:
        """Add windows."""
        self.keyframes.extend(keyframes)
        added = self.layers_of(keyframes)
        self.layers = Layers(self.layers.votes + added.votes, self.layers.exposure + added.exposure)
        self._typical = None
        for facet in self.facets:
            facet._area = None

    def layers_of(self, keyframes: Sequence[Keyframe]) -> Layers:
        """What windows add; each where it is exposed, as a map's do."""
        votes, exposure = torch.zeros_like(self.layers.votes), torch.zeros_like(self.layers.exposure)
        for k in keyframes:
            own = torch.zeros_like(exposure)
            self._expose(own.view(3, -1), k.state.pose.R[0].float(), (k.state.motion.omega * k.seconds[:, None])[0].float())
            image = draw_sum(k.state.homography(WALL, k.seconds).to(k.ink.x), k.ink, self.sphere)[0]
            votes += image.mul_(spread((own[0] + own[2] > 0).to(image)))
            exposure += own
        return Layers(steady(votes, self.sphere) / cosines(self.sphere), exposure)

    def _expose(self, exposure: Tensor, R: Tensor, spin: Tensor) -> None:
        """Adds how far what a camera sees moves over each cell, p p^T / |p|, where it turns by `spin` [3] rad: exposure [3, N].

        Divided by the solid angle of a sensor's pixel there, as a share of that in the middle: cos^3 of the angle to the axis.
        Half a cell more than the sensor on each side, as votes fall on all of a cell.
        """
        ray, sides = self._cells
        spare = CELL / 2 / self.focal
        low, high = self.border[:, :2].amin(0) - spare, self.border[:, :2].amax(0) + spare
        index = (ray @ R[:, 2] > max(AHEAD, math.cos(self.field_of_view + 2 * spare))).nonzero()[:, 0]
        here = ray[index] @ R
        xy = here[:, :2] / here[:, 2:]
        keep = ((xy >= low) & (xy <= high)).all(-1)
        index, depth = index[keep], here[keep, 2]
        moved = torch.linalg.cross((R @ spin).expand(len(index), 3), ray[index])
        px, py = ((sides[index] @ moved[..., None])[..., 0] * (self.sphere.focal / depth**3)[:, None]).unbind(-1)
        length = (px * px + py * py).sqrt().clamp_min(1e-9)
        exposure.index_add_(1, index, torch.stack([px * px, px * py, py * py]) / length)

    def toward(self, pose: Pose) -> Facet:
        """Where a camera [1] looks."""
        apart = [float((facet.turn[0, :, 2] * pose.R[0, :, 2]).sum()) for facet in self.facets]
        best = max(range(len(apart)), key=apart.__getitem__, default=-1)
        near = best >= 0 and apart[best] > math.cos(math.radians(SPACING))
        facet = self.facets.pop(best) if near else self.facing(pose)
        self.facets = [*self.facets[-KEPT + 1 :], facet]
        return facet

    def facing(self, pose: Pose) -> Facet:
        """A plane straight before a camera [1]."""
        return Facet(WALL, self.focal, self.border, self.texture, turn=pose.R, globe=self)

    def typical(self) -> float:
        """The rate that an event meets on average: sum r^2 / sum r over the sphere."""
        if self._typical is None:
            seen = self.layers.most.sum(1).nonzero()[:, 0]
            rows = slice(int(seen[0]) * CELL, (int(seen[-1]) + 1) * CELL) if len(seen) else slice(0)
            rate, area = self.rate(rows), cosines(self.sphere)[rows]
            self._typical = float((rate.square() * area).sum() / (rate * area).sum().clamp_min(1e-9))
        return self._typical

    def rate(self, rows: slice = slice(None)) -> Tensor:
        """Votes per px of motion along the direction of most motion: [H, W], or some rows of it, in whole cells."""
        cells = slice(*(None if i is None else i // CELL for i in (rows.start, rows.stop)))
        return self.layers.votes[rows] * spread(1 / self.layers.most[cells].clamp_min(self.texture.least))

    def strength(self) -> Tensor:
        """The rate, saturated, in 0..1: [H, W]."""
        rate = self.rate()
        return rate / (rate + max(self.typical(), 1e-9))

    def known(self) -> Tensor:
        """1 where it knows what there is, for motion in one direction at least: [H, W]."""
        return spread((self.layers.most >= self.texture.exposure).to(self.layers.votes))

    def copy(self) -> Globe:
        """As it is now."""
        fresh = Globe(self.focal, self.border, self.texture, list(self.keyframes), self.number)
        fresh.layers = Layers(self.layers.votes.clone(), self.layers.exposure.clone())
        return fresh
