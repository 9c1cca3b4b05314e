"""Transmissions against hand-made numbers, the chain's twist against differences of its pose."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcmax.rig.axis import Chain, drivable, from_motor, from_quadcounts, inertia, inverse, matrix, motor_torque, quadcounts, to_motor

EVERY = st.integers(-(2**31) + 1, 2**31 - 1)


def test_a_metre_of_belt(slider):
    (x,) = slider.axes
    assert to_motor(x, 0.060) == pytest.approx(4.8 * 2 * math.pi)
    assert quadcounts(x, 0.060) == 4.8 * 2000
    assert from_motor(x, to_motor(x, 0.123)) == pytest.approx(0.123)


@given(count=EVERY)
def test_quadcounts_come_back(slider, pantilt, count):
    for axis in (*slider.axes, *pantilt.axes):
        assert quadcounts(axis, from_quadcounts(axis, count)) == count


def test_an_inverted_axis_counts_backwards(slider):
    (x,) = slider.axes
    back = dataclasses.replace(x, invert=True)
    assert quadcounts(back, 0.2) == -quadcounts(x, 0.2)
    assert motor_torque(back, 0.5, 3.0) == -motor_torque(x, 0.5, 3.0)
    assert inertia(back) == inertia(x)


def test_a_drive_is_told_whole_rpm(slider):
    (x,) = slider.axes
    assert drivable(x, 1.0) == pytest.approx(1.0, rel=1e-12)  # 4800 rpm
    assert drivable(x, 1.0001) == pytest.approx(1.0, rel=1e-12)
    assert drivable(x, 0.0001) == 0


def test_torque_of_a_pass(slider):
    """2 kg at 12 m/s² and 3 N of friction, on 0.060 m / (2 pi 4.8) of lever."""
    (x,) = slider.axes
    lever = 0.060 / (2 * math.pi * 4.8)
    rotor = 21.9e-7 * 12 / lever
    assert motor_torque(x, 0.5, 12.0) == pytest.approx(27 * lever / 0.85 + rotor)
    assert motor_torque(x, 0.0, 12.0) == pytest.approx(27 * lever / 0.85 + rotor)
    assert motor_torque(x, 0.5, -12.0) == pytest.approx(-21 * lever * 0.85 - rotor)
    assert motor_torque(x, -0.5, -12.0) == pytest.approx(-27 * lever / 0.85 - rotor)
    assert motor_torque(x, 0.5, 0.0) == pytest.approx(3 * lever / 0.85)
    assert motor_torque(x, 0.0, 0.0) == 0
    heavy = dataclasses.replace(x, gravity=20.0)
    assert motor_torque(heavy, -0.5, 0.0) == pytest.approx(17 * lever * 0.85)


def test_inertia_takes_the_same_power_as_torque(slider):
    """Without losses, torque is inertia times angular acceleration."""
    (x,) = slider.axes
    free = dataclasses.replace(x, friction=0.0, transmission=dataclasses.replace(x.transmission, efficiency=1.0, inertia=1e-6))
    assert motor_torque(free, 1.0, 7.0) == pytest.approx(inertia(free) * to_motor(free, 7.0))


def test_a_slider_moves_the_camera_along(slider):
    T = Chain(slider).pose(np.array([[0.3]]))
    np.testing.assert_allclose(T[0], [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-15)


def test_tilt_rides_on_pan(pantilt):
    """By 90 deg each: the camera 0.06 before and 0.03 under the tilt's axis, at (0, 0.05, 0), looks up where it looked ahead."""
    T = Chain(pantilt).pose(np.radians([[90.0, 90.0]]))[0]
    np.testing.assert_allclose(T[:3, 2], [0, -1, 0], atol=1e-15)  # of tilt alone, and pan about that axis leaves it
    np.testing.assert_allclose(T[:3, 3], [-0.03, 0.05 - 0.06, 0], atol=1e-15)


def random_rig(rig, seed, moves):
    """Three axes of random kinds, directions and points, between random base and camera."""
    rng = np.random.default_rng(seed)
    axis = rig.axes[0]

    def unit(n):
        v = rng.normal(size=n)
        return tuple(v / np.linalg.norm(v))

    axes = tuple(
        dataclasses.replace(axis, name=str(k), kind=rng.choice(["linear", "rotary"]), direction=unit(3), point=tuple(rng.normal(size=3)))
        for k in range(3)
    )
    poses = [(*rng.normal(size=3), *unit(4)) for _ in range(2)]
    return dataclasses.replace(rig, axes=axes, moves=moves, camera=poses[0], base=poses[1]), rng


@pytest.mark.parametrize("moves", ["camera", "scene"])
@pytest.mark.parametrize("seed", range(10))
def test_twist_is_the_difference_of_poses(slider, seed, moves):
    rig, rng = random_rig(slider, seed, moves)
    chain, step = Chain(rig), 1e-5
    q, qd = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    v, omega = chain.twist(q, qd)
    before, T, after = (chain.pose(q + s * qd) for s in (-step, 0, step))
    R = T[:, :3, :3]
    change = np.swapaxes(R, 1, 2) @ (after - before)[:, :3] / (2 * step)
    np.testing.assert_allclose(change[:, :, 3], v, atol=1e-8)
    hat = np.cross(np.eye(3)[None], omega[:, None])  # rows e_i x omega: omega^
    np.testing.assert_allclose(change[:, :, :3], hat, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_a_moving_scene_is_the_inverse(slider, seed):
    rig, rng = random_rig(slider, seed, "camera")
    q = rng.normal(size=(5, 3))
    product = Chain(rig).pose(q) @ Chain(dataclasses.replace(rig, moves="scene")).pose(q)
    np.testing.assert_allclose(product, np.tile(np.eye(4), (5, 1, 1)), atol=1e-12)


def test_inverse_of_a_matrix():
    T = matrix((1, 2, 3, 0.5, 0.5, 0.5, 0.5))
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(inverse(T[None])[0] @ T, np.eye(4), atol=1e-15)
