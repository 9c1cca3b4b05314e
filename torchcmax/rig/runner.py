"""What a rig does: run a program, find home, record while it is moved by hand, or be asked how it is set up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import canopen
import numpy as np

from torchcmax.rig import objects as o
from torchcmax.rig.config import Rig
from torchcmax.rig.drive import GONE, Drive
from torchcmax.rig.errors import LinkLost, Refused, RigError
from torchcmax.rig.program import Program
from torchcmax.rig.record import ENCODER, LOG, RUN, Recorder
from torchcmax.rig.session import Guard, Session, Watch
from torchcmax.rig.simnode import simulated

DWELL = 0.2  # s at rest at the end
TRUTH = "groundtruth.txt"


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
    except (*GONE, ValueError, ImportError) as error:
        remedy = "look whether the interface is up (ip link set can0 up type can bitrate 1000000) and spelled as python-can does"
        raise LinkLost(f"{bus.interface} {bus.channel}: cannot be opened: {error}\n  what to do: {remedy}") from error
    try:
        yield network
    finally:
        with suppress(Exception):  # it tells again what ended the receiving thread
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
        session.homed = set(range(len(rig.axes)))
        session.enable(o.PROFILE_POSITION)
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
        session.enable(o.PROFILE_POSITION)
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
        with closing(Drive(network, axis, rig.bus.sync_period)) as drive:
            found[axis.name] = _described(rig, drive)
    late, period = [], rig.bus.sync_period
    due = time.monotonic()
    for _ in range(round(seconds / period)):
        due += period
        time.sleep(max(0.0, due - time.monotonic()))
        late.append(max(0.0, time.monotonic() - due))
    found["sync_delay_p99_s"] = float(np.quantile(late, 0.99))
    return found


def _described(rig: Rig, drive: Drive) -> dict[str, Any]:
    drive.wake()
    state = o.state_of(drive.read(o.STATUSWORD))
    wanted = {obj: value for obj, value in o.settings(drive.axis, rig.bus.heartbeat_timeout).items() if drive.has(obj)}
    return {
        **drive.identify(set()),
        "modes": o.bits(drive.read(o.SUPPORTED)),
        "state": None if state is None else state.value,
        "homed": bool(drive.read(o.STATUSWORD) & o.HOMED),
        "errors": [o.error_text(code) for code in drive.history()],
        "differs": {str(obj): [value, read] for obj, value in wanted.items() if (read := drive.read(obj)) != value},
    }


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
    if not simulate and threading.current_thread() is not threading.main_thread():
        raise Refused("this thread cannot be stopped by a signal\n  what to do: run a rig in the main thread of its own process")
    out.mkdir(parents=True, exist_ok=True)
    for name in (TRUTH, ENCODER, LOG, RUN):  # of an older run: not of this one
        (out / name).unlink(missing_ok=True)
    said: dict[str, Any] = {"status": "complete", "simulated": simulate, "configuration": rig.digest, "cycles": []}
    recorder = Recorder(rig, simulate, out)
    with Guard() as guard:
        session = Session(rig, network, recorder, guard, paced=not simulate, watch=watch)
        try:
            with session:
                said["drives"] = session.connect(modes)
                session.healthy(reset)
                session.configure(homing=o.HOMING in modes)
                work(session, said)
        except BaseException as error:
            told = [str(error) if isinstance(error, RigError) else f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])]
            said["status"] = "aborted: " + "\n".join(told)
            said["last"] = list(recorder.last)
            raise
        finally:
            said["syncs"] = {"sent": session.ticks, "left_out": session.late}
            said["unanswered"] = {drive.axis.name: drive.unanswered for drive in session.drives}
            failed = recorder.write(said)
        if failed is not None:
            raise failed
    return said
