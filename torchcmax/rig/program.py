"""What drives are told to do: moves that begin on a SYNC, whose trapezoid runs in the drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Move:
    """One set point of one axis.

    start: s since the program's first SYNC, a multiple of the SYNC's period | axis: index into Rig.axes
    kind: "position" (profile position mode: to target, m or rad, at speed v > 0, acceleration and deceleration a) or "velocity" (profile
    velocity mode: ramp with a to the signed speed v, kept until the next move; target is not used)
    """

    start: float
    axis: int
    kind: Literal["position", "velocity"]
    target: float
    v: float
    a: float


@dataclass(frozen=True)
class Program:
    """Moves in order of time; the axes begin at rest at `begin` [axes] m, rad, and rest again at `duration` s."""

    moves: tuple[Move, ...]
    begin: tuple[float, ...]
    duration: float
