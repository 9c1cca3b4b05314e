"""Tracking and mapping as a whole, on small simulated recordings with exact truth."""

from contextlib import ExitStack
from dataclasses import replace

import pytest
import torch
from scenes import angle

from torchcmax.core.camera import Camera
from torchcmax.core.match import Matching
from torchcmax.core.plane import Plane
from torchcmax.io import open
from torchcmax.mapfile import load_map, save_map
from torchcmax.score import score
from torchcmax.simulator import Simulation, write
from torchcmax.slam.mapper import Mapping
from torchcmax.slam.sense import Sensing
from torchcmax.slam.system import Slam, System, TooShort
from torchcmax.slam.tracker import Tracking

SLAM = Slam(mapping=Mapping(first=8))


def run(recording, *stretches, slam=SLAM, maps=None, through=lambda stream: stream):
    """The recording from and to some seconds, each as a camera of its own in one batch: the system, and the tracks of each."""
    stretches = stretches or ((None, None),)
    system = System([recording.camera] * len(stretches), slam, maps)
    found = [[] for _ in stretches]
    with ExitStack() as stack:
        streams = [stack.enter_context(recording.stream(*stretch)) for stretch in stretches]
        for one in system.run([through(stream) for stream in streams]):
            found[one.recording].append(one)
    return system, found


@pytest.fixture(scope="module")
def recording(recorded):
    return open(recorded)


@pytest.fixture(scope="module")
def tracked(recording):
    system, (found,) = run(recording)
    return system, found


def same(a, b):
    return torch.equal(a.time, b.time) and torch.equal(a.pose.t, b.pose.t) and torch.equal(a.pose.R, b.pose.R)


def first_plane(recording):
    """The true plane as the camera of the first event sees it."""
    return recording.plane.seen_from(recording.truth.pose[:1])


@pytest.mark.parametrize("first", [8, 16])
def test_the_truth_of_a_small_scene_is_recovered_from_nothing(recording, first):
    system, (found,) = run(recording, slam=Slam(mapping=Mapping(first=first)))
    error = score(system.trajectory(), recording.truth, recording.plane)
    assert error.percent_of_distance < 0.8
    assert error.orientation_rmse_deg < 1.2
    assert error.coverage == 1
    assert angle(system.maps[0].plane, first_plane(recording)) < 2
    assert [one.status for one in found] == ["start"] * first + ["ok"] * (len(found) - first)


def test_positions_are_in_distances_of_the_plane_from_the_camera_at_the_first_event(tracked, recording):
    trajectory = tracked[0].trajectory()
    truth = recording.truth.at(trajectory.time)
    assert tracked[0].maps[0].plane.distance.item() == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(trajectory.pose.t * first_plane(recording).distance, truth.t, rtol=0, atol=0.02)
    torch.testing.assert_close(trajectory.pose.R, truth.R, rtol=0, atol=0.03)


def test_tracks_tell_what_became_of_each_window(tracked, recording):
    system, found = tracked
    assert [one.index for one in found] == list(range(len(found)))
    assert sum(one.drawn for one in found) == len(system.maps[0].keyframes)
    assert all(0 <= one.overlap <= 1 for one in found)
    assert all(0 < one.strength < 1 for one in found if one.status != "start")
    assert all(one.contrast > one.contrast_zero for one in found)
    assert all(one.state.pose.t.isfinite().all() for one in found)
    assert all(0 <= one.keyframe < len(system.maps[0].keyframes) for one in found)
    for one in found:
        there = recording.plane.seen_from(recording.truth.at(torch.tensor([one.time])))
        assert angle(Plane(one.normal, torch.ones(1)), there) < 4


def test_two_runs_are_the_same_to_the_bit(tracked, recording):
    again, (found,) = run(recording)
    assert same(again.trajectory(), tracked[0].trajectory())
    assert torch.equal(again.maps[0].plane.normal, tracked[0].maps[0].plane.normal)
    assert [one.evaluations for one in found] == [one.evaluations for one in tracked[1]]
    assert all(torch.equal(tile.votes, tracked[0].maps[0].tiles[name].votes) for name, tile in again.maps[0].tiles.items())


def test_recordings_in_one_batch_are_tracked_as_each_alone(recording):
    stretches = (None, 0.55), (0.15, 0.8)
    together, found = run(recording, *stretches)
    assert len(found[0]) != len(found[1])
    for i, stretch in enumerate(stretches):
        alone, (tracks,) = run(recording, stretch)
        assert same(together.trajectory(i), alone.trajectory())
        assert [one.time for one in found[i]] == [one.time for one in tracks]
        assert torch.equal(together.maps[i].plane.normal, alone.maps[0].plane.normal)
        assert together.maps[i].number == 0


def test_a_saved_map_is_tracked_against_and_stays_as_it_is(tracked, recording, tmp_path):
    save_map(tmp_path / "map.h5", tracked[0].maps[0])
    loaded, kept = load_map(tmp_path / "map.h5"), load_map(tmp_path / "map.h5")
    for stretch in ((None, None), (0.3, 0.8)):
        system, (found,) = run(recording, stretch, maps=[loaded])
        assert system.maps[0] is loaded
        assert {one.status for one in found} == {"ok"}
        assert not any(one.drawn for one in found)
        error = score(system.trajectory(), recording.truth, recording.plane, 1000 * 300 if stretch[0] else None)
        assert error.percent_of_distance < 0.8
        assert error.orientation_rmse_deg < 1.2
        there = tracked[0].trajectory().at(system.trajectory().time.clamp(*tracked[0].trajectory().time[[0, -1]].tolist()))
        assert float((system.trajectory().pose.t - there.t).norm(dim=-1).median()) < 0.01
    assert loaded.tiles.keys() == kept.tiles.keys()
    assert all(torch.equal(tile.votes, kept.tiles[name].votes) for name, tile in loaded.tiles.items())
    assert all(torch.equal(tile.exposure, kept.tiles[name].exposure) for name, tile in loaded.tiles.items())
    assert torch.equal(loaded.plane.normal, kept.plane.normal)
    assert len(loaded.keyframes) == len(kept.keyframes)
    assert all(torch.equal(a.state.pose.t, b.state.pose.t) for a, b in zip(loaded.keyframes, kept.keyframes, strict=True))


@pytest.mark.parametrize("end", [0.0001, 0.002])
def test_a_recording_that_is_too_short_says_so(recording, end):
    with pytest.raises(TooShort, match="recording 0 holds too few events to begin"):
        run(recording, (None, end))


def test_a_recording_of_no_more_than_the_first_windows_is_tracked(recording):
    system, (found,) = run(recording, (None, 0.1))
    assert {one.status for one in found} == {"start"}
    assert 2 <= len(found) <= 8
    assert len(system.trajectory()) == len(found)


class Blind:
    """A stream whose events from a moment on, µs, are mirrored: edges that move, and that the map does not hold."""

    def __init__(self, stream, since):
        self.stream, self.since = stream, since

    def spoilt(self, window):
        if window is None or window.start.item() < self.since:
            return window
        return replace(window, ray=window.ray * torch.tensor([-1.0, 1.0, 1.0]))

    def look(self, events, seconds):
        return self.spoilt(self.stream.look(events, seconds))

    def skip(self, events):
        self.stream.skip(events)


@pytest.fixture(scope="module")
def blinded(recording):
    return run(recording, slam=replace(SLAM, atlas=False), through=lambda stream: Blind(stream, 350_000))


def test_a_blind_camera_is_weak_and_then_lost(blinded):
    found = blinded[1][0]
    before, after = ([one for one in found if (one.window.start.item() >= 350_000) is late] for late in (False, True))
    assert {one.status for one in before} == {"start", "ok"}
    statuses = [one.status for one in after]
    assert "ok" not in statuses
    assert statuses == sorted(statuses, reverse=True)  # weak, then lost
    lost = [one for one in after if one.status == "lost"]
    assert lost
    assert (lost[0].time - after[0].time) * 1e-6 > Sensing().patience
    assert all(one.state.pose.t.isfinite().all() for one in after)


def test_what_a_blind_camera_sees_is_not_drawn(blinded):
    system, (found,) = blinded
    assert not any(one.drawn for one in found if one.window.start >= 350_000)
    last = max(one.time for one in found if one.window.start < 350_000)
    assert system.maps[0].keyframes[-1].time <= last


@pytest.mark.parametrize(("most", "seconds"), [(3000, 0.04), (30000, 0.012)])
def test_windows_are_bounded_by_events_and_time_and_none_is_lost(recording, most, seconds):
    tracking = Tracking(most=most, seconds=seconds)
    with recording.stream(None, 0.3) as stream:
        found = list(System([recording.camera], replace(SLAM, tracking=tracking)).run([stream]))
        assert sum(one.window.ray.shape[1] for one in found) == stream.consumed
    assert max(one.window.ray.shape[1] for one in found) <= most
    assert max(one.window.duration.item() for one in found) <= seconds + 1e-6
    starts = [one.window.start.item() for one in found]
    assert starts == sorted(starts)
    usual = [one for one in found[:-1] if one.window.ray.shape[1] == most or one.window.duration.item() > 0.95 * seconds]
    assert len(usual) > 3


def test_windows_are_as_long_as_the_image_takes_to_move_by_the_displacement(tracked):
    """Of those that neither events nor time bound: the next window knows the motion of the last."""
    tracking = SLAM.tracking
    free = [w for one in tracked[1][8:-1] if (w := one.window).ray.shape[1] < tracking.most and w.duration.item() < 0.95 * tracking.seconds]
    if not free:
        pytest.skip("all windows are at their bounds")
    assert all(w.ray.shape[1] >= tracking.fewest for w in free)


@pytest.mark.parametrize("objective", ["variance", "lookup"])
@pytest.mark.parametrize("refine", ["motion", "full"])
def test_the_ways_of_the_thesis_run_without_exploding(recording, objective, refine):
    tracking = Tracking(matching=Matching(objective=objective, refine=refine))
    system, (found,) = run(recording, (None, 0.5), slam=replace(SLAM, tracking=tracking))
    trajectory = system.trajectory()
    assert trajectory.pose.t.isfinite().all()
    assert trajectory.pose.R.isfinite().all()
    assert float(trajectory.pose.t.norm(dim=-1).max()) < 1
    torch.testing.assert_close(torch.linalg.det(trajectory.pose.R), torch.ones(len(trajectory), dtype=torch.float64))
    assert "lost" not in {one.status for one in found}


@pytest.fixture(scope="module", params=["translation", "rotation"])
def simple(request, tmp_path_factory):
    """A camera that only shifts or only turns, tracked as one of which this is known."""
    folder = tmp_path_factory.mktemp(request.param) / "poster"
    write(Simulation(duration=0.5, motion=request.param), folder)
    recording = open(folder)
    return request.param, recording, *run(recording, slam=replace(SLAM, model=request.param))


def test_what_a_model_does_not_have_is_none(simple):
    name, _, system, (found,) = simple
    pose = system.trajectory().pose
    if name == "translation":
        torch.testing.assert_close(pose.R, torch.eye(3, dtype=torch.float64).expand_as(pose.R), rtol=0, atol=1e-9)
        assert max(float(one.state.motion.omega.norm()) for one in found) < 1e-9
    else:
        torch.testing.assert_close(pose.t, torch.zeros_like(pose.t), rtol=0, atol=1e-9)
        assert max(float(one.state.motion.velocity.norm()) for one in found) < 1e-9


def test_a_model_that_is_known_is_tracked_as_well_as_without(simple):
    name, recording, system, _ = simple
    error = score(system.trajectory(), recording.truth, recording.plane, rotation_only=name == "rotation")
    assert error.orientation_rmse_deg < 1.5
    assert error.coverage == 1
    if name == "translation":
        assert error.percent_of_distance < 0.8


def test_cameras_of_another_sensor_and_maps_of_another_number_are_refused(recording, tracked):
    with pytest.raises(ValueError, match="want the same sensor"):
        System([recording.camera, Camera.pinhole((90, 120))])
    with pytest.raises(ValueError, match="2 cameras want as many maps, got 1"):
        System([recording.camera] * 2, SLAM, tracked[0].maps)
    with pytest.raises(ValueError, match="the map wants the sensor that drew it"):
        System([Camera.pinhole((90, 120))], SLAM, tracked[0].maps)


def test_there_is_no_map_before_the_first_plane(recording):
    with pytest.raises(ValueError, match="no map before the first plane"):
        _ = System([recording.camera]).maps
