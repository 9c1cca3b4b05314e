import math

import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.pose import Motion, Pose, Trajectory


@pytest.fixture
def pose(rand):
    return Pose(so3.exp(rand(4, 3)), rand(4, 3))


def test_a_pose_times_its_inverse_is_nothing(pose, close):
    nothing = pose @ pose.inverse()
    close(nothing.R, torch.eye(3).to(nothing.R).expand(4, 3, 3))
    close(nothing.t, torch.zeros_like(nothing.t))


def test_composed_poses_carry_points_one_after_the_other(pose, rand, close):
    point = rand(4, 3, 1)
    other = Pose(pose.R.mT, 2 * pose.t)
    both = pose @ other
    close(both.R @ point + both.t[..., None], pose.R @ (other.R @ point + other.t[..., None]) + pose.t[..., None])


def test_constant_motion_for_two_stretches_is_one_for_both(rand, close):
    motion = Motion(rand(2, 3), torch.zeros_like(rand(2, 3)))
    half, whole = motion.at(torch.full_like(rand(2, 1), 0.1)), motion.at(torch.full_like(rand(2, 1), 0.2))
    close((half @ half).R, whole.R)


@pytest.fixture
def circle():
    """A camera that goes round a circle in four seconds and looks outwards, given every 10 ms."""
    seconds = torch.arange(0, 4.001, 0.01, dtype=torch.float64)
    turn = torch.stack([0 * seconds, seconds * math.pi / 2, 0 * seconds], -1)
    R = so3.exp(turn)
    return Trajectory((seconds * 1e6).round().long(), Pose(R, R[..., 2]))


def test_a_trajectory_is_exact_at_its_own_times_and_smooth_between(circle):
    torch.testing.assert_close(circle.at(circle.time).R, circle.pose.R)
    between = circle.at(torch.tensor([1_005_000, 2_345_678]))
    angle = torch.tensor([1.005, 2.345678], dtype=torch.float64) * math.pi / 2
    torch.testing.assert_close(between.t[:, 0], angle.sin(), rtol=0, atol=5e-5)
    torch.testing.assert_close(so3.log(between.R)[:, 1].abs(), angle.where(angle < math.pi, 2 * math.pi - angle), rtol=0, atol=1e-9)


def test_mean_motion_over_a_window_leads_from_its_start_to_its_end(circle):
    start, duration = torch.tensor([500_000, 1_230_000]), torch.tensor([0.1, 0.05], dtype=torch.float64)
    motion = circle.motion(start, duration)
    torch.testing.assert_close(motion.omega[:, 1], torch.full((2,), math.pi / 2, dtype=torch.float64))
    end = motion.following(circle.at(start), duration)
    expected = circle.at(start + (duration * 1e6).long())
    torch.testing.assert_close(end.t, expected.t)
    torch.testing.assert_close(end.R, expected.R)


def test_a_time_outside_the_trajectory_is_named(circle):
    with pytest.raises(ValueError, match=r"covers 0\.\.4000000 us, asked for 4000001 us"):
        circle.at(torch.tensor([0, 4_000_001]))
