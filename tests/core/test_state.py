"""Where a camera is, what a small step now is later, and where its events meet the plane of the map."""

import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import CLOSEST, SIZE, State
from torchcmax.core.warp import transfer


@pytest.fixture
def state(rand):
    """Four cameras that turn and move."""
    pose = Pose(so3.exp(rand(4, 3) - 0.5), 0.4 * (rand(4, 3) - 0.5))
    return State(pose, Motion(2 * (rand(4, 3) - 0.5), rand(4, 3) - 0.5))


@pytest.fixture
def plane(rand):
    return Plane(Plane.tilted(0.6 * (rand(4, 2) - 0.5)).normal, 1 + rand(4))


@pytest.fixture
def ray(rand):
    return torch.cat([rand(4, 20, 2) - 0.5, torch.ones_like(rand(4, 20, 1))], -1)


@pytest.fixture
def same(close):
    def same(a, b):
        for one, other in zip((a.pose.R, a.pose.t, *rates(a)), (b.pose.R, b.pose.t, *rates(b)), strict=True):
            close(one, other)

    return same


def rates(state):
    return state.motion.omega, state.motion.velocity


def pixels(ray):
    return ray[..., :2] / ray[..., 2:]


def test_a_step_is_found_again_from_where_it_leads(state, rand, close, same):
    p = rand(4, SIZE) - 0.5
    close(state.step_to(state.moved(p)), p)
    same(state.moved(torch.zeros_like(p)), state)


def test_the_step_to_another_state_leads_there(state, rand, same):
    other = state.moved(0.7 * (rand(4, SIZE) - 0.5)).later(0.3 * rand(4))
    same(state.moved(state.step_to(other)), other)


def test_a_step_by_hand():
    """The camera looks along the world's x: its own shift to the right, along x, is one along the world's -z."""
    quarter = so3.exp(torch.tensor([[0.0, torch.pi / 2, 0.0]], dtype=torch.float64))
    rest = torch.zeros(1, 3, dtype=torch.float64)
    state = State(Pose(quarter, rest + 1), Motion(rest, rest))
    p = torch.zeros(1, SIZE, dtype=torch.float64)
    p[0, 1], p[0, 3], p[0, 8], p[0, 11] = -torch.pi / 2, 0.5, 2.0, 3.0
    moved = state.moved(p)
    torch.testing.assert_close(moved.pose.R, torch.eye(3, dtype=torch.float64)[None])
    torch.testing.assert_close(moved.pose.t, torch.tensor([[1.0, 1.0, 0.5]], dtype=torch.float64))
    assert moved.motion.omega.tolist() == [[0, 0, 2]]
    assert moved.motion.velocity.tolist() == [[0, 0, 3]]


def test_later_and_later_again_is_later_by_both(state, rand, same):
    a, b = 0.5 * rand(4), 0.5 * rand(4)
    same(state.later(a).later(b), state.later(a + b))
    same(state.later(a).later(-a), state)


def test_the_velocity_stays_in_the_world(state, rand, close):
    dt = rand(4)
    after = state.later(dt)
    world, world_after = (s.pose.R @ s.motion.velocity[..., None] for s in (state, after))
    close(world, world_after)
    close(after.pose.t, state.pose.t + dt[:, None] * world[..., 0])


def steps_later(state, dt, h=1e-5):
    """`stepping` by central differences, [B, 12, 12]."""
    sides = h * torch.eye(SIZE, dtype=torch.float64)
    after = state.later(dt)
    return torch.stack(
        [(after.step_to(state.moved(p).later(dt)) - after.step_to(state.moved(-p).later(dt))) / (2 * h) for p in sides.unsqueeze(1)], -1
    )


@pytest.mark.parametrize("dtype", [torch.float64], indirect=False)
def test_stepping_is_that_of_central_differences(state, rand):
    dt = 0.2 * rand(4)
    torch.testing.assert_close(state.stepping(dt), steps_later(state, dt), rtol=0, atol=1e-8)


def test_no_time_changes_no_step(state, close):
    F = state.stepping(torch.zeros_like(state.pose.t[:, 0]))
    close(F, torch.eye(SIZE).to(F).expand_as(F))


def test_placement_is_the_transfer_through_the_plane(state, plane, ray, close):
    placed = ray @ state.placement(plane).mT
    close(pixels(placed), pixels(transfer(ray, state.pose[:, None], plane)))


def test_a_placed_ray_meets_the_plane_where_the_camera_sees_it(state, plane, ray, close):
    """Independent of `transfer`: cut both rays with the plane, each from where its eye is."""
    there = state.pose.R[:, None] @ ray[..., None]
    normal, distance, t = plane.normal[:, None], plane.distance[:, None, None], state.pose.t[:, None]
    there = there[..., 0]
    depth = -(distance + (t * normal).sum(-1, keepdim=True)) / (there * normal).sum(-1, keepdim=True)
    placed = ray @ state.placement(plane).mT
    close(pixels(placed), pixels(t + depth * there))


def test_a_view_is_a_turn_behind_the_placement(state, plane, ray, close):
    view = plane.facing()
    placed = transfer(ray, state.pose[:, None], plane) @ view.mT
    close(pixels(ray @ state.placement(plane, view).mT), pixels(placed))


@pytest.mark.parametrize("turned", [False, True])
def test_events_of_all_times_are_transferred_with_the_pose_of_their_time(state, plane, ray, rand, close, turned):
    seconds, s = 0.05 + 0.1 * rand(4), rand(4, 20) - 0.5
    view = plane.facing() if turned else None
    H_k = state.homography(plane, seconds, view)
    H = sum(H_k[:, None, k] * s[..., None, None] ** k for k in range(H_k.shape[1]))
    pose = state.pose[:, None] @ state.motion.at(s * seconds[:, None])
    expected = transfer(ray, pose, plane)
    close(pixels((H @ ray[..., None])[..., 0]), pixels(expected if view is None else expected @ view.mT))


def test_the_middle_of_a_window_is_placed_and_nothing_else(state, plane, rand, close):
    close(state.homography(plane, 0.1 * rand(4))[:, 0], state.placement(plane))


def test_a_camera_cannot_come_nearer_than_it_may(state, plane):
    behind = State(Pose(state.pose.R, -2 * plane.distance[:, None] * plane.normal), state.motion)
    assert (behind.seen(plane).distance == CLOSEST).all()
    assert behind.homography(plane, torch.full_like(plane.distance, 0.1)).isfinite().all()


def test_cameras_are_joined_in_their_order(state, same):
    same(State.join([state[:1], state[1:3], state[torch.tensor([3])]]), state)
