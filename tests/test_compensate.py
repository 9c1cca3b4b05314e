from itertools import count
from threading import enumerate as enumerate_threads

import numpy as np
import pytest
import torch

from torchcmax.compensate import Compensation, compensate, given_normal, motion_model, true_normal
from torchcmax.core.camera import Camera
from torchcmax.core.model import Planar, PlanarKnown, Rotation, Translation
from torchcmax.io import DataError, DataWarning, Events, OpenOptions, Recording, open


@pytest.fixture(scope="module")
def recording(demo):
    return open(demo)


def test_windows_come_in_order_whatever_the_batch(recording):
    def run(batch):
        parts = list(compensate(recording, Compensation(events=8000, batch=batch, limit=5)))
        return torch.cat([w.start for w, _ in parts]), torch.cat([e.motion.omega for _, e in parts]), [len(w) for w, _ in parts]

    start, omega, sizes = run(2)
    assert sizes == [2, 2, 1]
    assert (start.diff() > 0).all()
    for batch in (1, 5, 16):
        other = run(batch)
        assert torch.equal(other[0], start)
        assert torch.equal(other[1], omega)


def test_the_limit_is_kept_and_the_rest_not_even_read(recording):
    parts = list(compensate(recording, Compensation(events=5000, limit=1, batch=16)))
    assert sum(len(window) for window, _ in parts) == 1


def test_no_more_than_the_next_batch_is_read_and_the_file_closed(recording):
    log = []

    def chunks():
        try:
            for i in count():
                log.append(i)
                yield noisy(2000 * i)
        finally:
            log.append("closed")

    endless = Recording(recording.path, "endless", recording.camera, chunks)
    for options in (Compensation(events=1000, batch=2), Compensation(events=1000, batch=2, limit=2)):
        log.clear()
        parts = compensate(endless, options)
        next(parts)
        parts.close()
        assert log in ([0, "closed"], [0, 1, "closed"])  # a chunk is a batch; the next may not have been begun
        if options.limit:
            assert 1 not in log
    assert not [thread for thread in enumerate_threads() if thread.name.startswith("ahead")]


def noisy(start):
    """2000 events at random places."""
    rng = np.random.default_rng(start)
    x, y, p = (rng.integers(0, most, 2000).astype(kind) for most, kind in ((240, "u2"), (180, "u2"), (2, "u1")))
    return Events(start + np.arange(2000), x, y, p)


def test_an_error_in_the_file_comes_after_the_windows_before_it(recording):
    def chunks():
        yield noisy(0)
        yield noisy(2000)
        raise DataError("events.txt", "letters in a column", "mend it", "line 4001")

    parts = compensate(Recording(recording.path, "torn", recording.camera, chunks), Compensation(events=1000, batch=2))
    assert [len(next(parts)[0]) for _ in range(2)] == [2, 2]
    with pytest.raises(DataError, match="line 4001"):
        next(parts)


def test_what_is_said_of_the_file_is_said_to_the_caller(demo, tmp_path):
    text = "".join(f"{i * 1e-5:.6f} {i * 7 % 240} {i * 5 % 180} {i % 2}\n" for i in [*range(500), 520, *range(501, 520), *range(521, 2000)])
    (tmp_path / "events.txt").write_text(text)
    late = open(tmp_path, OpenOptions(camera=str(demo / "calib.txt"), sensor=(240, 180)))
    with pytest.warns(DataWarning, match="19 of 1999 events were out of order"):
        assert sum(len(window) for window, _ in compensate(late, Compensation(events=500, batch=1))) == 3


@pytest.mark.parametrize(
    ("options", "kind", "normal"),
    [
        ({"model": "rotation"}, Rotation, None),
        ({"model": "translation"}, Translation, None),
        ({"model": "translation", "plane": "wall"}, Translation, None),
        ({"model": "planar"}, Planar, None),
        ({"model": "planar", "plane": "free"}, Planar, None),
        ({"model": "planar", "plane": "wall"}, PlanarKnown, None),
        ({"model": "planar", "plane": "0, 3, -4"}, PlanarKnown, (0.0, 0.6, -0.8)),
        ({"model": "translation", "plane": "0 -3 4"}, Translation, (0.0, 0.6, -0.8)),
    ],
)
def test_model_and_plane_name_the_motion_model(recording, options, kind, normal):
    window = next(recording.windows(1000, batch=2))
    model = motion_model(Compensation(**options), recording, window)
    assert type(model) is kind
    if normal is None:
        assert model.normal is None
    else:
        torch.testing.assert_close(model.normal, torch.tensor(normal).expand(2, 3))


def test_the_true_plane_is_that_of_each_windows_first_camera(recording):
    start = torch.tensor([0, 60_000])
    normal = true_normal(recording, start)
    torch.testing.assert_close(normal[0], recording.plane.normal[0])
    pose = recording.truth.at(start)
    torch.testing.assert_close(normal, (pose.R.mT @ recording.plane.normal[0][:, None])[..., 0])
    window = next(recording.windows(8000, batch=2))
    model = motion_model(Compensation(model="planar", plane="truth"), recording, window)
    torch.testing.assert_close(model.normal, true_normal(recording, window.start))


def test_without_truth_the_true_plane_is_refused(recording):
    bare = Recording(recording.path, "bare", recording.camera, recording.chunks)
    with pytest.raises(DataError, match="has no ground truth and plane"):
        next(compensate(bare, Compensation(model="planar", plane="truth", events=5000)))


def test_truth_that_ends_too_early_is_named(recording):
    with pytest.raises(DataError, match="asked for 9000000 us"):
        true_normal(recording, torch.tensor([9_000_000]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"events": 1}, "events wants a number of at least 2"),
        ({"batch": 0}, "batch wants a number of at least 1"),
        ({"limit": 0}, "limit wants"),
        ({"stride": -3}, "stride wants"),
        ({"plane": "floor"}, "--plane wants auto, free, wall, truth or three numbers"),
        ({"plane": "0,0,0"}, "normal with a length"),
        ({"plane": "nan,0,1"}, "normal with a length"),
        ({"model": "translation", "plane": "free"}, "goes with --model planar"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        Compensation(**options)


def test_a_normal_is_made_unit_and_turned_to_the_camera():
    assert given_normal("0 0 5") == (0.0, 0.0, -1.0)
    assert given_normal("truth") is None


def test_too_few_events_for_one_window_are_named(recording):
    with pytest.raises(DataError, match=r"fewer than one window of 10000000\n  what to do: take smaller windows: --events \d+"):
        next(compensate(recording, Compensation(events=10_000_000)))


def test_motions_of_the_built_in_recording_are_near_the_truth(recording):
    """The simulator is honest: the estimator finds its motion as it does on the recordings of another simulator."""
    parts = list(compensate(recording, Compensation(model="planar", plane="truth", events=20000)))
    error = torch.cat([e.motion.omega - recording.truth.motion(w.start, w.duration.double()).omega for w, e in parts])
    pixels = error.norm(dim=-1) * torch.cat([w.duration for w, _ in parts]) * recording.camera.fx
    assert pixels.median() < 1.0


def test_a_camera_of_another_size_makes_no_difference_to_the_code(recording):
    """Events on a 64 x 48 sensor with its own calibration."""

    def chunks():
        for chunk in recording.chunks():
            yield type(chunk)(chunk.t, chunk.x // 4, chunk.y // 4, chunk.p)

    small = Recording(recording.path, "small", Camera((48, 64), 50.0, 50.0, 31.5, 23.5), chunks)
    _, estimate = next(compensate(small, Compensation(events=20000, limit=1)))
    assert estimate.gain.isfinite().all()
