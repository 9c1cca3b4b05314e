"""How runs end: seen to stop, or told that they were not; and what is left of them."""

import json
import signal
import threading
from functools import partial

import canopen
import pytest
from bus import (
    CONTROL,
    events,
    failing,
    marked,
    program,
    rig_on_bus,
    stands,
    sync,
)

from torchcmax.rig import objects as o
from torchcmax.rig.axis import reduction
from torchcmax.rig.drive import Drive
from torchcmax.rig.errors import Aborted, DriveFault, LinkLost, Refused, RigError
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.record import Recorder
from torchcmax.rig.runner import check, home, opened, run, watch_encoders
from torchcmax.rig.simnode import Faults, SimulatedDrive


@pytest.mark.parametrize("error", [OSError(19, "No such device"), RuntimeError("Not connected to CAN bus")])
def test_an_adapter_that_was_unplugged_is_a_lost_link(slider, tmp_path, error):
    def act(simulation):
        marked(simulation)

        def gone(message, timeout=None):
            raise error

        simulation.host.wire.send = gone

    simulation = failing(slider, tmp_path, LinkLost, f"the bus is gone: .*{error.args[-1]}", act=act, after=0)
    assert simulation.caught.code == 4
    assert sum(event["what"] == "not sent" for event in events(tmp_path)) == 3 * 2 + 1 + 1  # quick stops and SYNCs, a question, NMT stop
    assert "\n  NOT SEEN TO STOP" in json.loads((tmp_path / "run.json").read_text())["status"]
    assert "what to do: take the power from it" in str(simulation.caught)


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


def test_a_stop_that_nobody_saw_is_told(slider, tmp_path):
    """Ctrl-C, and from then on nothing can be sent: the link is what matters, and that the axis may still move."""

    def act(simulation):
        def gone(message, timeout=None):
            raise OSError(19, "No such device")

        simulation.host.wire.send = gone
        signal.raise_signal(signal.SIGINT)

    simulation = failing(
        slider, tmp_path, LinkLost, "stopped by the user\n  NOT SEEN TO STOP: the bus is gone: .*No such device\n.*power", act=act
    )
    assert simulation.caught.code == 4
    assert "NOT SEEN TO STOP" in json.loads((tmp_path / "run.json").read_text())["status"]
    assert simulation.drives[0].state is State.ENABLED


def test_a_drive_that_stays_on_is_told_whatever_ended_the_run(slider, tmp_path):
    def act(simulation):
        drive = simulation.drives[0]
        control = drive._control
        drive._control = lambda word: control(word) if word != o.NO_VOLTAGE else None
        signal.raise_signal(signal.SIGINT)

    simulation = failing(slider, tmp_path, Aborted, r"stopped.*\n  NOT SEEN TO STOP: axis x \(node 1\): is not disabled\n.*power", act=act)
    assert simulation.drives[0].state is State.STOPPING


@pytest.mark.parametrize("what", ["run", "home", "record", "check"])
def test_a_drive_that_was_let_go_answers_again(slider, tmp_path, what):
    """NMT has stopped it, so that it answers no SDO; its fault is from the heartbeats that it missed."""
    lost = lambda simulation: setattr(simulation.drives[0].faults, "dropped", True)  # noqa: E731
    with rig_on_bus(slider) as simulation:
        drive = simulation.drives[0]
        home(slider, tmp_path, simulate=True, network=simulation.host)
        with pytest.raises(LinkLost):
            run(slider, program(), tmp_path, simulate=True, watch=lambda k: k > 500 and lost(simulation), network=simulation.host)
        sync(simulation, 400)
        drive.faults.dropped = False
        simulation.host.send_message(0, b"\x02\x01")  # this time it is heard
        assert drive.node.nmt.state == "STOPPED"
        assert drive.state is State.FAULT
        if what == "check":
            assert check(slider, simulate=True, seconds=0.01, network=simulation.host)["x"]["state"] == "fault"
            return
        act = {
            "run": partial(run, slider, program(), reset=True),
            "home": partial(home, slider, reset=True),
            "record": partial(watch_encoders, slider, seconds=0.1),
        }[what]
        if what == "record":
            with pytest.raises(DriveFault, match="heartbeat was not heard"):
                act(out=tmp_path, simulate=True, network=simulation.host)
        else:
            assert act(out=tmp_path, simulate=True, network=simulation.host)["status"] == "complete"


@pytest.mark.parametrize("refused", [False, True], ids=["a fault", "a history that is refused"])
def test_a_fault_of_one_axis_at_the_end_is_none_of_the_others(pantilt, tmp_path, refused):
    """They are told to wait for no more heartbeats."""
    turn = Program(tuple(Move(0.0, k, "position", 0.1, 0.5, 2.0) for k in (0, 1)), (0.0, 0.0), 1.0)
    with rig_on_bus(pantilt) as simulation:
        pan, tilt = simulation.drives
        control = pan._control
        pan._control = lambda word: pan.fault(0x2310) if word == o.SHUT_DOWN and pan.state is State.ENABLED else control(word)
        live = pan._live

        def read(obj):
            if refused and obj == o.ERROR_LATEST:
                raise canopen.SdoAbortedError(0x08000020)
            return live(obj)

        pan._live = read
        with pytest.raises(DriveFault, match=r"axis pan.*over-current \(0x2310\)"):
            run(pantilt, turn, tmp_path, simulate=True, network=simulation.host)
        sync(simulation, 400)
        assert [drive.state for drive in simulation.drives] == [State.FAULT, State.DISABLED]
        assert not tilt.error


def test_drives_that_hear_no_syncs_are_asked(slider, tmp_path):
    """A drive that fell into its fault for want of heartbeats answers SDOs alone, and says that it is off."""

    def act(simulation):
        simulation.drives[0].faults.muted = True

    simulation = failing(slider, tmp_path, LinkLost, "has not answered 20 SYNCs", act=act)
    assert "NOT SEEN TO STOP" not in str(simulation.caught)
    stands(simulation)
