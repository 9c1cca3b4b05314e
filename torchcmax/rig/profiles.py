"""How one axis moves from rest to rest, in closed form.  Units are the axis' own, m or rad, and seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

GOLOMB = (0, 1, 4, 9, 15, 22, 32, 34)  # the shortest ruler of eight marks no two of whose differences are the same
NOWHERE = 1e-12  # m, rad: a way that is none


@dataclass(frozen=True)
class State:
    """Position, velocity, acceleration and jerk, all of one shape.  Where acceleration jumps, jerk is told as if it did not."""

    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    j: np.ndarray


class Profile(Protocol):
    """A motion from rest at `begin` to rest at `end`, `duration` s later.

    nodes [K, 5], t x v a j: where its pieces of constant jerk begin | moves: the single moves that it consists of, with their times
    """

    @property
    def begin(self) -> float: ...
    @property
    def end(self) -> float: ...
    @property
    def duration(self) -> float: ...
    @property
    def nodes(self) -> np.ndarray: ...
    @property
    def moves(self) -> tuple[tuple[float, Move], ...]: ...
    def sample(self, t: ArrayLike) -> State: ...


class Sampled:
    """What all profiles can."""

    def sample(self: Profile, t: ArrayLike) -> State:
        """At times [...] s; it rests before and after."""
        t = np.asarray(t, float)
        table = np.concatenate([[[0, self.begin, 0, 0, 0]], self.nodes, [[self.duration, self.end, 0, 0, 0]]])
        k = np.searchsorted(table[1:, 0], t, side="right")
        start, x, v, a, j = np.moveaxis(table[k], -1, 0)
        s = np.where(k > 0, t - start, 0.0)
        return State(x + s * (v + s * (a / 2 + s * j / 6)), v + s * (a + s * j / 2), a + s * j, j)


@dataclass(frozen=True)
class Move(Sampled):
    """A single move: a ramp, constant velocity, and the ramp reversed in time; at most at speed v and acceleration a.

    j: jerk of an S-curve of up to seven pieces, which no profile mode of the drives runs; without, a trapezoid, which they all run
    mode: of the drive, profile position or profile velocity; the latter reaches v always, see `cruise`
    """

    begin: float
    end: float
    v: float
    a: float
    j: float = math.inf
    mode: Literal["position", "velocity"] = "position"

    @property
    def way(self) -> float:
        """1 or -1."""
        return math.copysign(1.0, self.end - self.begin)

    @cached_property
    def peak(self) -> float:
        """The constant speed: v, or as much as there is room for."""
        length, least = abs(self.end - self.begin), self.a**2 / self.j  # of speeds that reach the acceleration
        if self.v * rise(self.v, self.a, self.j) <= length or self.mode == "velocity":
            return self.v
        if length < 2 * least * self.a / self.j:
            return math.cbrt(length**2 * self.j / 4)
        return (math.sqrt(least**2 + 4 * self.a * length) - least) / 2

    @cached_property
    def duration(self) -> float:
        """The ramps take twice as long for their way as the constant speed does."""
        length = abs(self.end - self.begin)
        return length / self.peak + rise(self.peak, self.a, self.j) if length > NOWHERE else 0.0

    @property
    def moves(self) -> tuple[tuple[float, Move], ...]:
        return ((0.0, self),) if self.duration else ()

    @cached_property
    def nodes(self) -> np.ndarray:
        if not self.duration:
            return np.zeros((0, 5))
        t, x, v = 0.0, self.begin, 0.0
        rows, mirrored = [], []
        for length, size, jerk in self._ramp():
            a, j = self.way * size, self.way * jerk
            rows.append((t, x, v, a, j))
            t, x, v = t + length, x + length * (v + length * (a / 2 + length * j / 6)), v + length * (a + length * j / 2)
            mirrored.append((self.duration - t, self.begin + self.end - x, v, -(a + length * j), j))
        rows.append((t, x, self.way * self.peak, 0.0, 0.0))
        return np.array(rows + mirrored[::-1])

    def _ramp(self) -> list[tuple[float, float, float]]:
        """Duration, acceleration at the begin and jerk of each piece from rest to the constant speed."""
        if math.isinf(self.j):
            return [(self.peak / self.a, self.a, 0.0)]
        jerking = min(math.sqrt(self.peak / self.j), self.a / self.j)
        a = self.j * jerking
        return [(jerking, 0.0, self.j), (max(self.peak / a - jerking, 0.0), a, 0.0), (jerking, a, -self.j)]


def rise(v: float, a: float, j: float = math.inf) -> float:
    """Duration of the ramp from rest to speed v, on which it is v / 2 on average."""
    return v / a + a / j if v >= a**2 / j else 2 * math.sqrt(v / j)


def constant_pass(x0: float, x1: float, v: float, a: float, j: float = math.inf, settle: float = 0.0) -> Move:
    """At constant speed from x0 to x1, and `settle` s before and after; the ramps lie outside of it."""
    before = math.copysign(v * (rise(v, a, j) / 2 + settle), x1 - x0)
    return Move(x0 - before, x1 + before, v, a, j)


def cruise(begin: float, v: float, a: float, hold: float) -> Move:
    """At the signed velocity v for `hold` s, between ramps; run by the drive's profile velocity mode."""
    return Move(begin, begin + v * (hold + rise(abs(v), a)), abs(v), a, mode="velocity")


@dataclass(frozen=True)
class Dwell(Sampled):
    """Rest."""

    begin: float
    duration: float
    moves: tuple[tuple[float, Move], ...] = ()

    @property
    def end(self) -> float:
        return self.begin

    @property
    def nodes(self) -> np.ndarray:
        return np.zeros((0, 5))


@dataclass(frozen=True)
class Sequence(Sampled):
    """One after the other; each begins where the one before ended."""

    parts: tuple[Profile, ...]

    def __post_init__(self) -> None:
        for before, after in zip(self.parts, self.parts[1:], strict=False):
            if not math.isclose(before.end, after.begin, rel_tol=1e-9, abs_tol=1e-9):
                raise ValueError(f"a part begins at {after.begin}, the one before ended at {before.end}")

    @property
    def begin(self) -> float:
        return self.parts[0].begin

    @property
    def end(self) -> float:
        return self.parts[-1].end

    @property
    def duration(self) -> float:
        return sum(part.duration for part in self.parts)

    @cached_property
    def nodes(self) -> np.ndarray:
        """With those of the rest at the end of each part."""
        tables = [np.concatenate([part.nodes, [[part.duration, part.end, 0, 0, 0]]]) for part in self.parts]
        for start, table in zip(self._starts(), tables, strict=True):
            table[:, 0] += start
        return np.concatenate(tables)

    @property
    def moves(self) -> tuple[tuple[float, Move], ...]:
        pairs = zip(self._starts(), self.parts, strict=True)
        return tuple((start + offset, move) for start, part in pairs for offset, move in part.moves)

    def _starts(self) -> list[float]:
        """When each part begins."""
        return [0.0, *np.cumsum([part.duration for part in self.parts[:-1]]).tolist()]


def repeat(profile: Profile, times: int) -> Sequence:
    """A profile that ends where it begins, so many times."""
    return Sequence((profile,) * times)


def sync(begin: float, far: float, v: float, a: float, pause: float) -> Sequence:
    """Eight moves, to `far` and back, to align clocks by: whatever the offset, at most one of them falls on another.

    They begin at the marks of a Golomb ruler whose unit is a move and the pause.
    """
    there, back = Move(begin, far, v, a), Move(far, begin, v, a)
    unit = there.duration + pause
    parts: list[Profile] = []
    for k, marks in enumerate(np.diff(GOLOMB).tolist()):
        move = back if k % 2 else there
        parts += [move, Dwell(move.end, marks * unit - move.duration)]
    return Sequence((*parts, back))
