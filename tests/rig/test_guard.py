"""What a host must see, believe and do before and while real drives move: nothing is switched on, trusted or finished by accident."""

import json
import signal
import struct
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from bus import CONTROL, Clock, failing, marked, never_enabled_after, program, rig_on_bus, stands, sync

from torchcmax.rig import objects as o
from torchcmax.rig.axis import reduction
from torchcmax.rig.drive import Drive
from torchcmax.rig.errors import Aborted, DriveFault, LinkLost, Refused, RigError
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.record import Recorder, read_encoder
from torchcmax.rig.runner import home, opened, run, watch_encoders
from torchcmax.rig.simnode import Faults, SimulatedDrive

CRUISE = Program((Move(0.0, 0, "velocity", 0.1, 0.3, 3.0), Move(1.0, 0, "velocity", 0.4, 0.0, 3.0)), (0.1,), 1.3)


def metres(drive):
    return drive.position * 6.25e-6


def events(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def dropping(simulation, lost):
    """Frames of the host that never arrive: lost(COB-ID, data) -> bool."""
    send = simulation.host.send_message
    simulation.host.send_message = lambda can_id, data, remote=False: None if lost(can_id, bytes(data)) else send(can_id, data, remote)


def deaf(simulation, lost):
    """Frames of drives that the host does not hear."""
    hear = simulation.host.notify
    simulation.host.notify = lambda can_id, data, stamp: None if lost(can_id, bytes(data)) else hear(can_id, data, stamp)


def on_hardware(rig, simulation, monkeypatch, out, told=None, **options):
    """Homed, and then run as hardware is, by a clock of its own."""
    home(rig, out / "home", simulate=True, network=simulation.host)
    clock = Clock(monkeypatch, simulation)
    simulation.mark = len(simulation.ear.frames)
    return run(rig, told or program(far=0.05), out, simulate=False, arm=True, network=simulation.host, **options), clock


# -- an axis that does something that nobody asked for


@pytest.mark.parametrize("state", [State.STOPPING, State.DISABLED, State.SWITCHED_ON])
def test_an_axis_that_is_stopped_from_outside_is_not_switched_on_again(slider, tmp_path, state):
    """A quick stop input, another program, a key."""

    def act(simulation):
        marked(simulation)
        simulation.drives[0]._quick_stop()
        simulation.drives[0].state = state

    simulation = failing(slider, tmp_path, DriveFault, f"axis x.*is {state.value}, not operation enabled, and nobody asked for it", act=act)
    stands(simulation, (State.DISABLED,))
    never_enabled_after(simulation, simulation.mark)


def test_of_two_axes_the_one_that_lets_go_ends_the_run(pantilt, tmp_path):
    both = Program(tuple(Move(0.0, k, "position", 0.4, 0.6, 3.0) for k in (0, 1)), (0.0, 0.0), 2.0)
    act = lambda simulation: setattr(simulation.drives[1], "state", State.DISABLED)  # noqa: E731
    pan, tilt = failing(pantilt, tmp_path, DriveFault, "axis tilt.*is switch on disabled", told=both, act=act).drives
    assert pan.state is tilt.state is State.DISABLED
    assert abs(pan.plant.velocity) < 1  # what has no voltage is not stopped any more


@pytest.mark.parametrize("lost", [0x301, 0x501])
def test_an_axis_has_arrived_where_it_is_and_stands(slider, tmp_path, lost):
    """Whatever its statusword says: it did not hear where to, or that it should stop."""
    told = CRUISE if lost == 0x501 else program()
    with rig_on_bus(slider) as simulation:
        drive, begun = simulation.drives[0], []

        def watch(k):
            if abs(drive.plant.velocity) > 100 and not begun:
                begun.append(k)
                dropping(simulation, lambda can_id, data: can_id == lost)

        with pytest.raises(DriveFault, match=r"has not arrived at 0\.\d+, is at 0\.\d+|too fast to stop"):
            run(slider, told, tmp_path, simulate=True, watch=watch, network=simulation.host)
        stands(simulation)


def test_a_velocity_that_is_not_reached_is_noticed(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]
        apply = drive._apply

        def half(entries, data):
            if entries[-1] == o.TARGET_VELOCITY:
                data = data[:1] + struct.pack("<i", struct.unpack("<i", data[1:])[0] // 2)
            apply(entries, data)

        drive._apply = half
        with pytest.raises(DriveFault, match=r"should move at 0.3 /s, and moves at 0.15"):
            run(slider, CRUISE, tmp_path, simulate=True, network=simulation.host)
        stands(simulation)


def test_a_fault_while_it_is_switched_off_is_a_fault(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        drive, control = simulation.drives[0], simulation.drives[0]._control
        drive._control = lambda word: drive.fault(0x2310) if word == o.SHUT_DOWN and drive.state is State.ENABLED else control(word)
        with pytest.raises(DriveFault, match=r"over-current \(0x2310\)"):
            run(slider, program(far=0.05), tmp_path, simulate=True, network=simulation.host)
    assert json.loads((tmp_path / "run.json").read_text())["status"].startswith("aborted")


# -- a host that is late


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


# -- drives as they are found


@pytest.mark.parametrize("state", [State.ENABLED, State.STOPPING, State.SWITCHED_ON, State.READY])
@pytest.mark.parametrize("what", ["run", "home", "record"])
def test_drives_that_somebody_else_has_switched_on_are_refused(slider, tmp_path, state, what):
    act = {
        "run": partial(run, slider, program(), tmp_path, simulate=True),
        "home": partial(home, slider, tmp_path, simulate=True),
        "record": partial(watch_encoders, slider, tmp_path, 0.1, simulate=True),
    }[what]
    with rig_on_bus(slider) as simulation:
        simulation.drives[0].state = state
        with pytest.raises(Refused, match=f"is {state.value}, not switch on disabled"):
            act(network=simulation.host)
        assert not simulation.ear.controlwords()
        assert simulation.drives[0].state is state


def test_a_record_ends_where_somebody_switches_an_axis_on(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        watch = lambda k: setattr(simulation.drives[0], "state", State.ENABLED if k > 100 else State.DISABLED)  # noqa: E731
        with pytest.raises(DriveFault, match="is operation enabled, not switch on disabled"):
            watch_encoders(slider, tmp_path, 1.0, simulate=True, watch=watch, network=simulation.host)
        stands(simulation, (State.DISABLED,))


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


def test_a_reset_takes_its_time(slider, tmp_path, monkeypatch):
    reads = []
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]
        drive.fault(o.FOLLOWING_ERROR)
        live = drive._live

        def slowly(obj):
            reads.extend([obj] if obj == o.STATUSWORD and drive.state is State.DISABLED else [])
            return o.STATES[State.FAULT][1] if obj == o.STATUSWORD and 0 < len(reads) < 4 else live(obj)

        drive._live = slowly
        assert run(slider, program(far=0.05), tmp_path, simulate=True, reset=True, network=simulation.host)["status"] == "complete"
    assert len(reads) > 4


def test_the_drives_offset_of_home_is_none(slider):
    for family in ("epos2", "epos4"):
        axis = replace(slider.axes[0], family=family)
        assert o.settings(axis, 0.1)[o.FAMILIES[family].home_move] == 0
        assert o.VELOCITY_UNIT not in o.settings(axis, 0.1)  # is compared, and not every firmware lets it be written


def test_a_limit_below_what_the_encoder_tells_in_a_sync(slider, tmp_path):
    """At 0.05 m/s a velocity of counts per SYNC comes in steps of an eighth of that."""
    slow = replace(slider, axes=(replace(slider.axes[0], limits=replace(slider.axes[0].limits, v=0.05, a=0.5)),))
    with rig_on_bus(slow, {"x": Faults(rough=True)}) as simulation:
        assert run(slow, program(far=0.01, v=0.05, a=0.5), tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


# -- answers


def test_hardly_any_answer_is_not_enough(slider, tmp_path):
    count = iter(range(10**9))
    act = lambda simulation: deaf(simulation, lambda can_id, data: can_id == 0x281 and next(count) % 15)  # noqa: E731
    stands(failing(slider, tmp_path, LinkLost, r"axis x.*has not answered \d+ of \d+ SYNCs", act=act, after=200))


def test_an_answer_that_is_lost_now_and_then_is_bridged_by_what_both_neighbours_tell(slider, tmp_path):
    """Within a trapezoid the cubic is exact, but for how the velocity is rounded."""
    count = iter(range(10**9))
    whole, holes = tmp_path / "whole", tmp_path / "holes"
    run(slider, program(), whole, simulate=True)
    with rig_on_bus(slider) as simulation:
        deaf(simulation, lambda can_id, data: can_id == 0x281 and next(count) % 110 < 1)
        said = run(slider, program(), holes, simulate=True, network=simulation.host)
    assert 5 < said["unanswered"]["x"] < 0.01 * said["syncs"]["sent"] + 10
    a, b = (read_encoder(out / "encoder.csv", slider) for out in (whole, holes))
    assert len(a.time) == len(b.time)
    assert abs(a.place - b.place).max() < 2e-5
    assert sum(event["what"] == "not answered" for event in events(holes)) > 5


def test_drives_may_need_a_while_before_they_answer(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        count = iter(range(60))
        deaf(simulation, lambda can_id, data: can_id & 0x780 in (0x180, 0x280, 0x380) and next(count, None) is not None)
        assert run(slider, program(far=0.05), tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


def test_drives_that_never_answer(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        deaf(simulation, lambda can_id, data: can_id == 0x381)
        with pytest.raises(LinkLost, match=r"axis x.*answers no SYNC"):
            run(slider, program(), tmp_path, simulate=True, network=simulation.host)
        assert set(simulation.ear.controlwords()) <= {o.QUICK}


def test_answers_to_two_syncs_are_not_mixed(slider):
    """Whole ones count, late or not; of one that is not whole nothing does."""
    with rig_on_bus(slider) as simulation:
        drive = Drive(simulation.host, slider.axes[0], slider.bus.sync_period)

        def tell(number, k):
            data = {1: struct.pack("<HbH", k, 1, 0), 2: struct.pack("<ii", k, 0), 3: struct.pack("<ii", k, 0)}[number]
            simulation.line.networks[1].send_message(0x80 + 0x100 * number + 1, data)

        def told(*numbers, k):
            drive.expect()
            for number in numbers:
                tell(number, k)
            return drive.complete and (drive.told.statusword, drive.told.position, drive.told.current)

        assert told(1, 2, 3, k=1) == (1, 1, 1)
        assert not told(1, 3, k=2)
        assert told(2, k=2) == (2, 2, 2)  # in time for the next
        assert not told(2, 3, k=3)  # its first was lost
        assert not told(1, 3, k=4)
        assert told(1, 2, 3, k=5) == (5, 5, 5)
        assert not told(2, 3, k=5)
        drive.count()
        assert drive.missed == drive.unanswered == 1


def test_a_position_that_always_comes_with_the_next_sync_is_an_answer(slider, tmp_path):
    kept = []

    def late(simulation):
        hear, send = simulation.host.notify, simulation.host.send_message

        def hold(can_id, data, stamp):
            kept.append(bytes(data)) if can_id == 0x281 else hear(can_id, data, stamp)

        def sent(can_id, data, remote=False):
            if can_id == 0x80 and kept:
                hear(0x281, kept.pop(0), 0.0)
            send(can_id, data, remote)

        simulation.host.notify, simulation.host.send_message = hold, sent

    with rig_on_bus(slider) as simulation:
        late(simulation)
        assert run(slider, program(far=0.05), tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


def test_an_interface_that_gives_back_what_is_sent(slider, tmp_path):
    """As some USB adapters do: nobody else is on the bus."""
    with rig_on_bus(slider) as simulation:
        send = simulation.host.send_message

        def echoed(can_id, data, remote=False):
            send(can_id, data, remote)
            simulation.host.notify(can_id, bytearray(data), 0.0)

        simulation.host.send_message = echoed
        assert run(slider, program(far=0.05), tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


def test_what_came_before_the_mapping_does_not_count(slider, tmp_path):
    """maxon's own mapping sends two bytes with each change of state."""
    with rig_on_bus(slider) as simulation:
        send = simulation.host.send_message

        def sent(can_id, data, remote=False):
            send(can_id, data, remote)
            if can_id == 0 and data[0] == 0x80:
                simulation.drives[0].network.send_message(0x181, b"\x40\x02")

        simulation.host.send_message = sent
        assert run(slider, program(far=0.05), tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


@pytest.mark.parametrize("can_id", [0x80, 0x77F])
def test_another_host_on_the_bus(slider, tmp_path, can_id):
    act = lambda simulation: simulation.line.networks[1].send_message(can_id, b"" if can_id == 0x80 else b"\x05")  # noqa: E731
    stands(failing(slider, tmp_path, DriveFault, "somebody else on this bus sends", act=act), (State.DISABLED,))


def test_of_a_fault_that_was_not_told_the_log_has_the_history(slider, tmp_path):
    """An EPOS2 tells its code in an emergency message, which can be lost."""
    older = replace(slider, axes=(replace(slider.axes[0], family="epos2"),))

    def act(simulation):
        deaf(simulation, lambda can_id, data: can_id == 0x81)
        simulation.drives[0].fault(0x2310)

    failing(older, tmp_path, DriveFault, "a fault whose code was not heard", act=act)
    (told,) = [event for event in events(tmp_path) if event["what"] == "in its fault state"]
    assert told["codes"][0] == "over-current (0x2310)"


def test_positions_of_all_axes_are_those_at_one_time(pantilt, tmp_path):
    """Of an axis whose answers come 0.8 ms after the first one's."""
    period = pantilt.bus.sync_period
    t, names = np.arange(200) * period, [axis.name for axis in pantilt.axes]
    lines = ["k,t_drive_s,axis,pos_qc,x,v,current_a,following_qc,statusword,rx_host_s"]
    for k, time in enumerate(t):
        for late, name in zip((0.0, 0.0008), names, strict=True):
            at = time + late
            lines.append(f"{k},{time:.6f},{name},0,{np.sin(3 * at):.9f},{3 * np.cos(3 * at):.9f},0,0,39,{7.0 + at:.6f}")
    (tmp_path / "encoder.csv").write_text("\n".join(lines) + "\n")
    encoder = read_encoder(tmp_path / "encoder.csv", replace(pantilt, rate=1 / period))
    assert encoder.time == pytest.approx(t, abs=1e-6)
    assert abs(encoder.place - np.sin(3 * t)[:, None]).max() < 1e-6


# -- ends


@pytest.mark.parametrize("error", [OSError(19, "No such device"), RuntimeError("Not connected to CAN bus")])
def test_an_adapter_that_was_unplugged_is_a_lost_link(slider, tmp_path, error):
    def act(simulation):
        marked(simulation)

        def gone(message, timeout=None):
            raise error

        simulation.host.wire.send = gone

    simulation = failing(slider, tmp_path, LinkLost, f"the bus is gone: .*{error.args[-1]}", act=act, after=0)
    assert simulation.caught.code == 4
    assert sum(event["what"] == "not sent" for event in events(tmp_path)) == 3 * 2 + 1


def test_what_ended_the_run_is_told_and_not_what_closing_the_bus_says(slider, monkeypatch):
    import can
    import canopen

    def broken(self):
        raise can.CanOperationError("Network is down")

    monkeypatch.setattr(canopen.Network, "connect", lambda self, **options: None)
    monkeypatch.setattr(canopen.Network, "disconnect", broken)
    with pytest.raises(LinkLost, match="lost before"), opened(slider, simulate=False):
        raise LinkLost("lost before")


def test_an_error_while_stopping_lets_the_drives_stop_by_themselves(slider, tmp_path, monkeypatch):
    monkeypatch.setattr("torchcmax.rig.session.Session._stand", lambda self: {}["nothing"])

    def act(simulation):
        marked(simulation)
        raise ZeroDivisionError("in somebody's progress bar")

    simulation = failing(slider, tmp_path, ZeroDivisionError, "progress bar", act=act, after=400)
    assert [event["reason"] for event in events(tmp_path) if event["what"] == "link lost"] == ["KeyError: 'nothing'"]
    words = [i for i, (can_id, data) in enumerate(simulation.ear.frames) if (can_id, data[:1]) == (CONTROL + 1, b"\x02")]
    (stop,) = [i for i, frame in enumerate(simulation.ear.frames) if frame == (0, b"\x02\x01")]
    assert stop > words[-1]  # a node that is stopped takes no PDO any more
    stands(simulation)


def test_the_end_is_seen_also_where_the_user_is_in_a_hurry(slider, tmp_path):
    """The second signal: no voltage, and the drive says so, and no longer waits for heartbeats."""
    act = lambda simulation: (signal.raise_signal(signal.SIGINT), signal.raise_signal(signal.SIGINT))  # noqa: E731
    simulation = failing(slider, tmp_path, Aborted, "stopped", act=act, after=500)
    assert [event["states"] for event in events(tmp_path) if event["what"] == "stopped"] == [["switch on disabled"]]
    assert not simulation.drives[0].get(o.CONSUMER_HEARTBEAT)
    assert simulation.drives[0].state is State.DISABLED


def test_a_quick_stop_is_given_time_where_an_axis_has_hardly_begun_to_move(slider, tmp_path):
    """Its velocity is still told as zero."""
    with rig_on_bus(slider) as simulation:
        drive, done = simulation.drives[0], []

        def watch(k):
            if drive.ramp.pieces and drive.mode == o.PROFILE_POSITION and not done:
                done.append(len(simulation.ear.frames))
                signal.raise_signal(signal.SIGINT)

        with pytest.raises(Aborted):
            run(slider, program(a=12.0), tmp_path, simulate=True, watch=watch, network=simulation.host)
        frames = simulation.ear.frames[done[0] :]
        quick, off = (frames.index((CONTROL + 1, word)) for word in (b"\x02\x00", b"\x00\x00"))
        assert sum(can_id == 0x80 for can_id, _ in frames[quick:off]) >= 10
        stands(simulation)


def test_what_does_not_stand_is_told(slider, tmp_path):
    """Before its voltage is taken away all the same."""

    def act(simulation):
        plant = simulation.drives[0].plant
        step = plant.step

        def shaken(asked, dt):
            step(asked, dt)
            plant.place += 1e-3 * (-1) ** len(simulation.ear.frames)

        plant.step = shaken
        signal.raise_signal(signal.SIGTERM)

    simulation = failing(slider, tmp_path, Aborted, "stopped", act=act)
    assert simulation.drives[0].state is State.DISABLED
    assert "does not stand" in [event["what"] for event in events(tmp_path)]


def test_a_rig_runs_where_a_signal_can_stop_it(slider, tmp_path):
    caught = []

    def act():
        with rig_on_bus(slider) as simulation:
            try:
                run(slider, program(), tmp_path, simulate=False, arm=True, network=simulation.host)
            except Refused as error:
                caught.append((str(error), simulation.ear.frames))

    thread = threading.Thread(target=act)
    thread.start()
    thread.join()
    ((told, frames),) = caught
    assert "main thread" in told
    assert not frames


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP")
def test_a_terminal_that_closes_stops_it(slider, tmp_path):
    stands(failing(slider, tmp_path, Aborted, "stopped", act=lambda s: signal.raise_signal(signal.SIGHUP)), (State.DISABLED,))


def test_a_signal_while_the_record_is_written_loses_nothing(slider, tmp_path, monkeypatch):
    finish = Recorder._finish

    def interrupted(self):
        signal.raise_signal(signal.SIGINT)
        finish(self)

    monkeypatch.setattr(Recorder, "_finish", interrupted)
    assert run(slider, program(far=0.05), tmp_path, simulate=True)["status"] == "complete"
    assert {path.name for path in tmp_path.iterdir()} == {"encoder.csv", "log.jsonl", "run.json"}


@pytest.mark.parametrize("fault", [False, True])
def test_a_record_that_cannot_be_written_is_told_and_the_rest_of_it_kept(slider, tmp_path, fault):
    def watch(k):
        (tmp_path / "encoder.csv").mkdir(exist_ok=True)
        if fault and simulation.drives[0].plant.velocity > 200:
            simulation.drives[0].fault(0x2310)

    with (
        rig_on_bus(slider) as simulation,
        pytest.raises(RigError, match="0x2310" if fault else r"encoder.csv: cannot be written: .*\n.*kept"),
    ):
        run(slider, program(), tmp_path, simulate=True, watch=watch, network=simulation.host)
    stands(simulation)
    status = json.loads((tmp_path / "run.json").read_text())["status"]
    assert status.startswith("aborted: axis x" if fault else "aborted: ")
    assert ("0x2310" in status) == fault
    (part,) = tmp_path.glob(".encoder.csv.*.part")
    assert len(part.read_text().splitlines()) > 100


def test_a_disk_that_fills_up_stops_the_axes(slider, tmp_path):
    def act(simulation):
        def full(text):
            raise OSError(28, "No space left on device")

        recorders[0].file.write = full

    recorders, init = [], Recorder.__init__

    class Full:
        def __init__(self, file):
            self.file = file

        def write(self, text):
            return self.file.write(text)

        def close(self):
            self.file.close()

    def made(self, *arguments):
        init(self, *arguments)
        self.file = Full(self.file)
        recorders.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Recorder, "__init__", made)
        simulation = failing(slider, tmp_path, RigError, "cannot be written: No space left on device\n.*make room", act=act)
    stands(simulation, (State.DISABLED,))


def test_nothing_of_an_older_run_is_left_by_one_that_fails_at_once(slider, tmp_path):
    old = ("encoder.csv", "log.jsonl", "run.json", "groundtruth.txt")
    for name in old:
        (tmp_path / name).write_text("of an older run\n")
    with rig_on_bus(slider, {"x": Faults(vendor=1)}) as simulation, pytest.raises(Refused):
        run(slider, program(), tmp_path, simulate=True, network=simulation.host)
    assert json.loads((tmp_path / "run.json").read_text())["status"].startswith("aborted: axis x")
    assert (tmp_path / "encoder.csv").read_text().count("\n") == 1
    assert not (tmp_path / "groundtruth.txt").exists()


def test_a_value_that_does_not_fit_is_refused(slider):
    with rig_on_bus(slider) as simulation:
        drive = Drive(simulation.host, slider.axes[0], slider.bus.sync_period)
        with pytest.raises(Refused, match="0x6085:00 cannot be set to -1"):
            drive.write(o.QUICK_STOP, -1)


def test_a_network_is_left_as_it_was_found(slider, tmp_path):
    """So that one process can run a rig many times."""
    with rig_on_bus(slider) as simulation:
        counts = []
        for _ in range(2):
            run(slider, program(far=0.02), tmp_path, simulate=True, network=simulation.host)
            counts.append({can_id: len(called) for can_id, called in simulation.host.subscribers.items()})
        assert counts[0] == counts[1]
        sync(simulation, 10)
        assert simulation.drives[0].state is State.DISABLED
        assert isinstance(simulation.drives[0], SimulatedDrive)
        assert reduction(slider.axes[0]) > 0
