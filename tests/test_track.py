import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.io import DataError, open
from torchcmax.judge import Judge
from torchcmax.mapfile import load_map, save_map
from torchcmax.slam.system import Slam, System
from torchcmax.track import TrackOptions, in_metres, load_kernels, track


def options(first=8, **more):
    """The first plane from fewer windows than usual, as the recording is short."""
    slam = Slam()
    return TrackOptions(replace(slam, mapping=replace(slam.mapping, first=first)), **more)


@pytest.fixture(scope="module")
def tracked(small):
    tracks = track(open(small), options())
    return tracks, list(tracks)


def test_it_is_the_system_on_the_recordings_stream(tracked, small):
    tracks, found = tracked
    recording, system = open(small), System([open(small).camera], tracks.options.slam)
    with recording.stream() as stream:
        same = list(system.run([stream]))
    assert [one.time for one in same] == [one.time for one in found]
    assert torch.equal(system.trajectory().pose.t, tracks.trajectory().pose.t)
    assert torch.equal(system.maps[0].plane.normal, tracks.map.plane.normal)


def test_every_window_has_its_pose_and_they_follow_each_other(tracked):
    tracks, found = tracked
    assert tracks.trajectory().time.tolist() == [one.time for one in found]
    assert [one.index for one in found] == list(range(len(found)))
    assert {one.status for one in found} == {"start", "ok"}
    assert tracks.stream.consumed >= sum(one.window.ray.shape[1] for one in found)


def test_only_the_stretch_asked_for_is_tracked(small):
    found = list(track(open(small), options(first=3, begin=0.2, end=0.35)))
    assert found[0].window.start.item() >= 200_000
    last = found[-1].window
    assert last.start.item() + round(1e6 * last.duration.item()) < 350_000


def test_the_stream_is_closed_when_tracking_ends_early(small):
    tracks = track(open(small), options(first=3))
    for _ in tracks:
        break
    with pytest.raises(ValueError, match="closed"):
        tracks.stream.take(100, 1.0)


def test_too_few_events_are_an_error_of_the_data(small):
    with pytest.raises(DataError, match="cannot be tracked") as caught:
        list(track(open(small), options(end=0.0005)))
    assert "--from" in str(caught.value)


def test_a_saved_map_is_tracked_against_and_left_as_it_is(tracked, small, tmp_path):
    tracks, found = tracked
    save_map(tmp_path / "map.h5", tracks.map)
    again = track(open(small), options(map=str(tmp_path / "map.h5")))
    count = len(list(again))
    assert count >= len(found) - 2
    save_map(tmp_path / "after.h5", again.map)
    assert (tmp_path / "after.h5").read_bytes() == (tmp_path / "map.h5").read_bytes()
    there = tracks.trajectory().at(again.trajectory().time.clamp(found[0].time, found[-1].time))
    assert (again.trajectory().pose.t - there.t).norm(dim=-1).median() < 0.02
    assert load_map(tmp_path / "after.h5").plane.distance.item() == 1


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"distance": 0.0}, "--distance wants metres above 0"),
        ({"distance": float("nan")}, "--distance"),
        ({"begin": 2.0, "end": 1.0}, "--from must come before --to"),
        ({"begin": float("inf")}, "--from wants seconds"),
        ({"end": float("nan")}, "--to wants seconds"),
    ],
)
def test_options_that_make_no_sense_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        TrackOptions(**wrong)


def test_metres_scale_positions_and_nothing_else(tracked):
    found = tracked[0].trajectory()
    scaled = in_metres(found, 2.5)
    torch.testing.assert_close(scaled.pose.t, 2.5 * found.pose.t)
    assert scaled.pose.R is found.pose.R
    assert track(tracked[0].recording, TrackOptions(distance=2.5)).unit == 2.5
    assert track(tracked[0].recording).unit == 1.0


PLANE = Plane(torch.tensor([[0.6, 0.0, -0.8]], dtype=torch.float64), torch.tensor([3.0], dtype=torch.float64))


def truth():
    """Poses of a camera that turns and moves, every 10 ms for a second, in metres."""
    s = torch.linspace(0, 1, 101, dtype=torch.float64)[:, None]
    R = so3.exp(torch.cat([0.3 * s, -0.2 * s, 0.5 * s.sin()], -1))
    return Trajectory((s[:, 0] * 1e6).round().long(), Pose(R, torch.cat([0.4 * s, 0.3 * s * s, (2 * s).sin() / 4], -1)))


def seen(error=0.0):
    """The truth in the world of its first camera, in distances of the plane from there, and the plane."""
    there = truth()
    first = there.pose[:1]
    plane = PLANE.seen_from(first)
    back = first.inverse()
    pose = Pose(back.R.expand(101, 3, 3), back.t.expand(101, 3)) @ there.pose
    shift = torch.linspace(0, error, 101, dtype=torch.float64)[:, None]
    return Trajectory(there.time, Pose(pose.R, pose.t / plane.distance + shift)), Plane(plane.normal, torch.ones_like(plane.distance))


def judge(with_truth=True, with_plane=True, model="planar"):
    recording = SimpleNamespace(truth=truth() if with_truth else None, plane=PLANE if with_plane else None)
    return Judge(SimpleNamespace(recording=recording, options=TrackOptions(Slam(model=model))))


def test_live_errors_are_none_on_the_truth_and_grow_with_what_is_off():
    for error in (0.0, 0.02):
        found, plane = seen(error)
        live, lines = judge(), []
        for part in (slice(0, 10), slice(10, 11), slice(11, None)):
            lines += live.live(found.time[part], found.pose[part], plane)
        percent = [line["error/live_percent_of_distance"] for line in lines]
        assert max(line["error/live_orientation_deg"] for line in lines) < 1e-6
        distance = PLANE.seen_from(truth().pose[:1]).distance.item()
        expected = 100 * error * 3**0.5 * distance / PLANE.distance.item()
        assert percent[0] == pytest.approx(0, abs=1e-9)
        assert percent[-1] == pytest.approx(expected, abs=1e-9)


def test_there_are_no_errors_where_the_truth_is_of_another_time():
    found, plane = seen()
    lines = judge().live(found.time + 500_000, found.pose, plane)
    assert [bool(line) for line in lines] == [True] * 51 + [False] * 50
    assert judge().final(Trajectory(found.time + 5_000_000, found.pose), plane.normal) is None


def test_without_truth_there_is_no_error_and_without_plane_none_of_position():
    found, plane = seen()
    assert judge(with_truth=False).live(found.time, found.pose, plane) == [{}] * 101
    assert judge(with_truth=False).final(found, plane.normal) is None
    for kind in (judge(with_plane=False), judge(model="rotation")):
        assert set(kind.live(found.time, found.pose, plane)[5]) == {"error/live_orientation_deg"}
        final = kind.final(found, plane.normal)
        error, curves = final.error, final.curves
        assert error["percent_of_distance"] is None
        assert error["plane_deg"] is None
        assert set(curves[found.time[5].item()]) == {"error/final_orientation_deg"}


def test_the_final_error_is_after_the_similarity():
    found, plane = seen(0.01)
    turn = so3.exp(torch.tensor([0.3, -1.0, 0.7], dtype=torch.float64))
    moved = Trajectory(found.time, Pose(turn @ found.pose.R, 5 * found.pose.t @ turn.mT + 3))
    final = judge().final(moved, plane.normal @ turn.mT)
    error, curves = final.error, final.curves
    assert torch.equal(final.truth.time, moved.time)
    apart = (final.truth.pose.t - moved.pose.t).norm(dim=-1).square().mean().sqrt()
    assert 0 < apart < 0.05 * moved.pose.t.std()  # the truth lies where the estimate is, in its unit
    assert error["coverage"] == pytest.approx(1)
    assert 0 < error["percent_of_distance"] < 1
    rms = torch.tensor([line["error/final_percent_of_distance"] for line in curves.values()]).square().mean().sqrt().item()
    assert rms == pytest.approx(error["percent_of_distance"], rel=1e-5)


@pytest.mark.parametrize("model", ["planar", "translation", "rotation"])
def test_kernels_are_loaded_by_tracking_something(model, monkeypatch):
    made = []

    class Watched(System):
        def run(self, sources):
            for one in super().run(sources):
                made.append(one.status)
                yield one

    monkeypatch.setattr("torchcmax.track.System", Watched)
    load_kernels(Slam(model=model), "cpu")
    assert made[:2] == ["start", "start"]
    assert len(made) > 2


@pytest.mark.parametrize("angle", [0.0, 0.1])
def test_the_final_error_tells_how_far_the_plane_is_tilted(angle):
    found, plane = seen()
    normal = plane.normal @ so3.exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64)).mT
    assert judge().final(found, normal).error["plane_deg"] == pytest.approx(math.degrees(angle), abs=1e-6)
