"""Tiles of a map: where they lie, what they hold, and how they are put side by side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchcmax.core.camera import Canvas

TILE = 64  # px
CELL = 4  # px of a tile, each way, that are exposed alike


@dataclass(frozen=True)
class Box:
    """Tiles from row, column on: rows x columns of them."""

    row: int
    column: int
    rows: int
    columns: int

    @property
    def size(self) -> tuple[int, int]:
        """px"""
        return self.rows * TILE, self.columns * TILE

    @property
    def corner(self) -> tuple[int, int]:
        """The map's pixel (x, y) that is the first of the box."""
        return self.column * TILE, self.row * TILE

    def tiles(self) -> Iterator[tuple[int, int]]:
        """The names of its tiles, row by row."""
        return ((self.row + i, self.column + j) for i in range(self.rows) for j in range(self.columns))

    def contains(self, other: Box) -> bool:
        """Whether another box lies in this one."""
        rows = self.row <= other.row and other.row + other.rows <= self.row + self.rows
        return rows and self.column <= other.column and other.column + other.columns <= self.column + self.columns

    def canvas(self, focal: float) -> Canvas:
        """These tiles as a canvas."""
        x, y = self.corner
        return Canvas(focal, (-float(x), -float(y)), self.size)


@dataclass(frozen=True)
class Layers:
    """Part of a map: votes [H, W] | exposure [3, H / CELL, W / CELL] px of motion, along xx, xy and yy"""

    votes: Tensor
    exposure: Tensor

    def __sub__(self, other: Layers) -> Layers:
        """Without what another one added; what rounding leaves of votes is none."""
        return Layers((self.votes - other.votes).clamp_min(0), self.exposure - other.exposure)

    @cached_property
    def most(self) -> Tensor:
        """px of motion along the direction of most: the larger eigenvalue, [H / CELL, W / CELL]."""
        xx, xy, yy = self.exposure.unbind(-3)
        return (xx + yy) / 2 + (((xx - yy) / 2).square() + xy.square()).sqrt()


def joined(tiles: list[Tensor], box: Box) -> Tensor:
    """Tiles side by side: rows * columns of [..., h, w] -> [..., rows h, columns w]."""
    grid: Tensor = torch.stack(tiles).unflatten(0, (box.rows, box.columns)).movedim((0, 1), (-4, -2))
    return grid.flatten(-4, -3).flatten(-2)


def apart(image: Tensor, box: Box) -> Tensor:
    """The tiles of an image [..., rows h, columns w]: -> [rows * columns, ..., h, w]."""
    grid: Tensor = image.unflatten(-1, (box.columns, -1)).unflatten(-3, (box.rows, -1))
    return grid.movedim((-4, -2), (0, 1)).flatten(0, 1)


def spread(cell: Tensor) -> Tensor:
    """Each cell's number for all its pixels: [..., H, W] -> [..., H * CELL, W * CELL]."""
    *rest, height, width = cell.shape
    return cell[..., :, None, :, None].expand(*rest, height, CELL, width, CELL).reshape(*rest, height * CELL, width * CELL)


def at(H_k: Tensor, s: float) -> Tensor:
    """The homography at a moment: H_k [K, 3, 3] -> [3, 3]."""
    powers = H_k.new_tensor([s**k for k in range(len(H_k))])
    found: Tensor = torch.tensordot(powers, H_k, 1)
    return found


def flat(ray: Tensor, focal: float) -> Tensor:
    """Rays [..., 3] -> px [..., 2]."""
    return ray[..., :2] / ray[..., 2:] * focal


def places(xy: Tensor, box: Box) -> tuple[Tensor, Tensor, Tensor]:
    """Column and row in a box of points [N, 2] px of the map, kept inside, and whether they are."""
    column, row = (xy - xy.new_tensor(box.corner)).nan_to_num(-1.0).round().long().unbind(-1)
    height, width = box.size
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return column.clamp(0, width - 1), row.clamp(0, height - 1), inside
