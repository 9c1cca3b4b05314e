"""What motors need for the motions of their axes, and how warm they become."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchcmax.rig.axis import motor_torque, to_motor
from torchcmax.rig.config import Axis, Rig
from torchcmax.rig.motors import current, voltage
from torchcmax.rig.profiles import Profile
from torchcmax.rig.thermal import TwoBody

HOTTEST = 1e6  # °C: of a motor that runs away


@dataclass(frozen=True)
class Samples:
    """time [K] s | x, v, a of the axes, torque Nm, current A, voltage V and winding's temperature °C of their motors [K, axes]"""

    time: np.ndarray
    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    torque: np.ndarray
    current: np.ndarray
    voltage: np.ndarray
    temperature: np.ndarray

    @property
    def returned(self) -> np.ndarray:
        """Power that the motors give back to their supply [K, axes], W."""
        return np.asarray(-self.voltage * self.current)


def samples(rig: Rig, tracks: tuple[Profile, ...], duration: float, cycles: int) -> Samples:
    """At every SYNC of the last of so many cycles, in which the motors are hottest."""
    period = rig.bus.sync_period
    time = np.arange(round(duration / period) + 1) * period
    columns = []
    for axis, track in zip(rig.axes, tracks, strict=True):
        state = track.sample(time)
        speed, torque, amperes = needed(axis, state.v, state.a)
        temperature = _heated(TwoBody(axis.motor, rig.ambient), amperes, speed, period, cycles)
        volts = voltage(axis.motor, amperes, speed, temperature)
        columns.append((state.x, state.v, state.a, torque, amperes, volts, temperature))
    return Samples(time, *(np.stack(parts, 1) for parts in zip(*columns, strict=True)))


def needed(axis: Axis, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocity and acceleration of the axis -> the motor's speed rad/s, torque Nm and current A.

    The gravity of a rotary axis may act either way, as its angle is: the larger torque counts.
    """
    torque = motor_torque(axis, v, a)
    if axis.kind == "rotary":
        other = motor_torque(replace(axis, gravity=-axis.gravity), v, a)
        torque = np.where(abs(other) > abs(torque), other, torque)
    speed = to_motor(axis, v)
    return speed, torque, current(axis.motor, torque, speed)


def _heated(body: TwoBody, amperes: np.ndarray, speed: np.ndarray, dt: float, cycles: int) -> np.ndarray:
    """Temperatures of the winding [K] in the last cycle, °C.

    What a cycle makes of the two temperatures is affine, so that three runs tell what all cycles do.
    """
    cold = np.full(2, body.ambient)

    def run(begin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return body.run(amperes[:-1], speed[:-1], dt, (float(begin[0]), float(begin[1])))

    def after(begin: np.ndarray) -> np.ndarray:
        winding, housing = run(begin)
        return np.array([winding[-1], housing[-1]])

    begin = cold
    if cycles > 1 and len(amperes) > 1:
        origin = after(cold)
        change = np.stack([after(cold + unit) - origin for unit in np.eye(2)], 1)
        for _ in range(cycles - 1):
            begin = np.minimum(origin + change @ (begin - cold), HOTTEST)
    return np.append(begin[0], run(begin)[0])
