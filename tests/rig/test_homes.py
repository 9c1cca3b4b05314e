"""Which home is believed, and how it is found."""

import math
import signal
from dataclasses import replace

import canopen
import pytest
from bus import Clock, program, rig_on_bus, stands

from torchcmax.rig import objects as o
from torchcmax.rig.axis import reduction
from torchcmax.rig.errors import Aborted, DriveFault, Refused
from torchcmax.rig.objects import State
from torchcmax.rig.runner import home, run, watch_encoders
from torchcmax.rig.simnode import SimulatedDrive


@pytest.mark.parametrize(
    "change",
    [
        lambda axis: replace(axis, invert=True),
        lambda axis: replace(axis, cpt=1000),
        lambda axis: replace(axis, homing=replace(axis.homing, method=18)),
        lambda axis: replace(axis, limits=replace(axis.limits, max=0.5)),
        lambda axis: replace(axis, transmission=replace(axis.transmission, travel=0.05)),
    ],
    ids=["invert", "cpt", "method", "limit", "travel"],
)
def test_a_home_that_was_found_under_another_configuration_is_not_believed(slider, tmp_path, change):
    other = replace(slider, axes=(change(slider.axes[0]),))
    with rig_on_bus(slider) as simulation:
        home(slider, tmp_path, simulate=True, network=simulation.host)
        heard = len(simulation.ear.controlwords())
        with pytest.raises(Refused, match=r"not found under this configuration: 0x.*\n.*rig home"):
            run(other, program(), tmp_path, simulate=False, arm=True, network=simulation.host)
        with pytest.raises(Refused, match="not found under this configuration"):
            watch_encoders(other, tmp_path, 0.1, simulate=True, network=simulation.host)
        assert len(simulation.ear.controlwords()) == heard


def test_a_search_for_home_that_was_not_finished_leaves_no_home(slider, tmp_path):
    """The drive still says that it has one: of the configuration before."""
    other = replace(slider, axes=(replace(slider.axes[0], invert=True),))
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]
        home(slider, tmp_path, simulate=True, network=simulation.host)

        def watch(k):
            if drive.mode == o.HOMING and drive.phase == "seeking":
                signal.raise_signal(signal.SIGINT)

        with pytest.raises(Aborted):
            home(other, tmp_path, simulate=True, watch=watch, network=simulation.host)
        assert drive.homed
        for rig in (slider, other):
            with pytest.raises(Refused, match="not found under this configuration"):
                run(rig, program(), tmp_path, simulate=False, arm=True, network=simulation.host)


def test_homing_is_under_the_hosts_limits_too(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]

        def watch(k):
            if drive.phase == "seeking":
                drive._put(o.HOMING_SPEED, 9000)
                drive.ramp = drive.ramp.at(-900.0, 9000.0)

        with pytest.raises(DriveFault, match=r"moves at -1\.\d+ /s, its limit is 1.4"):
            home(slider, tmp_path, simulate=True, watch=watch, network=simulation.host)
        stands(simulation)


def test_a_home_that_cannot_be_found(slider, tmp_path):
    """A method that this drive gives up on."""
    lost = replace(slider, axes=(replace(slider.axes[0], homing=replace(slider.axes[0].homing, method=33)),))
    with rig_on_bus(lost) as simulation:
        with pytest.raises(DriveFault, match="homing failed"):
            home(lost, tmp_path, simulate=True, network=simulation.host)
        stands(simulation, (State.DISABLED,))


def test_the_drives_offset_of_home_is_none(slider):
    for family in ("epos2", "epos4"):
        axis = replace(slider.axes[0], family=family)
        assert o.settings(axis, 0.1)[o.FAMILIES[family].home_move] == 0
        assert o.VELOCITY_UNIT not in o.settings(axis, 0.1)  # is compared, and not every firmware lets it be written


def test_a_search_for_home_that_fails_before_it_begins_leaves_no_home(slider, tmp_path):
    """Whichever write of the new configuration is the last that its drive takes: the home of the old one is not one of the new."""
    other = replace(slider, axes=(replace(slider.axes[0], invert=True),))
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]
        written, writes, left = drive._written, [], [math.inf]

        def write(index, subindex, od, data):
            if len(writes) >= left[0]:
                raise canopen.SdoAbortedError(0x08000020)
            writes.append((index, subindex))
            written(index, subindex, od, data)

        drive.node._write_callbacks[:] = [write]
        home(slider, tmp_path, simulate=True, network=simulation.host)
        count = writes[1:].index((o.HIGHEST.index, o.HIGHEST.sub))  # from the first to when home was found
        assert count > 50
        for kept in [0, 1, 2, 3, *range(4, count, 7)]:
            left[0] = math.inf
            home(slider, tmp_path, simulate=True, network=simulation.host)
            writes.clear()
            left[0] = kept
            with pytest.raises(Refused, match="0x08000020"):
                home(other, tmp_path, simulate=True, network=simulation.host)
            left[0] = math.inf
            assert drive.homed
            for rig in (other, slider) if kept else (other,):
                with pytest.raises(Refused, match="not found under this configuration"):
                    run(rig, program(), tmp_path, simulate=False, arm=True, network=simulation.host)


def test_that_home_was_found_is_written_when_nothing_moves_any_more(slider, tmp_path, monkeypatch):
    """An answer to an SDO may take as long as the drive waits for heartbeats, of which none come meanwhile."""
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]
        clock, written, states = Clock(monkeypatch, simulation), drive._written, []

        def write(index, subindex, od, data):
            if (index, subindex) == (o.HIGHEST.index, o.HIGHEST.sub):
                states.append(drive.state)
                clock.pass_(0.3)
            written(index, subindex, od, data)

        drive.node._write_callbacks[:] = [write]
        home(slider, tmp_path, simulate=False, arm=True, network=simulation.host)
        assert states == [State.DISABLED, State.DISABLED]
        run(slider, program(), tmp_path, simulate=False, arm=True, network=simulation.host)


def test_of_a_session_that_failed_later_home_is_known(pantilt, tmp_path):
    """Of the axis that had found it."""
    with rig_on_bus(pantilt) as simulation:
        pan, tilt = simulation.drives
        lost = replace(pantilt, axes=(pantilt.axes[0], replace(pantilt.axes[1], homing=replace(pantilt.axes[1].homing, method=33))))
        with pytest.raises(DriveFault, match=r"axis tilt.*homing failed"):
            home(lost, tmp_path, simulate=True, network=simulation.host)
        assert pan.get(o.HIGHEST) == o.settings(pantilt.axes[0], 0.1)[o.HIGHEST]
        assert tilt.get(o.HIGHEST) == o.settings(pantilt.axes[1], 0.1)[o.HIGHEST] - 1


def test_firmware_that_shows_no_target_reached_before_there_was_a_target(slider, tmp_path, monkeypatch):
    word, begin, begun = SimulatedDrive.statusword.fget, SimulatedDrive._begin, []

    def begins(self):
        begun.extend([self] if self.mode == o.PROFILE_POSITION else [])
        begin(self)

    monkeypatch.setattr(SimulatedDrive, "_begin", begins)
    monkeypatch.setattr(
        SimulatedDrive, "statusword", property(lambda self: word(self) & ~(0 if begun or self.mode != o.PROFILE_POSITION else o.ARRIVED))
    )
    assert run(slider, program(far=0.05), tmp_path, simulate=True)["status"] == "complete"


def test_a_servo_that_hunts_stands(slider, tmp_path):
    """By some counts about its place."""
    with rig_on_bus(slider) as simulation:
        (drive,), turn = simulation.drives, iter(range(10**9))
        live = drive._live
        drive._live = lambda obj: live(obj) + 5 * (-1) ** next(turn) if obj == o.POSITION else live(obj)
        assert home(slider, tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


def test_an_axis_is_given_the_time_that_its_drive_needs(slider, tmp_path, monkeypatch):
    """Which is told whole rpm."""
    turn = 2 * math.pi / abs(reduction(slider.axes[0]))  # m
    slow = replace(slider, axes=(replace(slider.axes[0], homing=replace(slider.axes[0].homing, method=35, speed=1.45 / 60 * turn)),))
    told = []
    monkeypatch.setattr("torchcmax.rig.session.Session.follow", lambda self, program: told.append((program, self.drives[0].place)))
    run(slow, program(), tmp_path, simulate=True)
    slowly, place = told[0]
    (move,) = slowly.moves
    assert move.v == pytest.approx(turn / 60)
    assert slowly.duration >= abs(move.target - place) / move.v > 10
