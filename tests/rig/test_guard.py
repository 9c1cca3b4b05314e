"""What a host must see, believe and do before and while real drives move: nothing is switched on, trusted or finished by accident."""

import contextlib
import json
import struct
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from bus import (
    CRUISE,
    deaf,
    dropping,
    events,
    failing,
    marked,
    never_enabled_after,
    program,
    rig_on_bus,
    stands,
)

from torchcmax.rig import objects as o
from torchcmax.rig.drive import Drive
from torchcmax.rig.errors import DriveFault, LinkLost, Refused
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.record import read_encoder
from torchcmax.rig.runner import home, run, watch_encoders
from torchcmax.rig.simnode import Faults

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


def test_a_limit_below_what_the_encoder_tells_in_a_sync(slider, tmp_path):
    """At 0.05 m/s a velocity of counts per SYNC comes in steps of an eighth of that."""
    slow = replace(slider, axes=(replace(slider.axes[0], limits=replace(slider.axes[0].limits, v=0.05, a=0.5)),))
    with rig_on_bus(slow, {"x": Faults(rough=True)}) as simulation:
        assert run(slow, program(far=0.01, v=0.05, a=0.5), tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


# -- answers


def test_hardly_any_answer_is_not_enough(slider, tmp_path):
    count = iter(range(10**9))
    act = lambda simulation: deaf(simulation, lambda can_id, data: can_id == 0x281 and next(count) % 15)  # noqa: E731
    simulation = failing(slider, tmp_path, LinkLost, r"axis x.*has not answered 101 of the last \d+ SYNCs", act=act)
    stands(simulation, (State.DISABLED,))  # it still does what it is told, and says so
    assert "NOT SEEN TO STOP" not in str(simulation.caught)
    assert (0, b"\x02\x01") not in simulation.ear.frames
    assert not simulation.drives[0].get(o.CONSUMER_HEARTBEAT)


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
        drive.count(5)
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


@pytest.mark.parametrize("late", [0, 15])
def test_an_interface_that_gives_back_late_or_not_all(slider, tmp_path, late):
    """In batches, or one in a hundred lost; and somebody else's SYNC is still one too many."""
    for other in (False, True):
        with rig_on_bus(slider) as simulation:
            send, kept, count, extra = simulation.host.send_message, [], iter(range(10**9)), []

            def echoed(can_id, data, remote=False, send=send, kept=kept, count=count, simulation=simulation):
                send(can_id, data, remote)
                kept.extend([(can_id, bytearray(data))] if late or next(count) % 100 else [])
                while len(kept) > late:
                    simulation.host.notify(*kept.pop(0), 0.0)

            def watch(k, simulation=simulation, extra=extra, other=other):
                if other and simulation.drives[0].plant.velocity > 200:
                    simulation.line.networks[1].send_message(0x80, b"")
                    extra.append(k)

            simulation.host.send_message = echoed
            act = partial(run, slider, program(far=0.1), tmp_path, simulate=True, watch=watch, network=simulation.host)
            if other:
                with pytest.raises(DriveFault, match="somebody else on this bus sends SYNCs"):
                    act()
                assert len(extra) < 200
            else:
                assert act()["status"] == "complete"


def test_velocities_that_follow_one_another(slider, tmp_path):
    """However far apart they are, and however rough the encoder tells them."""
    steps = [(0.0, 0.3), (0.5, 0.05), (1.2, -0.3), (2.4, 0.0)]
    moves = tuple(Move(t, 0, "velocity", 0.2, v, 1.0) for t, v in steps)
    with rig_on_bus(slider) as simulation:
        (drive,), turn = simulation.drives, iter(range(10**9))
        live = drive._live
        drive._live = lambda obj: live(obj) + 60 * (-1) ** next(turn) if obj == o.VELOCITY and drive.plant.velocity else live(obj)
        with contextlib.suppress(DriveFault):  # where it ends is none of this test's
            run(slider, Program(moves, (0.2,), 3.0), tmp_path, simulate=True, network=simulation.host)
    told = [event["reason"] for event in events(tmp_path) if event["what"] == "stopping"]
    assert not [reason for reason in told if "should move" in reason]
    assert [event["v"] for event in events(tmp_path) if event.get("kind") == "velocity"] == [v for _, v in steps]


def test_a_fault_while_a_mode_is_awaited_is_a_fault(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]
        drive._take_mode = lambda mode: drive.fault(0x8A88)
        with pytest.raises(DriveFault, match=r"safe torque off \(0x8A88\)") as caught:
            run(slider, program(), tmp_path, simulate=True, network=simulation.host)
        assert caught.value.code == 3
