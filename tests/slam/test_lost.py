"""Noise, loss, recovery and local maps, on a small simulated recording with exact truth."""

from dataclasses import replace

import pytest
import torch
from test_system import SLAM, run

from torchcmax.io import open
from torchcmax.mapfile import load_map, save_map
from torchcmax.score import score
from torchcmax.simulator import Simulation, write
from torchcmax.slam.relocalize import Relocalizing
from torchcmax.slam.sense import Sensing


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """1.4 s, long enough to be lost in the middle of."""
    folder = tmp_path_factory.mktemp("long") / "poster"
    write(Simulation(duration=1.4), folder)
    return open(folder)


class Noise:
    """A stream whose events of some stretches, µs, are few and anywhere on the sensor."""

    def __init__(self, stream, stretches, camera, share=0.02):
        self.stream, self.stretches, self.rays, self.share = stream, stretches, camera.rays().float().view(-1, 3), share

    def look(self, events, seconds):
        window = self.stream.look(events, seconds)
        if window is None or not any(a <= window.start.item() < b for a, b in self.stretches):
            return window
        random = torch.Generator().manual_seed(window.start.item())
        ray = self.rays[torch.randint(len(self.rays), window.ray.shape[:2], generator=random)]
        weight = (torch.rand(window.polarity.shape, generator=random) < self.share).to(window.polarity)
        return replace(window, ray=ray, polarity=window.polarity * weight)

    def skip(self, events):
        self.stream.skip(events)


class Chain:
    """One stretch of a recording after the other, with nothing in between."""

    def __init__(self, *streams):
        self.streams = list(streams)

    def look(self, events, seconds):
        while self.streams:
            found = self.streams[0].look(events, seconds)
            if found is not None:
                return found
            self.streams.pop(0)
        return None

    def skip(self, events):
        self.streams[0].skip(events)


def noisy(recording, *stretches):
    return lambda stream: Noise(stream, stretches, recording.camera)


def inside(found, a, b):
    return [one for one in found if a <= one.window.start.item() < b]


def with_gap(recording, slam, first=0.6, then=1.0):
    with recording.stream(then) as later:
        return run(recording, (None, first), slam=slam, through=lambda stream: Chain(stream, later))


def test_a_camera_before_nothing_but_noise_stays_where_it_is(recording):
    _, (found,) = run(recording, (None, 0.7), through=noisy(recording, (500_000, 700_000)))
    at_rest = inside(found, 500_000, 700_000)
    assert {one.status for one in at_rest} == {"still"}
    assert {one.reason for one in at_rest} == {"only noise"}
    assert not any(one.drawn for one in at_rest)
    assert all(torch.equal(one.state.pose.t, at_rest[0].state.pose.t) for one in at_rest)
    assert not any(one.state.motion.velocity.any() for one in at_rest)


def test_noise_before_the_first_motion_makes_no_map(recording):
    system, (found,) = run(recording, (None, 0.8), through=noisy(recording, (0, 200_000)))
    early = inside(found, 0, 200_000)
    assert {one.status for one in early} == {"still"}
    assert not any(one.drawn for one in early)
    assert [one.index for one in found] == list(range(len(found)))
    assert all(torch.equal(one.state.pose.R, early[0].state.pose.R) for one in early)
    assert system.maps[0].keyframes[0].time > 200_000
    assert score(system.trajectory(), recording.truth, recording.plane, 250_000).percent_of_distance < 0.8


def test_noise_that_is_tracked_when_still_is_switched_off(recording):
    slam = replace(SLAM, sensing=Sensing(still=False))
    _, (found,) = run(recording, (None, 0.7), slam=slam, through=noisy(recording, (500_000, 700_000)))
    assert "still" not in {one.status for one in found}


def test_after_a_gap_the_camera_is_found_in_its_map(recording):
    system, (found,) = with_gap(recording, SLAM)
    after = inside(found, 1_000_000, 2_000_000)
    assert after[0].status == "lost"
    assert after[0].reason == "no events for long"
    assert after[-1].status == "ok"
    assert (system.runs[0].losses, system.runs[0].recoveries) == (1, 1)
    assert len(system.atlas()) == 1
    error = score(system.trajectory(), recording.truth, recording.plane)
    assert error.percent_of_distance < 1
    assert error.orientation_rmse_deg < 1


def test_windows_in_which_a_camera_was_found_have_poses_though_they_were_lost_when_they_came(recording):
    system, (found,) = with_gap(recording, SLAM)
    then = system.placements()
    assert len(then) == len(found)
    assert [p.time for p in then] == [one.time for one in found]
    live, now = ([s == "lost" for s in statuses] for statuses in ([one.status for one in found], [p.status for p in then]))
    assert sum(now) < sum(live)
    assert [p.site is None for p in then] == now
    assert len(system.trajectory()) == len(then) - sum(now)


def test_a_lost_camera_begins_a_map_that_is_joined_when_it_is_found(recording):
    slow = replace(SLAM, relocalizing=Relocalizing(confirm=(120.0, 10)))
    system, (found,) = with_gap(recording, slow)
    assert {one.map.number for one in found} == {0, 1}
    assert system.runs[0].joins == 1
    assert len(system.atlas()) == 1
    assert all(p.site.map is system.maps[0] for p in system.placements() if p.site is not None)
    later = [p for p in system.placements() if p.time > 1_000_000]
    assert [p.status for p in later].count("lost") == 0
    error = score(system.trajectory(), recording.truth, recording.plane)
    assert error.percent_of_distance < 1
    assert error.orientation_rmse_deg < 1


def test_maps_that_are_never_joined_are_both_kept(recording):
    blind = replace(SLAM, relocalizing=Relocalizing(far=False))
    system, (found,) = with_gap(recording, blind)
    assert [m.number for m in system.atlas()] == [0, 1]
    assert {p.site.map.number for p in system.placements() if p.site is not None} == {0, 1}
    here = [p for p in system.placements() if p.site is not None and p.site.map.number == 0]
    assert len(system.trajectory()) == len(here) < len(found)
    assert max(p.time for p in here) < 1_000_000


def test_without_an_atlas_a_lost_camera_draws_nothing(recording):
    alone = replace(SLAM, atlas=False, relocalizing=Relocalizing(far=False))
    system, (found,) = with_gap(recording, alone)
    after = inside(found, 1_000_000, 2_000_000)
    assert {one.status for one in after} == {"lost"}
    assert not any(one.drawn for one in after)
    assert len(system.atlas()) == 1


def test_a_camera_starts_anywhere_on_a_given_map_which_stays_as_it_is(recording, tmp_path):
    system, _ = run(recording)
    save_map(tmp_path / "map.h5", system.maps[0])
    given, kept = load_map(tmp_path / "map.h5"), load_map(tmp_path / "map.h5")
    alone = {name: tile.votes.clone() for name, tile in kept.tiles.items()}
    again, (found,) = run(recording, (0.9, None), maps=[given])
    assert found[-1].status == "ok"
    error = score(again.trajectory(), recording.truth, recording.plane, 900_000)
    assert error.percent_of_distance < 0.8
    assert all(torch.equal(tile.votes, alone[name]) for name, tile in given.tiles.items())


def test_noise_alone_is_found_nowhere_on_a_given_map(recording, tmp_path):
    system, _ = run(recording, (None, 0.5))
    again, (found,) = run(recording, (0.5, 0.9), maps=system.maps, through=noisy(recording, (0, 2_000_000)))
    assert {one.status for one in found} == {"lost"}
    with pytest.raises(ValueError, match="at least two windows on the map, got 0"):
        again.trajectory()


def test_loss_and_recovery_repeat_to_the_bit(recording):
    one, other = (with_gap(recording, SLAM)[0] for _ in range(2))
    assert torch.equal(one.trajectory().pose.t, other.trajectory().pose.t)
    assert [p.status for p in one.placements()] == [p.status for p in other.placements()]


def test_motion_that_is_too_short_for_a_plane_is_lost_and_the_map_begins_behind_it(recording):
    system, (found,) = run(recording, (None, 0.8), through=noisy(recording, (0, 100_000), (150_000, 250_000)))
    assert {one.status for one in inside(found, 0, 150_000)} == {"lost"}
    assert {one.status for one in inside(found, 150_000, 250_000)} <= {"still", "lost"}
    assert system.maps[0].keyframes[0].time > 250_000


def test_a_camera_that_stops_soon_has_a_map_and_stands_where_it_stopped(recording):
    _, (found,) = run(recording, (None, 0.4), through=noisy(recording, (180_000, 400_000)))
    moving, resting = inside(found, 0, 180_000), inside(found, 180_000, 400_000)
    assert {one.status for one in moving} == {"start"}
    assert {one.status for one in resting} == {"still"}
    assert all(torch.equal(one.state.pose.t, resting[0].state.pose.t) for one in resting)
    apart = [float((one.state.pose.t - resting[0].state.pose.t).norm()) for one in moving]
    assert apart[-1] < apart[0] / 4
