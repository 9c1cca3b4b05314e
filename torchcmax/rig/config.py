"""A rig as its YAML file describes it.  Lengths m, angles rad, SI throughout; drive units live in objects.py alone.

The keys of the file name their units.  A linear axis is told in m, m/s, m/s², N and kg (max_m, v_mps, a_mps2, coulomb_n, mass_kg), a rotary
one in degrees, Nm and kg m² (max_deg, v_degps, a_degps2, coulomb_nm, inertia_kgm2).  configs/rig has examples with every key.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from torchcmax.rig.errors import Refused
from torchcmax.rig.motors import Motor, motor
from torchcmax.rig.section import Section, read

BITRATES = ("10000", "20000", "50000", "125000", "250000", "500000", "800000", "1000000")  # CiA 301
PUSHING = (-4, -3, -2, -1)  # those that drive onto a mechanical stop
HOMING = (-4, -3, -2, -1, 1, 2, 7, 11, 17, 18, 23, 27, 33, 34, 35, 37)  # methods of the EPOS drives
COUNTS = 2**31 - 1  # quadcounts, rpm and rpm/s that a drive's objects hold
CURRENT = (0.01, 65.0)  # A, likewise


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
    """Of an axis: position m or rad, its derivatives by s, following error, deceleration of a quick stop.

    j: infinite where the file gives none.  Drives run trapezoids, whose jerk no number bounds: with one, no plan is accepted.
    """

    min: float
    max: float
    v: float
    a: float
    j: float
    following: float
    quick_stop: float


@dataclass(frozen=True)
class Homing:
    """CiA 402 method | speed m/s, rad/s | offset: the position of home, m, rad | current A, of methods that push onto a stop, else None."""

    method: int
    speed: float
    offset: float
    current: float | None = None


@dataclass(frozen=True)
class Axis:
    """One axis of the chain.

    direction [3] and, of a rotary axis, a point [3] m on it, in the parent's frame | load: kg, kg m² | friction, gravity: N, Nm
    current_peak A | cpt: counts per turn of the motor, 4 quadcounts each | serial: of the drive, None where any will do
    gravity: what the motor holds against, where it pulls to negative positions; of a rotary axis, the most that it can be
    mode: which of the drive's modes it may use, profile position, profile velocity or both
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
    mode: Literal["auto", "ppm", "pvm"] = "auto"


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

    camera T_ec: end effector -> camera, base T_w0: world -> first axis; x, y, z m and quaternion x, y, z, w | digest: SHA-256 of the file
    Where the scene moves, base is that of the first axis in the camera's frame, and camera the world's pose on the end effector.
    rate 1/s: of the record, that of the SYNC or a whole part of it.
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


def load(path: str | Path) -> Rig:
    """The rig of a YAML file; Refused with the line, what is wrong and what to do."""
    file = Path(path)
    top, content = read(file, "rig bus axes camera record")
    rig = top.section("rig", "name moves supply_v modulation bus_max_v bus_capacitance_f ambient_c")
    supply = rig.number("supply_v", above=0)
    bus = _bus(top.section("bus", "interface channel bitrate sync_period_s heartbeat_s heartbeat_timeout_s"))
    camera = top.section("camera", "T_ec T_w0", "focal_px distance_m")
    record = top.section("record", "rate_hz")
    rate = record.number("rate_hz", above=0)
    part = 1 / (rate * bus.sync_period)
    if round(part) < 1 or abs(part - round(part)) > 1e-6:
        raise record.wrong("rate_hz", f"is {rate:g}", f"it wants the rate of the SYNC, {1 / bus.sync_period:g}, or a whole part of it")
    return Rig(
        name=rig.text("name"),
        moves=_literal(rig.choice("moves", "camera", "scene")),
        supply=supply,
        modulation=rig.number("modulation", above=0, most=1),
        bus_max=rig.number("bus_max_v", above=supply),
        bus_capacitance=rig.number("bus_capacitance_f", above=0),
        ambient=rig.number("ambient_c", least=-40, most=100),
        bus=bus,
        axes=_axes(top),
        camera=_pose(camera, "T_ec"),
        base=_pose(camera, "T_w0"),
        rate=rate,
        focal=camera.number("focal_px", above=0) if "focal_px" in camera else None,
        distance=camera.number("distance_m", above=0) if "distance_m" in camera else None,
        digest=hashlib.sha256(content).hexdigest(),
    )


def _bus(section: Section) -> Bus:
    period, heartbeat = section.number("sync_period_s", least=1e-3, most=5e-3), section.number("heartbeat_s", least=1e-3, most=1)
    return Bus(
        interface=section.text("interface"),
        channel=section.text("channel"),
        bitrate=int(section.choice("bitrate", *BITRATES)),
        sync_period=period,
        heartbeat=heartbeat,
        heartbeat_timeout=section.number("heartbeat_timeout_s", least=2 * max(heartbeat, period), most=1),
    )


def _axes(top: Section) -> tuple[Axis, ...]:
    axes: list[Axis] = []
    nodes = top.items("axes")
    if len(nodes) > 3:
        raise top.wrong("axes", f"holds {len(nodes)}", "a rig has one to three axes")
    for node in nodes:
        axis = _axis(top.file, node)
        for other in axes:
            if axis.name == other.name or axis.node_id == other.node_id:
                which = f"name {axis.name}" if axis.name == other.name else f"node_id {axis.node_id}"
                raise top.refused(f"two axes have the {which}", "give each its own", node)
        axes.append(axis)
    return tuple(axes)


@dataclass(frozen=True)
class Unit:
    """How the keys of an axis are spelled, and what they are multiplied with."""

    place: str
    rate: str
    scale: float
    force: str
    load: str
    transmissions: tuple[str, ...]
    geometry: str  # keys that only this kind has
    travel: str


UNITS = {
    "linear": Unit("m", "mps", 1.0, "n", "mass_kg", ("belt", "screw"), "", "travel_per_rev_m"),
    "rotary": Unit("deg", "degps", math.pi / 180, "nm", "inertia_kgm2", ("rotary",), "point_m", ""),
}


def _axis(file: Path, node: yaml.Node) -> Axis:
    every = "name kind direction drive motor encoder transmission load limits homing"
    kind = Section(file, "axis", node, every, "point_m").choice("kind", *UNITS)
    unit = UNITS[kind]
    section = Section(file, "axis", node, f"{every} {unit.geometry}")
    drive = section.section("drive", "family node_id mode", "serial")
    if drive.text("mode") in ("ipm", "csp", "csv", "cst"):
        raise drive.wrong(
            "mode", f"is {drive.text('mode')}, but interpolated and cyclic modes are out", "the profile runs in the drive: write auto"
        )
    winding = section.section("motor", "part current_peak_a")
    encoder = section.section("encoder", "cpt invert")
    load = section.section("load", f"{unit.load} coulomb_{unit.force} gravity_{unit.force}")
    axis = Axis(
        name=section.word("name"),
        kind=_literal(kind),
        direction=_direction(section),
        point=_three(section.numbers("point_m", 3)) if "point_m" in section else (0.0, 0.0, 0.0),
        family=_literal(drive.choice("family", "epos2", "epos4")),
        node_id=drive.whole("node_id", 1, 126),
        serial=drive.whole("serial", 0, 2**32 - 1) if "serial" in drive else None,
        motor=_motor(winding),
        current_peak=winding.number("current_peak_a", least=CURRENT[0], most=CURRENT[1]),
        cpt=encoder.whole("cpt", 1, 2**20),
        invert=encoder.flag("invert"),
        transmission=_transmission(section, unit),
        load=load.number(unit.load, least=0),
        friction=load.number(f"coulomb_{unit.force}", least=0),
        gravity=load.number(f"gravity_{unit.force}"),
        limits=_limits(section, unit),
        homing=_homing(section, unit),
        mode=_literal(drive.choice("mode", "auto", "ppm", "pvm")),
    )
    _fits(section, axis)
    return axis


def _fits(section: Section, axis: Axis) -> None:
    """What concerns more than one section of an axis, as drives are told it in whole numbers."""
    limits, home, turn = axis.limits, axis.homing, axis.transmission.travel / axis.transmission.ratio
    if not max(abs(limits.min), abs(limits.max)) / turn * 4 * axis.cpt < COUNTS:
        raise section.wrong("limits", "reach beyond what the drive can count", f"at most {COUNTS} quadcounts from zero")
    if not 1 <= limits.following / turn * 4 * axis.cpt < COUNTS:
        raise section.wrong("limits", "want a following error that the drive cannot count", f"from 1 to {COUNTS} quadcounts")
    for part, name, value in (
        ("limits", "speed", limits.v),
        ("limits", "change in a second", limits.a),
        ("limits", "quick stop in a second", limits.quick_stop),
        ("homing", "speed", home.speed),
    ):
        if not 1 <= value / turn * 60 <= COUNTS:
            told = f"has a {name} of {value / turn * 60:.3g} rpm of the motor"
            raise section.wrong(part, told, f"drives are told whole numbers from 1 to {COUNTS}")
    if not limits.min <= home.offset <= limits.max:
        raise section.wrong("homing", "puts home outside of the limits", "offset is where the axis stands after homing")
    if home.current is not None and home.current > min(axis.motor.nominal_current, axis.current_peak):
        raise section.wrong("homing", "pushes with more than the motor's nominal current", f"at most {axis.motor.nominal_current:g} A")
    if home.speed > limits.v:
        raise section.wrong("homing", "is faster than the axis may be", "lower its speed")


def _transmission(axis: Section, unit: Unit) -> Transmission:
    keys = f"type ratio efficiency {unit.travel} backlash_{unit.place} input_speed_max_rpm"
    section = axis.section("transmission", keys, "inertia_kgm2")
    return Transmission(
        kind=_literal(section.choice("type", *unit.transmissions)),
        ratio=section.number("ratio", above=0),
        efficiency=section.number("efficiency", above=0, most=1),
        travel=section.number(unit.travel, above=0) if unit.travel else 2 * math.pi,
        backlash=section.number(f"backlash_{unit.place}", least=0) * unit.scale,
        inertia=section.number("inertia_kgm2", least=0) if "inertia_kgm2" in section else 0.0,
        max_input_speed=section.number("input_speed_max_rpm", least=1, most=COUNTS) * math.pi / 30,
    )


def _limits(axis: Section, unit: Unit) -> Limits:
    jerk = f"j_{unit.rate}3"
    keys = f"min_{unit.place} max_{unit.place} v_{unit.rate} a_{unit.rate}2 following_{unit.place} quick_stop_{unit.rate}2"
    section = axis.section("limits", keys, jerk)
    lowest = section.number(f"min_{unit.place}")
    return Limits(
        min=lowest * unit.scale,
        max=section.number(f"max_{unit.place}", above=lowest) * unit.scale,
        v=section.number(f"v_{unit.rate}", above=0) * unit.scale,
        a=section.number(f"a_{unit.rate}2", above=0) * unit.scale,
        j=section.number(jerk, above=0) * unit.scale if jerk in section else math.inf,
        following=section.number(f"following_{unit.place}", above=0) * unit.scale,
        quick_stop=section.number(f"quick_stop_{unit.rate}2", above=0) * unit.scale,
    )


def _homing(axis: Section, unit: Unit) -> Homing:
    section = axis.section("homing", f"method speed_{unit.rate} offset_{unit.place}", "current_a")
    method = section.whole("method", min(HOMING), max(HOMING))
    if method not in HOMING:
        raise section.wrong("method", f"is {method}", f"the drives know {', '.join(map(str, HOMING))}")
    if (method in PUSHING) != ("current_a" in section):
        remedy = f"methods {min(PUSHING)} to {max(PUSHING)} want the current, A, at which a stop is reached; no others do"
        raise section.wrong("current_a", "and method do not go together", remedy)
    current = section.number("current_a", least=CURRENT[0], most=CURRENT[1]) if "current_a" in section else None
    speed = section.number(f"speed_{unit.rate}", above=0) * unit.scale
    return Homing(method, speed, section.number(f"offset_{unit.place}") * unit.scale, current)


def _motor(section: Section) -> Motor:
    try:
        return motor(section.text("part"))
    except Refused as error:
        raise section.wrong("part", "is unknown", str(error)) from error


def _direction(section: Section) -> tuple[float, float, float]:
    """Of unit length."""
    x, y, z = section.numbers("direction", 3)
    length = math.hypot(x, y, z)
    if not length > 1e-9:
        raise section.wrong("direction", "has no length", "it is a vector in the parent's frame, like [1, 0, 0]")
    return x / length, y / length, z / length


def _pose(section: Section, key: str) -> tuple[float, ...]:
    """x y z qx qy qz qw, the quaternion of length 1."""
    values = section.numbers(key, 7)
    length = math.hypot(*values[3:])
    if abs(length - 1) > 1e-3:
        raise section.wrong(
            key, f"has a quaternion of length {length:.4g}", "it is x y z qx qy qz qw, the quaternion of length 1 with qw last"
        )
    return (*values[:3], *(value / length for value in values[3:]))


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _literal(word: str) -> Any:
    """A word that was chosen from those of its type."""
    return word
