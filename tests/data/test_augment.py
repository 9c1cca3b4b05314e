"""Augmented windows are what a camera with the augmented truth would have seen."""

from dataclasses import replace

import pytest
import torch

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.core.warp import transfer
from torchcmax.core.window import Window
from torchcmax.data import Augment, Sample, collate
from torchcmax.data.augment import crop, disturb, drop, flip, reverse
from torchcmax.data.sample import labelled

CAMERA = Camera((40, 60), 50.0, 50.0, 28.0, 21.0)
POINTS, SEEN = 12, 9  # points of the plane, and how often each is seen


def sample(seed=0, padding=0):
    """Events of points on a plane, float64, with the truth of the camera that sees them."""
    chance = torch.Generator().manual_seed(seed)
    random = lambda *shape: torch.rand(shape, generator=chance, dtype=torch.float64) - 0.5  # noqa: E731
    motion = Motion(2 * random(1, 3), random(1, 3))
    plane = Plane(Plane.tilted(random(1, 2)).normal, torch.tensor([1.7], dtype=torch.float64))
    motion = replace(motion, velocity=motion.velocity * 1.7)
    dt = torch.cat([torch.zeros(1), torch.rand(POINTS * SEEN - 2, generator=chance).sort().values, torch.ones(1)]).double() * 0.2
    ray = torch.cat([random(POINTS, 2), torch.ones(POINTS, 1)], -1).repeat(SEEN, 1)
    point = ray * (-1.7 / (ray @ plane.normal[0]))[:, None]
    at = motion.at(dt[None])
    ray = (at.R[0].mT @ (point - at.t[0])[..., None])[..., 0]
    ray = torch.cat([ray / ray[:, 2:], torch.ones(padding, 3)])[None]
    polarity = torch.cat([torch.where(random(POINTS * SEEN) < 0, -1.0, 1.0), torch.zeros(padding)])[None].double()
    dt = torch.cat([dt, dt[-1:].expand(padding)])[None]
    window = Window(ray, dt, polarity, torch.tensor([1_000_000]), dt[:, -1])
    world = Pose(Motion(random(1, 3), random(1, 3)).at(torch.ones(1, 1)).R[:, 0], random(1, 3))
    time = torch.tensor([1_000_000, 1_200_000])
    poses = Motion(motion.omega, motion.velocity).at(torch.tensor([[0.0, 0.2]], dtype=torch.float64))
    poses = Pose(world.R, world.t) @ Pose(poses.R[0], poses.t[0])
    normal = (world.R @ plane.normal[..., None])[..., 0]
    known = Plane(normal, plane.distance - (world.t * normal).sum(-1))
    return labelled(window, 4, 77, 1_200_000, Trajectory(time, poses), known), point


def spread(sample: Sample) -> float:
    """How far apart the events of one point are after they were moved by the truth, and the plane's points with them."""
    window = sample.window
    motion = Motion(sample.omega, sample.velocity)
    plane = Plane(sample.normal, torch.ones_like(sample.distance))
    seen = transfer(window.ray, motion.at(window.dt), plane)
    xy = (seen[..., :2] / seen[..., 2:])[window.polarity != 0]
    near = (
        torch.cdist(xy, xy, compute_mode="donot_use_mm_for_euclid_dist").sort(-1).values[:, SEEN - 1]
    )  # as many as a point has events are in one place
    return near.max().item()


def same(a: Sample, b: Sample) -> None:
    for name in ("omega", "velocity", "normal", "distance", "R", "t"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-9, atol=1e-9)
    for name in ("ray", "dt", "polarity", "duration"):
        torch.testing.assert_close(getattr(a.window, name), getattr(b.window, name), rtol=1e-9, atol=1e-9)


ALL, NONE = torch.tensor([True]), torch.tensor([False])


@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize(
    "change",
    [lambda s: s, lambda s: flip(s, ALL, 0), lambda s: flip(s, ALL, 1), lambda s: reverse(s, ALL), lambda s: flip(reverse(s, ALL), ALL, 0)],
)
def test_the_truth_brings_the_events_of_every_point_together(change, padding):
    changed = change(sample(padding=padding)[0])
    assert spread(changed) < 1e-9
    assert torch.linalg.det(changed.R).item() == pytest.approx(1)
    wrong = replace(changed, omega=-changed.omega)
    assert spread(wrong) > 1e-3


@pytest.mark.parametrize("padding", [0, 7])
def test_twice_changed_is_unchanged_and_unchosen_stays(padding):
    one = sample(padding=padding)[0]
    for change in (lambda s, w: flip(s, w, 0), lambda s, w: flip(s, w, 1), reverse):
        same(change(change(one, ALL), ALL), one)
        same(change(one, NONE), one)
        assert not torch.equal(change(one, ALL).omega, one.omega)


def test_backwards_keeps_the_order_of_time_and_the_pose_of_the_last_event():
    one = sample(padding=5)[0]
    back = reverse(one, ALL)
    real = back.window.polarity[0] != 0
    assert real[:-5].all()
    assert not real[-5:].any()
    assert (back.window.dt[0, :-5].diff() >= 0).all()
    torch.testing.assert_close(back.window.ray[0, 0], one.window.ray[0, -6])
    torch.testing.assert_close(back.window.polarity[0, 0], -one.window.polarity[0, -6])
    step = Motion(one.omega, one.velocity * one.distance[:, None]).at(one.window.duration[:, None])[:, 0]
    end = Pose(one.R, one.t) @ step
    torch.testing.assert_close(back.R, end.R)
    torch.testing.assert_close(back.t, end.t)
    again = Motion(back.omega, back.velocity * back.distance[:, None]).at(back.window.duration[:, None])[:, 0]
    torch.testing.assert_close((end @ again).t, one.t)


def test_a_mirrored_world_has_the_mirrored_points():
    """X_w = R X_c + t holds for mirrored points."""
    one, point = sample()
    world = point @ one.R[0].mT + one.t
    for axis in (0, 1):
        flipped, mirror = flip(one, ALL, axis), torch.ones(3, dtype=torch.float64)
        mirror[axis] = -1
        torch.testing.assert_close((point * mirror) @ flipped.R[0].mT + flipped.t, world * mirror)


@pytest.mark.parametrize("axis", [0, 1])
def test_flow_of_a_mirrored_camera_is_mirrored(axis):
    one, centred = sample()[0], Canvas(50.0, (29.5, 19.5), (40, 60))
    flow, mirrored = one.flow(centred), flip(one, ALL, axis).flow(centred)
    sign = torch.tensor([-1.0, 1.0] if axis == 0 else [1.0, -1.0], dtype=torch.float64).view(1, 2, 1, 1)
    torch.testing.assert_close(mirrored, sign * flow.flip(3 - axis))


def test_flow_backwards_is_the_other_way():
    one, canvas = sample()[0], Canvas.around(CAMERA, 0.0)
    torch.testing.assert_close(reverse(one, ALL).flow(canvas, 0.3), -one.flow(canvas, 0.7))


def test_dropout_takes_a_share_away():
    one = collate([sample(seed)[0] for seed in range(40)])
    kept = drop(one, 0.3, torch.Generator().manual_seed(0))
    assert ((kept.window.polarity == 0) | (kept.window.polarity == one.window.polarity)).all()
    assert kept.window.weight.mean().item() == pytest.approx(0.7, abs=0.03)  # of 4320: four standard deviations
    same(drop(one, 0.0, torch.Generator()), one)


def test_noise_is_anywhere_on_the_sensor_at_any_time():
    one = sample(padding=9)[0]
    noisy = disturb(one, 5.0, CAMERA, torch.Generator().manual_seed(0))
    added = 5 * POINTS * SEEN
    assert noisy.window.weight.sum() == one.window.weight.sum() + added
    assert (noisy.window.dt.diff() >= 0).all()
    old = (noisy.window.ray[0, :, None] == one.window.ray[0]).all(-1).any(-1)
    xy = Canvas.around(CAMERA, 0.0).pixels(noisy.window.ray[0, ~old])
    assert len(xy) == added
    assert (xy.amin(0) >= -1e-4).all()
    assert (xy <= torch.tensor([59.0, 39.0]) + 1e-4).all()
    assert (xy.mean(0) - torch.tensor([29.5, 19.5])).abs().max() < 4
    assert noisy.window.dt[0, ~old].mean().item() == pytest.approx(0.1, abs=0.02)
    same(disturb(one, 0.0, CAMERA, torch.Generator()), one)
    empty = replace(one, window=replace(one.window, polarity=torch.zeros_like(one.window.polarity)))
    assert not disturb(empty, 1.0, CAMERA, torch.Generator()).window.weight.any()
    both = disturb(collate([one, drop(sample(1)[0], 0.9, torch.Generator().manual_seed(0))]), 0.5, CAMERA, torch.Generator())
    many, few = both.window.weight.sum(1).tolist()
    assert many == 1.5 * POINTS * SEEN
    assert few < 0.4 * many


def test_a_crop_keeps_one_rectangle():
    one = sample()[0]
    least, most = (torch.tensor([ends], dtype=torch.float64) for ends in ((-0.3, -0.2), (0.2, 0.3)))
    kept = crop(one, least, most).window.polarity[0] != 0
    x, y = one.window.ray[0, :, :2].T
    assert torch.equal(kept, (x >= -0.3) & (x <= 0.2) & (y >= -0.2) & (y <= 0.3))
    assert 0 < kept.sum() < len(kept)


def test_augmented_batches_are_still_what_their_truth_says():
    one = collate([sample(seed, padding=seed % 3)[0] for seed in range(16)])
    augment = Augment(CAMERA, dropout=0.0, noise=0.0)
    changed = augment(one, torch.Generator().manual_seed(1))
    assert all(spread(changed[i : i + 1]) < 1e-9 for i in range(16))
    kinds = {tuple((changed.normal[i].sign() == one.normal[i].sign()).tolist()) for i in range(16)}
    assert len(kinds) > 2  # each window by itself
    assert changed.omega.dtype == changed.window.ray.dtype == torch.float64
    again = augment(one, torch.Generator().manual_seed(1))
    same(again, changed)


@pytest.mark.parametrize("wrong", [{"mirror": 1.5}, {"dropout": -0.1}, {"crop": float("nan")}])
def test_shares_are_shares(wrong):
    with pytest.raises(ValueError, match="wants 0 to 1"):
        Augment(CAMERA, **wrong)


def test_a_turning_camera_that_moves_along_one_axis_is_right_backwards():
    """Only one part of the velocity is zero at the beginning; seen from the end, none is."""
    one = sample()[0]
    one = replace(one, velocity=torch.tensor([[0.42, 0.0, 0.29]], dtype=torch.float64))
    back = reverse(one, ALL)
    assert (back.velocity != 0).all()
    same(reverse(back, ALL), one)


def test_crops_of_a_distorted_sensor_reach_all_of_it():
    wide = Camera((40, 60), 50.0, 50.0, 28.0, 21.0, (-0.35, 0.13, 0.0, 0.0, 0.0))
    ray = wide.rays().view(1, -1, 3)
    n = ray.shape[1]
    window = Window(
        ray,
        torch.linspace(0, 1, n, dtype=torch.float64)[None],
        torch.ones(1, n, dtype=torch.float64),
        torch.zeros(1).long(),
        torch.ones(1).double(),
    )
    one = replace(sample()[0], window=window)
    for crop_to, least in ((1.0, 1.0), (0.999, 0.95)):
        augment = Augment(wide, 0, 0, 0, 0, 0, crop_to)
        assert augment(one, torch.Generator().manual_seed(0)).window.weight.mean() >= least


def test_autocast_leaves_samples_exact():
    one, canvas = sample()[0].to("cpu", torch.float32), Canvas.around(CAMERA, 0.0)

    def found():
        backwards, any_way = (Augment(CAMERA, *chances) for chances in ((0, 0, 1, 0, 0), ()))
        return one.flow(canvas), backwards(one, torch.Generator()).R, any_way(one, torch.Generator().manual_seed(0)).omega

    plain = found()
    with torch.autocast("cpu", torch.bfloat16):
        cast = found()
    assert all(torch.equal(a, b) for a, b in zip(plain, cast, strict=True))


def test_flow_is_not_known_where_a_pixel_does_not_see_the_plane():
    grazing = Plane.tilted(torch.tensor([[1.4, 0.0]], dtype=torch.float64)).normal
    flow = replace(sample()[0], normal=grazing).flow(Canvas.around(CAMERA, 0.0), at=0.0)
    ray = Canvas.around(CAMERA, 0.0)
    y, x = torch.meshgrid(torch.arange(40), torch.arange(60), indexing="ij")
    toward = ((torch.stack([x, y], -1) - torch.tensor(ray.centre)) / ray.focal).double()
    away = (torch.cat([toward, torch.ones(40, 60, 1)], -1) @ grazing[0]) > 0
    assert away.any()
    assert flow.isnan()[0, :, away].all()
    assert flow.isfinite().any()
