import ast
import dataclasses
import inspect
import math
from functools import cache
from itertools import pairwise

import h5py
import numpy as np
import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose
from torchcmax.core.warp import transfer
from torchcmax.io.errors import DataError
from torchcmax.io.recording import Events
from torchcmax.simulator import LIMITS, MOTIONS, Simulation, pose, simulate, velocity, write
from torchcmax.texture import texture

SMALL = Simulation(duration=0.03, width=64, height=48, focal=55.0)
SCENES = {
    "poster": Simulation(duration=0.12),
    "shapes": Simulation("shapes", duration=0.12),
    "panorama": Simulation("panorama", "rotation", duration=0.1),
}


@cache
def events(options):
    return Events.join(list(simulate(options).chunks()))


def same(a, b):
    return len(a) == len(b) and all((getattr(a, k) == getattr(b, k)).all() for k in "txyp")


def variance(options, window, scale):
    """Variance of the image of events warped to the first one with `scale` times the true motion."""
    time = torch.from_numpy(window.t * 1e-6)
    true = pose(options, time)
    move = true[:1].inverse() @ true
    scaled = Pose(so3.exp(scale * so3.log(move.R)), scale * move.t)
    seen = options.plane.seen_from(true[:1]) if options.plane else Plane.tilted(torch.zeros(1, 2, dtype=torch.float64))
    ray = options.camera.rays()[window.y.astype(int), window.x.astype(int)]
    canvas = Canvas.around(options.camera)
    xy = canvas.pixels(transfer(ray[None], scaled[None], seen))[0].numpy()
    corner = np.floor(xy)
    image = np.zeros(canvas.size)
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = (corner + np.array([dx, dy])).astype(int).T
            weight = np.prod(1 - np.abs(xy - corner - (dx, dy)), -1)
            on = (x >= 0) & (y >= 0) & (x < canvas.size[1]) & (y < canvas.size[0])
            np.add.at(image, (y[on], x[on]), weight[on])
    return image.var()


def test_the_same_seed_gives_the_same_events():
    recording = simulate(SMALL)
    first, second = (Events.join(list(recording.chunks())) for _ in range(2))
    assert same(first, second)
    texture.cache_clear()
    assert same(first, Events.join(list(simulate(SMALL).chunks())))


def test_another_seed_gives_other_events():
    assert not same(events(SMALL), events(dataclasses.replace(SMALL, seed=1)))


@pytest.mark.parametrize("scene", SCENES)
def test_events_are_sorted_within_the_duration_and_on_the_sensor(scene):
    options, e = SCENES[scene], events(SCENES[scene])
    assert (e.t.dtype, e.x.dtype, e.y.dtype, e.p.dtype) == (np.int64, np.uint16, np.uint16, np.uint8)
    assert (np.diff(e.t) >= 0).all()
    assert e.t[0] >= 0
    assert e.t[-1] <= options.duration * 1e6
    assert e.x.max() == options.width - 1
    assert e.y.max() == options.height - 1
    assert e.p.max() == 1


def test_polarities_are_balanced():
    for options in SCENES.values():
        assert 0.4 < events(options).p.mean() < 0.6


@pytest.mark.parametrize("scene", SCENES)
def test_no_two_events_of_a_pixel_are_closer_than_the_refractory_time(scene):
    e = events(SCENES[scene])
    pixel = e.y.astype(int) * 240 + e.x
    order = np.lexsort([e.t, pixel])
    gap = np.diff(e.t[order])[np.diff(pixel[order]) == 0]
    assert gap.min() >= 500


@pytest.mark.parametrize("motion", sorted(set(MOTIONS) - {"sweep"}))
def test_the_path_starts_at_the_identity_and_covers_the_duration(motion):
    recording = simulate(Simulation(motion=motion, duration=0.2504))
    truth = recording.truth
    assert torch.equal(truth.pose.R[0], torch.eye(3, dtype=torch.float64))
    assert torch.equal(truth.pose.t[0], torch.zeros(3, dtype=torch.float64))
    assert truth.time[-1] == 251_000
    assert (truth.time.diff() == 1000).all()
    assert recording.plane.distance.item() == pytest.approx(0.8 * math.cos(math.hypot(8, 10) * math.pi / 180))
    assert (recording.name, str(recording.path), recording.count) == (f"poster_{motion}", "simulated", None)


TURNING = Simulation("panorama", "rotation", speed=1.5), Simulation("panorama", "sweep", speed=0.7)


@pytest.mark.parametrize("options", [*(Simulation(motion=m) for m in MOTIONS if m != "sweep"), *TURNING], ids=str)
def test_velocity_agrees_with_differences_of_the_path(options):
    time, h = torch.linspace(0.1, 5, 400, dtype=torch.float64), 1e-4
    before, here, after = (pose(options, time + s) for s in (-h, 0, h))
    omega = (so3.log(here.R.mT @ after.R) - so3.log(here.R.mT @ before.R)) / (2 * h)
    speed = (here.R.mT @ (after.t - before.t)[..., None])[..., 0] / (2 * h)
    motion = velocity(options, time)
    torch.testing.assert_close(motion.omega, omega, rtol=1e-4, atol=1e-4 * omega.abs().max().item())
    torch.testing.assert_close(motion.velocity, speed, rtol=1e-4, atol=1e-4 * speed.abs().max().item())


def test_motion_is_as_fast_as_promised():
    motion = velocity(Simulation(), torch.linspace(0, 10, 5000, dtype=torch.float64))
    omega, speed = motion.omega.norm(dim=-1).rad2deg(), motion.velocity.norm(dim=-1)
    assert 150 < omega.max() < 230
    assert 0.9 < speed.max() < 1.3
    assert omega.min() < 60


def test_a_camera_that_stands_still_sees_noise_only():
    e = events(Simulation(duration=0.3, speed=0.0, noise=4.0))
    expected = 4 * 0.3 * 240 * 180
    assert abs(len(e) - expected) < 5 * math.sqrt(expected)
    assert abs(e.p.mean() - 0.5) < 5 * 0.5 / math.sqrt(expected)


def test_noise_in_a_recording_is_as_frequent_as_asked():
    e = events(Simulation(duration=0.1, speed=0.0, noise=100.0, refractory=0.0))
    assert len(e) / (0.1 * 240 * 180) == pytest.approx(100, rel=0.03)


def test_half_the_threshold_gives_about_twice_the_events():
    # with edges of several thresholds: where texture is fainter than that, as in the poster, it is three times
    quiet = dataclasses.replace(SMALL, scene="shapes", noise=0.0, duration=0.1)
    ratio = len(events(dataclasses.replace(quiet, threshold=0.125, mismatch=0.0175))) / len(events(quiet))
    assert 1.6 < ratio < 2.6


def test_no_noise_no_filter_no_blindness_no_mismatch_are_possible():
    clean = dataclasses.replace(SMALL, noise=0.0, bandwidth=0.0, refractory=0.0, mismatch=0.0)
    assert len(events(clean)) > 100


@pytest.mark.parametrize("scene", SCENES)
def test_the_true_motion_is_the_sharpest(scene):
    options, e = SCENES[scene], events(SCENES[scene])
    windows = [e[i : i + 20_000] for i in range(0, len(e) - 19_999, 20_000)]
    assert len(windows) >= 2
    for window in windows:
        true, still, less, more = (variance(options, window, s) for s in (1, 0, 0.9, 1.1))
        print(f"{scene} {true / still:.3f} {true / less:.3f} {true / more:.3f}")
        assert true > 1.15 * still
        assert true > less
        assert true > more


def test_events_are_as_rich_as_those_of_the_shared_simulation(shared):
    with h5py.File(shared / "data/sim/poster_6dof_sim/events.h5") as file:
        there = len(file["events/t"]) / 6.0
    assert 0.3 < len(events(SCENES["poster"])) / 0.12 / there < 3


def test_the_panorama_has_no_seam():
    light = texture("panorama", 0, 200.0)
    latitude = torch.linspace(-1.57, 1.57, 3000)

    def step(longitude):
        across = [torch.tensor(longitude + s).deg2rad() for s in (-0.05, 0.05)]
        left, right = (light.sample(torch.stack([latitude.cos() * a.sin(), latitude.sin(), latitude.cos() * a.cos()])) for a in across)
        return (left - right).abs().mean()

    inside = torch.stack([step(x) for x in (-160.0, -100.0, -20.0, 20.0, 70.0, 110.0)]).max()
    for longitude in (180.0, -135.0, -45.0, 45.0, 135.0):  # the ends of a map, and the edges of the cube behind it
        assert step(longitude) < 2 * inside
    angle = torch.linspace(0, 2 * math.pi, 50)
    for pole in (-1.0, 1.0):
        near = light.sample(torch.stack([1e-4 * angle.cos(), torch.full_like(angle, pole), 1e-4 * angle.sin()]))
        assert near.std() < 1e-3


def test_a_picture_is_a_scene(tmp_path):
    from PIL import Image

    y, x = np.mgrid[:90, :120]
    Image.fromarray((((x // 6 + y // 6) % 2) * 200).astype(np.uint8)).save(tmp_path / "board.png")
    options = dataclasses.replace(SMALL, scene=str(tmp_path / "board.png"))
    assert simulate(options).name == "board_6dof"
    assert len(events(options)) > 100
    (tmp_path / "none.png").write_text("no picture")
    with pytest.raises(DataError, match="cannot be read as a picture"):
        events(dataclasses.replace(SMALL, scene=str(tmp_path / "none.png")))


@pytest.mark.parametrize("size", [(1, 3000), (3000, 1), (10, 41)])
def test_a_picture_too_narrow_or_too_flat_is_refused(tmp_path, size):
    from PIL import Image

    Image.new("L", size).save(tmp_path / "strip.png")
    with pytest.raises(DataError, match=r"too narrow or too flat.*\n.*4 times its shorter side"):
        write(dataclasses.replace(SMALL, scene=str(tmp_path / "strip.png")), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_picture_too_large_is_refused(tmp_path):
    from PIL import Image

    Image.new("1", (20_000, 20_000)).save(tmp_path / "huge.png")
    with pytest.raises(DataError, match=r"too large a picture(.|\n)*make it smaller"):
        events(dataclasses.replace(SMALL, scene=str(tmp_path / "huge.png")))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "postre"}, "did you mean 'poster'"),
        ({"motion": "5dof"}, "did you mean '6dof'"),
        ({"scene": "panorama"}, "motion wants rotation"),
        ({"duration": 0.0}, "duration wants 0.001 to 600 s, got 0"),
        ({"duration": 1e-7}, "duration wants 0.001 to 600 s, got 1e-07"),
        ({"duration": 1e9}, "duration wants 0.001 to 600 s"),
        ({"speed": 1e6}, "speed wants 0 to 100, got 1000000"),
        ({"distance": math.nan}, "distance wants 0.01 to 10000 m, got nan"),
        ({"distance": 1e300}, "distance wants 0.01 to 10000 m"),
        ({"focal": 1e9}, "focal wants 8 to 100000 px"),
        ({"threshold": 1e-9}, "threshold wants 0.01 to 10"),
        ({"mismatch": math.inf}, "mismatch wants 0 to 10"),
        ({"noise": -1.0}, "noise wants 0 to 1000 Hz, got -1"),
        ({"noise": 1e15}, "noise wants 0 to 1000 Hz, got 1000000000000000"),
        ({"refractory": 1e300}, "refractory wants 0 to 1000 ms"),
        ({"bandwidth": 1e-300}, "bandwidth wants 0, or 1 to 1000000 Hz"),
        ({"seed": -1}, "seed wants 0 to"),
        ({"seed": 2**70}, "seed wants 0 to"),
        ({"tilt": (80.0, 0.0)}, "tilt wants two angles"),
        ({"tilt": (0.0, math.nan)}, "tilt wants two angles"),
        ({"width": 2}, "width wants 8 to 2048 px, got 2"),
        ({"height": 65535}, "height wants 8 to 2048 px, got 65535"),
        ({"scene": "x" * 5000}, "scene wants one of"),
        ({"scene": "a\0b"}, "scene wants one of"),
        ({"distortion": (0.1, 0.2)}, "plumb_bob wants 5"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        Simulation(**options)


def test_the_ends_of_the_bounds_are_possible():
    options = Simulation(duration=0.001, speed=100, width=8, height=8, focal=20.0, noise=1000, refractory=0, bandwidth=1, threshold=0.01)
    assert len(events(options)) > 8 * 8
    dull = dataclasses.replace(options, speed=0, refractory=1000, bandwidth=1e6, threshold=10, mismatch=10, seed=2**63 - 1)
    assert len(events(dull)) <= 8 * 8


def test_every_option_says_in_a_sentence_what_it_is_and_its_bounds():
    source = ast.parse(inspect.getsource(Simulation)).body[0].body
    texts = {a.target.id: b.value.value for a, b in pairwise(source) if isinstance(a, ast.AnnAssign) and isinstance(b, ast.Expr)}
    assert set(texts) == {f.name for f in dataclasses.fields(Simulation)}
    for name, text in texts.items():
        assert len(text.split()) > 5, name
        assert text[0].isupper()
        assert text.endswith(".")
        if name in LIMITS and name != "seed":
            least, most, unit = LIMITS[name]
            assert f"{least} " in text
            assert f" {most}" in text
            assert unit.strip() in text


def test_more_frames_than_can_be_are_refused(monkeypatch):
    remedy = r"lower speed than .* shorter duration than .* shorter focal length than"
    with pytest.raises(ValueError, match=remedy):
        simulate(Simulation("panorama", "rotation", speed=100, focal=2000.0))
    monkeypatch.setattr("torchcmax.simulator.MOST_FRAMES", 100)
    with pytest.raises(ValueError, match=f"at most 100 can be.*{remedy}"):
        simulate(Simulation())


def test_a_lens_that_cannot_be_inverted_names_the_options_to_change():
    with pytest.raises(ValueError, match=r"cannot be inverted.*weaker distortion than \(-5.0, .*focal length than 200.0 px.*240 x 180"):
        simulate(Simulation(distortion=(-5.0, 0.0, 0.0, 0.0, 0.0)))


def test_a_view_past_the_horizon_is_refused():
    with pytest.raises(
        ValueError, match=r"looks past the plane's horizon.*smaller tilt than .*larger distance than .*another motion than 6dof"
    ):
        simulate(Simulation(tilt=(50.0, 0.0)))
    with pytest.raises(ValueError, match=r"at 0\.\d+ s the camera"):
        simulate(Simulation(distance=0.1))


def test_chunks_stay_small_however_long_and_noisy_the_recording(monkeypatch):
    monkeypatch.setattr("torchcmax.simulator.CHUNK", 500)
    options = dataclasses.replace(SMALL, noise=100.0)
    chunks = list(simulate(options).chunks())
    assert max(map(len, chunks)) < 500 + 64 * 48
    assert len(chunks) > 5
    monkeypatch.undo()
    assert same(Events.join(chunks), events(options))


def test_a_sweep_goes_round_twice_in_six_seconds_and_nods():
    options = Simulation("panorama", "sweep")
    R = pose(options, torch.linspace(0, 6, 601, dtype=torch.float64)).R
    yaw = torch.atan2(R[:, 0, 2], R[:, 2, 2])
    turned = (yaw.diff() + math.pi) % (2 * math.pi) - math.pi
    assert turned.sum().item() == pytest.approx(4 * math.pi, abs=0.2)
    assert R[:, 1, 2].abs().max() > 0.2
    assert torch.equal(R[0], torch.eye(3, dtype=torch.float64))
    assert simulate(options).plane is None


def test_a_sweep_wants_a_panorama():
    with pytest.raises(ValueError, match=r"scene wants panorama, got 'poster'"):
        Simulation("poster", "sweep")
