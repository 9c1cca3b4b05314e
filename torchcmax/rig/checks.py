"""What a plan is checked for: every limit with the worst moment of the motion.

Between the corners of a track, where acceleration changes, what motors need is affine in velocity, so that the worst lies at a corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy.signal import lfilter

from torchcmax.rig.axis import RPM, motor_torque, quantum, to_motor
from torchcmax.rig.config import UNITS, Axis, Rig
from torchcmax.rig.demand import Samples, either_way, needed
from torchcmax.rig.motors import current, voltage
from torchcmax.rig.profiles import Sequence

REACTION = 0.1  # s that pass before a quick stop begins
EDGES = 1e6  # 1/s, of an encoder
COOLER = 10.0  # K below what the winding bears
LOAD = 0.6  # of the bus
PDOS = (5, 8, 8)  # bytes that a drive sends at every SYNC
EXACT = 1e-9  # relative: what counts as equal
PARTS = 32  # of a time between two corners, by which energies are summed
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
    return (*found, *_rig(rig, tracks, every, cycles))


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
    volts = voltage_needed(rig, axis, speed, amperes, hot.max())
    stops = [needed(axis, part * at.v, -np.sign(at.v) * axis.limits.quick_stop) for part in (1, INSIDE)]  # as they begin and end
    braking = np.max([abs(taken) for _, _, taken in stops], 0)
    stopping = np.max([voltage_needed(rig, axis, turns, taken, hot.max()) for turns, _, taken in stops], 0)
    mean = np.sqrt(np.mean(np.square(samples.torque[:-1, k])))
    lasting = _lasting(samples.current[:-1, k], samples.step / motor.winding_time)
    end = samples.time[-1]
    return [
        most("motor's speed", abs(speed) / RPM, motor.max_speed / RPM, "rpm", at.time),
        most("transmission's input speed", abs(speed) / RPM, axis.transmission.max_input_speed / RPM, "rpm", at.time),
        most("encoder's edges", abs(at.v / quantum(axis)), EDGES, "1/s", at.time),
        most("voltage, its winding hot or cold", volts, rig.modulation * rig.supply, "V", at.time),
        most("current", abs(amperes), axis.current_peak, "A", at.time),
        most("current of a quick stop", braking, axis.current_peak, "A", at.time),
        most("voltage of a quick stop", stopping, rig.modulation * rig.supply, "V", at.time),
        most("mean current (rms)", lasting, motor.nominal_current, "A", samples.time[:-1]),
        most("mean torque (rms)", mean, motor.nominal_torque, "Nm", end),
        most("winding's temperature", hot, motor.winding_max - COOLER, "°C", samples.time),
    ]


def voltage_needed(rig: Rig, axis: Axis, speed: np.ndarray, amperes: np.ndarray, hottest: float) -> np.ndarray:
    """V, either way: driving a hot winding, or one that brakes while it is cold."""
    return np.asarray(np.max([abs(voltage(axis.motor, amperes, speed, temperature)) for temperature in (rig.ambient, hottest)], 0))


def _lasting(current: np.ndarray, share: float) -> np.ndarray:
    """Root of the mean square of a current [K] over the winding's time constant, of which a sample is a share, cycle after cycle: [K].

    Drives, and the host while it runs, look no farther back.
    """
    once, last = lfilter([share], [1, share - 1], np.square(current), zi=[0.0])
    begin = last[0] / -np.expm1(len(current) * np.log1p(-share)) / (1 - share)  # what the cycles before leave
    left = begin * (1 - share) ** np.arange(1, len(current) + 1)
    return np.asarray(np.sqrt(once + left))


def _rig(rig: Rig, tracks: tuple[Track, ...], every: list[Corners], cycles: int) -> list[Check]:
    """What the axes share: supply and bus."""
    ends = np.unique(np.concatenate([at.time for at in every]))
    time = np.interp(np.arange(PARTS * len(ends)) / PARTS, np.arange(len(ends)), ends)
    states = [track.sample(time) for track in tracks]
    stored = np.zeros_like(time)
    for axes in product(*map(either_way, rig.axes)):
        power = [_returned(axis, state.v, state.a, rig.ambient) for axis, state in zip(axes, states, strict=True)]
        given = _integral(np.sum(power, 0), time)
        left = _kept(given)[-1] if cycles > 1 else 0.0  # by the cycle before
        stored = np.maximum(stored, _kept(given, left))
    stopped = np.sum([_stopped(axis, state.v, rig.ambient) for axis, state in zip(rig.axes, states, strict=True)], 0)

    def volts(energy: np.ndarray) -> np.ndarray:
        return np.sqrt(rig.supply**2 + 2 * energy / rig.bus_capacitance)

    return [
        _most("", "supply's voltage in braking", volts(stored), rig.bus_max, "V", time),
        _most("", "supply's voltage in a quick stop", volts(stored + stopped), rig.bus_max, "V", time),
        _most("", "load of the CAN bus", 100 * can_load(rig), 100 * LOAD, "%", 0.0),
    ]


def _returned(axis: Axis, v: np.ndarray, a: np.ndarray, temperature: float) -> np.ndarray:
    """Power that a motor gives back to its supply, W: the most, its winding as cold as it begins.  At rest friction may hold the axis."""
    speed = to_motor(axis, v)
    amperes = current(axis.motor, motor_torque(axis, v, a), speed)
    return np.asarray(np.where(v == 0, 0.0, -voltage(axis.motor, amperes, speed, temperature) * amperes))


def _stopped(axis: Axis, v: np.ndarray, temperature: float) -> np.ndarray:
    """Energy that quick stops from velocities v give back at most, J."""
    speed, slower = np.linspace(0, abs(v).max(), 8 * PARTS), axis.limits.quick_stop

    def energy(way: int) -> np.ndarray:
        power = [_returned(one, way * speed, np.full_like(speed, -way * slower), temperature) for one in either_way(axis)]
        return np.asarray(np.interp(way * v, speed, _kept(_integral(np.max(power, 0), speed / slower))))

    return np.asarray(energy(1) + energy(-1))


def _integral(power: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Energy given since the begin."""
    return np.append(0.0, ((power[1:] + power[:-1]) / 2 * np.diff(time)).cumsum())


def _kept(given: np.ndarray, begin: float = 0.0) -> np.ndarray:
    """What of it the capacitors hold, which held so much in the begin: the supply takes nothing back, axes take from them first."""
    return np.asarray(given - np.minimum.accumulate(np.minimum(given, -begin)))


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
