"""What the tests of the drives share: a simulation to run on, and an ear on its bus."""

import json
from contextlib import contextmanager

import pytest

pytest.importorskip("canopen", reason="the extra rig is not installed")

from torchcmax.rig import drive as drives
from torchcmax.rig import objects as o
from torchcmax.rig import session
from torchcmax.rig.axis import reduction
from torchcmax.rig.errors import Aborted, RigError
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.runner import run
from torchcmax.rig.simnode import SYNC, simulated

EMERGENCY, STATUS, CONTROL, SDO = 0x80, 0x180, 0x200, 0x600
STOPPING, SWITCHING = {o.QUICK, o.NO_VOLTAGE}, {o.SHUT_DOWN, o.SWITCH_ON, o.ENABLE, o.START, o.AT_ONCE}

CRUISE = Program((Move(0.0, 0, "velocity", 0.1, 0.3, 3.0), Move(1.0, 0, "velocity", 0.4, 0.0, 3.0)), (0.1,), 1.3)


class Ear:
    """Every frame on the bus, in order: (COB-ID, data)."""

    def __init__(self, line):
        self.frames = []
        line.network().notify = lambda can_id, data, timestamp: self.frames.append((can_id, bytes(data)))

    def controlwords(self, node=1):
        return [int.from_bytes(data, "little") for can_id, data in self.frames if can_id == CONTROL + node]

    def lawful(self):
        """No controlword that nobody means, and none that switches a drive on after a fault of any, or after its own quick stop.

        The former until it is reset, the latter until it is disabled.
        """
        faulty, stopped = set(), set()
        for can_id, data in self.frames:
            kind, node = can_id & 0x780, can_id & 0x7F
            code = int.from_bytes(data[:2], "little")
            if kind == EMERGENCY and node:
                (faulty.add if code >= 0x100 else faulty.discard)(node)
            elif kind == STATUS:
                state = o.state_of(code)
                if state is State.STOPPING:
                    stopped.add(node)
                elif state is State.DISABLED:
                    stopped.discard(node)
            elif kind == CONTROL:
                assert len(data) == 2
                assert code in (STOPPING if faulty or node in stopped else STOPPING | SWITCHING)
                if code == o.QUICK:
                    stopped.add(node)
            elif kind == SDO and data[0] & 0xE0 == 0x20 and data[1:3] == b"\x40\x60":
                assert data[4] in (0, o.RESET)


@contextmanager
def rig_on_bus(rig, faults=None, places=None, lawful=True):
    """The simulation of a rig; that the host was lawful is asserted in the end."""
    with simulated(rig, places, faults) as simulation:
        simulation.ear = Ear(simulation.line)
        yield simulation
        if lawful:
            simulation.ear.lawful()


def there_and_back(axis=0, far=0.3, v=0.5, a=5.0):
    """One axis goes and comes back, by profile position mode."""
    lasts = far / v + v / a
    second = round((lasts + 0.05) * 1e3) / 1e3
    return (Move(0.0, axis, "position", 0.1 + far, v, a), Move(second, axis, "position", 0.1, v, a)), second + lasts


def program(begin=(0.1,), **options):
    moves, duration = there_and_back(**options)
    return Program(moves, begin, round(duration + 0.05, 3))


def sync(simulation, count):
    """SYNCs from somebody who sends no heartbeat."""
    for _ in range(count):
        simulation.host.sync.transmit()


def failing(rig, out, error, match, faults=None, told=None, act=None, after=0, lawful=True):
    """A run in which something happens while the first axis moves fast: the simulation as it was left.

    faults: from the beginning | act: simulation -> None, done once | after: SYNCs that still come
    """
    out.mkdir(exist_ok=True)
    (out / "groundtruth.txt").write_text("of an older run\n")
    done = []
    told = told or program()
    fast = 0.6 * told.moves[0].v * abs(reduction(rig.axes[0]))  # rad/s of the motor: in the middle of a move
    with rig_on_bus(rig, {rig.axes[0].name: faults} if faults else None) as simulation:
        drive = simulation.drives[0]

        def watch(k):
            if act is not None and not done and abs(drive.plant.velocity) > fast and drive.mode == o.PROFILE_POSITION:
                done.append(k)
                act(simulation)

        with pytest.raises(error, match=match) as caught:
            run(rig, told, out, simulate=True, watch=watch, network=simulation.host)
        assert act is None or done
        assert not (out / "groundtruth.txt").exists()
        assert json.loads((out / "run.json").read_text())["status"].startswith("aborted: ")
        assert not list(out.glob(".*"))
        if isinstance(caught.value, RigError):
            assert "what to do" in str(caught.value) or isinstance(caught.value, Aborted)
        simulation.caught = caught.value
        sync(simulation, after)
        return simulation


def stands(simulation, states=(State.DISABLED, State.FAULT)):
    for drive in simulation.drives:
        assert drive.state in states
        assert abs(drive.plant.velocity) < 1
        assert drive.plant.current == 0


def never_enabled_after(simulation, before):
    """No controlword but quick stop and no voltage came after a frame."""
    later = [int.from_bytes(data, "little") for can_id, data in simulation.ear.frames[before:] if can_id & 0x780 == CONTROL]
    assert set(later) <= {o.QUICK, o.NO_VOLTAGE}


def marked(simulation):
    simulation.mark = len(simulation.ear.frames)


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


class Clock:
    """The time of a host and of drives that go on by it, SYNC or no SYNC; only sleeping and `pass_` move it.

    shift: s by which the interface's clock is ahead | grain: s in which it goes on, 0 where it knows all
    """

    def __init__(self, monkeypatch, simulation):
        self.now, self.shift, self.grain = 100.0, 0.0, 0.0
        for module in (session, drives):
            monkeypatch.setattr(module, "time", self)
        hear = simulation.host.notify
        simulation.host.notify = lambda can_id, data, timestamp: hear(can_id, data, self._stamp())
        for drive in simulation.drives:
            drive.network.subscribers[SYNC].insert(0, self._running(drive, drive._run))
            drive._run = lambda: None

    def _running(self, drive, run):
        """Up to a SYNC, before the drive takes what comes with it."""
        begun = ran = self.now

        def go_on(can_id, data, timestamp):
            nonlocal ran
            periods = round((self.now - ran) / drive.period)
            for _ in range(periods):
                run()
            ran += periods * drive.period
            drive.time = self.now - begun

        return go_on

    def _stamp(self):
        stamp = self.now + self.shift
        return stamp // self.grain * self.grain if self.grain else stamp

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds

    pass_ = sleep
