"""A host that is late, and what counts its time: no axis goes farther for that, and what was planned is kept apart as it was."""

from dataclasses import replace

import numpy as np
import pytest
from bus import CRUISE, Clock, events, metres, program, rig_on_bus, stands

from torchcmax.rig import objects as o
from torchcmax.rig.axis import quadcounts
from torchcmax.rig.drive import Drive
from torchcmax.rig.errors import DriveFault, RigError
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.record import read_encoder
from torchcmax.rig.runner import home, run, watch_encoders
from torchcmax.rig.session import Session


@pytest.mark.parametrize("stalls", [{600}, set(range(0, 4000, 100)), {150, 1100}])
def test_a_host_that_is_late_lets_an_axis_go_no_farther(slider, tmp_path, monkeypatch, stalls):
    """SYNCs count time: one cruise, with stalls of 10 ms or 40 ms, ends where it was planned to."""
    seconds = 0.04 if len(stalls) == 1 else 0.009
    with rig_on_bus(slider, places=(0.1,)) as simulation:
        home(slider, tmp_path / "home", simulate=True, network=simulation.host)
        clock, begun = Clock(monkeypatch, simulation), []

        def watch(k):
            begun.append(k) if simulation.drives[0].mode == o.PROFILE_VELOCITY_MODE else None
            if len(begun) in stalls and begun:
                clock.pass_(seconds)

        said = run(slider, CRUISE, tmp_path, simulate=False, arm=True, watch=watch, network=simulation.host)
        assert said["status"] == "complete"
        assert said["syncs"]["left_out"] >= len(stalls & set(range(1300))) * 5
        assert metres(simulation.drives[0]) == pytest.approx(0.4, abs=0.3 * seconds + 0.001 if 0 in stalls else 1e-3)


def test_moves_wait_for_the_one_before(slider, tmp_path, monkeypatch):
    """The host is late when the first begins: the second, 50 ms after its planned end, is as much later, and both go all the way."""
    with rig_on_bus(slider, places=(0.1,)) as simulation:
        home(slider, tmp_path / "home", simulate=True, network=simulation.host)
        clock, drive = Clock(monkeypatch, simulation), simulation.drives[0]
        late, places = [], []

        def watch(k):
            places.append(metres(drive))
            if (
                drive.ramp.pieces
                and drive.ramp.end is not None
                and abs(drive.ramp.end * 0.06 / 4.8 / 6.283185307 - 0.4) < 1e-3
                and not late
            ):
                late.append(k)
            if late and len(late) < 6:
                late.append(k)
                clock.pass_(0.045)

        said = run(slider, program(), tmp_path, simulate=False, arm=True, watch=watch, network=simulation.host)
        assert said["status"] == "complete"
        assert max(places) == pytest.approx(0.4, abs=1e-4)
        assert metres(drive) == pytest.approx(0.1, abs=1e-4)


def test_a_host_that_stalls_stops_the_axes(slider, tmp_path, monkeypatch):
    with rig_on_bus(slider, places=(0.1,)) as simulation:
        home(slider, tmp_path / "home", simulate=True, network=simulation.host)
        clock, done = Clock(monkeypatch, simulation), []

        def watch(k):
            if simulation.drives[0].plant.velocity > 100 and not done:
                done.append(k)
                clock.pass_(0.08)

        with pytest.raises(DriveFault, match=r"the host was late by (7\d|80) ms"):
            run(slider, CRUISE, tmp_path, simulate=False, arm=True, watch=watch, network=simulation.host)
        stands(simulation, (State.DISABLED,))


def test_the_host_lives_by_the_clock(slider, tmp_path, monkeypatch):
    """Ticks that take twice as long as they should, and drives that wait no longer than two heartbeats."""
    slow = replace(slider, bus=replace(slider.bus, heartbeat=0.05, heartbeat_timeout=0.1))
    with rig_on_bus(slow, places=(0.1,)) as simulation:
        home(slow, tmp_path / "home", simulate=True, network=simulation.host)
        clock = Clock(monkeypatch, simulation)
        watch = lambda k: clock.pass_(0.0009)  # noqa: E731
        assert run(slow, CRUISE, tmp_path, simulate=False, arm=True, watch=watch, network=simulation.host)["status"] == "complete"


def test_a_clock_that_is_set_meanwhile_ends_the_record(slider, tmp_path, monkeypatch):
    with rig_on_bus(slider, places=(0.1,)) as simulation:
        home(slider, tmp_path / "home", simulate=True, network=simulation.host)
        clock = Clock(monkeypatch, simulation)

        def watch(k):
            clock.shift = -0.5 if simulation.drives[0].plant.velocity > 200 else clock.shift

        with pytest.raises(RigError, match=r"clock jumped by -0\.500 s"):
            run(slider, program(), tmp_path, simulate=False, arm=True, watch=watch, network=simulation.host)
        stands(simulation, (State.DISABLED,))


def test_a_host_that_is_late_just_when_a_cruise_begins(slider, tmp_path, monkeypatch):
    """It goes as far as planned."""
    with rig_on_bus(slider, places=(0.1,)) as simulation:
        home(slider, tmp_path / "home", simulate=True, network=simulation.host)
        clock, start = Clock(monkeypatch, simulation), Session._start

        def late(self, move):
            start(self, move)
            clock.pass_(0.045 if move.kind == "velocity" and move.v else 0.0)

        monkeypatch.setattr(Session, "_start", late)
        said = run(slider, CRUISE, tmp_path, simulate=False, arm=True, network=simulation.host)
        assert said["syncs"]["left_out"] >= 40
        assert metres(simulation.drives[0]) == pytest.approx(0.4, abs=1e-3)
        begun, ended = (event["k"] for event in events(tmp_path) if event.get("kind") == "velocity")
        assert ended - begun == 1000


def test_what_waits_delays_all_that_follows(pantilt, tmp_path):
    """Tilt takes twice as long as planned for its first move: the second of pan and tilt are as much later, and as far apart."""
    period = pantilt.bus.sync_period
    starts = [(0.0, 1, 0.3), (0.95, 1, 0.0), (2.0, 0, 0.3), (3.5, 1, 0.2)]
    told = Program(tuple(Move(t, axis, "position", x, 0.4, 2.0) for t, axis, x in starts), (0.0, 0.0), 4.5)
    with rig_on_bus(pantilt) as simulation:
        tilt, seen = simulation.drives[1], []
        rate, begin = tilt._rate, tilt._begin

        def begins():
            seen.append(tilt.get(o.TARGET_POSITION))
            slow = len([x for x in seen if x == seen[-1]]) == 1 and abs(seen[-1] - target) <= 1
            tilt._rate = lambda obj: rate(obj) / (2 if slow and obj == o.PROFILE_VELOCITY else 1)
            begin()

        target = int(quadcounts(pantilt.axes[1], 0.3))
        tilt._begin = begins
        run(pantilt, told, tmp_path, simulate=True, network=simulation.host)
    moves = [event for event in events(tmp_path) if event.get("kind") == "position"][2:]  # after going to the begin
    assert [event["target"] for event in moves] == [0.3, 0.0, 0.3, 0.2]
    ks = np.array([event["k"] for event in moves]) * period
    assert ks[1] - ks[0] > 1.5
    assert np.diff(ks)[1:] == pytest.approx([1.05, 1.5], abs=1e-9)


def test_a_late_host_does_not_take_a_clock_for_one_that_jumps(slider, tmp_path, monkeypatch):
    """Its stamps are compared by when they came, not by when it had the time to look; and a record lasts as long as it should."""
    patient = replace(slider, bus=replace(slider.bus, heartbeat_timeout=0.4))
    with rig_on_bus(patient) as simulation:
        clock, count, ticks = Clock(monkeypatch, simulation), Drive.count, []

        def counted(self, k):
            count(self, k)
            ticks.append(k)
            clock.pass_(0.15 if len(ticks) % 300 == 0 else 0.0)

        monkeypatch.setattr(Drive, "count", counted)
        said = watch_encoders(patient, tmp_path, 2.0, simulate=False, network=simulation.host)
        assert said["syncs"]["left_out"] > 500
        ((begin, end),) = said["cycles"]
        assert begin == 0
        assert end * slider.bus.sync_period == pytest.approx(2.0, abs=0.16)
        assert read_encoder(tmp_path / "encoder.csv", slider).time[-1] == pytest.approx(2.0, abs=0.3)


def test_the_clock_of_an_interface_may_begin_at_zero_but_has_to_go_on(slider, tmp_path, monkeypatch):
    with rig_on_bus(slider) as simulation:
        clock = Clock(monkeypatch, simulation)
        clock.shift = -clock.now - 0.051  # the first sample's
        said = watch_encoders(slider, tmp_path / "zero", 0.2, simulate=False, network=simulation.host)
        assert said["status"] == "complete"
        assert read_encoder(tmp_path / "zero" / "encoder.csv", slider).time == pytest.approx(0.001 * np.arange(200), abs=1e-6)
        clock.grain = 0.005
        with pytest.raises(RigError, match=r"clock does not go on from SYNC to SYNC.*\n.*sync_period_s"):
            watch_encoders(slider, tmp_path / "coarse", 0.2, simulate=False, network=simulation.host)
