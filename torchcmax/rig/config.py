"""A rig as its YAML file describes it.  Lengths m, angles rad, SI throughout; drive units live in objects.py alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchcmax.rig.motors import Motor


@dataclass(frozen=True)
class Transmission:
    """From the motor to the axis.

    travel: m or rad of the axis per turn of the output | inertia: kg m², at the motor | backlash: m, rad | max_input_speed: rad/s
    """

    kind: Literal["belt", "screw", "rotary"]
    ratio: float
    efficiency: float
    travel: float
    backlash: float
    inertia: float
    max_input_speed: float


@dataclass(frozen=True)
class Limits:
    """Of an axis: position m or rad, its derivatives by s, following error, deceleration of a quick stop."""

    min: float
    max: float
    v: float
    a: float
    j: float
    following: float
    quick_stop: float


@dataclass(frozen=True)
class Homing:
    """CiA 402 method | speed m/s, rad/s | offset: the position of home, m, rad."""

    method: int
    speed: float
    offset: float


@dataclass(frozen=True)
class Axis:
    """One axis of the chain.

    direction [3] and, of a rotary axis, a point [3] m on it, in the parent's frame | load: kg, kg m² | friction, gravity: N, Nm
    current_peak A | cpt: counts per turn of the motor, 4 quadcounts each | serial: of the drive, None where any will do
    """

    name: str
    kind: Literal["linear", "rotary"]
    direction: tuple[float, float, float]
    point: tuple[float, float, float]
    family: Literal["epos2", "epos4"]
    node_id: int
    serial: int | None
    motor: Motor
    current_peak: float
    cpt: int
    invert: bool
    transmission: Transmission
    load: float
    friction: float
    gravity: float
    limits: Limits
    homing: Homing


@dataclass(frozen=True)
class Bus:
    """A python-can interface and channel | bitrate 1/s | sync_period, heartbeat, heartbeat_timeout: s."""

    interface: str
    channel: str
    bitrate: int
    sync_period: float
    heartbeat: float
    heartbeat_timeout: float


@dataclass(frozen=True)
class Rig:
    """A whole rig.  supply, bus_max V | modulation: share of the supply that a drive gives | bus_capacitance F | ambient °C

    camera: end effector -> camera, base: world -> first axis; x, y, z m and quaternion x, y, z, w | digest: SHA-256 of what was read
    focal px and distance m, where given, tell the image speed.
    """

    name: str
    moves: Literal["camera", "scene"]
    supply: float
    modulation: float
    bus_max: float
    bus_capacitance: float
    ambient: float
    bus: Bus
    axes: tuple[Axis, ...]
    camera: tuple[float, ...]
    base: tuple[float, ...]
    rate: float
    focal: float | None
    distance: float | None
    digest: str
