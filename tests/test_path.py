"""Simulated cameras that follow the poses of a file."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcmax import open
from torchcmax.cli import main
from torchcmax.core import so3
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.io import DataError
from torchcmax.io.recording import Events
from torchcmax.io.trajectory import write_trajectory
from torchcmax.path import Path
from torchcmax.simulator import Simulation, pose, simulate, velocity, write

SMALL = Simulation(duration=0.06, width=64, height=48, focal=55.0)
ELSEWHERE = Pose(so3.exp(torch.tensor([[0.4, -0.2, 1.1]], dtype=torch.float64)), torch.tensor([[3.0, -1.0, 2.0]], dtype=torch.float64))


def closed_form(time):
    """T_wc of the simulator's own path: [M] µs -> Trajectory."""
    return Trajectory(time, pose(Simulation(), time.double() * 1e-6))


def rough():
    """Few poses at uneven times."""
    return closed_form(torch.tensor([0, 90_000, 130_000, 280_000, 300_000, 420_000, 600_000]))


def test_it_goes_through_every_pose():
    poses = rough()
    there, _ = Path.through(poses).at(poses.time.double() * 1e-6)
    torch.testing.assert_close(there.t, poses.pose.t, rtol=0, atol=1e-12)
    torch.testing.assert_close(there.R, poses.pose.R, rtol=0, atol=1e-12)


def test_dense_poses_give_the_closed_form_between_them():
    path = Path.through(closed_form(torch.arange(0, 300_001, 1000)))
    time = torch.linspace(0.01, 0.29, 997, dtype=torch.float64)
    (there, motion), true, known = path.at(time), pose(Simulation(), time), velocity(Simulation(), time)
    assert (there.t - true.t).norm(dim=-1).max() < 1e-8
    assert so3.log(there.R.mT @ true.R).norm(dim=-1).max() < 1e-8
    assert (motion.velocity - known.velocity).norm(dim=-1).max() < 1e-4  # m/s, of up to 1.3
    assert (motion.omega - known.omega).norm(dim=-1).max() < 1e-4  # rad/s, of up to 4


def test_velocity_is_the_paths_derivative_and_does_not_jump():
    path, h = Path.through(rough()), 1e-5
    time = torch.cat([torch.linspace(-0.02, 0.62, 501, dtype=torch.float64), path.time])
    before, here, after = (path.at(time + s) for s in (-h, 0, h))
    omega = (so3.log(here[0].R.mT @ after[0].R) - so3.log(here[0].R.mT @ before[0].R)) / (2 * h)
    speed = (here[0].R.mT @ (after[0].t - before[0].t)[..., None])[..., 0] / (2 * h)
    assert (omega - here[1].omega).norm(dim=-1).max() < 1e-2  # of up to 4; where acceleration jumps, h times half of that
    assert (speed - here[1].velocity).norm(dim=-1).max() < 1e-2
    assert (after[1].omega - before[1].omega).norm(dim=-1).max() < 2e-2


def test_two_poses_are_a_straight_line():
    turn = torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64)
    ends = Pose(so3.exp(torch.stack([0 * turn, turn])), torch.tensor([[0.0, 0, 0], [0.5, 0, 0]], dtype=torch.float64))
    there, motion = Path.through(Trajectory(torch.tensor([7, 1_000_007]), ends)).at(torch.tensor([0.25], dtype=torch.float64))
    torch.testing.assert_close(so3.log(there.R)[0], turn / 4)
    torch.testing.assert_close(there.t[0], ends.t[1] / 4)
    torch.testing.assert_close(motion.omega[0], turn)


def test_poses_of_the_built_in_path_give_its_recording_in_their_own_world_and_clock(tmp_path):
    known = simulate(SMALL)
    time = known.truth.time
    write_trajectory(tmp_path / "moved.txt", Trajectory(time + 12_345_000, ELSEWHERE @ known.truth.pose))
    options = replace(SMALL, trajectory=str(tmp_path / "moved.txt"), duration=1.0)
    assert options.duration == pytest.approx(0.06)
    again = simulate(options)
    assert again.name == "poster_moved"
    assert torch.equal(again.truth.time, time + 12_345_000)
    torch.testing.assert_close(again.truth.pose.t, (ELSEWHERE @ known.truth.pose).t, rtol=0, atol=1e-9)
    torch.testing.assert_close(again.truth.pose.R, (ELSEWHERE @ known.truth.pose).R, rtol=0, atol=1e-9)
    first = again.plane.seen_from(ELSEWHERE)
    torch.testing.assert_close(first.normal, known.plane.normal)
    torch.testing.assert_close(first.distance, known.plane.distance)


def test_a_slider_is_the_same_from_a_file_event_by_event(tmp_path):
    known = simulate(replace(SMALL, motion="slider"))
    write_trajectory(tmp_path / "slide.txt", Trajectory(known.truth.time + 12_345_000, ELSEWHERE @ known.truth.pose))
    again = simulate(replace(SMALL, trajectory=str(tmp_path / "slide.txt")))
    e, events = (Events.join(list(r.chunks())) for r in (known, again))
    assert len(e) > 300
    assert (len(events), (events.x != e.x).sum(), (events.y != e.y).sum()) == (len(e), 0, 0)
    assert abs(events.t - 12_345_000 - e.t).max() <= 2  # the file tells poses to 1e-12 m, frames are at whole µs


def test_the_command_follows_a_file_and_leaves_a_whole_recording(tmp_path):
    write_trajectory(tmp_path / "slide.txt", closed_form(torch.arange(5_000_000, 5_040_001, 1000)))
    sensor = ["--width", "64", "--height", "48", "--focal", "55"]
    assert main(["simulate", "--trajectory", str(tmp_path / "slide.txt"), *sensor, "--out", str(tmp_path / "out")]) == 0
    recording = open(tmp_path / "out")
    assert int(recording.truth.time[0]) == 5_000_000
    table = np.loadtxt(tmp_path / "out" / "velocity.txt")
    known = velocity(Simulation(), torch.from_numpy(table[2:-2, 0]))
    np.testing.assert_allclose(table[2:-2, 1:], torch.cat([known.velocity, known.omega], -1), atol=1e-3)
    events = Events.join(list(recording.chunks()))
    assert 5_000_000 <= events.t[0] < events.t[-1] <= 5_040_000


def test_what_cannot_be_followed_is_refused(tmp_path):
    name = str(tmp_path / "path.txt")
    with pytest.raises(DataError, match=r"path\.txt"):
        Simulation(trajectory=name)
    poses = closed_form(torch.arange(0, 50_001, 1000))
    write_trajectory(tmp_path / "path.txt", poses)
    with pytest.raises(ValueError, match="speed wants 1, got 2"):
        Simulation(trajectory=name, speed=2.0)
    back = Pose(so3.exp(torch.tensor([0, math.pi, 0], dtype=torch.float64)), torch.tensor([0, 0, 5.0], dtype=torch.float64))
    write_trajectory(tmp_path / "path.txt", Trajectory(poses.time, back @ poses.pose))  # it looks towards the origin, 5 m away
    with pytest.raises(ValueError, match=r"behind the plane.*larger distance than 0.8 m"):
        Simulation(trajectory=name)
    assert Simulation(trajectory=name, distance=6.0).duration == pytest.approx(0.05)
    write_trajectory(tmp_path / "path.txt", Trajectory(poses.time * 20_000, poses.pose))
    with pytest.raises(ValueError, match=r"duration wants 0\.001 to 600 s, got 1000"):
        Simulation(trajectory=name)


def test_a_finished_folder_is_replaced_by_the_same_events(tmp_path):
    write_trajectory(tmp_path / "path.txt", closed_form(torch.arange(1_000_000, 1_030_001, 1000)))
    options = replace(SMALL, trajectory=str(tmp_path / "path.txt"))
    told = []
    write(options, tmp_path / "out", told.append)
    first = (tmp_path / "out" / "groundtruth.txt").read_text()
    assert 0.02 < told[-1] <= 0.031  # seconds that are done, not of the clock
    write(options, tmp_path / "out")
    assert (tmp_path / "out" / "groundtruth.txt").read_text() == first
