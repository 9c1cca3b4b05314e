"""A camera that only turns, tracked and mapped: the bars that the project set itself, the full circle, the pole, loss, real windows."""

import math

import pytest
import torch
from accuracy import ROTATIONS, whole
from panoramas import found, turns
from test_lost import Chain, Noise

from torchcmax import simulator
from torchcmax.core import so3
from torchcmax.core.estimate import estimate
from torchcmax.core.model import Rotation
from torchcmax.core.window import Window
from torchcmax.io import open
from torchcmax.score import score
from torchcmax.simulator import Simulation, simulate, write
from torchcmax.slam.globe import Globe
from torchcmax.slam.system import Panorama, System
from torchcmax.track import TrackOptions, track

SMALL = {"width": 120, "height": 90, "focal": 100.0}


def followed(recording, **options):
    """Its tracks, gone through, and each of them."""
    tracks = track(recording, TrackOptions(Panorama(), **options))
    return tracks, list(tracks)


@pytest.fixture(scope="module")
def outdoors(shared):
    """The simulated street, tracked."""
    return followed(open(shared / "data/sim/rotation_panorama_sim"))


@pytest.mark.slow
def test_the_simulated_street_is_tracked_from_nothing_to_the_end(outdoors):
    tracks, every = outdoors
    error = score(tracks.trajectory(), tracks.recording.truth, rotation_only=True)
    assert not [one.index for one in every if one.status == "lost"]
    assert error.orientation_rmse_deg < 0.3
    assert error.coverage == 1
    assert not tracks.trajectory().pose.t.any()
    assert isinstance(tracks.map, Globe)


@pytest.mark.slow
def test_a_camera_is_found_anywhere_in_the_finished_panorama(outdoors):
    tracks, _ = outdoors
    numbers = found(tracks, 10)
    assert numbers["within 0.5 deg"] == 10
    assert numbers["wrong"] == 0


@pytest.fixture(scope="module")
def round_and_round():
    """Two times round, with nods."""
    return followed(simulate(Simulation(scene="panorama", motion="sweep", duration=6.0, **SMALL)))


@pytest.mark.slow
def test_a_full_circle_closes_on_itself(round_and_round):
    tracks, every = round_and_round
    assert not [one.index for one in every if one.status == "lost"]
    ends = turns(tracks, 3.0)
    assert ends["end of turn 2, deg"] <= ends["end of turn 1, deg"] + 0.1
    assert ends["end of turn 1, deg"] < 0.3
    assert score(tracks.trajectory(), tracks.recording.truth, rotation_only=True).orientation_rmse_deg < 0.3


@pytest.mark.slow
def test_no_edges_are_doubled_where_the_circle_closes(round_and_round):
    """In the second turn, windows meet as much where the two ends of the first one overlap as elsewhere."""
    _, every = round_and_round
    late = [one for one in every if one.time > 3.3e6 and one.signs.strength == one.signs.strength]
    seam, rest = [], []
    for one in late:
        degrees = float(torch.atan2(one.state.pose.R[0, 0, 2], one.state.pose.R[0, 2, 2]).rad2deg())
        (seam if abs(degrees) < 45 else rest).append(one.signs.strength)
    assert len(seam) >= 5
    assert sum(seam) / len(seam) > 0.85 * sum(rest) / len(rest)


def test_a_camera_is_tracked_over_the_pole(monkeypatch):
    monkeypatch.setattr(simulator, "LOOK_ROUND", (((1.9, 0.25, 0.0),), ((0.15, 0.5, 0.0),), ((0.1, 0.7, 0.0),)))
    tracks, every = followed(simulate(Simulation(scene="panorama", motion="rotation", duration=1.0, **SMALL)))
    path = tracks.trajectory()
    assert path.pose.R[:, 1, 2].abs().max() > 0.99  # it looks along the axis
    assert path.pose.R[-1, 2, 2] < 0  # and beyond it
    assert not [one.index for one in every if one.status == "lost"]
    assert score(path, tracks.recording.truth, rotation_only=True).orientation_rmse_deg < 0.3


@pytest.mark.parametrize("name", ["boxes_rotation", "boxes_rotation_13s", "dynamic_rotation"])
def test_single_real_windows_are_as_sharp_as_the_estimator_makes_them(shared, monkeypatch, name):
    monkeypatch.syspath_prepend(str(shared / "tools"))
    from score_motion import score as judge

    folder = shared / "data/real/ecd" / name
    _, (one,) = followed(open(folder))
    camera, window = whole(folder)
    best = estimate(window, camera, Rotation(camera.fx)).motion.omega[0]
    ours, theirs = (judge(folder, omega.tolist())["middle_sigma1"]["gain"] for omega in (one.state.motion.omega[0], best))
    assert ours - 1 >= 0.99 * (theirs - 1)


def test_the_real_shapes_turn_as_is_known(shared):
    _, every = followed(open(shared / "data/real/ecd/shapes_rotation_2s"))
    seconds = torch.cat([one.window.duration.double() for one in every])
    omega = torch.cat([one.state.motion.omega for one in every])
    mean = (omega * seconds[:, None]).sum(0) / seconds.sum()
    assert (mean - torch.tensor(ROTATIONS["shapes_rotation_2s"])).norm() * 180 / math.pi < 1.5


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small sensor that turns for 1.2 s."""
    return open(write(Simulation(scene="panorama", motion="rotation", duration=1.2, **SMALL), tmp_path_factory.mktemp("small") / "street"))


def through(recording, source):
    """The tracks of a source, and the run that made them."""
    system = System([recording.camera], Panorama())
    return list(system.run([source])), system.runs[0]


class Pause:
    """A stream that stops at a moment, µs, for so long, with nothing but noise, and goes on where it stopped."""

    STEP = 50_000  # µs

    def __init__(self, stream, camera, moment, long):
        self.stream, self.rays, self.moment, self.long, self.held = stream, camera.rays().float().view(-1, 3), moment, long, 0

    def resting(self, window):
        return window is not None and window.start.item() >= self.moment and self.held < self.long

    def look(self, events, seconds):
        window = self.stream.look(events, seconds)
        if window is None or window.start.item() < self.moment:
            return window
        if not self.resting(window):
            return Window(window.ray, window.dt, window.polarity, window.start + self.long, window.duration)
        random, count = torch.Generator().manual_seed(self.held), 300
        ray = self.rays[torch.randint(len(self.rays), (1, count), generator=random)]
        dt = torch.linspace(0, self.STEP * 0.9e-6, count)[None]
        return Window(ray, dt, torch.ones_like(dt), torch.tensor([self.moment + self.held]), dt[:, -1])

    def skip(self, events):
        if self.resting(self.stream.look(2, 1.0)):
            self.held += self.STEP
        else:
            self.stream.skip(events)


def test_a_camera_that_stands_still_stays_where_it_is_and_goes_on_from_there(small):
    moment, long = 600_000, 400_000
    with small.stream() as stream:
        every, run = through(small, Pause(stream, small.camera, moment, long))
    still = [one for one in every if one.status == "still"]
    assert len(still) == long // Pause.STEP
    assert {one.reason for one in still} == {"only noise"}
    assert not any(one.drawn for one in still)
    assert all(torch.equal(one.state.pose.R, still[0].state.pose.R) for one in still)
    assert run.losses == 0
    assert every[-1].status == "ok"
    path = run.trajectory()
    passed = torch.where(path.time >= moment + long, path.time - long, path.time.clamp_max(moment))
    there = small.truth.at(passed).R
    off = so3.log((path.pose.R @ there.mT)[:1].mT @ (path.pose.R @ there.mT)).norm(dim=-1).rad2deg()
    assert off.square().mean().sqrt() < 0.6


def test_a_camera_that_goes_on_where_there_is_nothing_to_see_is_not_believed_to_rest(small):
    """What it then draws would be in the wrong place: the next window does not fit where it was held."""
    with small.stream() as stream:
        every, run = through(small, Noise(stream, [(500_000, 700_000)], small.camera))
    assert [one.index for one in every if one.status == "still"]
    first = next(one for one in every if one.time > 700_000)
    assert first.status in ("weak", "lost")
    assert first.reason
    path = run.trajectory()
    assert score(path, small.truth, rotation_only=True).orientation_rmse_deg < 0.6


def test_a_lost_camera_is_found_again(small):
    with small.stream(None, 0.6) as stream, small.stream(0.9) as later:
        every, run = through(small, Chain(stream, later))
    after = next(one for one in every if one.time > 900_000)
    assert (after.status, after.reason) == ("lost", "no events for long")
    assert run.losses == 1
    assert score(run.trajectory(), small.truth, rotation_only=True).orientation_rmse_deg < 0.6


@pytest.mark.slow
def test_what_a_lost_camera_drew_elsewhere_becomes_part_of_the_panorama(shared):
    recording = open(shared / "data/sim/rotation_panorama_sim")
    with recording.stream(None, 1.2) as stream, recording.stream(3.0) as later:
        every, run = through(recording, Chain(stream, later))
    assert (run.losses, run.recoveries, run.joins, len(run.sites)) == (1, 1, 1, 1)
    assert every[-1].status == "ok"
    path = run.trajectory()
    assert int(((path.time > 3_200_000) & (path.time < 4_500_000)).sum()) > 20
    assert score(path, recording.truth, rotation_only=True).orientation_rmse_deg < 0.5
