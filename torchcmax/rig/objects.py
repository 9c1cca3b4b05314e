"""CiA 402 as maxon's EPOS4 and EPOS2 speak it: objects, state machine, units and error texts.  Pure data and functions, no I/O.

Objects are in the drives' own units: quadcounts, rpm, rpm/s, mA.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum
from typing import Literal

from torchcmax.rig.axis import RPM, drivable, quadcounts, reduction
from torchcmax.rig.config import Axis

Family = Literal["epos2", "epos4"]
FORMATS = {"i8": "<b", "u8": "<B", "i16": "<h", "u16": "<H", "i32": "<i", "u32": "<I"}
VENDOR = 0xFB  # maxon motor ag
MASTER = 0x7F  # node of the host, whose heartbeat the drives watch
INSIDE = 10  # quadcounts from a soft limit to the home at its end: a switch that was left closes again farther out
BEGIN, END, PREPARE = 1, 2, 0x80  # NMT commands of CiA 301: operational, stopped, pre-operational
OFF, NO_REMOTE = 1 << 31, 1 << 30  # of a COB-ID: the PDO does not exist; nobody may ask for it by a remote frame


@dataclass(frozen=True)
class Object:
    """An entry of a drive's dictionary.  kind: a key of FORMATS."""

    index: int
    sub: int
    kind: str

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize(FORMATS[self.kind])

    def pack(self, value: int) -> bytes:
        return struct.pack(FORMATS[self.kind], value)

    def unpack(self, data: bytes) -> int:
        value: int = struct.unpack(FORMATS[self.kind], data)[0]
        return value

    def __str__(self) -> str:
        return f"0x{self.index:04X}:{self.sub:02X}"


ERROR_COUNT, ERROR_LATEST = Object(0x1003, 0, "u8"), Object(0x1003, 1, "u32")
CONSUMER_HEARTBEAT, PRODUCER_HEARTBEAT = Object(0x1016, 1, "u32"), Object(0x1017, 0, "u16")
VENDOR_ID, PRODUCT, SERIAL = Object(0x1018, 1, "u32"), Object(0x1018, 2, "u32"), Object(0x1018, 4, "u32")
ABORT_OPTION = Object(0x6007, 0, "i16")
ERROR_CODE = Object(0x603F, 0, "u16")
CONTROLWORD, STATUSWORD = Object(0x6040, 0, "u16"), Object(0x6041, 0, "u16")
QUICK_STOP_OPTION, FAULT_OPTION = Object(0x605A, 0, "i16"), Object(0x605E, 0, "i16")
MODE, MODE_SHOWN = Object(0x6060, 0, "i8"), Object(0x6061, 0, "i8")
POSITION, FOLLOWING_WINDOW, VELOCITY = Object(0x6064, 0, "i32"), Object(0x6065, 0, "u32"), Object(0x606C, 0, "i32")
TARGET_POSITION = Object(0x607A, 0, "i32")
LOWEST, HIGHEST = Object(0x607D, 1, "i32"), Object(0x607D, 2, "i32")
MAX_PROFILE_VELOCITY, PROFILE_VELOCITY = Object(0x607F, 0, "u32"), Object(0x6081, 0, "u32")
ACCELERATION, DECELERATION, QUICK_STOP = Object(0x6083, 0, "u32"), Object(0x6084, 0, "u32"), Object(0x6085, 0, "u32")
PROFILE_TYPE = Object(0x6086, 0, "u16")
HOMING_METHOD, HOMING_SPEED, HOMING_SLOWLY = Object(0x6098, 0, "i8"), Object(0x6099, 1, "u32"), Object(0x6099, 2, "u32")
HOMING_ACCELERATION = Object(0x609A, 0, "u32")
VELOCITY_UNIT = Object(0x60A9, 0, "u32")
TARGET_VELOCITY = Object(0x60FF, 0, "i32")
SUPPORTED = Object(0x6502, 0, "u32")
RPM_UNIT = 0x00B44700  # of 0x60A9: revolutions per minute

OBJECTS = [value for value in globals().values() if isinstance(value, Object)]


@dataclass(frozen=True)
class Drive:
    """What differs between families.  nominal_current mA, peak_current mA, thermal_time 0.1 s, max_speed rpm, home: its position, qc

    home_move: qc, by which an axis would still move away from where it found home | home_current mA, by which it finds a stop
    status: what is told beside the statusword; an EPOS2 tells errors by emergency messages alone
    optional: settings that not every firmware has
    """

    name: str
    current: Object
    following: Object
    nominal_current: Object
    peak_current: Object
    pole_pairs: Object
    thermal_time: Object
    max_speed: Object
    home: Object
    home_move: Object
    home_current: Object
    soft_limit: int
    limit_switch: int
    status: tuple[Object, ...]
    optional: tuple[Object, ...]

    @property
    def objects(self) -> list[Object]:
        own = [value for value in vars(self).values() if isinstance(value, Object)]
        return [obj for obj in OBJECTS if obj not in self.optional] + own


FAMILIES: dict[str, Drive] = {
    "epos4": Drive("EPOS4", Object(0x30D1, 2, "i32"), Object(0x60F4, 0, "i32"), Object(0x3001, 1, "u32"), Object(0x3001, 2, "u32"),
                   Object(0x3001, 3, "u8"), Object(0x3001, 4, "u16"), Object(0x6080, 0, "u32"), Object(0x30B0, 0, "i32"),
                   Object(0x30B1, 0, "i32"), Object(0x30B2, 0, "u16"), 0x8A82, 0x8A80, (MODE_SHOWN, ERROR_CODE), ()),
    "epos2": Drive("EPOS2", Object(0x6078, 0, "i16"), Object(0x20F4, 0, "i16"), Object(0x6410, 1, "u16"), Object(0x6410, 2, "u16"),
                   Object(0x6410, 3, "u8"), Object(0x6410, 5, "u16"), Object(0x6410, 4, "u32"), Object(0x2081, 0, "i32"),
                   Object(0x607C, 0, "i32"), Object(0x2080, 0, "u16"), 0xFF09, 0xFF06,
                   (MODE_SHOWN,), (ABORT_OPTION, QUICK_STOP_OPTION, FAULT_OPTION)),
}  # fmt: skip

PROFILE_POSITION, PROFILE_VELOCITY_MODE, HOMING = 1, 3, 6
MODES = {PROFILE_POSITION: "profile position", PROFILE_VELOCITY_MODE: "profile velocity", HOMING: "homing"}
FOLLOWING_ERROR, HEARTBEAT_LOST, TOO_WARM = 0x8611, 0x8130, 0x4210
ERRORS = {
    0x1000: "generic error", 0x2310: "over-current", 0x3210: "over-voltage", 0x3220: "under-voltage", TOO_WARM: "over-temperature",
    0x7320: "position sensor", 0x8120: "CAN passive mode", HEARTBEAT_LOST: "the host's heartbeat was not heard",
    0x8180: "CAN bus off", FOLLOWING_ERROR: "following error", 0x8A80: "negative limit switch", 0x8A81: "positive limit switch",
    0x8A82: "soft limit of the position", 0x8A88: "safe torque off", 0xFF01: "overloaded", 0xFF06: "negative limit switch",
    0xFF07: "positive limit switch", 0xFF09: "soft limit of the position", 0xFF0B: "overloaded",
}  # fmt: skip


def error_text(code: int) -> str:
    """In words; of the firmware's other codes only the number."""
    if not code:
        return "a fault whose code was not heard: log.jsonl has the drive's history"
    return f"{ERRORS.get(code, 'see the firmware specification of the drive')} (0x{code:04X})"


class State(Enum):
    """CiA 402-2, the device control state machine."""

    NOT_READY = "not ready to switch on"
    DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    STOPPING = "quick stop active"
    FAULTING = "fault reaction active"
    FAULT = "fault"


STATES = {
    State.NOT_READY: (0x4F, 0x00), State.DISABLED: (0x4F, 0x40), State.READY: (0x6F, 0x21), State.SWITCHED_ON: (0x6F, 0x23),
    State.ENABLED: (0x6F, 0x27), State.STOPPING: (0x6F, 0x07), State.FAULTING: (0x4F, 0x0F), State.FAULT: (0x4F, 0x08),
}  # mask and value of the statusword  # fmt: skip
ARRIVED, ANSWERED, OFFSIDE, HOMED = 1 << 10, 1 << 12, 1 << 13, 1 << 15  # target reached, mode's answer, mode's error, home is known

SHUT_DOWN, SWITCH_ON, ENABLE, QUICK, NO_VOLTAGE, RESET = 0x06, 0x07, 0x0F, 0x02, 0x00, 0x80  # controlwords
START = ENABLE | 0x10  # homing begins; a new set point
AT_ONCE = START | 0x20  # a new set point, whatever the one before


def state_of(statusword: int) -> State | None:
    """The state that a statusword shows, None where it shows none: EPOS2's refresh and commutation search look like switched on."""
    return next((state for state, (mask, value) in STATES.items() if statusword & mask == value), None)


def towards_enabled(state: State | None) -> int | None:
    """The controlword for the next step to operation enabled; None where only waiting, or a reset of a fault, leads on."""
    steps = {State.DISABLED: SHUT_DOWN, State.READY: SWITCH_ON, State.SWITCHED_ON: ENABLE, State.ENABLED: ENABLE}
    return None if state is None else steps.get(state)


@dataclass(frozen=True)
class Pdo:
    """A process data object: COB-ID without the node, transmission (1: at each SYNC, 255: at once) and what it carries."""

    number: int
    base: int
    send: bool
    transmission: int
    entries: tuple[Object, ...]

    @property
    def communication(self) -> int:
        return (0x1800 if self.send else 0x1400) + self.number - 1

    @property
    def mapping(self) -> int:
        return (0x1A00 if self.send else 0x1600) + self.number - 1

    def pack(self, *values: int) -> bytes:
        return b"".join(entry.pack(value) for entry, value in zip(self.entries, values, strict=True))

    def unpack(self, data: bytes) -> tuple[int, ...]:
        return struct.unpack("<" + "".join(FORMATS[entry.kind][1] for entry in self.entries), data)


def pdos(family: str) -> tuple[Pdo, ...]:
    """The mapping that we want.  The controlword is in one RPDO alone, so that nothing else can send one by accident.

    What a drive would send by itself, its fourth PDO, is off.
    Set points are taken at once, and do nothing until the controlword starts them with a SYNC; mode and target velocity wait for it too.
    """
    return (
        Pdo(1, 0x200, False, 1, (CONTROLWORD,)),
        Pdo(2, 0x300, False, 255, (TARGET_POSITION, PROFILE_VELOCITY)),
        Pdo(3, 0x400, False, 255, (ACCELERATION, DECELERATION)),
        Pdo(4, 0x500, False, 1, (MODE, TARGET_VELOCITY)),
        Pdo(1, 0x180, True, 1, (STATUSWORD, *FAMILIES[family].status)),
        Pdo(2, 0x280, True, 1, (POSITION, VELOCITY)),
        Pdo(3, 0x380, True, 1, (FAMILIES[family].current, FAMILIES[family].following)),
        Pdo(4, 0x480, True, 1, ()),
    )


def rpm(axis: Axis, v: float) -> int:
    """Speed of an axis, m/s or rad/s, or acceleration, as whole rpm or rpm/s of the motor, with its sign."""
    return round(v * reduction(axis) / RPM)


def from_rpm(axis: Axis, value: float) -> float:
    return value * RPM / reduction(axis)


def speed_step(axis: Axis, period: float) -> float:
    """rpm that a motor seems to turn by where its encoder counts one quadcount in a period, s."""
    return 60 / (4 * axis.cpt * period)


def settings(axis: Axis, timeout: float) -> dict[Object, int]:
    """What is written into a drive before it may move, and read back.  timeout: s without the host's heartbeat after which it stops."""
    drive, motor, limits = FAMILIES[axis.family], axis.motor, axis.limits
    ends = sorted(int(quadcounts(axis, x)) for x in (limits.min, limits.max))
    fastest = abs(rpm(axis, drivable(axis, limits.v)))
    return {
        CONSUMER_HEARTBEAT: MASTER << 16 | round(timeout * 1e3),
        ABORT_OPTION: 3,  # when the host is gone: quick stop
        QUICK_STOP_OPTION: 6,  # stay in quick stop
        FAULT_OPTION: 2,  # a fault: slow down by the quick stop's ramp
        LOWEST: ends[0],
        HIGHEST: ends[1],
        MAX_PROFILE_VELOCITY: fastest,
        drive.max_speed: min(round(motor.max_speed / RPM), round(axis.transmission.max_input_speed / RPM)),
        FOLLOWING_WINDOW: max(1, abs(int(quadcounts(axis, limits.following)))),
        QUICK_STOP: abs(rpm(axis, drivable(axis, limits.quick_stop))),
        PROFILE_TYPE: 0,  # trapezoid
        drive.nominal_current: round(motor.nominal_current * 1e3),
        drive.peak_current: round(axis.current_peak * 1e3),
        drive.pole_pairs: motor.pole_pairs,
        drive.thermal_time: round(motor.winding_time * 10),
        HOMING_METHOD: axis.homing.method,
        HOMING_SPEED: max(1, abs(rpm(axis, axis.homing.speed))),
        HOMING_SLOWLY: max(1, abs(rpm(axis, axis.homing.speed / 5))),
        HOMING_ACCELERATION: max(1, abs(rpm(axis, drivable(axis, gentle(axis))))),
        drive.home: {-1: ends[0] + INSIDE, 1: ends[1] - INSIDE}.get(homing_end(axis), int(quadcounts(axis, axis.homing.offset))),
        drive.home_move: 0,
    } | ({} if axis.homing.current is None else {drive.home_current: round(axis.homing.current * 1e3)})


def gentle(axis: Axis) -> float:
    """Acceleration of an axis that goes at the speed of homing: 50 ms to reach it, and less than a current of a stop."""
    return min(axis.limits.a, axis.limits.quick_stop, 20 * axis.homing.speed)


def homing_end(axis: Axis) -> int:
    """The end of the motor's way at which the method finds home: -1 or 1; 0 where it is at the offset.

    Switch and stop are where the soft limit is, as there is no way beyond; the axis is brought to the offset afterwards.
    """
    return {1: -1, 17: -1, -2: -1, -4: -1, 2: 1, 18: 1, -1: 1, -3: 1}.get(axis.homing.method, 0)


def bits(modes: int) -> list[str]:
    """The modes of 0x6502 that we know, in words."""
    return [name for mode, name in MODES.items() if modes >> (mode - 1) & 1]
