"""Ground truth files against the closed form of the motion that the encoders told."""

import dataclasses
import json
import math

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the extra rig is not installed")
from torchcmax.core import so3
from torchcmax.io.trajectory import read_trajectory
from torchcmax.rig.axis import Chain, from_quadcounts, quadcounts, quantum
from torchcmax.rig.clock import ClockModel
from torchcmax.rig.errors import Refused
from torchcmax.rig.truth import ENDED, Encoded, repeatability, sigma, write_truth

CLOCK = ClockModel(12.345, 40e-6, 2e-4, 5e-6, "velocity", 0.8)
TIME = np.arange(2001) * 1e-3


def swing(rig, status=ENDED, **more):
    """Every axis to and fro on a sine, in whole quadcounts."""
    place = np.stack([0.3 * np.sin(2 * np.pi * (k + 1) * TIME) for k in range(len(rig.axes))], -1)
    counted = [from_quadcounts(axis, quadcounts(axis, x)) for axis, x in zip(rig.axes, place.T, strict=True)]
    return Encoded(TIME, np.stack(counted, -1), status, True, **more)


@pytest.mark.parametrize("name", ["slider", "pantilt"])
def test_poses_are_those_of_the_chain_in_the_cameras_clock(name, request, tmp_path):
    rig = request.getfixturevalue(name)
    encoded = swing(rig)
    said = write_truth(tmp_path, rig, encoded, CLOCK)
    first = (tmp_path / "groundtruth.txt").read_text().splitlines()[0]
    assert first.startswith("#")
    assert rig.digest in first
    assert "simulated" in first
    truth, drives = (read_trajectory(tmp_path / f"groundtruth{end}.txt") for end in ("", "_driveclock"))
    pose = Chain(rig).pose(encoded.place)
    np.testing.assert_allclose(truth.pose.t.numpy(), pose[:, :3, 3], atol=1e-11)
    np.testing.assert_allclose(truth.pose.R.numpy(), pose[:, :3, :3], atol=1e-11)
    np.testing.assert_allclose(truth.time.numpy() * 1e-6, 12.345 + (1 + 40e-6) * TIME, atol=0.6e-6)
    np.testing.assert_allclose(drives.time.numpy() * 1e-6, TIME, atol=0.6e-6)
    assert said == json.loads((tmp_path / "truth.json").read_text())
    assert (said["status"], said["simulated"], said["truth"]) == ("complete", True, True)
    assert said["sigma_t"] == pytest.approx(math.hypot(2e-4, 5e-6))  # s, at the ends: 1 s at 5 ppm from mid-run
    assert said["clock"]["accepted"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["groundtruth.txt", "groundtruth_driveclock.txt", "truth.json", "twist.txt"]
    )


@pytest.mark.parametrize("name", ["slider", "pantilt"])
def test_velocities_are_those_of_the_path_and_not_of_the_encoders_steps(name, request, tmp_path):
    rig = request.getfixturevalue(name)
    write_truth(tmp_path, rig, swing(rig), CLOCK)
    table = np.loadtxt(tmp_path / "twist.txt")
    inner = TIME[10:-10]  # the ends lack samples
    np.testing.assert_allclose(table[:, 0], 12.345 + (1 + 40e-6) * inner, atol=0.6e-6)
    place = np.stack([0.3 * np.sin(2 * np.pi * (k + 1) * inner) for k in range(len(rig.axes))], -1)
    rate = np.stack([0.6 * np.pi * (k + 1) * np.cos(2 * np.pi * (k + 1) * inner) for k in range(len(rig.axes))], -1)
    v, omega = Chain(rig).twist(place, rate)
    step = max(abs(quantum(axis)) for axis in rig.axes) / 1e-3  # what differences of single samples jump by: 6 mm/s, 3 deg/s
    np.testing.assert_allclose(table[:, 1:4], v, atol=0.1 * step)
    np.testing.assert_allclose(table[:, 4:], omega, atol=0.1 * step)


def test_velocities_agree_with_differences_of_the_poses(pantilt, tmp_path):
    write_truth(tmp_path, pantilt, swing(pantilt), CLOCK)
    truth, table = read_trajectory(tmp_path / "groundtruth.txt"), np.loadtxt(tmp_path / "twist.txt")
    before, after = truth.pose[500:1500:50], truth.pose[520:1520:50]
    omega = so3.log(before.R.mT @ after.R) / 0.02
    np.testing.assert_allclose(table[500:1500:50, 4:], omega.numpy(), atol=2e-2)  # row 500 is of sample 510, their middle


@pytest.mark.parametrize(
    ("status", "clock"),
    [("aborted: SIGINT", CLOCK), (ENDED, None), (ENDED, dataclasses.replace(CLOCK, reason="another offset fits about as well"))],
)
def test_no_ground_truth_without_a_normal_end_and_an_accepted_clock(slider, tmp_path, status, clock):
    write_truth(tmp_path, slider, swing(slider), CLOCK)
    assert (tmp_path / "groundtruth.txt").exists()
    said = write_truth(tmp_path, slider, swing(slider, status), clock)
    assert not (tmp_path / "groundtruth.txt").exists()
    assert read_trajectory(tmp_path / "groundtruth_driveclock.txt").time[-1] == 2_000_000
    assert (said["status"], said["truth"], said["sigma_t"]) == (status, False, None)
    assert said == json.loads((tmp_path / "truth.json").read_text())
    assert "the drives' clock" in (tmp_path / "twist.txt").read_text().splitlines()[0]


def test_what_is_not_known_is_null(slider, tmp_path):
    lost = ClockModel(0.0, 0.0, math.inf, math.inf, "rate", 0.0, "the camera saw 3 windows")
    write_truth(tmp_path, slider, swing(slider, repeatability={"x": 1e-5}), lost)
    said = json.loads((tmp_path / "truth.json").read_text())  # which has no Infinity
    assert said["clock"]["sigma"] is None
    assert said["clock"]["reason"] == "the camera saw 3 windows"
    assert said["repeatability"] == {"x": 1e-5}


def test_sigma_of_a_position(slider):
    """0.060 m / (4.8 · 2000) is 6.25 µm; the belt's play is 170 µm."""
    (x,) = slider.axes
    assert sigma(x) == pytest.approx(math.hypot(6.25e-6 / math.sqrt(12), 1.7e-4))
    tight = dataclasses.replace(x, transmission=dataclasses.replace(x.transmission, backlash=0.0))
    assert sigma(tight) == pytest.approx(1.804e-6, rel=1e-3)


@pytest.mark.parametrize("status", [ENDED, "aborted: stopped by the user"])
def test_too_few_samples_are_refused_and_are_no_truth(slider, tmp_path, status):
    write_truth(tmp_path, slider, swing(slider), CLOCK)
    few = Encoded(TIME[:20], np.zeros((20, 1)), status, True)
    with pytest.raises(Refused, match="20 samples"):
        write_truth(tmp_path, slider, few, CLOCK)
    said = json.loads((tmp_path / "truth.json").read_text())
    assert (said["status"], said["truth"]) == (status, False)
    assert not (tmp_path / "groundtruth.txt").exists()


def test_repeatability_is_the_spread_of_the_cycles_where_it_is_largest(slider):
    way = np.linspace(0, 0.3, 101)
    off = np.zeros(101)
    off[50] = 1e-3
    place = np.concatenate([way + off, np.full(7, 0.3), way - off])[:, None]  # on its way back it need not be the same
    assert repeatability(slider, place, [(0, 101), (108, 209)]) == {"x": pytest.approx(math.sqrt(2) * 1e-3)}
    assert repeatability(slider, place, [(0, 101)]) is None
    assert repeatability(slider, place, []) is None
