"""What a plan is checked for: every limit with the worst moment of the motion.

Between the corners of a track, where acceleration changes, what motors need is affine in velocity, so that the worst lies at a corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.signal import lfilter

from torchcmax.rig.axis import RPM, quantum
from torchcmax.rig.config import UNITS, Axis, Rig
from torchcmax.rig.demand import Samples, needed
from torchcmax.rig.motors import voltage
from torchcmax.rig.profiles import Sequence

REACTION = 0.1  # s that pass before a quick stop begins
EDGES = 1e6  # 1/s, of an encoder
COOLER = 10.0  # K below what the winding bears
LOAD = 0.6  # of the bus
PDOS = (5, 8, 8)  # bytes that a drive sends at every SYNC
EXACT = 1e-9  # relative: what counts as equal
INSIDE = 1e-9  # of a piece: so far from its ends are its corners, that there is a velocity

Track = Sequence  # an axis' whole cycle, of trapezoids and rests


@dataclass(frozen=True)
class Check:
    """One limit of one axis, or of the rig (axis empty): the worst value, and when, s.  margin: negative where it is not kept."""

    name: str
    axis: str
    value: float
    limit: float
    unit: str
    margin: float
    time: float
    ok: bool

    def __str__(self) -> str:
        where = f"axis {self.axis}: " if self.axis else ""
        return f"{where}{self.name} {self.value:.4g} {self.unit} at {self.time:.3f} s, limit {self.limit:.4g} {self.unit}"


@dataclass(frozen=True)
class Corners:
    """Of one axis [N]: time s, position, velocity and acceleration."""

    time: np.ndarray
    x: np.ndarray
    v: np.ndarray
    a: np.ndarray


def check(rig: Rig, tracks: tuple[Track, ...], samples: Samples, strange: list[int], cycles: int) -> tuple[Check, ...]:
    """All checks; strange [axes]: moves that the drives' modes do not know."""
    every = [corners(axis, track) for axis, track in zip(rig.axes, tracks, strict=True)]
    found: list[Check] = []
    for k, (axis, at) in enumerate(zip(rig.axes, every, strict=True)):
        found += _motion(axis, at, strange[k])
        found += _motor(rig, axis, at, samples, k)
        if cycles > 1:
            gap = abs(samples.x[-1, k] - samples.x[0, k])
            found.append(_most(axis.name, "way left to the begin", gap, abs(quantum(axis)), UNITS[axis.kind].place, samples.time[-1]))
    return (*found, *_rig(rig, every, samples))


def corners(axis: Axis, track: Track) -> Corners:
    """Both ends of every piece, and where between them a quick stop would end farthest."""
    t, x, v, a, _ = np.concatenate([[[0, track.begin, 0, 0, 0]], track.nodes]).T
    length = np.diff(np.append(t, track.duration)).clip(0)
    slower, stop = np.maximum(abs(a), 1e-12), axis.limits.quick_stop
    with np.errstate(divide="ignore"):
        worst = np.where(slower < stop, REACTION / np.maximum(1 / slower - 1 / stop, 1e-12), np.inf)  # speed, where it decelerates
    between = ((abs(v) - worst) / slower).clip(INSIDE * length, (1 - INSIDE) * length)
    s = np.stack([INSIDE * length, between, (1 - INSIDE) * length])
    return Corners(*(part.ravel() for part in (t + s, x + s * (v + s * a / 2), v + s * a, a + 0 * s)))


def _motion(axis: Axis, at: Corners, strange: int) -> list[Check]:
    """What the axis itself bears, and what its drive can be told."""
    limits, unit, most = axis.limits, UNITS[axis.kind], partial(_most, axis.name)
    place, rate, scale = unit.place, f"{unit.place}/s", unit.scale
    stop = at.v**2 / (2 * limits.quick_stop) + REACTION * abs(at.v)
    low, high = at.x - np.where(at.v < 0, stop, 0), at.x + np.where(at.v > 0, stop, 0)
    jerk = np.where(abs(at.a) > 0, math.inf, 0.0)
    return [
        _least(axis.name, "lower soft limit, quick stop included", low / scale, limits.min / scale, place, at.time),
        most("upper soft limit, quick stop included", high / scale, limits.max / scale, place, at.time),
        most("speed", abs(at.v) / scale, limits.v / scale, rate, at.time),
        most("acceleration", abs(at.a) / scale, limits.a / scale, f"{rate}²", at.time),
        most("jerk of the drive's trapezoids", jerk, limits.j / scale, f"{rate}³", at.time),
        most("moves that the drive's mode does not run", strange, 0, "moves", 0.0),
    ]


def _motor(rig: Rig, axis: Axis, at: Corners, samples: Samples, k: int) -> list[Check]:
    """What motor, transmission, encoder and drive bear."""
    motor, most = axis.motor, partial(_most, axis.name)
    speed, _, amperes = needed(axis, at.v, at.a)
    hot = samples.temperature[:, k]
    volts = voltage(motor, amperes, speed, hot.max())
    braking = needed(axis, at.v, -np.sign(at.v) * axis.limits.quick_stop)[2] * (at.v != 0)
    mean = np.sqrt(np.mean(np.square(samples.torque[:-1, k])))
    lasting = _lasting(samples.current[:-1, k], rig.bus.sync_period / motor.winding_time)
    end = samples.time[-1]
    return [
        most("motor's speed", abs(speed) / RPM, motor.max_speed / RPM, "rpm", at.time),
        most("transmission's input speed", abs(speed) / RPM, axis.transmission.max_input_speed / RPM, "rpm", at.time),
        most("encoder's edges", abs(at.v / quantum(axis)), EDGES, "1/s", at.time),
        most("voltage at the hot winding", abs(volts), rig.modulation * rig.supply, "V", at.time),
        most("current", abs(amperes), axis.current_peak, "A", at.time),
        most("current of a quick stop", abs(braking), axis.current_peak, "A", at.time),
        most("mean current (rms)", lasting, motor.nominal_current, "A", samples.time[:-1]),
        most("mean torque (rms)", mean, motor.nominal_torque, "Nm", end),
        most("winding's temperature", hot, motor.winding_max - COOLER, "°C", samples.time),
    ]


def _lasting(current: np.ndarray, share: float) -> np.ndarray:
    """Root of the mean square of a current [K] over the winding's time constant, of which a sample is a share, cycle after cycle: [K].

    Drives, and the host while it runs, look no farther back.
    """
    once, last = lfilter([share], [1, share - 1], np.square(current), zi=[0.0])
    begin = last[0] / -np.expm1(len(current) * np.log1p(-share)) / (1 - share)  # what the cycles before leave
    left = begin * (1 - share) ** np.arange(1, len(current) + 1)
    return np.asarray(np.sqrt(once + left))


def _rig(rig: Rig, every: list[Corners], samples: Samples) -> list[Check]:
    """What the axes share: supply and bus.  The supply takes nothing back, its capacitors do until the axes need it again."""
    given = (samples.returned.sum(1) * rig.bus.sync_period).cumsum()
    stored = given - np.minimum.accumulate(given.clip(max=0))
    stops = [_quick_stop(axis, at, samples.temperature[0, k]) for k, (axis, at) in enumerate(zip(rig.axes, every, strict=True))]

    def volts(energy: np.ndarray | float) -> np.ndarray:
        return np.sqrt(rig.supply**2 + 2 * np.asarray(energy) / rig.bus_capacitance)

    return [
        _most("", "supply's voltage in braking", volts(stored), rig.bus_max, "V", samples.time),
        _most("", "supply's voltage in a quick stop", volts(sum(energy for energy, _ in stops)), rig.bus_max, "V", max(stops)[1]),
        _most("", "load of the CAN bus", 100 * can_load(rig), 100 * LOAD, "%", 0.0),
    ]


def _quick_stop(axis: Axis, at: Corners, temperature: float) -> tuple[float, float]:
    """The most energy that a quick stop gives back, J, and when it would begin."""
    part = np.linspace(1, 0, 65)[:, None]
    v = part * at.v
    speed, _, amperes = needed(axis, v, -np.sign(at.v) * axis.limits.quick_stop)
    power = -voltage(axis.motor, amperes, speed, temperature) * amperes
    dt = abs(at.v) / axis.limits.quick_stop / (len(part) - 1)
    energy = ((power[1:] + power[:-1]) / 2 * dt).cumsum(0).max(0).clip(0)
    k = int(energy.argmax())
    return float(energy[k]), float(at.time[k])


def can_load(rig: Rig) -> float:
    """Share of the bus that the SYNC, the drives' answers and the heartbeats take, with as many stuffed bits as can be."""
    bus = rig.bus
    bits = (_frame(0) + len(rig.axes) * sum(map(_frame, PDOS))) / bus.sync_period + (1 + len(rig.axes)) * _frame(1) / bus.heartbeat
    return bits / bus.bitrate


def _frame(size: int) -> int:
    """Bits of a data frame of CAN 2.0A at most, and of the gap behind it: 34 + 8 n of 47 + 8 n bits can be stuffed (Davis et al. 2007)."""
    return 8 * size + 47 + (34 + 8 * size - 1) // 4


def _most(axis: str, name: str, values: np.ndarray | float, limit: float, unit: str, time: np.ndarray | float) -> Check:
    """That no value is above the limit."""
    values = np.atleast_1d(values)
    k = int(np.argmax(values))
    value, when = float(values[k]), float(np.broadcast_to(time, values.shape)[k])
    ok = value <= limit or math.isclose(value, limit, rel_tol=EXACT, abs_tol=EXACT)
    return Check(name, axis, value, limit, unit, limit - value if value != limit else 0.0, when, ok)


def _least(axis: str, name: str, values: np.ndarray, limit: float, unit: str, time: np.ndarray) -> Check:
    """That no value is below the limit."""
    found = _most(axis, name, -values, -limit, unit, time)
    return Check(name, axis, -found.value, limit, unit, found.margin, found.time, found.ok)
