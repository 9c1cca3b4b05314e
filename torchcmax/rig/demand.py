"""What motors need for the motions of their axes, and how warm they become."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from torchcmax.rig.axis import motor_torque, to_motor
from torchcmax.rig.config import Axis, Rig
from torchcmax.rig.motors import current, voltage
from torchcmax.rig.profiles import Profile
from torchcmax.rig.thermal import TwoBody

FINE = 1e-3  # s: samples are no farther apart
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
    def step(self) -> float:
        return float(self.time[1])

    def every(self, count: int) -> Samples:
        """Only every so many."""
        return Samples(*(getattr(self, each.name)[::count] for each in fields(self)))


def samples(rig: Rig, tracks: tuple[Profile, ...], duration: float, cycles: int) -> Samples:
    """At every SYNC, and between them where these are far apart, of the last of so many cycles, in which the motors are hottest."""
    step = rig.bus.sync_period / math.ceil(rig.bus.sync_period / FINE - 1e-9)
    time = np.arange(round(duration / step) + 1) * step
    columns = []
    for axis, track in zip(rig.axes, tracks, strict=True):
        state = track.sample(time)
        speed, torque, amperes = needed(axis, state.v, state.a)
        temperature = _heated(TwoBody(axis.motor, rig.ambient), amperes, speed, step, cycles)
        volts = voltage(axis.motor, amperes, speed, temperature)
        columns.append((state.x, state.v, state.a, torque, amperes, volts, temperature))
    return Samples(time, *(np.stack(parts, 1) for parts in zip(*columns, strict=True)))


def needed(axis: Axis, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocity and acceleration of the axis -> the motor's speed rad/s, torque Nm and current A: the most, whichever way gravity acts."""
    speed = to_motor(axis, v)
    torque = np.stack([motor_torque(one, v, a) for one in either_way(axis)])
    amperes = current(axis.motor, torque, speed)
    worst = abs(amperes).argmax(0)[None]
    return speed, np.take_along_axis(torque, worst, 0)[0], np.take_along_axis(amperes, worst, 0)[0]


def either_way(axis: Axis) -> tuple[Axis, ...]:
    """An axis as its gravity may act: that of a rotary one both ways, as its angle is."""
    return (axis,) if axis.kind == "linear" else (axis, replace(axis, gravity=-axis.gravity))


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
