"""Motors as their data sheets print them, and what they need for a torque at a speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


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
