"""Datasets of windows: every window once and the same, however it is reached, and its truth."""

import copy
import pickle
from collections import OrderedDict

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.data import Augment, WindowDataset, WindowStream, collate
from torchcmax.io import DataError, OpenOptions, Recording, open, save
from torchcmax.io.events import Events

CAMERA = Camera((24, 32), 30.0, 30.0, 15.0, 11.0)
MOTION = Motion(torch.tensor([[0.3, -0.5, 0.2]], dtype=torch.float64), torch.tensor([[0.4, 0.1, -0.3]], dtype=torch.float64))


def recording(tmp_path, name="r", count=1000, truth=True, seed=0):
    """Random events, 100 us apart on average, of a camera at constant velocity before a tilted plane 2 m away."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.integers(0, 200, count)) + 5_000_000
    events = Events(t, *(rng.integers(0, most, count).astype(kind) for most, kind in ((32, "u2"), (24, "u2"), (2, "u1"))))
    time = torch.arange(4_999_000, int(t[-1]) + 2000, 1000)
    pose = MOTION.at((time - time[0]).double()[None] * 1e-6)
    known = Trajectory(time, Pose(pose.R[0], pose.t[0]))
    plane = Plane(Plane.tilted(torch.tensor([[0.2, -0.1]], dtype=torch.float64)).normal, torch.tensor([2.0], dtype=torch.float64))
    return Recording(tmp_path / name, name, CAMERA, lambda: iter([events]), count, *((known, plane) if truth else ()))


@pytest.fixture
def file(tmp_path):
    save(recording(tmp_path), tmp_path / "r.h5")
    return tmp_path / "r.h5"


@pytest.fixture
def text(tmp_path):
    """The same kind of events as text, without truth."""
    (events,) = recording(tmp_path, seed=1).chunks()
    folder = tmp_path / "text"
    folder.mkdir()
    rows = zip(events.t, events.x, events.y, events.p, strict=True)
    (folder / "events.txt").write_text("".join(f"{t * 1e-6:.6f} {x} {y} {p}\n" for t, x, y, p in rows))
    (folder / "calib.txt").write_text("30 30 15 11 0 0 0 0 0\n")
    return folder


SENSOR = OpenOptions(sensor=(32, 24))


def equal(a, b):
    """Two samples, or windows, to the last bit."""
    pairs = zip(vars(a).values(), vars(b).values(), strict=True)
    return all(torch.equal(x.nan_to_num(7), y.nan_to_num(7)) if isinstance(x, torch.Tensor) else equal(x, y) for x, y in pairs)


def test_windows_are_those_of_the_recording(file):
    """Random access gives what reading in order gives."""
    dataset, expected = WindowDataset(file, 100, 70), list(open(file).windows(100, 70))
    assert len(dataset) == len(expected) == 13
    for i in np.random.default_rng(0).permutation(13):
        found = dataset[int(i)]
        assert all(torch.equal(getattr(found.window, name), getattr(expected[i], name)) for name in vars(expected[i]))
        assert (found.recording.item(), found.event.item()) == (0, 70 * i)
    assert equal(dataset[-1], dataset[12])
    with pytest.raises(IndexError, match="13 windows, asked for number 13"):
        dataset[13]


def test_several_recordings_of_any_format_follow_each_other(file, text):
    dataset = WindowDataset([file, text], 300, options=SENSOR)
    assert [(s.recording.item(), s.event.item()) for s in (dataset[i] for i in range(6))] == [
        (r, 300 * i) for r in (0, 1) for i in range(3)
    ]
    assert dataset[2].omega.isfinite().all()
    assert dataset[3].omega.isnan().all()
    (window,) = list(open(text, SENSOR).windows(300))[1:2]
    assert torch.equal(dataset[4].window.ray, window.ray)


def test_truth_is_that_of_the_motion(file):
    sample = WindowDataset(file, 100)[3]
    since = (sample.window.start - 4_999_000).double() * 1e-6
    there = MOTION.at(since[None])
    torch.testing.assert_close(sample.omega, MOTION.omega.float(), rtol=1e-3, atol=0)  # times are whole us
    plane = Plane(Plane.tilted(torch.tensor([[0.2, -0.1]], dtype=torch.float64)).normal, torch.tensor([2.0], dtype=torch.float64))
    seen = plane.seen_from(there[:, 0])
    torch.testing.assert_close(sample.normal, seen.normal.float())
    torch.testing.assert_close(sample.distance, seen.distance.float())
    expected = (there[:, 0].R.mT @ MOTION.velocity[..., None])[..., 0] / seen.distance
    torch.testing.assert_close(sample.velocity, expected.float(), rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(sample.R, there.R[:, 0].float())
    torch.testing.assert_close(sample.t, there.t[:, 0].float())


def test_truth_that_does_not_cover_a_window_is_not_known(tmp_path):
    whole = recording(tmp_path)
    part = Trajectory(whole.truth.time[:30], whole.truth.pose[:30])
    dataset = WindowDataset(Recording(whole.path, "r", CAMERA, whole.chunks, 1000, part, whole.plane), 100)
    known = [bool(dataset[i].omega.isfinite().all()) for i in range(10)]
    assert known == [int(dataset[i].window.start + dataset[i].window.duration * 1e6) <= part.time[-1] for i in range(10)]
    assert {*known} == {True, False}


@pytest.mark.parametrize("at", [0.0, 0.5, 1.0])
def test_flow_is_where_points_of_the_plane_go(file, at):
    """A point of the plane, projected by the poses at the beginning, at `at`, and at the end."""
    sample = WindowDataset(file, 400)[1].to("cpu", torch.float64)
    canvas, duration = Canvas.around(CAMERA, 0.0), sample.window.duration
    flow = sample.flow(canvas, at)
    assert flow.shape == (1, 2, 24, 32)
    motion = Motion(sample.omega, sample.velocity)
    x, y = 21, 5
    ray = torch.tensor([[(x - 15) / 30, (y - 11) / 30, 1.0]], dtype=torch.float64)
    then = motion.at(at * duration[:, None])[:, 0]
    plane = Plane(sample.normal, torch.ones(1, dtype=torch.float64)).seen_from(then)
    depth = -plane.distance / (plane.normal * ray).sum(-1)
    point = (then.R @ (depth[:, None] * ray)[..., None])[..., 0] + then.t
    ends = [motion.at(share * duration[:, None])[:, 0] for share in (0.0, 1.0)]
    begin, end = (canvas.pixels((pose.R.mT @ (point - pose.t)[..., None])[..., 0]) for pose in ends)
    torch.testing.assert_close(flow[:, :, y, x], end - begin, rtol=1e-9, atol=1e-9)


def test_a_camera_that_turns_needs_no_plane(tmp_path):
    whole = recording(tmp_path)
    truth = Trajectory(whole.truth.time, Pose(whole.truth.pose.R, torch.zeros_like(whole.truth.pose.t)))
    sample = WindowDataset(Recording(whole.path, "r", CAMERA, whole.chunks, 1000, truth), 100)[0]
    assert sample.normal.isnan().all()
    assert (sample.velocity == 0).all()
    assert sample.flow(Canvas.around(CAMERA, 0.0)).isfinite().all()
    backwards = Augment(CAMERA, 0, 0, 1, 0, 0)(sample, torch.Generator())
    assert (backwards.velocity == 0).all()
    assert backwards.flow(Canvas.around(CAMERA, 0.0)).isfinite().all()


@pytest.mark.filterwarnings("ignore:This DataLoader will create 4 worker processes")
@pytest.mark.parametrize("workers", [0, 1, 4])
@pytest.mark.parametrize("kind", ["dataset", "stream"])
def test_any_number_of_workers_gives_the_same_samples(file, text, workers, kind):
    augment = Augment(CAMERA, crop=0.7)
    if kind == "dataset":
        dataset = WindowDataset([file, text], 90, 41, augment, seed=3, options=SENSOR)
        expected = [dataset[i] for i in range(len(dataset))]
    else:
        dataset = WindowStream([file, text], 90, 41, augment, seed=3, options=SENSOR)
        expected = list(dataset)
    found = list(DataLoader(dataset, batch_size=1, num_workers=workers, collate_fn=collate))
    assert len(found) == len(expected) == 2 * 23
    key = lambda sample: (sample.recording.item(), sample.event.item())  # noqa: E731
    assert all(equal(a, b) for a, b in zip(sorted(found, key=key), sorted(expected, key=key), strict=True))


def test_a_stream_gives_what_the_dataset_gives(file, text):
    dataset, stream = (kind([file, text], 90, 41, options=SENSOR) for kind in (WindowDataset, WindowStream))
    assert all(equal(a, b) for a, b in zip(stream, (dataset[i] for i in range(len(dataset))), strict=True))


@pytest.mark.parametrize("shuffle", [0, 1, 5, 1000])
def test_shards_share_the_windows_among_them(file, text, shuffle):
    found = [
        (s.recording.item(), s.event.item())
        for rank in range(3)
        for s in DataLoader(
            WindowStream([file, text], 90, 41, shuffle=shuffle, shard=(rank, 3), options=SENSOR), 1, num_workers=2, collate_fn=collate
        )
    ]
    assert sorted(found) == [(r, 41 * i) for r in (0, 1) for i in range(23)]
    assert shuffle < 5 or found != sorted(found)


def test_an_epoch_changes_order_and_augmentation_and_comes_back(file):
    stream = WindowStream(file, 90, 41, Augment(CAMERA), shuffle=8)

    def epoch(number):
        stream.set_epoch(number)
        return list(stream)

    first, second, again = epoch(0), epoch(1), epoch(0)
    assert all(equal(a, b) for a, b in zip(first, again, strict=True))
    assert [s.event.item() for s in first] != [s.event.item() for s in second]
    dataset = WindowDataset(file, 90, transform=Augment(CAMERA))
    before = dataset[2]
    dataset.set_epoch(1)
    assert not equal(before, dataset[2])


def test_living_workers_hear_of_the_epoch(file):
    dataset = WindowDataset(file, 90, transform=Augment(CAMERA))
    loader = DataLoader(dataset, batch_size=None, num_workers=1, persistent_workers=True)
    first = list(loader)
    dataset.set_epoch(1)
    assert not any(equal(a, b) for a, b in zip(first, loader, strict=True))
    assert all(equal(a, b) for a, b in zip(loader, (dataset[i] for i in range(len(dataset))), strict=True))


def test_copies_hear_of_their_own_epoch(file):
    dataset = WindowDataset(file, 90, transform=Augment(CAMERA))
    for copied in (copy.deepcopy(dataset), pickle.loads(pickle.dumps(dataset))):
        loader = DataLoader(copied, batch_size=None, num_workers=1, persistent_workers=True)
        first = list(loader)
        copied.set_epoch(1)
        assert not any(equal(a, b) for a, b in zip(first, loader, strict=True))
    assert equal(dataset[0], first[0])


@pytest.mark.parametrize(("events", "stride", "workers"), [(90, 45, 4), (100, 75, 4), (90, 70, 2)])
def test_ranks_differ_by_one_window_at_most(file, events, stride, workers):
    counts = [len(list(DataLoader(WindowStream(file, events, stride, shard=(rank, 2)), None, num_workers=workers))) for rank in (0, 1)]
    assert abs(counts[0] - counts[1]) <= 1


def test_recordings_without_a_file_are_not_mixed_up_in_the_cache(tmp_path):
    first, second = (recording(tmp_path, "gone", seed=seed) for seed in (1, 2))
    a, b = (WindowDataset(one, 100, cache=tmp_path / "cache") for one in (first, second))
    assert not equal(a[0].window, b[0].window)


def test_a_window_without_duration_has_no_known_motion(tmp_path):
    whole = recording(tmp_path)
    (events,) = whole.chunks()
    still = Events(events.t // 20_000 * 20_000, events.x, events.y, events.p)
    dataset = WindowDataset(Recording(whole.path, "r", CAMERA, lambda: iter([still]), 1000, whole.truth, whole.plane), 50)
    batch = collate([dataset[i] for i in range(len(dataset))])
    empty = batch.window.duration == 0
    assert empty.any()
    assert batch.omega[empty].isnan().all()
    assert torch.equal(batch.known, ~empty & batch.omega.isfinite().all(-1))
    assert batch[batch.known].omega.isfinite().all()


def test_an_error_in_a_worker_is_the_same_error(file):
    error = DataError("a.h5", "is broken", "mend it", "event 3")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.path, again.place) == (str(error), error.path, "event 3")
    with pytest.raises(DataError, match="fewer than one window"):
        list(DataLoader(WindowStream(file, 2000), None, num_workers=1))


def test_more_recordings_than_files_may_be_open(tmp_path, monkeypatch):
    opened = OrderedDict()
    monkeypatch.setattr("torchcmax.io.hdf5._opened", opened)
    monkeypatch.setattr("torchcmax.io.hdf5.MOST_OPEN", 3)
    for i in range(7):
        save(recording(tmp_path, f"r{i}", 300, seed=i), tmp_path / f"r{i}.h5")
    dataset = WindowDataset([tmp_path / f"r{i}.h5" for i in range(7)], 100)
    expected = [list(open(tmp_path / f"r{i}.h5").windows(100)) for i in range(7)]
    for i in np.random.default_rng(0).integers(0, 21, 60):
        assert torch.equal(dataset[int(i)].window.ray, expected[i // 3][i % 3].ray)
    assert len(opened) <= 3


def test_a_window_that_begins_before_the_last_one_ended_is_refused(tmp_path):
    import h5py

    save(recording(tmp_path), tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5", "r+") as opened:
        opened["events/t"][199] = opened["events/t"][200] + 50
    dataset = WindowDataset(tmp_path / "r.h5", 100)
    assert dataset[1].event == 100
    with pytest.raises(DataError, match="event 201 is earlier"):
        dataset[2]


def test_a_loader_shuffles_by_its_seed(file):
    def order(seed):
        loader = DataLoader(WindowDataset(file, 90), 3, True, collate_fn=collate, generator=torch.Generator().manual_seed(seed))
        return torch.cat([batch.event for batch in loader]).tolist()

    assert order(0) == order(0) != order(1)
    assert sorted(order(0)) == [90 * i for i in range(11)]


def test_batches_are_padded(file):
    short, long = WindowDataset(file, 50)[1], WindowDataset(file, 80)[2]
    batch = collate([short, long])
    assert batch.window.ray.shape == (2, 80, 3)
    assert batch.window.polarity[0, 50:].eq(0).all()
    assert batch.event.tolist() == [50, 160]
    torch.testing.assert_close(batch.omega, torch.cat([short.omega, long.omega]))


def test_a_dataset_can_be_pickled_whatever_has_been_read(file, text):
    dataset = WindowDataset([file, text], 90, transform=Augment(CAMERA), options=SENSOR)
    before = [dataset[i] for i in (0, 15)]
    copy = pickle.loads(pickle.dumps(dataset))
    assert all(equal(a, copy[i]) for a, i in zip(before, (0, 15), strict=True))


def test_the_cache_is_made_once_and_again_where_the_recording_changed(text, tmp_path, monkeypatch):
    held = WindowDataset(text, 90, options=SENSOR)
    cached = [WindowDataset(text, 90, cache=tmp_path / "cache", options=SENSOR) for _ in range(2)]
    (copy,) = (tmp_path / "cache").iterdir()
    assert all(equal(held[i], dataset[i]) for dataset in cached for i in range(len(held)))
    made = copy.stat().st_mtime_ns
    WindowDataset(text, 90, cache=tmp_path / "cache", options=SENSOR)
    assert copy.stat().st_mtime_ns == made
    lines = (text / "events.txt").read_text().splitlines(keepends=True)
    (text / "events.txt").write_text("".join(lines[:-200]))
    assert len(WindowDataset(text, 90, cache=tmp_path / "cache", options=SENSOR)) == 8
    monkeypatch.setattr("torchcmax.data.windows.MOST_HELD", 700)
    assert len(WindowDataset(text, 90, cache=tmp_path / "cache", options=SENSOR)) == 8
    with pytest.raises(DataError, match=r"more than 700 events.*\n.*torchcmax convert"):
        WindowDataset(text, 90, options=SENSOR)


@pytest.mark.parametrize("kind", [WindowDataset, WindowStream])
def test_what_makes_no_sense_is_refused(file, kind, tmp_path):
    with pytest.raises(ValueError, match="at least 2 events"):
        kind(file, 1)
    with pytest.raises(ValueError, match="at least one recording"):
        kind([])
    with pytest.raises(DataError, match=r"holds 1000 events, fewer than one window of 1001"):
        list(kind(file, 1001))
    with pytest.raises(DataError, match="check the name"):
        list(kind(tmp_path / "nothing.h5"))


def test_a_file_that_is_out_of_order_or_off_the_sensor_is_refused_where_it_is(tmp_path):
    import h5py

    save(recording(tmp_path), tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        file["events/t"][250] = 5_000_000
        file["events/x"][620] = 32
    dataset = WindowDataset(tmp_path / "r.h5", 100)
    assert len(dataset[1].event) == 1
    with pytest.raises(DataError, match=r"event 251 is earlier than the one before it\n.*torchcmax convert"):
        dataset[2]
    with pytest.raises(DataError, match="events 601 to 700: events up to pixel"):
        dataset[6]


def test_a_file_that_is_cut_off_while_it_is_read_is_told(file):
    dataset = WindowDataset(file, 100)
    file.write_bytes(file.read_bytes()[:3000])
    with pytest.raises(DataError, match="cannot be read as HDF5"):
        dataset[0]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: nothing to pin memory for")
def test_memory_is_pinned(file):
    loader = DataLoader(WindowDataset(file, 100), 2, collate_fn=collate, pin_memory=True)
    assert next(iter(loader)).window.ray.is_pinned()


def test_the_flow_is_what_the_loss_wants(tmp_path):
    """Events that follow the true flow are as sharp as by the true motion, and sharper than half way there."""
    from torchcmax.nn import ContrastLoss, FlowContrastLoss
    from torchcmax.simulator import Simulation, simulate

    recording = simulate(Simulation(duration=0.25, speed=2.0, noise=0.0))
    sample = WindowDataset(recording, 8000)[4]
    canvas = Canvas.around(recording.camera, 0.0)
    by_flow = FlowContrastLoss(recording.camera, margin=0.25, smoothness=0.0, guard=0.0)
    by_motion = ContrastLoss(recording.camera, references=(0.0, 0.5, 1.0), guard=0.0)(
        sample.window, sample.omega, sample.velocity, sample.normal
    )
    flow = sample.flow(canvas)
    losses = {share: by_flow(sample.window, share * flow).item() for share in (0.0, 0.5, 0.8, 1.0, 1.2)}
    assert min(losses, key=losses.get) == 1.0, losses
    assert losses[0.0] - losses[1.0] > 0.97 * (losses[0.0] - by_motion.item())
