"""Runs a program on the drives of a rig, and sees that everything stands still and is switched off however it ends."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import can
import canopen
import numpy as np

from torchcmax.rig import objects as o
from torchcmax.rig.config import Rig
from torchcmax.rig.drive import Drive
from torchcmax.rig.errors import Aborted, DriveFault, LinkLost, Refused, RigError
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.record import Recorder
from torchcmax.rig.simnode import HEARTBEAT, OPERATIONAL, simulated
from torchcmax.rig.thermal import TwoBody

LOST = (5, 0.02)  # periods, s without an answer, the longer of which means that a drive is lost
ENABLE_TIME, MODE_TIME, ANSWER_TIME, ARRIVE_TIME, HOME_TIME = 5.0, 1.0, 0.1, 2.0, 120.0  # s; EPOS2 finds its commutation first
DWELL = 0.2  # s at rest at the end
BEYOND = {"linear": 1e-3, "rotary": math.radians(0.1)}  # of a soft limit, that the host does not accept
FASTER, COOLER = 1.1, 5.0  # times the limit of the speed; K below the winding's limit: where the host stops
STANDS = 2.0  # rpm of the motor
TURN = 4  # SYNCs before a move by which its mode is sent
LAST = 200  # samples that are told of a fault
Watch = Callable[[int], object]


@dataclass
class Guard:
    """SIGINT and SIGTERM as a count: the first stops, the second takes the voltage away."""

    signals: int = 0
    _before: dict[int, Any] = field(default_factory=dict)

    def __enter__(self) -> Guard:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._count)
        return self

    def _count(self, number: int, frame: FrameType | None) -> None:
        self.signals += 1

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


class Session:
    """The drives of a rig on a bus, ticked by the SYNC.  Leaving it, however that comes, stops and disables all of them.

    network: with the drives on it | paced: in real time, else as fast as it goes | watch: is called after every tick with its number
    """

    def __init__(self, rig: Rig, network: canopen.Network, recorder: Recorder, paced: bool, watch: Watch | None = None) -> None:
        self.rig, self.network, self.recorder, self.paced, self.watch = rig, network, recorder, paced, watch
        self.drives = [Drive(network, axis) for axis in rig.axes]
        self.guard, self.k, self.begin = Guard(), -1, 0
        self.recording = self.limited = self.stopping = self.armed = False
        self.beat = max(1, round(rig.bus.heartbeat / rig.bus.sync_period))
        self.bodies = [TwoBody(axis.motor, rig.ambient) for axis in rig.axes]
        self.warm = [(rig.ambient, rig.ambient) for _ in rig.axes]
        self.load = [0.0 for _ in rig.axes]  # mean square of the current, A^2
        self.next = time.monotonic()

    def __enter__(self) -> Session:
        self.guard.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if self.armed:
                self._stop(error)
        finally:
            self.guard.__exit__(kind, error, trace)

    @property
    def period(self) -> float:
        return self.rig.bus.sync_period

    # -- one SYNC

    def tick(self) -> None:
        """One SYNC and the answers to it; the errors of whatever must not go on.  The heartbeat is only sent after a good one."""
        if self.guard.signals and not self.stopping:
            raise Aborted("stopped by the user")
        if self.paced:
            self._wait()
        self.k += 1
        for drive in self.drives:
            drive.heard.clear()
        self.network.sync.transmit()
        self._answers()
        if self.recording:
            self.recorder.take(self.k - self.begin, self.drives)
        for drive in self.drives:
            drive.missed = 0 if drive.complete else drive.missed + 1
            if not self.stopping:
                drive.check()
            if drive.missed * self.period >= max(LOST[0] * self.period, LOST[1]):
                raise LinkLost(f"{drive}: has not answered {drive.missed} SYNCs\n  what to do: look at its power and cable")
        if self.limited and not self.stopping:
            self._limit()
        if self.k % self.beat == 0:
            self.network.send_message(HEARTBEAT + o.MASTER, bytes([OPERATIONAL]))
        if self.watch is not None and not self.stopping:
            self.watch(self.k)

    def _wait(self) -> None:
        """Until the next SYNC is due."""
        now = time.monotonic()
        self.next = max(self.next + self.period, now)
        time.sleep(self.next - now)

    def _answers(self) -> None:
        """Wait for the drives, a period at most.  Simulated ones have answered already."""
        until = time.monotonic() + self.period
        while self.paced and not all(drive.complete for drive in self.drives) and time.monotonic() < until:
            time.sleep(self.period / 20)

    def _limit(self) -> None:
        """The host's own limits, with some room about those of the drives."""
        for i, drive in enumerate(self.drives):
            axis, told = drive.axis, drive.told
            limits, room = axis.limits, BEYOND[axis.kind]
            current, speed = told.current / 1e3, told.velocity * math.pi / 30
            loss = axis.motor.torque_constant * axis.motor.no_load_current * abs(speed)
            loss *= abs(speed) / axis.motor.no_load_speed if axis.motor.commutation == "ec" else 1.0
            self.warm[i] = self.bodies[i].step(*self.warm[i], current, loss, self.period)
            self.load[i] += (current**2 - self.load[i]) * self.period / axis.motor.winding_time
            wrong = None
            if not limits.min - room <= drive.place <= limits.max + room:
                wrong = f"is at {drive.place:.4f}, outside of {limits.min:g} to {limits.max:g}"
            elif abs(drive.speed) > FASTER * limits.v:
                wrong = f"moves at {drive.speed:.4g} /s, its limit is {limits.v:g}"
            elif self.warm[i][0] > axis.motor.winding_max - COOLER:
                wrong = f"has a winding of {self.warm[i][0]:.0f} °C by the model"
            elif self.load[i] > axis.motor.nominal_current**2:
                wrong = f"takes {math.sqrt(self.load[i]):.2f} A, more than the {axis.motor.nominal_current:g} A that it can for ever"
            if wrong is not None:
                raise DriveFault(f"{drive}: {wrong}\n  what to do: look for what is in its way, or plan a gentler motion")

    def until(self, done: Callable[[], bool], seconds: float, what: str) -> None:
        """Tick until something is so; DriveFault where it is not in time."""
        for _ in range(max(1, math.ceil(seconds / self.period))):
            self.tick()
            if done():
                return
        raise DriveFault(f"{what} within {seconds:g} s\n  what to do: look at log.jsonl, and at the drive with its maker's program")

    # -- getting ready

    def connect(self, modes: set[int]) -> list[dict[str, int]]:
        """Who is there; Refused, or DriveFault, where that is not as it must be."""
        return [drive.identify(modes) for drive in self.drives]

    def healthy(self, reset: bool) -> None:
        """DriveFault where a drive is in its fault state; it is reset, once, where that is asked for, and stays switched off."""
        for drive in self.drives:
            if o.state_of(drive.read(o.STATUSWORD)) is not State.FAULT:
                continue
            codes = ", ".join(o.error_text(code) for code in drive.history()) or "no code in its history"
            if not reset:
                raise DriveFault(f"{drive}: is in its fault state: {codes}\n  what to do: remove the cause, then --reset-fault")
            self.recorder.note(self.k, "fault reset", axis=drive.axis.name, codes=codes)
            drive.write(o.CONTROLWORD, 0)
            drive.write(o.CONTROLWORD, o.RESET)
            if o.state_of(drive.read(o.STATUSWORD)) is State.FAULT:
                raise DriveFault(f"{drive}: stays in its fault state: {codes}\n  what to do: remove the cause")
            drive.emergency = 0

    def configure(self) -> None:
        """Limits, supervision and PDOs, read back; then the drives listen to PDOs."""
        self._command(0x80)
        for drive in self.drives:
            self.recorder.note(self.k, "configured", axis=drive.axis.name, values=drive.configure(self.rig.bus.heartbeat_timeout))
        self._command(1)
        self.armed = True
        for _ in range(3):
            self.tick()

    def _command(self, code: int) -> None:
        """An NMT command to each drive: 1 operational, 2 stop, 0x80 pre-operational."""
        for drive in self.drives:
            drive.node.nmt.send_command(code)

    def enable(self, mode: dict[int, int]) -> None:
        """Switch the axes on, each in a mode, to hold where they stand."""
        for i, wanted in mode.items():
            self.drives[i].turn(wanted)
        shown = lambda: all(self.drives[i].told.mode == wanted for i, wanted in mode.items())  # noqa: E731
        try:
            self.until(shown, MODE_TIME, "a mode was not taken")
        except DriveFault:
            refused = [f"{self.drives[i]}: mode {o.MODES[m]}" for i, m in mode.items() if self.drives[i].told.mode != m]
            if not refused:
                raise
            raise Refused(f"{', '.join(refused)} is refused\n  what to do: look at the drive's set-up") from None
        sent: dict[int, int | None] = {}
        for _ in range(math.ceil(ENABLE_TIME / self.period)):
            if all(self.drives[i].state is State.ENABLED for i in mode):
                self.recorder.note(self.k, "enabled")
                return
            for i in mode:
                drive = self.drives[i]
                word = o.towards_enabled(drive.state)
                if word is not None and sent.get(i) != word:
                    drive.control(word)
                    sent[i] = word
            self.tick()
        raise DriveFault(
            f"{', '.join(str(self.drives[i]) for i in mode)}: not enabled in {ENABLE_TIME:g} s\n  what to do: look at safe torque off"
        )

    def home(self) -> None:
        """Every axis, one after the other, by its own method; the others hold where they stand."""
        self.enable(dict.fromkeys(range(len(self.drives)), o.HOMING))
        for drive in self.drives:
            drive.control(o.START)
            self.rest(ANSWER_TIME)  # what it answers before is of an earlier homing
            self.until(lambda d=drive: d.shows(o.ANSWERED) or d.shows(o.OFFSIDE), HOME_TIME, f"{drive}: home was not found")  # type: ignore[misc]
            if drive.shows(o.OFFSIDE):
                raise DriveFault(f"{drive}: homing failed\n  what to do: look at the switch and at homing.method in the configuration")
            drive.control(o.ENABLE)
            self.until(lambda d=drive: abs(d.told.velocity) <= STANDS, ARRIVE_TIME, f"{drive}: did not stand")  # type: ignore[misc]
            self.recorder.note(self.k, "homed", axis=drive.axis.name, position=drive.told.position)
        self.limited = True

    # -- moving

    def go(self, places: tuple[float, ...]) -> None:
        """All axes to their places, slowly: at the speed of homing."""
        moves = [
            Move(TURN * self.period, i, "position", x, axis.homing.speed, min(axis.limits.a, 2 * axis.homing.speed / 0.1))
            for i, (axis, x) in enumerate(zip(self.rig.axes, places, strict=True))
        ]
        far = max(abs(d.place - x) / d.axis.homing.speed for d, x in zip(self.drives, places, strict=True))
        self.follow(Program(tuple(moves), places, far + 1.0))

    def ready(self, program: Program) -> None:
        """The drives in the modes that their first moves want."""
        firsts = {move.axis: move for move in sorted(program.moves, key=lambda move: -move.start)}
        for move in firsts.values():
            self._turn(move)
        self.rest(TURN * self.period)

    def follow(self, program: Program) -> None:
        """The moves of a program, each at its SYNC, until all axes have arrived."""
        first, pending = self.k + 1, sorted(program.moves, key=lambda move: move.start)
        starts = [first + round(move.start / self.period) for move in pending]
        due, turned = 0, 0
        waiting: dict[int, int] = {}  # axes whose set point is not answered yet, since which SYNC
        last = first + round(program.duration / self.period)
        while self.k < last or waiting:
            for move, start in zip(pending[turned:], starts[turned:], strict=True):
                if start - TURN > self.k + 1:
                    break
                self._turn(move)
                turned += 1
            while due < len(pending) and starts[due] <= self.k + 1:
                self._start(pending[due], waiting)
                due += 1
            self.tick()
            self._answered(waiting)
        self.until(lambda: all(drive.shows(o.ARRIVED) for drive in self.drives), ARRIVE_TIME, "not all axes have arrived")

    def _turn(self, move: Move) -> None:
        """Its mode and its set point ahead of time, where that changes nothing yet."""
        drive = self.drives[move.axis]
        mode = o.PROFILE_POSITION if move.kind == "position" else o.PROFILE_VELOCITY_MODE
        if drive.told.mode != mode:
            drive.turn(mode)
        if move.kind == "position":
            drive.aim(move)

    def _start(self, move: Move, waiting: dict[int, int]) -> None:
        """With the next SYNC."""
        drive = self.drives[move.axis]
        wanted = o.PROFILE_POSITION if move.kind == "position" else o.PROFILE_VELOCITY_MODE
        if drive.told.mode != wanted:
            raise Refused(f"{drive}: mode {o.MODES[wanted]} is refused\n  what to do: look at the drive's set-up")
        self.recorder.note(self.k + 1, "move", axis=drive.axis.name, kind=move.kind, target=move.target, v=move.v, a=move.a)
        if move.kind == "velocity":
            drive.aim(move)
            drive.control(o.ENABLE)
        elif move.axis in waiting or drive.shows(o.ANSWERED):
            raise DriveFault(f"{drive}: still answers the move before\n  what to do: leave more time between moves")
        else:
            drive.aim(move)
            drive.control(o.AT_ONCE)
            waiting[move.axis] = self.k

    def _answered(self, waiting: dict[int, int]) -> None:
        """The hand-shake of set points: answered, taken back, and the answer too."""
        for i, since in list(waiting.items()):
            drive = self.drives[i]
            if drive.shows(o.ANSWERED) and since >= 0:
                drive.control(o.ENABLE)
                waiting[i] = -1 - self.k
            elif not drive.shows(o.ANSWERED) and since < 0:
                del waiting[i]
            elif (self.k - (since if since >= 0 else -1 - since)) * self.period > ANSWER_TIME:
                raise DriveFault(f"{drive}: does not answer a set point\n  what to do: look at the drive with its maker's program")

    def rest(self, seconds: float) -> None:
        """Tick for so long."""
        for _ in range(round(seconds / self.period)):
            self.tick()

    # -- coming to an end

    def _stop(self, error: BaseException | None) -> None:
        """Everything stands still and is disabled; what goes wrong now is told to the log, as `error` is the one to be told."""
        self.stopping, self.recording = True, self.recording and error is not None
        self.recorder.note(self.k, "stopping", reason="done" if error is None else f"{type(error).__name__}: {error}")
        try:
            if isinstance(error, LinkLost | can.CanError):
                raise error
            moving = [drive for drive in self.drives if drive.state not in (State.FAULT, State.FAULTING)]
            if error is not None:
                for drive in moving:
                    drive.control(o.QUICK)
                self._while(lambda: not all(abs(drive.told.velocity) <= STANDS for drive in self.drives), self._patience())
            for word in (o.SHUT_DOWN, o.NO_VOLTAGE) if error is None else (o.NO_VOLTAGE,):
                for drive in moving:
                    drive.control(word)
                self.tick()
            off = (State.DISABLED, State.FAULT)
            self._while(lambda: not all(drive.state in off for drive in self.drives), 1.0)
            self.recorder.note(self.k, "stopped", states=[str(drive.state and drive.state.value) for drive in self.drives])
            for drive in self.drives:
                if drive.state not in off:
                    raise DriveFault(f"{drive}: is not disabled\n  what to do: take the power from it, then look at log.jsonl")
                if drive.state is State.DISABLED:
                    drive.unwatch()
        except (RigError, can.CanError) as failed:
            if isinstance(failed, LinkLost | can.CanError):
                self._let_go(failed)
            elif failed is not error:
                self.recorder.note(self.k, "not stopped as it should", reason=str(failed))
            if error is None:
                raise

    def _patience(self) -> float:
        """s that stopping may take."""
        return 0.5 + max(2 * drive.axis.limits.v / drive.axis.limits.quick_stop for drive in self.drives)

    def _while(self, going: Callable[[], bool], seconds: float) -> None:
        """Tick while something is so, for so long at most, or until the user presses again."""
        for _ in range(math.ceil(seconds / self.period)):
            if not going() or self.guard.signals > 1:
                return
            self.tick()

    def _let_go(self, lost: BaseException) -> None:
        """Without answers: no more heartbeat, so that drives stop by themselves; and three times what would stop them now."""
        self.recorder.note(self.k, "link lost", reason=str(lost))
        for _ in range(3):
            stops: list[Callable[[], object]] = [partial(drive.control, o.QUICK) for drive in self.drives]
            stops += [self.network.sync.transmit, partial(self._command, 2)]
            for send in stops:
                try:
                    send()
                except (can.CanError, RuntimeError) as error:
                    self.recorder.note(self.k, "not sent", reason=str(error))


@contextmanager
def opened(rig: Rig, simulate: bool) -> Iterator[canopen.Network]:
    """The host's end of the bus: a simulation of the rig's drives, or the interface that its file names; LinkLost where that fails."""
    if simulate:
        with simulated(rig) as simulation:
            yield simulation.host
        return
    network, bus = canopen.Network(), rig.bus
    try:
        network.connect(interface=bus.interface, channel=bus.channel, bitrate=bus.bitrate)
    except (can.CanError, OSError, ValueError, ImportError) as error:
        remedy = "look whether the interface is up (ip link set can0 up type can bitrate 1000000) and spelled as python-can does"
        raise LinkLost(f"{bus.interface} {bus.channel}: cannot be opened: {error}\n  what to do: {remedy}") from error
    try:
        yield network
    finally:
        network.disconnect()


def run(
    rig: Rig, program: Program, out: Path, *, simulate: bool, arm: bool = False, repeat: int = 1, reset: bool = False,
    watch: Watch | None = None, network: canopen.Network | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run a program `repeat` times, record it, and write encoder.csv, log.jsonl and run.json into `out` -> what run.json says.

    simulate: with simulated drives, which are homed first | arm: hardware may move; Refused without | reset: a fault, once
    network: the bus, else it is opened | RigError of its kind; everything stands still then and is disabled, and what was recorded is kept
    """
    _armed(simulate, arm)
    modes = {o.PROFILE_POSITION} | {o.PROFILE_VELOCITY_MODE for move in program.moves if move.kind == "velocity"}

    def work(session: Session, said: dict[str, Any]) -> None:
        if simulate:
            session.home()
        elif not all(drive.shows(o.HOMED) for drive in session.drives):
            lost = ", ".join(str(drive) for drive in session.drives if not drive.shows(o.HOMED))
            raise Refused(f"{lost}: home is not known\n  what to do: torchcmax rig home")
        session.limited = True
        session.enable(dict.fromkeys(range(len(rig.axes)), o.PROFILE_POSITION))
        session.go(program.begin)
        session.rest(DWELL)
        session.ready(program)
        session.begin, session.recording = session.k + 1, True
        for _ in range(repeat):
            begin = session.k + 1 - session.begin
            session.follow(program)
            said["cycles"].append([begin, session.k - session.begin])
            if len(said["cycles"]) < repeat:
                session.go(program.begin)
                session.ready(program)
        session.rest(DWELL)

    return _session(rig, out, simulate, modes | ({o.HOMING} if simulate else set()), reset, watch, network, work)


def home(
    rig: Rig, out: Path, *, simulate: bool, arm: bool = False, reset: bool = False, watch: Watch | None = None,
    network: canopen.Network | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Find home on every axis, and go to the place that the configuration gives it; arguments and errors as of `run`."""
    _armed(simulate, arm)

    def work(session: Session, said: dict[str, Any]) -> None:
        session.home()
        session.enable(dict.fromkeys(range(len(rig.axes)), o.PROFILE_POSITION))
        session.go(tuple(axis.homing.offset for axis in rig.axes))

    return _session(rig, out, simulate, {o.HOMING, o.PROFILE_POSITION}, reset, watch, network, work)


def watch_encoders(
    rig: Rig, out: Path, seconds: float, *, simulate: bool, watch: Watch | None = None, network: canopen.Network | None = None
) -> dict[str, Any]:
    """Record for so long while the drives stay disabled: a rig that is moved by hand."""

    def work(session: Session, said: dict[str, Any]) -> None:
        session.begin, session.recording = session.k + 1, True
        session.rest(seconds)
        said["cycles"].append([0, session.k - session.begin])

    return _session(rig, out, simulate, set(), False, watch, network, work)


def check(rig: Rig, *, simulate: bool, seconds: float = 1.0, network: canopen.Network | None = None) -> dict[str, Any]:
    """Who is there and how it is set up, read only; and how evenly this machine would send SYNCs: the 99th percentile of their delay."""
    if network is None:
        with opened(rig, simulate) as made:
            return check(rig, simulate=simulate, seconds=seconds, network=made)
    found: dict[str, Any] = {}
    for axis in rig.axes:
        drive = Drive(network, axis)
        state = o.state_of(drive.read(o.STATUSWORD))
        wanted = {obj: value for obj, value in o.settings(axis, rig.bus.heartbeat_timeout).items() if drive.has(obj)}
        found[axis.name] = {
            **drive.identify(set()),
            "modes": o.bits(drive.read(o.SUPPORTED)),
            "state": None if state is None else state.value,
            "homed": bool(drive.read(o.STATUSWORD) & o.HOMED),
            "errors": [o.error_text(code) for code in drive.history()],
            "differs": {str(obj): [value, read] for obj, value in wanted.items() if (read := drive.read(obj)) != value},
        }
    late, period = [], rig.bus.sync_period
    due = time.monotonic()
    for _ in range(round(seconds / period)):
        due += period
        time.sleep(max(0.0, due - time.monotonic()))
        late.append(max(0.0, time.monotonic() - due))
    found["sync_delay_p99_s"] = float(np.quantile(late, 0.99))
    return found


def _bus_gone(error: can.CanError) -> LinkLost:
    """Bus off, a full queue, an interface that went down."""
    return LinkLost(f"the bus is gone: {error}\n  what to do: look at the interface (ip -details link show), cable and termination")


def _armed(simulate: bool, arm: bool) -> None:
    if not (simulate or arm):
        remedy = "try --dry-run first; give --arm when nobody is within reach of the rig and the emergency stop is in yours"
        raise Refused(f"this would move hardware, and is not armed\n  what to do: {remedy}")


def _session(
    rig: Rig, out: Path, simulate: bool, modes: set[int], reset: bool, watch: Watch | None, network: canopen.Network | None,
    work: Callable[[Session, dict[str, Any]], None],
) -> dict[str, Any]:  # fmt: skip
    """Connect, configure, work, stop, and write down how that went."""
    if network is None:
        with opened(rig, simulate) as made:
            return _session(rig, out, simulate, modes, reset, watch, made, work)
    recorder = Recorder(rig, simulate)
    said: dict[str, Any] = {"status": "complete", "simulated": simulate, "configuration": rig.digest, "cycles": []}
    out.mkdir(parents=True, exist_ok=True)
    try:
        with Session(rig, network, recorder, paced=not simulate, watch=watch) as session:
            said["drives"] = session.connect(modes)
            session.healthy(reset)
            session.configure()
            work(session, said)
    except BaseException as caught:
        error = _bus_gone(caught) if isinstance(caught, can.CanError) else caught
        said["status"] = f"aborted: {error}" if isinstance(error, RigError) else f"aborted: {type(error).__name__}: {error}"
        said["last"] = recorder.rows[-LAST:]
        if error is not caught:
            raise error from caught
        raise
    finally:
        (out / "groundtruth.txt").unlink(missing_ok=True)  # of an older run: not of this one
        recorder.write(out, said)
    return said
