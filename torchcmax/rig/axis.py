"""Between axis and motor, and between the axes and the camera."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from torchcmax.rig.config import Axis, Rig

RPM = math.pi / 30  # rad/s
Array = np.ndarray


def reduction(axis: Axis) -> float:
    """Turn of the motor per way of the axis, rad/m or rad/rad, with its sign."""
    ratio = 2 * math.pi * axis.transmission.ratio / axis.transmission.travel
    return -ratio if axis.invert else ratio


def to_motor(axis: Axis, x: ArrayLike) -> Array:
    """Axis -> motor: positions m, rad -> rad; velocities and accelerations likewise."""
    return np.asarray(x) * reduction(axis)


def from_motor(axis: Axis, angle: ArrayLike) -> Array:
    """Motor -> axis."""
    return np.asarray(angle) / reduction(axis)


def quadcounts(axis: Axis, x: ArrayLike) -> Array:
    """Positions m, rad -> int64 of the encoder on the motor's shaft, nearest."""
    return np.rint(np.asarray(x) / quantum(axis)).astype(np.int64)


def from_quadcounts(axis: Axis, counts: ArrayLike) -> Array:
    """int -> m, rad."""
    return np.asarray(counts) * quantum(axis)


def quantum(axis: Axis) -> float:
    """Way of the axis per quadcount, m or rad, with its sign."""
    return 2 * math.pi / (4 * axis.cpt) / reduction(axis)


def drivable(axis: Axis, value: float) -> float:
    """The largest speed, or acceleration, not above the value that a drive can be told: whole rpm, rpm/s of the motor."""
    step = RPM / abs(reduction(axis))
    return math.floor(value / step * (1 + 1e-12)) * step


def inertia(axis: Axis) -> float:
    """Everything that turns or moves, at the motor, kg m²."""
    return axis.motor.inertia + axis.transmission.inertia + axis.load / reduction(axis) ** 2


def motor_torque(axis: Axis, v: ArrayLike, a: ArrayLike) -> Array:
    """Torque Nm at the motor's shaft, in its direction, that the axis needs at velocity v and acceleration a.

    Losses of the transmission add to what the motor gives, and take from what the load gives back.  At rest the axis is about to move to
    where it accelerates.
    """
    v, a = np.asarray(v, float), np.asarray(a, float)
    way = np.where(v != 0, np.sign(v), np.sign(a))
    force = axis.load * a + axis.friction * way + axis.gravity
    driving = force * way >= 0
    load: Array = force / reduction(axis) * np.where(driving, 1 / axis.transmission.efficiency, axis.transmission.efficiency)
    return load + (axis.motor.inertia + axis.transmission.inertia) * to_motor(axis, a)


class Chain:
    """The axes of a rig one after the other, from the base to the camera, or to the scene where that moves."""

    def __init__(self, rig: Rig) -> None:
        self.axes, self.scene = rig.axes, rig.moves == "scene"
        self.base, self.end = matrix(rig.base), matrix(rig.camera)
        self.screws = np.stack([_screw(axis) for axis in rig.axes])

    def pose(self, q: Array) -> Array:
        """Positions [M, axes] -> T_wc [M, 4, 4]."""
        transform = self._forward(q)[0]
        return inverse(transform) if self.scene else transform

    def twist(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Positions and velocities [M, axes] -> v m/s, omega rad/s of the camera in its frame, [M, 3] each.

        R(t+dt) = R exp(omega^ dt) and t(t+dt) = t + R v dt, as in the thesis, equations 2.7 to 2.16.
        """
        transform, rests = self._forward(q)
        v, omega = np.zeros((len(q), 3)), np.zeros((len(q), 3))
        for k, rest in enumerate(rests):
            seen = inverse(rest)
            turn = seen[:, :3, :3] @ self.screws[k, 3:]
            move = seen[:, :3, :3] @ self.screws[k, :3] + np.cross(seen[:, :3, 3], turn)
            v, omega = v + move * qd[:, k, None], omega + turn * qd[:, k, None]
        if not self.scene:
            return v, omega
        R, t = transform[:, :3, :3], transform[:, :3, 3]
        omega = (R @ omega[..., None])[..., 0]
        return -((R @ v[..., None])[..., 0] + np.cross(t, omega)), -omega

    def _forward(self, q: Array) -> tuple[Array, list[Array]]:
        """The whole chain [M, 4, 4], and from before each joint to its end."""
        q = np.asarray(q, float)
        rests: list[Array] = []
        transform = np.broadcast_to(self.end, (len(q), 4, 4))
        for k in reversed(range(len(self.axes))):
            transform = _exp(self.screws[k], q[:, k]) @ transform
            rests.insert(0, transform)
        return self.base @ transform, rests


def matrix(pose: tuple[float, ...]) -> Array:
    """x y z qx qy qz qw -> [4, 4]."""
    x, y, z, w = pose[3:]
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = pose[:3]
    return out


def inverse(transform: Array) -> Array:
    """Of rigid motions [M, 4, 4]."""
    out = np.zeros_like(transform)
    back = np.swapaxes(transform[:, :3, :3], 1, 2)
    out[:, :3, :3], out[:, 3, 3] = back, 1
    out[:, :3, 3] = -(back @ transform[:, :3, 3:])[..., 0]
    return out


def _screw(axis: Axis) -> Array:
    """v, omega [6] of the axis at unit speed, in the parent's frame."""
    direction = np.array(axis.direction)
    if axis.kind == "linear":
        return np.concatenate([direction, np.zeros(3)])
    return np.concatenate([np.cross(axis.point, direction), direction])


def _exp(screw: Array, q: Array) -> Array:
    """Motions [M, 4, 4] by q [M] along a screw without pitch."""
    v, omega = screw[:3], screw[3:]
    out = np.tile(np.eye(4), (len(q), 1, 1))
    if not omega.any():
        out[:, :3, 3] = q[:, None] * v
        return out
    hat = np.array([[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]])
    sin, cos = np.sin(q)[:, None, None], np.cos(q)[:, None, None]
    out[:, :3, :3] += sin * hat + (1 - cos) * hat @ hat
    point = np.cross(omega, v)  # of the axis that is nearest to the origin
    out[:, :3, 3] = point - out[:, :3, :3] @ point
    return out
