"""The whole estimator on real windows and on simulated ones with exact truth: the bars that the project set itself."""

import math

import pytest
import torch
from accuracy import FAST, ROTATIONS, end_point_error, from_random_starts, sample, whole

from torchcmax.core.estimate import Search, estimate
from torchcmax.core.model import MODELS, PlanarKnown, Rotation
from torchcmax.core.objective import Look
from torchcmax.io import open


@pytest.fixture
def judge(shared, monkeypatch):
    monkeypatch.syspath_prepend(str(shared / "tools"))
    from score_motion import score

    return score


@pytest.mark.parametrize(("name", "degrees", "contrast"), [("boxes_rotation_13s", 2.0, 1.117), ("shapes_rotation_2s", 0.5, 2.275)])
def test_moderate_rotations_are_found_as_exactly_as_by_the_best_published_estimator(shared, judge, name, degrees, contrast):
    camera, window = whole(shared / "data/real/ecd" / name)
    found = estimate(window, camera, Rotation(camera.fx))
    error = (found.motion.omega[0] - torch.tensor(ROTATIONS[name])).norm() * 180 / math.pi
    assert error < degrees
    assert judge(shared / "data/real/ecd" / name, found.motion.omega[0].tolist())["middle_sigma1"]["gain"] >= contrast
    assert found.converged.all()


@pytest.mark.slow
@pytest.mark.parametrize("name", FAST)
def test_fast_windows_reach_what_fifty_random_starts_find(shared, judge, name):
    """99.9 % of the gain over the image at rest, by our contrast and by the independent judge's."""
    camera, window = whole(shared / "data/real/ecd" / name)
    model = MODELS[name.split("_")[1]](camera.fx)
    found, best = estimate(window, camera, model), from_random_starts(window, camera, model)
    best_gain = (-best.value).exp() / found.contrast_zero
    assert (found.gain - 1) >= 0.999 * (best_gain - 1)

    def judged(turn, shift):
        omega, velocity = (v[0] / window.duration[0] for v in (turn, shift))
        return judge(shared / "data/real/ecd" / name, omega.tolist(), velocity.tolist())["middle_sigma1"]["gain"]

    there = model.displacement(best.x, torch.zeros(1, dtype=torch.int64))
    ours = judged(found.motion.omega * window.duration, found.motion.velocity * window.duration)
    assert ours - 1 >= 0.999 * (judged(there.turn, there.shift) - 1)


@pytest.mark.parametrize("name", ["poster_6dof_sim", "shapes_6dof_sim"])
def test_six_degrees_of_freedom_before_the_known_plane(shared, name):
    recording = open(shared / "data/sim" / name)
    window, truth, plane = sample(recording, 20)
    found = estimate(window, recording.camera, PlanarKnown(recording.camera.fx, plane.normal))
    assert end_point_error(window, found, truth, plane, recording.camera.fx).median() < 0.5


@pytest.mark.parametrize("name", ["poster_6dof_sim", "poster_translation_sim"])
def test_six_degrees_of_freedom_and_the_plane_from_nothing(shared, name):
    recording = open(shared / "data/sim" / name)
    window, truth, plane = sample(recording, 8)
    found = estimate(window, recording.camera, MODELS["planar"](recording.camera.fx))
    assert end_point_error(window, found, truth, plane, recording.camera.fx).median() < 0.5
    assert (found.normal[:, 2] < 0).all()


def test_rotations_of_the_panorama(shared):
    recording = open(shared / "data/sim/rotation_panorama_sim")
    stride = (recording.count - 30000) // 9
    window = next(recording.windows(30000, stride, 10))
    truth = recording.truth.motion(window.start, window.duration.double())
    found = estimate(window, recording.camera, Rotation(recording.camera.fx))
    error = (found.motion.omega - truth.omega).norm(dim=-1) * window.duration * recording.camera.fx
    assert error.median() < 0.5  # px over the window


def test_a_window_has_the_same_answer_alone_and_in_a_batch(shared):
    recording = open(shared / "data/sim/poster_6dof_sim")
    window = next(recording.windows(8000, 600_000, 4))
    model = MODELS["planar"](recording.camera.fx)
    together = estimate(window, recording.camera, model)
    for i in range(4):
        alone = estimate(window[i : i + 1], recording.camera, model)
        assert torch.equal(alone.motion.omega[0], together.motion.omega[i])
        assert torch.equal(alone.normal[0], together.normal[i])
        assert alone.evaluations[0] == together.evaluations[i]


def test_several_starts_are_never_worse_than_one(shared):
    camera, window = whole(shared / "data/real/ecd/shapes_translation")
    model = MODELS["translation"](camera.fx)
    one, five = (estimate(window, camera, model, search=Search(start=start)) for start in (0.0, 20.0))
    assert five.contrast >= 0.999 * one.contrast
    assert five.evaluations > one.evaluations


@pytest.mark.parametrize("reference", ["middle", "first"])
def test_the_motion_is_that_at_the_first_event_whatever_the_reference(shared, reference):
    camera, window = whole(shared / "data/real/ecd/shapes_rotation_2s")
    found = estimate(window, camera, Rotation(camera.fx), Look(reference=reference))
    torch.testing.assert_close(found.motion.omega[0], torch.tensor([-0.071, 0.663, -0.128]), rtol=0, atol=0.02)


@pytest.mark.parametrize("model", ["translation", "planar"])
def test_without_the_guard_blurred_images_collapse_and_with_it_they_do_not(shared, model):
    """Reference at the first event and blur reward collapse (a zoom that piles all events up); the guard forbids it."""
    recording = open(shared / "data/sim/poster_6dof_sim")
    window = next(recording.windows(30000, 500_000, 4))
    search = Search(blur=(8.0, 4.0))
    gains, areas = {}, {}
    for guard in (0.0, Look.guard):
        found = estimate(window, recording.camera, MODELS[model](recording.camera.fx), Look(reference="first", guard=guard), search)
        end = found.H_k.sum(1)  # at the last event
        areas[guard] = (torch.linalg.det(end).abs().log() - 3 * end[:, 2, 2].abs().log()).abs()
        gains[guard] = found.gain
    assert gains[0.0].max() > 3 * gains[Look.guard].max()
    assert (areas[Look.guard] < math.log(4)).all()
    assert areas[0.0].max() > math.log(4)


def test_events_that_all_come_at_once_have_no_motion(shared):
    camera, window = whole(shared / "data/real/ecd/shapes_rotation_2s")
    at_once = type(window)(window.ray, 0 * window.dt, window.polarity, window.start, 0 * window.duration)
    found = estimate(at_once, camera, Rotation(camera.fx))
    assert (found.motion.omega == 0).all()
    assert found.gain.isfinite().all()
