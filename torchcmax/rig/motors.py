"""Motors as their data sheets print them, and what they need for a torque at a speed."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import product
from typing import Literal

import numpy as np

from torchcmax.rig.errors import Refused

RPM = math.pi / 30  # rad/s
COPPER = 0.0039  # 1/K, change of the winding's resistance
REFERENCE = 25.0  # °C at which data sheets give it
UNITS = {
    "voltage": ("voltage_v", 1.0),
    "no_load_speed": ("no_load_speed_rpm", RPM),
    "no_load_current": ("no_load_current_ma", 1e-3),
    "nominal_speed": ("nominal_speed_rpm", RPM),
    "nominal_torque": ("nominal_torque_mnm", 1e-3),
    "nominal_current": ("nominal_current_a", 1.0),
    "stall_torque": ("stall_torque_mnm", 1e-3),
    "starting_current": ("starting_current_a", 1.0),
    "efficiency": ("efficiency_percent", 1e-2),
    "resistance": ("resistance_ohm", 1.0),
    "inductance": ("inductance_mh", 1e-3),
    "torque_constant": ("torque_constant_mnm_per_a", 1e-3),
    "speed_constant": ("speed_constant_rpm_per_v", RPM),
    "gradient": ("gradient_rpm_per_mnm", RPM / 1e-3),
    "time_constant": ("time_constant_ms", 1e-3),
    "inertia": ("inertia_gcm2", 1e-7),
    "housing_ambient": ("housing_ambient_k_per_w", 1.0),
    "winding_housing": ("winding_housing_k_per_w", 1.0),
    "winding_time": ("winding_time_s", 1.0),
    "housing_time": ("housing_time_s", 1.0),
    "winding_max": ("winding_max_c", 1.0),
    "max_speed": ("max_speed_rpm", RPM),
}  # of Motor's numbers: the column of the data sheets' table, and what its unit is in SI


@dataclass(frozen=True)
class Motor:
    """One winding of a motor, in SI units; angles rad, temperatures °C.  Resistance is that at 25 °C."""

    part: str
    family: str
    commutation: Literal["ec", "dc"]
    voltage: float
    no_load_speed: float
    no_load_current: float
    nominal_speed: float
    nominal_torque: float
    nominal_current: float
    stall_torque: float
    starting_current: float
    efficiency: float
    resistance: float
    inductance: float
    torque_constant: float
    speed_constant: float
    gradient: float
    time_constant: float
    inertia: float
    housing_ambient: float
    winding_housing: float
    winding_time: float
    housing_time: float
    winding_max: float
    max_speed: float
    pole_pairs: int
    source: str


@cache
def motors() -> dict[str, Motor]:
    """All windings that are known, by their part number, from motors.csv, which holds what the data sheets print."""
    text = files("torchcmax.rig").joinpath("motors.csv").read_text("utf-8")
    return {row["part"]: _motor(row) for row in csv.DictReader(text.splitlines())}


def _motor(row: dict[str, str]) -> Motor:
    numbers = {name: float(row[column]) * unit for name, (column, unit) in UNITS.items()}
    commutation: Literal["ec", "dc"] = "ec" if row["commutation"] == "ec" else "dc"
    return Motor(row["part"], row["family"], commutation, **numbers, pole_pairs=int(row["pole_pairs"]), source=row["source"])


def motor(part: str) -> Motor:
    """The winding of a part number; Refused where it is not known."""
    known = motors()
    if part not in known:
        listed = "; ".join(f"{family}: {', '.join(p for p, m in known.items() if m.family == family)}" for family in _families())
        raise Refused(f"no data sheet of motor {part!r} is known\n  what to do: take one of {listed}")
    return known[part]


def _families() -> list[str]:
    return [*dict.fromkeys(m.family for m in motors().values())]


def resistance(motor: Motor, temperature: float | np.ndarray) -> float | np.ndarray:
    """Ohm, of the winding at a temperature, °C."""
    return motor.resistance * (1 + COPPER * (temperature - REFERENCE))


def no_load_current(motor: Motor, speed: np.ndarray) -> np.ndarray:
    """A, at a speed, rad/s: of a brushless motor it grows with the speed (eddy currents), of brushes it is constant; against the motion."""
    if motor.commutation == "ec":
        return np.asarray(motor.no_load_current * np.asarray(speed) / motor.no_load_speed)
    return np.asarray(motor.no_load_current * np.sign(speed))


def current(motor: Motor, torque: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """A, for a torque at the shaft, Nm, at a speed, rad/s: M = kM (I - I0(n))."""
    return np.asarray(np.asarray(torque) / motor.torque_constant + no_load_current(motor, speed))


def voltage(motor: Motor, current: np.ndarray, speed: np.ndarray, temperature: float | np.ndarray = REFERENCE) -> np.ndarray:
    """V at the terminals, for a current, A, at a speed, rad/s: U = R(T) I + kM n."""
    return np.asarray(resistance(motor, temperature) * np.asarray(current) + motor.torque_constant * np.asarray(speed))


def available_speed(motor: Motor, torque: np.ndarray, volts: float, temperature: float = REFERENCE) -> np.ndarray:
    """rad/s of at least 0 that a torque, Nm, negative where it brakes, can be had at with so many V at the terminals."""
    R = float(resistance(motor, temperature))
    left = volts - R * np.asarray(torque) / motor.torque_constant
    if motor.commutation == "ec":
        return np.asarray(left / (motor.torque_constant + R * motor.no_load_current / motor.no_load_speed))
    return np.asarray((left - R * motor.no_load_current) / motor.torque_constant)


def no_load_loss(motor: Motor, speed: np.ndarray) -> np.ndarray:
    """W that heat the housing at a speed, rad/s."""
    return np.asarray(motor.torque_constant * no_load_current(motor, speed) * np.asarray(speed))


def thermal_current(motor: Motor, speed: np.ndarray, ambient: float = REFERENCE) -> np.ndarray:
    """A that hold the winding at its highest temperature for ever, at a speed, rad/s, in air of a temperature, °C; 0 where none does."""
    rise = motor.winding_max - ambient - no_load_loss(motor, speed) * motor.housing_ambient
    heat = rise.clip(0) / (motor.housing_ambient + motor.winding_housing)
    return np.asarray(np.sqrt(heat / resistance(motor, motor.winding_max)))


def continuous_torque(motor: Motor, speed: np.ndarray, ambient: float = REFERENCE) -> np.ndarray:
    """Nm for ever: what the winding's temperature allows, but no more than the data sheet prints, which brushes do not bear."""
    thermal = motor.torque_constant * (thermal_current(motor, speed, ambient) - abs(no_load_current(motor, speed)))
    return np.asarray(np.minimum(thermal.clip(0), motor.nominal_torque))


@dataclass(frozen=True)
class Deviation:
    """What a data sheet prints against what its other numbers say, both in SI.

    outside_rounding: no numbers that round to what is printed make both equal
    """

    field: str
    identity: str
    printed: float
    computed: float
    outside_rounding: bool

    @property
    def relative(self) -> float:
        """Printed against computed, as a share."""
        return self.printed / self.computed - 1


def _thermal(highest: float, out: float, through: float, R: float, loss: float) -> float:
    """The current that holds a winding at its highest temperature for ever, its housing heated by a loss, W."""
    return math.sqrt((highest - REFERENCE - loss * out) / ((out + through) * R * (1 + COPPER * (highest - REFERENCE))))


THERMAL = "winding_max housing_ambient winding_housing resistance torque_constant no_load_current nominal_speed"
Formula = Callable[..., float]
IDENTITIES: list[tuple[str, str, str, str, Formula]] = [
    # of both kinds, or of one: the field, how it reads, the fields it is made of
    ("speed_constant", "1 / kM", "ec dc", "torque_constant", lambda k: 1 / k),
    ("starting_current", "U / R", "ec dc", "voltage resistance", lambda u, r: u / r),
    ("stall_torque", "kM I_A", "ec dc", "torque_constant starting_current", lambda k, i: k * i),
    ("gradient", "R / kM^2", "ec dc", "resistance torque_constant", lambda r, k: r / k**2),
    ("gradient", "n0 / M_H", "dc", "no_load_speed stall_torque", lambda n, m: n / m),
    ("gradient", "kn U / M_H", "ec", "speed_constant voltage stall_torque", lambda k, u, m: k * u / m),
    ("time_constant", "J R / kM^2", "ec dc", "inertia resistance torque_constant", lambda j, r, k: j * r / k**2),
    ("time_constant", "J dn/dM", "ec dc", "inertia gradient", lambda j, g: j * g),
    ("no_load_speed", "kn (U - R I0)", "ec dc", "speed_constant voltage resistance no_load_current", lambda k, u, r, i: k * (u - r * i)),
    ("efficiency", "(1 - sqrt(I0 / I_A))^2", "ec dc", "no_load_current starting_current", lambda i, s: (1 - math.sqrt(i / s)) ** 2),
    ("nominal_current", "M_N / kM + I0", "dc", "nominal_torque torque_constant no_load_current", lambda m, k, i: m / k + i),
    ("nominal_current", "M_N / kM + I0 n_N / n0", "ec", "nominal_torque torque_constant no_load_current nominal_speed no_load_speed",
     lambda m, k, i, n, n0: m / k + i * n / n0),
    ("nominal_current", "that of T_max at n_N", "dc", THERMAL, lambda T, a, h, r, k, i, n: _thermal(T, a, h, r, k * i * n)),
    ("nominal_current", "that of T_max at n_N", "ec", f"{THERMAL} no_load_speed",
     lambda T, a, h, r, k, i, n, n0: _thermal(T, a, h, r, k * i * n * n / n0)),
    ("nominal_speed", "n0 - dn/dM M_N", "ec dc", "no_load_speed gradient nominal_torque", lambda n0, g, m: n0 - g * m),
]  # fmt: skip
EXACT = ("voltage", "winding_max")  # are no measurements


def verify(motor: Motor) -> list[Deviation]:
    """The identities between the numbers of a data sheet, each with what it is off: -> one of each.

    Data sheets print three significant digits, the efficiency two; an identity may be off by what these round away.
    """
    return [
        _deviation(motor, field, identity, fields.split(), formula)
        for field, identity, kinds, fields, formula in IDENTITIES
        if motor.commutation in kinds.split()
    ]


def _deviation(motor: Motor, field: str, identity: str, fields: list[str], formula: Formula) -> Deviation:
    corners = [formula(*values) for values in product(*(_rounded(motor, name) for name in fields))]  # each is monotone in all
    least, most = _rounded(motor, field)
    outside = max(corners) < least or min(corners) > most
    return Deviation(field, identity, getattr(motor, field), formula(*(getattr(motor, name) for name in fields)), outside)


def _rounded(motor: Motor, field: str) -> tuple[float, float]:
    """The least and the most that rounds to what is printed."""
    unit = UNITS[field][1]
    printed = getattr(motor, field) / unit
    digits = 2 if field == "efficiency" else 3
    half = 0.0 if field in EXACT else 0.5 * 10 ** (math.floor(math.log10(printed) + 1e-9) + 1 - digits)
    return (printed - half) * unit, (printed + half) * unit
