"""The drives of a rig in time with the SYNC: made ready, moved, watched, and stopped and switched off however that ends."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from types import FrameType, TracebackType
from typing import Any

import canopen

from torchcmax.rig import objects as o
from torchcmax.rig.axis import drivable
from torchcmax.rig.config import Rig
from torchcmax.rig.drive import Drive, bus
from torchcmax.rig.errors import Aborted, DriveFault, LinkLost, Refused, RigError, Unanswered
from torchcmax.rig.objects import State
from torchcmax.rig.program import Move, Program
from torchcmax.rig.record import Recorder
from torchcmax.rig.simnode import HEARTBEAT, OPERATIONAL, SYNC
from torchcmax.rig.thermal import TwoBody

LOST = (5, 0.02)  # periods, s without an answer, the longer of which means that a drive is lost
MISSING = (10.0, 0.01)  # s, and part of their SYNCs that a drive may leave unanswered
STALL = 0.05  # s by which the host may be late while axes are on
FIRST_TIME, ENABLE_TIME, MODE_TIME, ANSWER_TIME, ARRIVE_TIME, HOME_TIME = 0.5, 5.0, 1.0, 0.1, 2.0, 120.0  # s; EPOS2 finds its commutation
RESET_TIME, OFF_TIME, STAND_TIME = 0.5, 1.0, 0.02  # s
BEYOND = {"linear": 1e-3, "rotary": math.radians(0.1)}  # of a soft limit, that the host does not accept
FASTER, COOLER = 1.1, 5.0  # times the limit of the speed; K below the winding's limit: where the host stops
ECHO_TIME = 0.05  # s, in which an interface that gives back what is sent has given back most of it
TURN = 4  # SYNCs before a move by which its mode is sent
WITHOUT_VOLTAGE = (State.DISABLED, State.FAULT)
Watch = Callable[[int], object]


@dataclass
class Guard:
    """SIGINT, SIGTERM and SIGHUP as a count: the first stops, the second takes the voltage away."""

    signals: int = 0
    _before: dict[int, Any] = field(default_factory=dict)

    def __enter__(self) -> Guard:
        if threading.current_thread() is threading.main_thread():
            hangup = {signal.SIGHUP} if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN else set()  # nohup
            for number in {signal.SIGINT, signal.SIGTERM} | hangup:
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
    k: number of the last SYNC, by the time: one that was not sent in time counts too, and is among `late`
    echo: whether the interface gives back what is sent, None before that is known | off: all drives have been seen without voltage
    allowed: the state in which every drive has to be now, None while that changes
    """

    def __init__(
        self, rig: Rig, network: canopen.Network, recorder: Recorder, guard: Guard, paced: bool, watch: Watch | None = None
    ) -> None:  # fmt: skip
        self.rig, self.network, self.recorder, self.guard, self.paced, self.watch = rig, network, recorder, guard, paced, watch
        self.drives = [Drive(network, axis, rig.bus.sync_period) for axis in rig.axes]
        self.k, self.begin, self.before, self.ticks, self.late = -1, 0, -1, 0, 0
        self.recording = self.limited = self.stopping = self.armed = self.off = False
        self.echo: bool | None = None
        self.allowed: State | None = None
        self.homed: set[int] = set()  # axes whose places are to be believed
        self.found: set[int] = set()  # those that have found home just now
        self.moves: dict[int, Move] = {}  # the last one of every axis
        self.waiting: dict[int, tuple[bool, int]] = {}  # axes with a set point: whether its answer has to come or go, since when
        self.beaten = -math.inf  # s, when the last heartbeat was sent
        self.due = 0.0  # s, when the last SYNC was
        self.sent, self.heard = {SYNC: 0, HEARTBEAT + o.MASTER: 0}, {SYNC: 0, HEARTBEAT + o.MASTER: 0}  # what this host alone may send
        self.bodies = [TwoBody(axis.motor, rig.ambient) for axis in rig.axes]
        self.warm = [(rig.ambient, rig.ambient) for _ in rig.axes]
        self.load = [0.0 for _ in rig.axes]  # mean square of the current, A^2

    def __enter__(self) -> Session:
        for cob_id in self.sent:
            self.network.subscribe(cob_id, self._on_own)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if self.armed:
                self._stop(error)
        finally:
            for cob_id in self.sent:
                self.network.unsubscribe(cob_id, self._on_own)
            for drive in self.drives:
                drive.close()

    def _on_own(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """From somebody else, or by an interface that gives back whatever is sent."""
        self.heard[can_id] += 1

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
        self.before, self.k, self.ticks = self.k, self.k + 1, self.ticks + 1
        for drive in self.drives:
            drive.expect()
        self._say(SYNC, b"")
        self._answers()
        for drive in self.drives:
            drive.count(self.k)
        self._record()
        for drive in self.drives:
            if not self.stopping:
                self._check(drive)
            if drive.missed * self.period >= max(LOST[0] * self.period, LOST[1]):
                raise LinkLost(f"{drive}: has not answered {drive.missed} SYNCs\n  what to do: look at its power and cable")
        if self.limited and not self.stopping:
            self._limit()
        self._beat()
        if self.watch is not None and not self.stopping:
            self.watch(self.k)

    def _record(self) -> None:
        """What cannot be recorded ends a run, and does not get in the way of its end."""
        try:
            if self.recording:
                self.recorder.take(self.k - self.begin, self.drives)
        except RigError:
            self.recording = False
            if not self.stopping:
                raise

    def _wait(self) -> None:
        """Until the next SYNC is due; those whose time is over are left out, so that whatever counts SYNCs still counts time."""
        self.due += self.period
        missed = max(0, int((time.monotonic() - self.due) / self.period))
        if missed * self.period > STALL and self.limited and not self.stopping:
            remedy = "leave this machine to the rig alone, and look what `torchcmax rig check` says of its SYNCs"
            raise DriveFault(f"the host was late by {1e3 * missed * self.period:.0f} ms\n  what to do: {remedy}")
        self.k, self.late, self.due = self.k + missed, self.late + missed, self.due + missed * self.period
        time.sleep(max(0.0, self.due - time.monotonic()))

    def _answers(self) -> None:
        """Wait for the drives, a period at most.  Simulated ones have answered already."""
        until = time.monotonic() + self.period
        while self.paced and not all(drive.complete for drive in self.drives) and time.monotonic() < until:
            time.sleep(self.period / 20)

    def _beat(self) -> None:
        """The host lives, by the clock rather than by SYNCs, which may take longer than they should."""
        now = time.monotonic() if self.paced else self.k * self.period
        if now >= self.beaten + self.rig.bus.heartbeat - self.period / 2:
            self.beaten = now
            self._say(HEARTBEAT + o.MASTER, bytes([OPERATIONAL]))

    def _say(self, cob_id: int, data: bytes) -> None:
        self.sent[cob_id] += 1
        with bus():
            self.network.send_message(cob_id, data)

    def _check(self, drive: Drive) -> None:
        """What a drive tells, and what it leaves untold."""
        drive.check()
        for cob_id, count in self.sent.items():
            if self.heard[cob_id] > (0 if self.echo is False else count):
                remedy = "end that program, or give the rig its own bus"
                raise DriveFault(
                    f"somebody else on this bus sends {'SYNCs' if cob_id == SYNC else 'heartbeats'} as its host\n  what to do: {remedy}"
                )
        if self.allowed is not None and drive.complete and drive.state is not self.allowed:
            remedy = "look for an input, a key or another program that commands the drive, and at safe torque off"
            raise DriveFault(f"{drive}: is {drive.says}, not {self.allowed.value}, and nobody asked for it\n  what to do: {remedy}")
        window = round(MISSING[0] / self.period)
        while drive.silent and drive.silent[0] <= self.k - window:
            drive.silent.popleft()
        if len(drive.silent) > MISSING[1] * window:
            remedy = "look at cable, termination and the load of the bus, or give it more time: sync_period_s"
            last = min(self.ticks, window)
            raise Unanswered(f"{drive}: has not answered {len(drive.silent)} of the last {last} SYNCs\n  what to do: {remedy}")

    def _limit(self) -> None:
        """The host's own limits, with some room about those of the drives; of places where home is known."""
        elapsed = (self.k - self.before) * self.period
        for i, drive in enumerate(self.drives):
            axis, told, place = drive.axis, drive.told, drive.place
            limits, room = axis.limits, BEYOND[axis.kind]
            current, speed = told.current / 1e3, told.velocity * math.pi / 30
            loss = axis.motor.torque_constant * axis.motor.no_load_current * abs(speed)
            loss *= abs(speed) / axis.motor.no_load_speed if axis.motor.commutation == "ec" else 1.0
            self.warm[i] = self.bodies[i].step(*self.warm[i], current, loss, elapsed)
            self.load[i] += (current**2 - self.load[i]) * min(1.0, elapsed / axis.motor.winding_time)
            fastest = max(FASTER * limits.v, limits.v + 2 * abs(o.from_rpm(axis, o.speed_step(axis, self.period))))
            stop = place + drive.speed * abs(drive.speed) / (2 * limits.quick_stop)
            wrong = None
            if i in self.homed and not (limits.min - room <= place <= limits.max + room):
                wrong = f"is at {place:.4f}, outside of {limits.min:g} to {limits.max:g}"
            elif i in self.homed and not (limits.min - room <= stop <= limits.max + room):
                wrong = f"is at {place:.4f} and too fast to stop between {limits.min:g} and {limits.max:g}"
            elif abs(drive.speed) > fastest:
                wrong = f"moves at {drive.speed:.4g} /s, its limit is {limits.v:g}"
            elif self.warm[i][0] > axis.motor.winding_max - COOLER:
                wrong = f"has a winding of {self.warm[i][0]:.0f} °C by the model"
            elif self.load[i] > axis.motor.nominal_current**2:
                wrong = f"takes {math.sqrt(self.load[i]):.2f} A, more than the {axis.motor.nominal_current:g} A that it can for ever"
            if wrong is not None:
                raise DriveFault(f"{drive}: {wrong}\n  what to do: look for what is in its way, or plan a gentler motion")

    def ticks_of(self, seconds: float) -> Iterator[None]:
        """Tick for so long, once at least."""
        end = self.k + max(1, round(seconds / self.period))
        while self.k < end:
            self.tick()
            yield

    def rest(self, seconds: float) -> None:
        """Only tick."""
        for _ in self.ticks_of(seconds):
            pass

    def within(self, seconds: float, done: Callable[[], bool]) -> bool:
        """Tick until something is so: whether it is in time."""
        return any(done() for _ in self.ticks_of(seconds))

    def until(self, done: Callable[[], bool], seconds: float, what: Callable[[], str]) -> None:
        """Tick until something is so; DriveFault where it is not in time."""
        if not self.within(seconds, done):
            raise DriveFault(f"{what()} within {seconds:g} s\n  what to do: look at log.jsonl, and at the drive with its maker's program")

    # -- getting ready

    def connect(self, modes: set[int]) -> list[dict[str, int]]:
        """Who is there; Refused, or DriveFault, where that is not as it must be."""
        for drive in self.drives:
            drive.wake()
        return [drive.identify(modes) for drive in self.drives]

    def healthy(self, reset: bool) -> None:
        """Every drive switched off, else Refused; DriveFault where one is in its fault state, which is reset where that is asked for."""
        for drive in self.drives:
            word = drive.read(o.STATUSWORD)
            state = o.state_of(word)
            if state in (State.FAULT, State.FAULTING):
                self._heal(drive, reset)
            elif state is not State.DISABLED:
                what = f"is {state.value if state else f'in an unknown state (0x{word:04X})'}, not {State.DISABLED.value}"
                raise Refused(f"{drive}: {what}\n  what to do: end whatever else commands it, or switch the drive off and on")

    def _heal(self, drive: Drive, reset: bool) -> None:
        codes = ", ".join(o.error_text(code) for code in drive.history()) or "no code in its history"
        if not reset:
            raise DriveFault(f"{drive}: is in its fault state: {codes}\n  what to do: remove the cause, then --reset-fault")
        self.recorder.note(self.k, "fault reset", axis=drive.axis.name, codes=codes)
        drive.unwatch()  # the host's heartbeat does not come yet
        drive.write(o.CONTROLWORD, 0)
        drive.write(o.CONTROLWORD, o.RESET)
        until = time.monotonic() + RESET_TIME
        while o.state_of(drive.read(o.STATUSWORD)) is not State.DISABLED:
            if time.monotonic() > until:
                raise DriveFault(f"{drive}: stays in its fault state: {codes}\n  what to do: remove the cause")
            time.sleep(0.01)
        drive.emergency = 0

    def configure(self, homing: bool) -> None:
        """Limits, supervision and PDOs, read back; then the drives listen to PDOs.  homing: whether home is going to be found now."""
        self._command(o.PREPARE)
        for drive in self.drives:
            if not homing:
                drive.believed()
            values = drive.configure(self.rig.bus.heartbeat_timeout, homing)
            self.recorder.note(self.k, "configured", axis=drive.axis.name, values=values)
            drive.forget()
        self.allowed, self.armed = State.DISABLED, True
        self._command(o.BEGIN)
        self.due = time.monotonic()
        self._first()

    def _first(self) -> None:
        """SYNCs until every drive has answered one, which takes a while where it has just begun to listen."""
        for _ in self.ticks_of(FIRST_TIME):
            if all(drive.complete for drive in self.drives):
                break
            for drive in self.drives:
                drive.missed = 0
                drive.silent.clear()
        for drive in self.drives:
            if not drive.complete:
                raise LinkLost(f"{drive}: answers no SYNC\n  what to do: look at the bus for who else sends on it")
            drive.pardon()
        self.rest(ECHO_TIME)
        self.echo = 2 * self.heard[SYNC] > self.sent[SYNC]

    def _command(self, code: int) -> None:
        """An NMT command to each drive."""
        for drive in self.drives:
            with bus():
                drive.node.nmt.send_command(code)

    def enable(self, mode: int) -> None:
        """Switch the axes on in a mode, to hold where they stand."""
        self.limited = True
        for drive in self.drives:
            drive.turn(mode)
        if not self.within(MODE_TIME, lambda: all(drive.told.mode == mode for drive in self.drives)):
            refused = ", ".join(f"{drive}: mode {o.MODES[mode]}" for drive in self.drives if drive.told.mode != mode)
            raise Refused(f"{refused} is refused\n  what to do: look at the drive's set-up")
        if self.allowed is State.ENABLED:
            return
        self.allowed = None
        sent: dict[int, int] = {}
        for _ in range(math.ceil(ENABLE_TIME / self.period)):
            if all(drive.state is State.ENABLED for drive in self.drives):
                self.allowed = State.ENABLED
                self.recorder.note(self.k, "enabled")
                return
            for i, drive in enumerate(self.drives):
                word = o.towards_enabled(drive.state)
                if word is not None and sent.get(i) != word:
                    drive.control(word)
                    sent[i] = word
            self.tick()
        waiting = ", ".join(f"{drive} (is {drive.says})" for drive in self.drives if drive.state is not State.ENABLED)
        raise DriveFault(f"{waiting}: not enabled in {ENABLE_TIME:g} s\n  what to do: look at safe torque off")

    def home(self) -> None:
        """Every axis, one after the other, by its own method; the others hold where they stand."""
        self.enable(o.HOMING)
        for i, drive in enumerate(self.drives):
            drive.control(o.START)
            self.rest(ANSWER_TIME)  # what it answers before is of an earlier homing
            answered = partial(drive.shows, o.ANSWERED | o.OFFSIDE)
            self.until(answered, HOME_TIME, partial("{}: home was not found".format, drive))
            if drive.shows(o.OFFSIDE):
                raise DriveFault(f"{drive}: homing failed\n  what to do: look at the switch and at homing.method in the configuration")
            drive.control(o.ENABLE)
            self.until(partial(self.stands, drive), ARRIVE_TIME, partial("{}: did not stand".format, drive))
            self.recorder.note(self.k, "homed", axis=drive.axis.name, position=drive.told.position)
            self.homed.add(i)
            self.found.add(i)

    # -- moving

    def go(self, places: tuple[float, ...]) -> None:
        """All axes to their places, slowly: at the speed of homing."""
        speeds = [drivable(axis, axis.homing.speed) for axis in self.rig.axes]
        moves = [
            Move(TURN * self.period, i, "position", x, speed, o.gentle(axis))
            for i, (axis, x, speed) in enumerate(zip(self.rig.axes, places, speeds, strict=True))
        ]
        far = max(abs(d.place - x) / speed for d, x, speed in zip(self.drives, places, speeds, strict=True))
        self.follow(Program(tuple(moves), places, far + 1.0))

    def ready(self, program: Program) -> None:
        """The drives in the modes that their first moves want."""
        firsts = {move.axis: move for move in sorted(program.moves, key=lambda move: -move.start)}
        for move in firsts.values():
            self._turn(move)
        self.rest(TURN * self.period)

    def follow(self, program: Program) -> None:
        """The moves of a program, each at its SYNC, until all axes have arrived.

        No move begins before the axis has arrived from the one before: while one has to wait, and where the host is late, the program's
        time stands (`lag`), so that all that follows is as much later.
        A velocity is ended as many SYNCs as planned after it really began, so that it goes no farther.
        """
        first, lag, blocked = self.k + 1, 0, 0
        pending = sorted(program.moves, key=lambda move: move.start)
        queues = [deque(move for move in pending if move.axis == i) for i in range(len(self.drives))]
        turned: dict[int, Move] = {}
        begun: dict[int, tuple[Move, int, float]] = {}  # the last move of an axis, its SYNC, and the velocity before

        def runs(i: int) -> bool:
            return i in begun and begun[i][0].kind == "velocity" and begun[i][0].v != 0

        def due(move: Move) -> int:
            if not runs(move.axis):
                return first + lag + round(move.start / self.period)
            before, k, _ = begun[move.axis]
            return k + round((move.start - before.start) / self.period)

        while any(queues) or self.waiting or self.k < first + lag + round(program.duration / self.period):
            heads = [queue[0] for queue in queues if queue]
            for move in heads:
                arrived = runs(move.axis) or self.drives[move.axis].arrived(self.moves.get(move.axis))
                if turned.get(move.axis) is not move and due(move) - TURN <= self.k + 1 and arrived:
                    self._turn(move)
                    turned[move.axis] = move
            now = [move for move in heads if runs(move.axis) and due(move) <= self.k + 1]
            idle = [move for move in heads if not runs(move.axis)]
            due_first = min(map(due, idle), default=math.inf)
            begins = [move for move in idle if due(move) == due_first <= self.k + 1]
            waits = any(turned.get(move.axis) is not move or self._busy(move) for move in begins)  # together or not at all
            now += [] if waits else begins
            for move in now:
                self._start(move)
                queues[move.axis].popleft()
            before = self.k
            self.tick()
            if waits:
                lag, blocked = lag + self.k - before, blocked + self.k - before
                if blocked * self.period > ARRIVE_TIME:
                    raise DriveFault(f"{', '.join(map(self._late, begins))}\n  what to do: look at log.jsonl and motion.png")
            elif begins:
                lag, blocked = lag + self.k - round(due_first), 0
            for move in now:
                begun[move.axis] = move, self.k, begun[move.axis][0].v if runs(move.axis) else 0.0
                self._started(move)
            self._answered()
            for i in filter(runs, begun):
                self._keeps(i, *begun[i])
        there = lambda: all(drive.arrived(self.moves.get(i)) for i, drive in enumerate(self.drives))  # noqa: E731
        self.until(there, ARRIVE_TIME, lambda: ", ".join(self._late(move) for move in self.moves.values()))

    def _mode(self, move: Move) -> int:
        return o.PROFILE_POSITION if move.kind == "position" else o.PROFILE_VELOCITY_MODE

    def _turn(self, move: Move) -> None:
        """Its mode and its set point ahead of time, where that changes nothing yet."""
        drive = self.drives[move.axis]
        if drive.told.mode != self._mode(move):
            drive.turn(self._mode(move))
        if move.kind == "position":
            drive.aim(move)

    def _busy(self, move: Move) -> bool:
        """Whether its drive cannot take it yet: it has another mode, or still answers the set point before."""
        drive = self.drives[move.axis]
        answers = move.axis in self.waiting or (move.kind == "position" and drive.shows(o.ANSWERED))
        return drive.told.mode != self._mode(move) or answers

    def _late(self, move: Move) -> str:
        """What is wrong where a move could not begin, or has not ended."""
        drive = self.drives[move.axis]
        if drive.told.mode != self._mode(move):
            return f"{drive}: mode {o.MODES[self._mode(move)]} is refused"
        target = self.moves.get(move.axis, move).target
        return f"{drive}: has not arrived at {target:.4f}, is at {drive.place:.4f} and moves at {drive.speed:.4g} /s"

    def _start(self, move: Move) -> None:
        """With the next SYNC."""
        drive = self.drives[move.axis]
        drive.aim(move)
        drive.control(o.AT_ONCE if move.kind == "position" else o.ENABLE)
        self.moves[move.axis] = move

    def _started(self, move: Move) -> None:
        """With the SYNC that has just been."""
        drive = self.drives[move.axis]
        self.recorder.note(self.k, "move", axis=drive.axis.name, kind=move.kind, target=move.target, v=move.v, a=move.a)
        if move.kind == "position":
            self.waiting[move.axis] = True, self.k
        else:  # once more, for firmware that takes controlword and velocity in this order
            drive.control(o.ENABLE)

    def _answered(self) -> None:
        """The hand-shake of set points: answered, taken back, and the answer too."""
        for i, (coming, since) in list(self.waiting.items()):
            drive = self.drives[i]
            if drive.shows(o.ANSWERED) is not coming:
                if (self.k - since) * self.period > ANSWER_TIME:
                    raise DriveFault(f"{drive}: does not answer a set point\n  what to do: look at the drive with its maker's program")
            elif coming:
                drive.control(o.ENABLE)
                self.waiting[i] = False, self.k
            else:
                del self.waiting[i]

    def _keeps(self, i: int, move: Move, began: int, before: float) -> None:
        """DriveFault where an axis has not the velocity that it should have reached by now, from the one before."""
        drive = self.drives[i]
        reached = abs(move.v - before) / move.a + ANSWER_TIME
        room = 0.1 * max(abs(move.v), abs(before)) + 2 * abs(o.from_rpm(drive.axis, drive.slow))
        if (self.k - began) * self.period > reached and abs(drive.mean_speed - move.v) > room:
            what = f"should move at {move.v:.4g} /s, and moves at {drive.mean_speed:.4g}"
            raise DriveFault(f"{drive}: {what}\n  what to do: look for what is in its way, and at the drive's own limits")

    def stands(self, drive: Drive) -> bool:
        return drive.steady * self.period >= STAND_TIME

    # -- coming to an end

    def _stop(self, error: BaseException | None) -> None:
        """Everything stands still and is disabled.  Of what goes wrong now the log is told, and `error` where that leaves drives on."""
        self.stopping, self.recording = True, self.recording and error is not None
        self.recorder.note(self.k, "stopping", reason="done" if error is None else f"{type(error).__name__}: {error}")
        try:
            if isinstance(error, LinkLost) and not isinstance(error, Unanswered):
                raise error
            self._switch_off(error)
        except BaseException as failed:
            if isinstance(failed, RigError) and not isinstance(failed, LinkLost):
                self.recorder.note(self.k, "not stopped as it should", reason=str(failed))
            else:
                self._let_go(failed)
            told = error or failed
            if not self.off:
                told = self._unsafe(told, failed)
            if told is not error:
                raise told from error

    def _unsafe(self, error: BaseException, failed: BaseException) -> BaseException:
        """What ended a run, and that its drives have not been seen to stop: a lost link where it was one that kept them from it."""
        what = "" if failed is error else f": {str(failed).splitlines()[0] if str(failed) else type(failed).__name__}"
        told = f"  NOT SEEN TO STOP{what}\n  what to do: take the power from it before anybody comes near"
        if isinstance(error, RigError):
            kind = LinkLost if isinstance(failed, LinkLost) else type(error)
            return kind(f"{error}\n{told}")
        error.add_note(told)
        return error

    def _switch_off(self, error: BaseException | None) -> None:
        """Quick stop, if anything was wrong; then no voltage, seen to be off, and no longer watching for the host."""
        moving = [drive for drive in self.drives if drive.state not in (State.FAULT, State.FAULTING)]
        if error is not None:
            for drive in moving:
                drive.control(o.QUICK)
            self._stand()
        for word in (o.SHUT_DOWN, o.NO_VOLTAGE) if error is None else (o.NO_VOLTAGE,):
            for drive in moving:
                drive.control(word)
            self.tick()
        self.off = self.within(OFF_TIME, lambda: all(drive.complete and drive.state in WITHOUT_VOLTAGE for drive in self.drives))
        self.recorder.note(self.k, "stopped", states=[drive.says for drive in self.drives])
        refused = self._leave()
        for drive in self.drives:
            if drive.state not in WITHOUT_VOLTAGE:
                raise DriveFault(f"{drive}: is not disabled\n  what to do: take the power from it, then look at log.jsonl")
            if error is None:
                drive.check()
        if refused is not None:
            raise refused

    def _leave(self) -> RigError | None:
        """What drives without voltage are told and asked, each whatever becomes of the others -> the first that went wrong.

        They watch for the host no more, and those that have found home may be believed; of a fault the log has the history.
        """
        failed: RigError | None = None
        for i, drive in enumerate(self.drives):
            try:
                if drive.state is State.DISABLED:
                    drive.unwatch()
                    if i in self.found:
                        drive.found_home()
                elif drive.state is State.FAULT:
                    codes = [o.error_text(code) for code in drive.history()]
                    self.recorder.note(self.k, "in its fault state", axis=drive.axis.name, codes=codes)
            except RigError as error:
                self.recorder.note(self.k, "not told or asked", axis=drive.axis.name, reason=str(error))
                failed = failed or error
        return failed

    def _stand(self) -> None:
        """Tick until all axes stand, or the user is tired of it."""
        longest = 0.5 + max(2 * drive.axis.limits.v / drive.axis.limits.quick_stop for drive in self.drives)
        for drive in self.drives:
            drive.steady = 0  # before the quick stop has taken hold
        if self.guard.signals > 1 or self.within(longest, lambda: self.guard.signals > 1 or all(map(self.stands, self.drives))):
            return
        self.recorder.note(self.k, "does not stand", places=[drive.place for drive in self.drives])

    def _let_go(self, lost: BaseException) -> None:
        """Without answers to SYNCs: no more heartbeat, so that drives stop by themselves; three times what would stop them now; NMT stop.

        Before the third they are asked by SDO, which answers also where a drive has gone pre-operational for want of heartbeats.
        """
        self.recorder.note(self.k, "link lost", reason=f"{type(lost).__name__}: {lost}")
        quick = [*(partial(drive.control, o.QUICK) for drive in self.drives), partial(self._say, SYNC, b"")]
        for last in (False, False, True):
            if last:
                self._try(self._ask)
            for send in quick:
                self._try(send)
            if self.paced and not last:  # a queue that is full takes a while to empty
                time.sleep(STAND_TIME)
        for drive in self.drives:
            self._try(partial(drive.node.nmt.send_command, o.END))

    def _try(self, send: Callable[[], object]) -> None:
        try:
            send()
        except Exception as error:
            self.recorder.note(self.k, "not sent", reason=f"{type(error).__name__}: {error}")

    def _ask(self) -> None:
        """Whether drives say by SDO that they are without voltage."""
        on = self.drives
        for _ in range(math.ceil(OFF_TIME / self.period)):
            on = [drive for drive in on if o.state_of(drive.read(o.STATUSWORD)) not in WITHOUT_VOLTAGE]
            if not on:
                self.off = True
                return
            self._say(SYNC, b"")  # they may just be about to take the quick stop
            if self.paced:
                time.sleep(self.period)
