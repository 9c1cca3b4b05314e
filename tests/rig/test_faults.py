"""Whatever fails: everything ends standing and disabled, with its kind of error, without ground truth, and no axis is switched on again."""

import json
import signal
from dataclasses import replace

import pytest
from bus import CONTROL, failing, marked, never_enabled_after, program, rig_on_bus, stands

from torchcmax.rig import objects as o
from torchcmax.rig.errors import Aborted, DriveFault, LinkLost, Refused
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.runner import run
from torchcmax.rig.simnode import Faults


def set_fault(name, value):
    def act(simulation):
        marked(simulation)
        setattr(simulation.drives[0].faults, name, value)

    return act


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("blocked_rotor", True, r"axis x.*following error \(0x8611\)"),
        ("limit_input", True, r"axis x.*limit switch \(0x8A80\)"),
        ("heat", 200.0, r"axis x.*over-temperature \(0x4210\)"),
    ],
)
def test_a_drive_that_faults(slider, tmp_path, name, value, match):
    simulation = failing(slider, tmp_path, DriveFault, match, Faults(), act=set_fault(name, value))
    assert simulation.caught.code == 3
    stands(simulation)
    assert simulation.drives[0].state is State.FAULT
    never_enabled_after(simulation, simulation.mark)
    last = json.loads((tmp_path / "run.json").read_text())["last"]
    assert last == (tmp_path / "encoder.csv").read_text().splitlines()[-len(last) :]
    assert 20 < len(last) <= 200


@pytest.mark.parametrize("family", ["epos4", "epos2"])
def test_any_other_fault_is_told_by_its_number(slider, tmp_path, family):
    """An EPOS2 tells it in an emergency message alone."""
    rig = replace(slider, axes=(replace(slider.axes[0], family=family),))
    simulation = failing(rig, tmp_path, DriveFault, r"0x7320", act=lambda s: s.drives[0].fault(0x7320))
    stands(simulation)


def test_the_other_axes_stop_too(pantilt, tmp_path):
    """A fault of one axis: the other, which has none, is stopped and disabled."""
    both = Program(tuple(Move(0.0, k, "position", 0.4, 0.6, 3.0) for k in (0, 1)), (0.0, 0.0), 2.0)
    simulation = failing(pantilt, tmp_path, DriveFault, pantilt.axes[0].name, Faults(), told=both, act=set_fault("blocked_rotor", True))
    assert [drive.state for drive in simulation.drives] == [State.FAULT, State.DISABLED]
    stands(simulation)
    assert o.QUICK in simulation.ear.controlwords(pantilt.axes[1].node_id)
    never_enabled_after(simulation, simulation.mark)


def test_a_soft_limit_is_the_end(slider, tmp_path):
    """A program that no plan would accept: the host stops before the limit is reached."""
    beyond = Program((Move(0.0, 0, "position", 0.9, 0.5, 5.0),), (0.1,), 3.0)
    simulation = failing(slider, tmp_path, DriveFault, r"is at 0\.7\d+ and too fast to stop between -0.02 and 0.75", told=beyond)
    stands(simulation)
    assert simulation.drives[0].plant.place * 0.06 / 4.8 / 6.283185307 < slider.axes[0].limits.max + 0.003


def test_a_drive_knows_its_soft_limit_itself(slider, tmp_path, monkeypatch):
    """Were the host's limits not there."""
    monkeypatch.setattr("torchcmax.rig.session.Session._limit", lambda self: None)
    beyond = Program((Move(0.0, 0, "position", 0.9, 0.5, 5.0),), (0.1,), 3.0)
    simulation = failing(slider, tmp_path, DriveFault, r"axis x.*soft limit of the position \(0x8A82\)", told=beyond)
    stands(simulation)


def test_the_host_has_limits_too(slider, tmp_path):
    """Profile velocity mode does not know the limit of the speed; the host does."""
    fast = Program((Move(0.0, 0, "velocity", 0.0, 1.65, 11.0), Move(0.3, 0, "velocity", 0.5, 0.0, 11.0)), (0.0,), 0.6)
    simulation = failing(slider, tmp_path, DriveFault, r"moves at 1\.\d+ /s, its limit is 1.4", told=fast)
    stands(simulation)


@pytest.mark.parametrize(
    ("model", "match"), [("warm", r"winding of 1\d\d °C by the model"), ("load", r"takes 99\.\d+ A, more than the 2.66 A")]
)
def test_the_host_counts_heat_and_current(slider, tmp_path, monkeypatch, model, match):
    from torchcmax.rig import session

    sessions = []
    begun = session.Session.__enter__
    monkeypatch.setattr(session.Session, "__enter__", lambda self: sessions.append(self) or begun(self))
    values = {"warm": (154.0, 100.0), "load": 99.0**2 + 40}
    act = lambda simulation: getattr(sessions[0], model).__setitem__(0, values[model])  # noqa: E731
    stands(failing(slider, tmp_path, DriveFault, match, act=act))


@pytest.mark.parametrize("how", ["dropped", "muted"])
def test_a_drive_that_is_no_longer_heard(slider, tmp_path, how):
    simulation = failing(slider, tmp_path, LinkLost, "axis x.*has not answered 20 SYNCs", Faults(), act=set_fault(how, True), after=400)
    assert simulation.caught.code == 4
    never_enabled_after(simulation, simulation.mark)
    assert (0, b"\x02\x01") in simulation.ear.frames[simulation.mark :]  # NMT stop
    last = max(i for i, (can_id, _) in enumerate(simulation.ear.frames) if can_id == 0x77F)
    assert all(can_id != 0x77F for can_id, _ in simulation.ear.frames[last + 1 :])  # no heartbeat any more
    stands(simulation)


@pytest.mark.parametrize("which", [0x80, 0x77F])
def test_the_bus_is_gone(slider, tmp_path, which):
    """What python-can raises when the bus is off or the queue is full, at a SYNC or at a heartbeat."""
    import can

    def act(simulation):
        marked(simulation)
        send = simulation.host.wire.send

        def broken(message, timeout=None):
            if message.arbitration_id == which:
                raise can.CanOperationError("Network is down")
            send(message, timeout)

        simulation.host.wire.send = broken

    simulation = failing(slider, tmp_path, LinkLost, r"the bus is gone: Network is down", act=act)
    assert simulation.caught.code == 4
    assert any(can_id == 0 and data == b"\x02\x01" for can_id, data in simulation.ear.frames[simulation.mark :])
    never_enabled_after(simulation, simulation.mark)


@pytest.mark.parametrize(
    ("faults", "match"),
    [
        (Faults(vendor=0x1234), "its vendor is 0x1234"),
        (Faults(altered={o.SUPPORTED: 0b1}), "it has no mode profile velocity, homing|it has no mode homing"),
        (Faults(altered={o.VELOCITY_UNIT: 0x00B40300}), "its unit of velocity is 0x00B40300, not rpm"),
        (Faults(altered={o.HIGHEST: 2**31 - 1}), "0x607D:02 was set to 119999 and reads 2147483647"),
        (Faults(altered={o.Object(0x1601, 1, "u32"): 0x60400010}), "0x1601:01 was set to 1618608160 and reads 1614807056"),
        (Faults(altered={o.CONSUMER_HEARTBEAT: 0}), "0x1016:01 was set to 8323172 and reads 0"),
        (Faults(aborted={o.FOLLOWING_WINDOW: 0x06090031}), "0x6065:00 cannot be set to 480: .*0x06090031"),
    ],
)
def test_a_drive_that_is_not_as_it_should_is_never_switched_on(slider, tmp_path, faults, match):
    simulation = failing(slider, tmp_path, Refused, match, faults)
    assert simulation.caught.code == 2
    assert simulation.ear.controlwords() == []
    stands(simulation, (State.DISABLED,))


def test_a_mode_that_is_refused(slider, tmp_path):
    simulation = failing(slider, tmp_path, Refused, "mode profile position is refused", Faults(refused_mode=o.PROFILE_POSITION))
    assert simulation.caught.code == 2
    stands(simulation, (State.DISABLED,))


def test_a_wrong_serial_number(slider, tmp_path):
    other = replace(slider, axes=(replace(slider.axes[0], serial=7),))
    assert failing(other, tmp_path, Refused, "its serial number is 12345678, not 7").ear.controlwords() == []


def test_nobody_is_there(slider, tmp_path):
    simulation = failing(slider, tmp_path, LinkLost, r"0x1018:01 cannot be read[^\n]*\n.*node id", Faults(dropped=True))
    assert simulation.ear.controlwords() == []


def test_a_fault_from_before_stays_until_it_is_reset(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        simulation.drives[0].fault(o.FOLLOWING_ERROR)
        with pytest.raises(DriveFault, match=r"in its fault state: following error \(0x8611\)\n.*--reset-fault"):
            run(slider, program(), tmp_path, simulate=True, network=simulation.host)
        assert simulation.ear.controlwords() == []
        assert run(slider, program(), tmp_path, simulate=True, reset=True, network=simulation.host)["status"] == "complete"


def test_an_exception_anywhere_stops_the_axes(slider, tmp_path):
    def act(simulation):
        marked(simulation)
        raise ZeroDivisionError("in somebody's progress bar")

    simulation = failing(slider, tmp_path, ZeroDivisionError, "progress bar", act=act)
    stands(simulation, (State.DISABLED,))
    never_enabled_after(simulation, simulation.mark)


def test_a_message_that_cannot_be_understood_stops_the_axes(slider, tmp_path):
    """In the callback of a PDO, whose errors canopen would only log."""

    def act(simulation):
        marked(simulation)
        simulation.drives[0].network.send_message(0x181, b"\x01")

    import struct

    stands(failing(slider, tmp_path, struct.error, "unpack", act=act), (State.DISABLED,))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_user_stops_it(slider, tmp_path, number):
    before = signal.getsignal(number)

    def act(simulation):
        marked(simulation)
        signal.raise_signal(number)

    simulation = failing(slider, tmp_path, Aborted, "stopped by the user", act=act)
    assert simulation.caught.code == 5
    stands(simulation, (State.DISABLED,))
    never_enabled_after(simulation, simulation.mark)
    first = next(int.from_bytes(data, "little") for can_id, data in simulation.ear.frames[simulation.mark :] if can_id == CONTROL + 1)
    assert first == o.QUICK
    assert signal.getsignal(number) == before


def test_the_second_signal_takes_the_voltage_away_at_once(slider, tmp_path):
    simulation = failing(
        slider,
        tmp_path,
        Aborted,
        "stopped",
        act=lambda s: (marked(s), signal.raise_signal(signal.SIGINT), signal.raise_signal(signal.SIGINT)),
    )
    words = [(i, d) for i, (can_id, d) in enumerate(simulation.ear.frames[simulation.mark :]) if can_id == CONTROL + 1]
    assert [int.from_bytes(d, "little") for _, d in words] == [o.QUICK, o.NO_VOLTAGE]
    syncs = sum(can_id == 0x80 for can_id, _ in simulation.ear.frames[simulation.mark + words[0][0] : simulation.mark + words[1][0]])
    assert syncs == 0
    assert simulation.drives[0].state is State.DISABLED


def test_a_quick_stop_is_as_short_as_planned(slider, tmp_path):
    """v² / (2 a) and what a tick takes."""
    places = []

    def act(simulation):
        places.append((simulation.drives[0].position, simulation.drives[0].plant.velocity))
        signal.raise_signal(signal.SIGINT)

    told = Program((Move(0.0, 0, "position", 0.7, 1.0, 10.0),), (0.1,), 1.0)

    simulation = failing(slider, tmp_path, Aborted, "stopped", told=told, act=act)
    metres = 6.25e-6
    speed = places[0][1] * 0.06 / 4.8 / 6.283185307
    went = (simulation.drives[0].position - places[0][0]) * metres
    assert went <= speed**2 / (2 * slider.axes[0].limits.quick_stop) + 0.002 + 2 * speed * slider.bus.sync_period


def test_a_drive_that_is_not_disabled_is_told(slider, tmp_path, monkeypatch):
    """A run ends well only where every drive says that it is off."""
    with rig_on_bus(slider) as simulation:
        (drive,) = simulation.drives
        control = drive._control
        monkeypatch.setattr(
            drive,
            "_control",
            lambda word: control(word) if word not in (o.SHUT_DOWN, o.NO_VOLTAGE) or drive.state is not State.ENABLED else None,
        )
        with pytest.raises(DriveFault, match=r"axis x.*is not disabled\n.*power"):
            run(slider, program(far=0.05), tmp_path, simulate=True, network=simulation.host)
    assert json.loads((tmp_path / "run.json").read_text())["status"].startswith("aborted: ")


def test_what_a_drive_said_before_it_fell_silent_is_told(slider, tmp_path):
    def act(simulation):
        simulation.drives[0].fault(o.FOLLOWING_ERROR)
        simulation.drives[0].faults.muted = True

    failing(slider, tmp_path, DriveFault, r"following error \(0x8611\)", act=act, after=400)
