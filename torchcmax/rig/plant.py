"""A simulated motor with its axis: the trapezoid that its drive makes, the servo that follows it, and the physics that move it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torchcmax.rig.axis import reduction
from torchcmax.rig.config import Axis
from torchcmax.rig.motors import COPPER, REFERENCE
from torchcmax.rig.thermal import TwoBody

SUBSTEPS = 8  # of the physics, in a period of the SYNC
STOP = 0.02  # of an axis' way, beyond its limits: where its mechanical ends are
BANDWIDTH = 2 * math.pi * 25  # rad/s, of the servo
SLACK = 1e-9  # rad/s: slower is at rest
NEAR = 2  # quadcounts from where it should rest, within which the servo integrates no more: friction would wind it up


@dataclass
class Ramp:
    """A motion in pieces of constant acceleration, from a place and velocity on, rad of the motor; after the last, the velocity stays."""

    place: float
    velocity: float
    pieces: list[tuple[float, float]] = field(default_factory=list)  # s, rad/s^2
    end: float | None = None  # where it comes to rest, exactly

    def advance(self, dt: float) -> tuple[float, float, float]:
        """Place, velocity and acceleration after dt s more."""
        while self.pieces and dt >= self.pieces[0][0]:
            lasts, a = self.pieces.pop(0)
            self.place += self.velocity * lasts + a * lasts * lasts / 2
            self.velocity += a * lasts
            dt -= lasts
            if not self.pieces and self.end is not None:
                self.place, self.velocity = self.end, 0.0
        a = self.pieces[0][1] if self.pieces else 0.0
        self.place += self.velocity * dt + a * dt * dt / 2
        self.velocity += a * dt
        if self.pieces:
            self.pieces[0] = self.pieces[0][0] - dt, a
        return self.place, self.velocity, a

    @property
    def done(self) -> bool:
        return not self.pieces

    def to(self, target: float, speed: float, up: float, down: float) -> Ramp:
        """To rest at a target, by a trapezoid of the velocity, from whatever velocity there is."""
        v0 = self.velocity
        stop = self.place + v0 * abs(v0) / (2 * down)  # where braking now would end
        way = math.copysign(1.0, target - stop) if target != stop else math.copysign(1.0, v0)
        if v0 * way < 0:  # too fast, or the wrong way: brake first, and come back
            back = Ramp(stop, 0.0).to(target, speed, up, down)
            return Ramp(self.place, v0, [(abs(v0) / down, way * down), *back.pieces], target)
        distance, v0 = way * (target - self.place), way * v0
        peak = min(speed, math.sqrt(max(0.0, (2 * distance * up * down + v0 * v0 * down) / (up + down))))
        change = up if peak > v0 else -down
        first = (peak - v0) / change
        last = peak / down
        cruise = distance - (peak + v0) / 2 * first - peak / 2 * last
        pieces = [(first, way * change), (max(0.0, cruise / peak) if peak > 0 else 0.0, 0.0), (last, -way * down)]
        return Ramp(self.place, self.velocity, [piece for piece in pieces if piece[0] > 0], target)

    def at(self, velocity: float, acceleration: float) -> Ramp:
        """To a velocity, and on with it."""
        change = velocity - self.velocity
        pieces = [(abs(change) / acceleration, math.copysign(acceleration, change))] if change else []
        return Ramp(self.place, self.velocity, pieces)


class Plant:
    """The motor of an axis and what it drives, in rad of the motor.  A drive commands a current; the rest is physics.

    place rad, velocity rad/s, current A, winding and housing °C | blocked: its rotor is held fast
    """

    def __init__(self, axis: Axis, supply: float, ambient: float, place: float) -> None:
        self.axis, self.motor, self.supply = axis, axis.motor, supply
        self.body = TwoBody(axis.motor, ambient)
        self.place, self.velocity, self.current, self.blocked = place, 0.0, 0.0, False
        self.winding = self.housing = ambient
        self.ratio = reduction(axis)
        room = STOP * (axis.limits.max - axis.limits.min)
        self.ends = sorted((self.ratio * (axis.limits.min - room), self.ratio * (axis.limits.max + room)))
        self.rotor = axis.motor.inertia + axis.transmission.inertia
        self.inertia = self.rotor + axis.load / self.ratio**2
        self.count = 2 * math.pi / (4 * axis.cpt)  # rad of the motor per quadcount
        self._error = 0.0

    def follow(self, place: float, velocity: float, acceleration: float, seen: float, dt: float) -> float:
        """The current A that a servo asks for: feed-forward of what the axis needs, and a correction of what the encoder, rad, shows."""
        error = place - seen
        w = BANDWIDTH
        torque = self.inertia * (w * w * error + 1.4 * w * (velocity - self.velocity) + 0.3 * w**3 * self._error)
        torque += self.needed(velocity, acceleration)
        asked = torque / self.motor.torque_constant + self._no_load(velocity)
        peak = self.axis.current_peak
        rests = velocity == acceleration == 0 and abs(error) < NEAR * self.count
        if abs(asked) < peak and not rests:  # else it would wind up
            self._error += error * dt
        return max(-peak, min(peak, asked))

    def release(self) -> None:
        """The servo lets go."""
        self._error = 0.0

    def needed(self, velocity: float, acceleration: float) -> float:
        """Torque Nm that the axis needs at the motor, as `axis.motor_torque`."""
        v, a = velocity / self.ratio, acceleration / self.ratio
        way = math.copysign(1.0, v) if v else (math.copysign(1.0, a) if a else 0.0)
        force = self.axis.load * a + self.axis.friction * way + self.axis.gravity
        return self._through(force, way) + self.rotor * acceleration

    def _through(self, force: float, way: float) -> float:
        """Torque at the motor for a force of the axis, N or Nm, while that moves `way`."""
        efficiency = self.axis.transmission.efficiency
        factor = 1.0 if way == 0 else 1 / efficiency if force * way >= 0 else efficiency
        return force / self.ratio * factor

    def _no_load(self, velocity: float) -> float:
        m = self.motor
        if m.commutation == "ec":
            return m.no_load_current * velocity / m.no_load_speed
        return math.copysign(m.no_load_current, velocity) if abs(velocity) > SLACK else 0.0

    def step(self, asked: float, dt: float) -> None:
        """dt s on, with a current A asked for: as much of it as the supply can drive through the warm winding."""
        m = self.motor
        R = m.resistance * (1 + COPPER * (self.winding - REFERENCE))
        back = m.torque_constant * self.velocity
        self.current = max((-self.supply - back) / R, min((self.supply - back) / R, asked))
        torque = m.torque_constant * (self.current - self._no_load(self.velocity))
        loss = m.torque_constant * self._no_load(self.velocity) * self.velocity
        self.winding, self.housing = self.body.step(self.winding, self.housing, self.current, loss, dt)
        if self.blocked:
            self.velocity = 0.0
            return
        before = self.velocity
        self.velocity += self._acceleration(torque) * dt
        if before * self.velocity < 0:  # friction stops, and does not turn round
            self.velocity = 0.0
        self.place += (before + self.velocity) / 2 * dt
        if not self.ends[0] <= self.place <= self.ends[1]:
            self.place, self.velocity = min(max(self.place, self.ends[0]), self.ends[1]), 0.0

    def _acceleration(self, torque: float) -> float:
        """rad/s² that a torque Nm at the motor makes."""
        axis, way = self.axis, math.copysign(1.0, self.velocity / self.ratio) if abs(self.velocity) > SLACK else 0.0
        if way == 0:  # at rest: it goes where the torque goes if friction lets it
            push = torque - self._through(axis.gravity, 0.0)
            if abs(push) <= abs(axis.friction / self.ratio):
                return -self.velocity
            way = math.copysign(1.0, push / self.ratio)
        held = axis.friction * way + axis.gravity
        found = 0.0
        for factor in (1 / axis.transmission.efficiency, axis.transmission.efficiency):
            found = (torque - factor * held / self.ratio) / (self.rotor + factor * axis.load / self.ratio**2)
            if (axis.load * found / self.ratio + held) * way >= 0:  # the motor drives the load
                break
        return found
