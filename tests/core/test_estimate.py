"""The whole estimator on real windows and on simulated ones with exact truth: the bars that the project set itself."""

import math
from dataclasses import replace

import pytest
import torch
from accuracy import FAST, ROTATIONS, end_point_error, from_random_starts, sample, whole

from torchcmax import kernels
from torchcmax.core.camera import Canvas
from torchcmax.core.estimate import Search, estimate
from torchcmax.core.minimize import Stop
from torchcmax.core.model import MODELS, Planar, PlanarKnown, Rotation, Translation
from torchcmax.core.objective import Look
from torchcmax.core.window import Window
from torchcmax.io import open

EVERY_MODEL = pytest.mark.parametrize("kind", [Rotation, Translation, PlanarKnown, Planar])


@pytest.fixture(scope="module")
def built_in(demo):
    """Camera and four windows of 8,000 events of the built-in recording."""
    recording = open(demo)
    return recording.camera, next(recording.windows(8000, batch=4))


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


@EVERY_MODEL
def test_events_that_all_come_at_once_have_no_motion_and_no_gain(built_in, kind):
    camera, window = built_in
    at_once = Window(window.ray, 0 * window.dt, window.polarity, window.start, 0 * window.duration)
    found = estimate(at_once, camera, kind(camera.fx))
    assert (found.motion.omega == 0).all()
    assert (found.motion.velocity == 0).all()
    assert (found.gain == 1).all()
    assert not found.converged.any()


@EVERY_MODEL
def test_the_built_in_recording_is_sharpened_in_both_precisions(built_in, kind, dtype, device):
    camera, window = built_in
    found = estimate(window.to(device, dtype), camera, kind(camera.fx))
    assert found.motion.omega.dtype == dtype
    assert found.motion.omega.device.type == device.type
    assert (found.gain >= 1).all()
    assert found.converged.float().mean() >= 0.75
    if kind is not Translation:
        assert found.gain.mean() > 1.1


@EVERY_MODEL
def test_a_row_is_the_same_to_the_bit_alone_and_in_a_batch_wider_than_a_register(built_in, kind):
    camera, _ = built_in
    window = built_in[1][torch.arange(20) % len(built_in[1])]
    window = Window(window.ray + 1e-3 * torch.arange(20)[:, None, None], window.dt, window.polarity, window.start, window.duration)
    together = estimate(window, camera, kind(camera.fx))
    for i in (0, 9, 19):
        alone = estimate(window[i : i + 1], camera, kind(camera.fx))
        assert torch.equal(alone.H_k[0], together.H_k[i])
        assert alone.evaluations[0] == together.evaluations[i]


@EVERY_MODEL
def test_padding_changes_nothing_but_roundings(built_in, kind):
    camera, window = built_in
    window = window.to("cpu", torch.float64)[torch.arange(2)]
    spare = [torch.cat([part, torch.zeros_like(part)], 1) for part in (window.ray, window.dt, window.polarity)]
    found, padded = (estimate(w, camera, kind(camera.fx)) for w in (window, Window(*spare, window.start, window.duration)))
    torch.testing.assert_close(padded.gain, found.gain, rtol=1e-3, atol=0)
    torch.testing.assert_close(padded.motion.omega, found.motion.omega, rtol=0, atol=0.02)


def test_no_windows_are_refused_by_name(built_in):
    camera, window = built_in
    with pytest.raises(ValueError, match="wants at least one window"):
        estimate(window[:0], camera, Rotation(camera.fx))


@pytest.mark.parametrize(
    "wrong", [{"blur": ()}, {"blur": (-1.0,)}, {"blur": (1000.0, 1.0)}, {"blur": (float("nan"),)}, {"start": -1.0}, {"margin": -5.0}]
)
def test_searches_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="a search wants"):
        Search(**wrong)


def test_some_windows_of_an_estimate_are_those_of_their_own(built_in):
    camera, window = built_in
    found = estimate(window, camera, Planar(camera.fx))
    some = found[torch.tensor([2, 0])]
    for name in ("H_k", "normal", "contrast", "contrast_zero", "evaluations", "converged", "iterations", "gain"):
        assert torch.equal(getattr(some, name), getattr(found, name)[[2, 0]])
    assert torch.equal(some.motion.velocity, found.motion.velocity[[2, 0]])
    for a, b in zip(some.traces, found.traces, strict=True):
        torch.testing.assert_close(a, b[[2, 0]], rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("name", ["poster_6dof_sim", "stop_and_go_sim", "slider_far_sim"])
@pytest.mark.parametrize("events", [3000, 6000])
def test_short_windows_are_never_worse_than_at_rest_and_show_planes_that_the_camera_can_see(shared, name, events):
    recording = open(shared / "data/sim" / name)
    window = next(recording.windows(events, (recording.count - events) // 11, 12))
    for kind in (Planar, Translation):
        found = estimate(window, recording.camera, kind(recording.camera.fx))
        assert (found.gain >= 0.999).all()  # less the little that the pull of the plane may cost
        unseen = (window.ray @ found.normal[..., None])[..., 0] > 0
        assert (unseen.float().mean(-1) < 0.1).all()


REAL = [*(f"real/ecd/{name}" for name in ROTATIONS), "sim/poster_6dof_sim", "sim/rotation_panorama_sim"]


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_every_backend_gives_the_same_answer(shared, monkeypatch, name):
    """Contrast within 1e-4, angular velocity within 0.05 degrees a second; with the kernels and without."""
    pytest.importorskip("numba", reason="numba is not installed")
    recording = open(shared / "data" / name)
    window = next(recording.windows(min(20_000, recording.count or 20_000), batch=2))
    fast = estimate(window, recording.camera, Rotation(recording.camera.fx))
    monkeypatch.setenv(kernels.SWITCH, "0")
    plain = estimate(window, recording.camera, Rotation(recording.camera.fx))
    torch.testing.assert_close(fast.contrast, plain.contrast, rtol=1e-4, atol=0)
    torch.testing.assert_close(fast.motion.omega, plain.motion.omega, rtol=0, atol=math.radians(0.05))


def test_a_window_that_begins_where_the_one_before_ended_takes_fewer_evaluations(built_in):
    camera, window = built_in
    for kind in (Rotation, PlanarKnown):
        model = kind(camera.fx)
        cold = estimate(window, camera, model)
        start = model.parameters(cold.displacement(window)).roll(1, 0)
        warm = estimate(window, camera, replace(model, start=start), None, Search((1.0,)))
        assert warm.evaluations[1:].sum() < 0.8 * cold.evaluations[1:].sum()
        assert (warm.contrast[1:] > 0.99 * cold.contrast[1:]).all()


def test_what_is_not_sharper_than_rest_is_searched_for_again_from_there(built_in):
    camera, window = built_in
    model = Rotation(camera.fx)
    lost = torch.zeros(4, 3)
    lost[2] = 300.0  # px, off the canvas
    found = estimate(window, camera, replace(model, start=lost), None, Search((1.0,)))
    assert (found.gain > 1).all()
    assert found.evaluations[2] > found.evaluations[0]


def test_a_start_of_another_shape_is_refused(built_in):
    camera, window = built_in
    with pytest.raises(ValueError, match=r"a start wants \[W, P\] = \[4, 8\], got \[4, 6\]"):
        estimate(window, camera, Planar(camera.fx, start=torch.zeros(4, 6)))


def test_the_contrast_is_that_of_the_warp(built_in):
    camera, window = built_in
    found = estimate(window, camera, Rotation(camera.fx), None, Search(stop=Stop(tolerance=3.0)))
    view = Look().at(window, Canvas.around(camera), 1.0)
    torch.testing.assert_close(found.contrast, Look().sharpness(found.H_k, view, torch.arange(4)), rtol=1e-6, atol=0)
