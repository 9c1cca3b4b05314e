"""Consecutive windows before one plane: the chain of their poses, how it follows each motion, and what sharpens all together."""

import math
from dataclasses import replace

import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.draw import Ink, draw
from torchcmax.core.joint import (
    Common,
    Frames,
    Joint,
    areas,
    canvas_of,
    carried,
    chained,
    following,
    onto,
    optimize_chain,
    products,
    rates,
    tilted,
    whitened_chain,
)
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import SIZE, State
from torchcmax.core.warp import monomials, transfer, warp

DOUBLE, FOCAL, SECONDS = torch.float64, 100.0, 0.04


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def equal(a, b, tolerance=1e-10):
    torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


def path(count):
    """Windows of a camera that moves with constant velocity, the first at the world's origin in its middle."""
    rest = State(
        Pose(torch.eye(3, dtype=DOUBLE)[None], torch.zeros(1, 3, dtype=DOUBLE)),
        Motion(torch.tensor([[0.3, -0.5, 0.8]], dtype=DOUBLE), torch.tensor([[0.9, 0.5, -0.4]], dtype=DOUBLE)),
    )
    return State.join([rest.later(torch.tensor([SECONDS * i], dtype=DOUBLE)) for i in range(count)])


def pattern(plane):
    """Points of the plane on the edges of twenty squares: [M, 3]."""
    centre, turn = 1.2 * (rand(20, 2, seed=1) - 0.5), 3 * rand(20, seed=2)
    side = (torch.arange(25).double() / 25)[:, None] * torch.tensor([[2.0, 0.0]]) - 1
    square = torch.cat([side, side.flip(1), -side, -side.flip(1)]) * 0.06
    R = torch.stack([turn.cos(), -turn.sin(), turn.sin(), turn.cos()], -1).view(20, 2, 2)
    flat = (centre[:, None] + square @ R.mT).flatten(0, 1)
    return plane.across()[0].mT @ flat[..., None] - (plane.normal * plane.distance[:, None]).mT


def scene(count=8, events=700, tilt=(0.25, -0.2)):
    """Frames at the truth: each event is a point of the plane, seen at its time from where the camera is."""
    plane = Plane.tilted(torch.tensor([tilt], dtype=DOUBLE))
    points, states, seconds = pattern(plane)[..., 0], path(count), torch.full((count,), SECONDS, dtype=DOUBLE)
    s = rand(count, events, seed=3).sort(-1).values - 0.5
    pose = states.pose[:, None] @ states.motion.at(s * SECONDS)
    inverse = pose.inverse()
    which = (rand(count, events, seed=4) * len(points)).long()
    seen = (inverse.R @ points[which][..., None])[..., 0] + inverse.t
    ink = Ink(seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2], s, torch.ones_like(s))
    return Frames(states, seconds, ink, plane)


def off(frames, size, tilt=(0.0, 0.0), seed=9):
    """The frames with motions that are wrong by up to `size` px of a window, and with another plane."""
    wrong = 2 * size * (rand(len(frames), 6, seed=seed) - 0.5) * rates(frames, FOCAL)
    motion = frames.state.motion
    state = State(frames.state.pose, Motion(motion.omega + wrong[:, :3], motion.velocity + wrong[:, 3:]))
    return replace(frames, state=state, plane=tilted(frames.plane, torch.tensor(tilt, dtype=DOUBLE)))


def common_of(frames, how, middle):
    """As optimize_chain makes it."""
    way, eye = chained(frames, FOCAL, middle), frames.state.pose[middle : middle + 1]
    H_k = onto(way(torch.zeros(6 * len(frames), dtype=DOUBLE)), frames.plane, frames.seconds, eye)
    canvas, whiten = canvas_of(H_k, frames.ink.sample(60), FOCAL), whitened_chain(frames, FOCAL, eye, middle)
    return Common(frames, way, eye, canvas, how, whiten, areas(H_k))


def apart(found, truth):
    """px rms between where the events of all frames are seen and where they are, from the eye of the middle frame."""
    middle, xy = len(truth) // 2, []
    for frames in (found, truth):
        ray = truth.ink.warped(onto(frames.state, frames.plane, truth.seconds, truth.state.pose[middle : middle + 1]))
        xy.append(FOCAL * ray[..., :2] / ray[..., 2:])
    return float((xy[0] - xy[1]).square().sum(-1).mean().sqrt())


@pytest.mark.parametrize("count", [1, 2, 5, 8, 9])
def test_products_are_those_one_after_the_other(count):
    steps = Pose(so3.exp(rand(count - 1, 3) - 0.5), rand(count - 1, 3, seed=1) - 0.5)
    found = products(steps)
    assert found.R.shape == (count, 3, 3)
    last = Pose(torch.eye(3, dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE))
    for i in range(count):
        equal(found.R[i], last.R)
        equal(found.t[i], last.t)
        last = last @ steps[i] if i < count - 1 else last


@pytest.mark.parametrize("middle", [0, 3, 7])
def test_a_chain_of_constant_velocity_goes_through_the_states_of_a_camera_that_has_it(middle):
    frames = scene(events=10)
    states = chained(frames, FOCAL, middle)(torch.zeros(6 * len(frames), dtype=DOUBLE))
    equal(frames.state.step_to(states), torch.zeros(8, SIZE, dtype=DOUBLE))


def test_in_a_chain_one_window_begins_where_the_last_one_ends():
    frames = scene(events=10)
    states = chained(frames, FOCAL, 3)(2 * (rand(48) - 0.5))
    half = frames.seconds[:, None] / 2
    ends, starts = states.pose @ states.motion.at(half)[:, 0], states.pose @ states.motion.at(-half)[:, 0]
    equal(ends.R[:-1], starts.R[1:])
    equal(ends.t[:-1], starts.t[1:])
    equal(states.pose.R[3], frames.state.pose.R[3])  # the middle one stays
    equal(states.pose.t[3], frames.state.pose.t[3])


@pytest.mark.parametrize("middle", [0, 2, 4])
def test_the_states_of_a_chain_follow_its_numbers_as_central_differences_do(middle):
    frames = off(scene(count=5, events=10), 3.0)
    way, h = chained(frames, FOCAL, middle), 1e-4
    here = way(torch.zeros(30, dtype=DOUBLE))
    found = following(replace(frames, state=here), rates(frames, FOCAL), middle)
    sides = h * torch.eye(30, dtype=DOUBLE)
    expected = torch.stack([(here.step_to(way(side)) - here.step_to(way(-side))) / (2 * h) for side in sides], -1)
    equal(found, expected, 1e-9)
    assert expected[middle, :6].abs().max() < 1e-12


def test_a_small_step_is_carried_into_another_camera_s_frame():
    here, there = (Pose(so3.exp(rand(3, 3, seed=i) - 0.5), rand(3, 3, seed=i + 2) - 0.5) for i in (0, 1))
    step = 1e-6 * (rand(3, 6, seed=7) - 0.5)
    moved = here @ Pose(so3.exp(step[:, :3]), step[:, 3:])
    rest = (there.inverse() @ here).inverse()  # a rigid body: `there` goes along
    after = there.inverse() @ moved @ rest
    found = (carried(there.inverse() @ here) @ step[..., None])[..., 0]
    equal(torch.cat([so3.log(after.R), after.t], -1), found, 1e-11)


def test_events_are_seen_by_the_eye_as_their_points_of_the_plane_are():
    frames = off(scene(count=3, events=50), 2.0, (0.1, 0.1))
    eye = Pose(so3.exp(torch.tensor([[0.1, -0.2, 0.3]], dtype=DOUBLE)), torch.tensor([[0.1, 0.2, -0.1]], dtype=DOUBLE))
    found = frames.ink.warped(onto(frames.state, frames.plane, frames.seconds, eye))
    pose = frames.state.pose[:, None] @ frames.state.motion.at(frames.ink.s * SECONDS)
    relative = eye.inverse()[:, None] @ pose
    expected = transfer(frames.ink.ray.mT, relative, frames.plane.seen_from(eye).repeated(3))
    equal(found[..., :2] / found[..., 2:], expected[..., :2] / expected[..., 2:], 1e-8)


def test_rays_of_events_are_those_of_the_warp():
    frames = scene(count=3, events=50)
    H_k = onto(frames.state, frames.plane, frames.seconds, frames.state.pose[1:2])
    equal(frames.ink.warped(H_k), warp(H_k, monomials(frames.ink.ray.mT, frames.ink.s)).mT)


def test_the_common_canvas_holds_the_events_and_not_much_more():
    frames = scene()
    H_k = onto(frames.state, frames.plane, frames.seconds, frames.state.pose[4:5])
    canvas = canvas_of(H_k, frames.ink, FOCAL)
    drawn = draw(H_k, frames.ink, canvas, torch.arange(8)).sum((1, 2))
    equal(drawn, torch.full((8,), 700.0, dtype=DOUBLE), 1e-6)
    xy = canvas.pixels(frames.ink.warped(H_k)).flatten(0, 1)
    extent = xy.amax(0) - xy.amin(0)
    assert canvas.size[1] < 1.3 * extent[0] + 20
    assert canvas.size[0] < 1.3 * extent[1] + 20


def test_one_whitened_unit_moves_each_coordinate_of_the_events_by_about_a_pixel():
    frames = scene()
    common = common_of(frames, Joint(), 4)
    here = FOCAL * common_places(common, torch.zeros(50, dtype=DOUBLE))
    for seed in range(5):
        y = torch.nn.functional.normalize(rand(50, seed=seed) - 0.5, dim=0)
        rms = (FOCAL * common_places(common, 0.1 * y) - here).square().mean().sqrt()
        assert 0.085 < rms < 0.115


def common_places(common, y):
    states, plane = common.at(y)
    ray = common.frames.ink.warped(onto(states, plane, common.frames.seconds, common.eye))
    return ray[..., :2] / ray[..., 2:]


@pytest.mark.parametrize("contrast", ["gradient_magnitude", "variance"])
def test_the_gradient_of_the_common_cost_is_that_of_central_differences(contrast):
    common = common_of(off(scene(count=4, events=200), 2.0), Joint(contrast, sigma=2.0, deformation=1.0001), 2)
    y, h = 0.5 * (rand(26, seed=5) - 0.5), 1e-4
    (gradient,) = torch.autograd.grad(common.cost(y.requires_grad_()), y)
    y = y.detach()
    for p in range(0, 26, 5):
        side = torch.zeros(26, dtype=DOUBLE)
        side[p] = h
        difference = float((common.cost(y + side) - common.cost(y - side)) / (2 * h))
        assert gradient[p].item() == pytest.approx(difference, rel=5e-3, abs=1e-5)


def test_the_guard_by_hand():
    """Areas that shrink to a quarter are log 4 - log 1.5 too small; a camera 0.02 before the plane is 0.1 too near."""
    frames = scene(count=2, events=10, tilt=(0.0, 0.0))
    rest = State(Pose(torch.eye(3, dtype=DOUBLE).expand(2, 3, 3), torch.zeros(2, 3, dtype=DOUBLE)), frames.state.motion)
    common = replace(common_of(frames, Joint(), 1), first=torch.zeros(2, 2, dtype=DOUBLE))
    same = torch.zeros(2, 6, 3, 3, dtype=DOUBLE)
    same[:, 0] = torch.eye(3)
    half = same * torch.tensor([0.5, 0.5, 1.0])[:, None]
    assert common.strain(same, rest, frames.plane) == 0
    for shrunk in (half, 4 * half, same * torch.tensor([2.0, 2.0, 1.0])[:, None]):  # a homography has no scale; growth is as bad
        assert common.strain(shrunk, rest, frames.plane).item() == pytest.approx(10 * math.log(4 / 1.5) ** 2)
    assert common.strain(torch.cat([half[:1], same[:1]]), rest, frames.plane).item() == pytest.approx(5 * math.log(4 / 1.5) ** 2)
    near = State(Pose(rest.pose.R, torch.tensor([[0, 0, 0.0], [0, 0, 0.98]], dtype=DOUBLE)), rest.motion)
    assert common.strain(same, near, frames.plane).item() == pytest.approx(10 * 0.1**2 / 2)


def test_changes_of_the_motion_by_hand():
    """One of two changes is of half a sigma in one of six numbers; windows of 0.04 s and a camera that may change by 20 rad/s^2."""
    frames = scene(count=3, events=10)
    common = common_of(frames, Joint(steady=2.4), 1)
    omega, still = torch.zeros(3, 3, dtype=DOUBLE), torch.ones(3, 3, dtype=DOUBLE)
    omega[2, 1] = 0.5 * 20 * SECONDS
    assert common.jerk(Motion(omega, still)).item() == pytest.approx(2.4 * 0.5**2 / 12)
    assert common.jerk(Motion(still, still)) == 0
    velocity = still + torch.tensor([[0.0], [8 * SECONDS], [0.0]])  # there and back again, by a sigma in three numbers each
    assert common.jerk(Motion(still, velocity)).item() == pytest.approx(2.4 * 6 / 12, rel=1e-5)
    alone = scene(count=1, events=10)
    assert common_of(alone, Joint(), 0).jerk(alone.state.motion) == 0


@pytest.mark.parametrize("free", [(True, False), (False, True)])
def test_what_is_not_free_stays_as_it_is(free):
    start = off(scene(count=4, events=300), 2.0)
    solved = optimize_chain(replace(start, free=free), FOCAL, Joint(), 2)
    for name, goes in zip(("omega", "velocity"), free, strict=True):
        assert torch.equal(getattr(solved.frames.state.motion, name), getattr(start.state.motion, name)) != goes
    assert solved.contrast > solved.before


def test_collapse_is_sharper_and_does_not_pay():
    """Cameras that are all nearer, and slower by as much, draw the same picture smaller, so with more events in a pixel."""
    frames, y = scene(), torch.zeros(50, dtype=DOUBLE)
    foot = -frames.plane.normal * frames.plane.distance[:, None]
    state = frames.state
    nearer = State(Pose(state.pose.R, foot + 0.3 * (state.pose.t - foot)), Motion(state.motion.omega, 0.3 * state.motion.velocity))
    for guard, pays in ((0.0, True), (10.0, False)):
        common = common_of(frames, Joint(guard=guard), 4)
        assert (replace(common, way=lambda x: nearer).cost(y) < common.cost(y)) == pays


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])
def test_motions_and_plane_of_consecutive_windows_are_found(dtype):
    truth = scene()
    ink = Ink(*(getattr(truth.ink, n).to(dtype) for n in ("x", "y", "s", "weight")))
    start = replace(off(truth, 2.0, (0.15, 0.1)), ink=ink)
    first = replace(start, state=chained(start, FOCAL, 4)(torch.zeros(48, dtype=DOUBLE)))
    solved = optimize_chain(start, FOCAL, Joint(), 4)
    assert solved.contrast > 1.3 * solved.before
    assert apart(first, truth) > 2
    assert apart(solved.frames, truth) < 0.3
    angle = (solved.frames.plane.normal * truth.plane.normal).sum().clamp(max=1).acos()
    assert angle < math.radians(2.5)
    ahead = solved.frames.state.motion.velocity - truth.state.motion.velocity
    assert ahead.norm(dim=-1).max() < 0.15


def test_at_the_truth_hardly_anything_is_left_to_gain():
    solved = optimize_chain(scene(), FOCAL, Joint(), 4)
    assert solved.before <= solved.contrast < 1.02 * solved.before
    assert apart(solved.frames, scene()) < 0.1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_contrast_never_falls(seed):
    start = off(scene(count=4, events=300), 4.0, seed=seed)
    solved = optimize_chain(start, FOCAL, Joint(), 2)
    assert solved.contrast >= solved.before
    y = torch.zeros(26, dtype=DOUBLE)
    common = common_of(start, Joint(), 2)
    assert solved.before == pytest.approx(math.exp(-float(common.cost(y))), rel=1e-9)


def test_torch_lbfgs_finds_the_same_minimum():
    start, how = off(scene(count=4), 1.0), Joint()
    common, y = common_of(start, how, 2), torch.zeros(26, dtype=DOUBLE, requires_grad=True)
    optimizer = torch.optim.LBFGS([y], max_iter=150, line_search_fn="strong_wolfe", tolerance_grad=1e-9, tolerance_change=1e-12)

    def closure():
        optimizer.zero_grad()
        cost = common.cost(y)
        cost.backward()
        return cost

    optimizer.step(closure)
    solved = optimize_chain(start, FOCAL, how, 2)
    lowest, states, plane = float(common.cost(y.detach())), *common.at(y.detach())
    assert -math.log(solved.contrast) == pytest.approx(lowest, abs=2e-3)
    assert apart(replace(start, state=states, plane=plane), solved.frames) < 0.1


@pytest.mark.parametrize("wrong", [{"contrast": "beauty"}, {"sigma": -1.0}, {"deformation": 1.0}, {"acceleration": (0.0, 1.0)}])
def test_a_joint_without_sense_is_refused(wrong):
    with pytest.raises(ValueError, match=r"none of|joint wants"):
        Joint(**wrong)
