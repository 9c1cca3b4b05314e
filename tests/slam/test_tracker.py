"""One window against the map: what is predicted, how fast the image moves, where a state may go, and what a step finds."""

from dataclasses import replace

import pytest
import torch
from scenes import drawn, map_of, pixels, state_of, wall

from torchcmax.core import so3
from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.match import NUMBERS, Matching, units
from torchcmax.core.pose import Motion
from torchcmax.core.state import SIZE, State
from torchcmax.slam.tracker import Belief, Sight, Tracking, basis_of, front, rays_of, speed, step

CAMERA = Camera.pinhole((90, 120), 100 / 120)
ACCELERATION = 20.0, 8.0
STATES = {
    "still": state_of(),
    "moving": state_of((0.1, -0.2, 0.3), (0.2, 0.1, -0.3), (1.0, -2.0, 0.5), (0.4, 0.6, -0.8)),
    "turning": state_of((0.4, 0.1, 0.0), (0.0, 0.0, 0.0), (3.0, 1.0, -4.0)),
}


def belief(state, sigma=0.01):
    random = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Belief(torch.tensor([1000]), state, (sigma**2 * (random @ random.mT + torch.eye(SIZE)))[None])


@pytest.mark.parametrize("name", STATES)
def test_the_covariance_of_a_prediction_is_symmetric_positive_and_grows(name):
    now = belief(STATES[name])
    sizes = []
    for us in (1000, 6000, 21_000, 101_000):
        then = now.at(torch.tensor([us]), ACCELERATION)
        covariance = then.covariance[0]
        torch.testing.assert_close(covariance, covariance.mT, rtol=1e-12, atol=1e-15)
        assert float(torch.linalg.eigvalsh(covariance).min()) > 0
        sizes.append(float(torch.linalg.slogdet(covariance).logabsdet))
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[1]


def test_at_its_own_time_a_belief_is_itself():
    now = belief(STATES["moving"])
    same = now.at(now.time, ACCELERATION)
    torch.testing.assert_close(same.covariance, now.covariance)
    torch.testing.assert_close(same.state.step_to(now.state), torch.zeros(1, SIZE, dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_prediction_says_what_accelerations_do_in_the_time():
    """From certainty: sigma dt^2 / 2 of the pose, sigma dt of the motion, and both are the same chance."""
    sure = Belief(torch.tensor([0]), STATES["still"], torch.zeros(1, SIZE, SIZE, dtype=torch.float64))
    sigma = sure.at(torch.tensor([100_000]), ACCELERATION).covariance[0].diagonal().sqrt()
    wanted = torch.tensor([0.1] * 3 + [0.04] * 3 + [2.0] * 3 + [0.8] * 3, dtype=torch.float64)
    torch.testing.assert_close(sigma, wanted)


def test_beliefs_of_several_cameras_are_predicted_as_each_alone():
    both = [belief(STATES["moving"]), replace(belief(STATES["turning"], 0.02), time=torch.tensor([3000]))]
    together = Belief.join(both).at(torch.tensor([9000, 15_000]), ACCELERATION)
    for i, (one, time) in enumerate(zip(both, (9000, 15_000), strict=True)):
        alone = one.at(torch.tensor([time]), ACCELERATION)
        torch.testing.assert_close(together[i : i + 1].covariance, alone.covariance, rtol=1e-12, atol=0)
        torch.testing.assert_close(together[i : i + 1].state.pose.t, alone.state.pose.t)


@pytest.mark.parametrize("name", STATES)
def test_the_speed_of_the_image_is_that_of_points_of_the_plane(name):
    state, plane, ray, h = STATES[name], wall(0.2, -0.1), rays_of(CAMERA), 1e-5

    def seen(dt):
        """Where points of the plane are in the image after a time: px."""
        after = state.later(torch.tensor([dt], dtype=torch.float64))
        end = ray @ (torch.linalg.inv(after.placement(plane)) @ state.placement(plane))[0].mT
        return end[:, :2] / end[:, 2:] * CAMERA.fx

    flow = (seen(h) - seen(-h)) / (2 * h)
    assert speed(state, plane, ray, CAMERA.fx) == pytest.approx(float(flow.square().sum(-1).mean().sqrt()), rel=1e-6, abs=1e-9)


def test_the_speed_before_a_wall_is_known():
    ray = rays_of(CAMERA)
    assert speed(state_of(velocity=(0.5, 0.0, 0.0)), wall(), ray, 100.0) == pytest.approx(50)
    assert speed(state_of(shift=(0.0, 0.0, 0.5), velocity=(0.3, 0.4, 0.0)), wall(), ray, 100.0) == pytest.approx(100)
    assert speed(state_of(), wall(), ray, 100.0) == 0


@pytest.mark.parametrize(("name", "count"), [("planar", 12), ("translation", 6), ("rotation", 6)])
def test_a_basis_has_a_direction_for_each_number_that_is_free(name, count):
    full, motion = basis_of(name, "full"), basis_of(name, "motion")
    assert full.shape == (NUMBERS, count)
    assert motion.shape == (NUMBERS, count // 2)
    assert torch.equal(full.mT @ full, torch.eye(count, dtype=torch.float64))
    torch.testing.assert_close(motion.mT @ motion, 1.25 * torch.eye(count // 2, dtype=torch.float64))
    fixed = {"planar": [], "translation": [*range(3), *range(6, 9)], "rotation": [*range(3, 6), *range(9, 12)]}[name]
    for basis in (full, motion):
        assert not basis[[*fixed, 12, 13]].any()


@pytest.mark.parametrize("name", ["planar", "translation", "rotation"])
def test_refining_the_motion_alone_keeps_the_pose_at_the_start_of_the_window(name):
    """To first order: half the step leaves a quarter of what is left."""
    seconds, plane, state = torch.tensor([0.02], dtype=torch.float64), wall(0.1, 0.2), state_of((0.1, 0.2, 0.0), (0.1, -0.2, 0.3))
    basis = basis_of(name, "motion")
    q = torch.linspace(-1, 1, basis.shape[1], dtype=torch.float64)

    def moved(size):
        """How far a step of some px moves the pose at the window's start and at its middle."""
        after = state.moved((size * basis @ q)[:SIZE] * units(state, plane, seconds, 100.0)[:, :SIZE])
        return [float(s.step_to(a)[:, :6].norm()) for s, a in ((state, after.later(-seconds / 2)), (state, after))]

    (whole, middle), (half, _) = moved(5.0), moved(2.5)
    assert whole < 0.05 * middle
    assert half < 0.26 * whole or whole < 1e-12


def perturbed(scene, i, seed, size=2.0):
    """The true state of a window, each number off by some px, and how sure of it one may be."""
    random = torch.Generator().manual_seed(seed)
    window, true = scene.windows[i], scene.states[i]
    unit = size * units(true, scene.plane, window.duration.double(), scene.focal)[:, :SIZE]
    off = torch.randn(1, SIZE, generator=random, dtype=torch.float64) * unit
    return Belief(window.middle, true.moved(off), torch.diag_embed(unit.square()))


def others(scene, i):
    """The true map without a window."""
    return drawn(scene, [k for k in range(len(scene.windows)) if k != i])


def error(scene, state, i):
    return pixels([state], scene.plane, [scene.states[i]], scene.plane, scene.camera)


def drift(scene, state, i):
    """By how much the image moves otherwise in a window than it should: px, rms."""
    true, motion = scene.states[i], state.motion
    wrong = Motion(motion.omega - true.motion.omega, motion.velocity - true.motion.velocity)
    return speed(State(true.pose, wrong), scene.plane, rays_of(scene.camera), scene.focal) * scene.windows[i].duration.item()


def seen(m, before, window):
    """What one camera sees of its map."""
    return [Sight.of(m, before.state, window.duration.double())]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_step_recovers_a_perturbed_state(poster, seed):
    for i in (9, 16):
        before = perturbed(poster, i, seed)
        found = step(
            poster.windows[i], Canvas.around(poster.camera), before, seen(others(poster, i), before, poster.windows[i]), Tracking()
        )
        assert error(poster, before.state, i) > 3
        assert error(poster, found.after.state, i) < 0.15
        assert found.match.strength[0] > 0.3
        assert drift(poster, before.state, i) > 1.8
        assert drift(poster, found.after.state, i) < 0.5


def test_a_step_makes_the_belief_more_certain(poster):
    before = perturbed(poster, 9, 0)
    after = step(
        poster.windows[9], Canvas.around(poster.camera), before, seen(others(poster, 9), before, poster.windows[9]), Tracking()
    ).after
    assert torch.equal(after.time, before.time)
    assert torch.equal(after.covariance, after.covariance.mT)
    assert float(torch.linalg.eigvalsh(after.covariance[0]).min()) > 0
    assert float(torch.linalg.eigvalsh((before.covariance - after.covariance)[0]).min()) > -1e-12
    assert float(torch.linalg.slogdet(after.covariance[0]).logabsdet) < float(torch.linalg.slogdet(before.covariance[0]).logabsdet)


def test_cameras_in_one_step_are_each_as_alone(poster):
    canvas, which = Canvas.around(poster.camera), (5, 12)
    maps = [others(poster, i) for i in which]
    beliefs = [perturbed(poster, i, 0, 1.0) for i in which]
    windows = [poster.windows[i] for i in which]
    sights = [seen(m, before, window)[0] for m, before, window in zip(maps, beliefs, windows, strict=True)]
    together = step(type(windows[0]).join(windows), canvas, Belief.join(beliefs), sights, Tracking())
    for row, (window, before, sight) in enumerate(zip(windows, beliefs, sights, strict=True)):
        alone = step(window, canvas, before, [sight], Tracking())
        assert torch.equal(together.after.state.pose.t[row], alone.after.state.pose.t[0])
        assert torch.equal(together.after.state.pose.R[row], alone.after.state.pose.R[0])
        assert torch.equal(together.match.strength[row], alone.match.strength[0])


@pytest.mark.parametrize("refine", ["full", "motion"])
@pytest.mark.parametrize("objective", ["lookup", "variance"])
def test_translation_and_rotation_never_leave_their_subspace(poster, refine, objective):
    how, before = Tracking(matching=Matching(objective=objective, refine=refine)), perturbed(poster, 9, 0, 0.5)
    m, canvas = others(poster, 9), Canvas.around(poster.camera)
    before = replace(before, state=State(before.state.pose, replace(before.state.motion, omega=torch.zeros(1, 3, dtype=torch.float64))))
    found = step(poster.windows[9], canvas, before, seen(m, before, poster.windows[9]), how, "translation").after.state
    torch.testing.assert_close(found.pose.R, before.state.pose.R, rtol=0, atol=1e-14)
    assert torch.equal(found.motion.omega, before.state.motion.omega)
    assert not torch.equal(found.pose.t, before.state.pose.t)
    found = step(poster.windows[9], canvas, before, seen(m, before, poster.windows[9]), how, "rotation").after.state
    torch.testing.assert_close(found.pose.t, before.state.pose.t, rtol=0, atol=1e-14)
    assert torch.equal(found.motion.velocity, before.state.motion.velocity)
    assert float(so3.log(before.state.pose.R.mT @ found.pose.R).norm()) > 0


@pytest.mark.parametrize("name", ["planar", "translation", "rotation"])
def test_the_front_end_sharpens_a_window_with_what_the_model_has(poster, name):
    window, true = poster.windows[9], poster.states[9]
    found = front(window, Canvas.around(poster.camera), true, poster.plane, Tracking(), name)
    assert (found.contrast > found.zero).all()
    if name != "translation":
        assert float((found.motion.omega - true.motion.omega).norm()) < 1.5
    else:
        assert not found.motion.omega.any()
    if name == "rotation":
        assert not found.motion.velocity.any()


def test_a_camera_that_looks_along_its_plane_sees_nothing_of_it(poster):
    m, seconds = map_of(poster.camera, wall()), poster.windows[0].duration.double()
    assert Sight.of(m, state_of((0.0, 1.5, 0.0)), seconds) is None
    assert Sight.of(m, state_of((0.0, 0.0, 0.0)), seconds) is not None


@pytest.mark.parametrize(
    "wrong", [{"displacement": 0.0}, {"fewest": 1}, {"fewest": 2000, "most": 1000}, {"seconds": 0.0}, {"acceleration": (0.0, 1.0)}]
)
def test_tracking_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match="tracking wants"):
        Tracking(**wrong)
