"""torchcmax rig sync and truth: from a run of a rig and a recording of its camera to ground truth."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from jsonargparse import Namespace

from torchcmax.config import Parser, UsageError
from torchcmax.io import OpenOptions, open
from torchcmax.io.recording import Recording
from torchcmax.resultfiles import read_result

if TYPE_CHECKING:  # the extra may be missing
    from torchcmax.rig.clock import ClockModel, Driven, Seen
    from torchcmax.rig.config import Rig
    from torchcmax.rig.demand import Samples
    from torchcmax.rig.record import Encoder
    from torchcmax.rig.truth import Encoded

LOCK, CLOCK = "config.lock.yaml", "clock.json"
OF_CLOCKS = (CLOCK, "groundtruth.txt", "truth.json", "twist.txt")
OF_RUNS = (
    *OF_CLOCKS, "profile.yaml", "plan.json", "encoder.csv", "log.jsonl", "run.json", "groundtruth_driveclock.txt",
    "motion.png", "repeat.png", "oprange_*.png",
)  # fmt: skip
ANY_CAMERA = OpenOptions(camera="pinhole")  # nobody looks where events are
BIN = 0.002  # s, in which events are counted
AWAKE = 0.15  # of the 90 % quantile of events a second: with less, a window is of a camera at rest


def sync_options(sub: Parser) -> None:
    sub.add_argument("run", type=str, help="folder that rig run wrote")
    sub.add_argument("--result", type=str, default="", help="by velocity: folder that compensate or track wrote of the camera's recording")
    sub.add_argument("--events", type=str, default="", help="by the rate of events: the camera's recording")


def truth_options(sub: Parser) -> None:
    sub.add_argument("run", type=str, help="folder that rig run wrote and rig sync found the clock of")


def sync(config: Namespace) -> None:
    """clock.json, also of a clock that is not accepted."""
    from torchcmax.rig.clock import align
    from torchcmax.rig.record import write_whole
    from torchcmax.rig.truth import told as parts

    if bool(config.result) == bool(config.events):
        raise UsageError("give one of --result FOLDER, to align by velocity, and --events RECORDING, to align by the rate of events")
    out = Path(config.run)
    rig, encoded = read_run(out)
    driven, turning = _driven(rig, encoded)
    seen = _velocities(Path(config.result), turning) if config.result else _rates(open(config.events, ANY_CAMERA))
    clear(out, OF_CLOCKS)  # of an older clock
    clock = align(driven, seen, "velocity" if config.result else "rate")
    write_whole(out / CLOCK, json.dumps(parts(clock) | _whose(out, rig), indent=2) + "\n")
    tell(f"clock: {out / CLOCK}")
    clock.demand()
    drift = f"{clock.drift * 1e6:.0f} ppm, sigma {clock.drift_sigma * 1e6:.0f} ppm"
    tell(f"the camera's clock is {clock.offset:.6f} s ahead, sigma {clock.sigma * 1e3:.2f} ms; drift {drift}")


def truth(config: Namespace) -> None:
    """groundtruth.txt and what belongs to it."""
    from torchcmax.rig.errors import Rejected
    from torchcmax.rig.truth import TRUTH, write_truth

    out = Path(config.run)
    rig, encoded = read_run(out)
    clock = _clock(out, rig)
    said = write_truth(out, rig, encoded, clock)
    if clock is None:
        raise Rejected(f"{out}: the camera's clock is not known\n  what to do: torchcmax rig sync {out} --result FOLDER")
    clock.demand()
    if not said["truth"]:
        raise Rejected(f"{out}: the run did not end normally, {encoded.status}\n  what to do: run it again")
    tell(f"truth: {out / TRUTH}")


def tell(text: str, stream: TextIO | None = None, end: str = "\n") -> None:
    """Print.  Whoever reads it may be gone, or its disk full: what a rig does goes on, and the exit status says how."""
    stream = stream or sys.stdout
    try:
        print(text, end=end, file=stream, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def clear(out: Path, patterns: tuple[str, ...]) -> None:
    """Without these files."""
    for pattern in patterns:
        for path in out.glob(pattern):
            path.unlink()


@contextmanager
def kept(out: Path, rig: Rig, simulated: bool, planned: Samples | None = None) -> Iterator[None]:
    """What the encoders told by the drives' clock is written down and drawn, however the run ended; truth.json says from the first how."""
    from torchcmax.rig.errors import Refused
    from torchcmax.rig.record import write_whole
    from torchcmax.rig.truth import SAID

    def say(why: str) -> None:
        said = {"status": f"aborted: {why}", "simulated": simulated, "configuration": rig.digest, "truth": False}
        write_whole(out / SAID, json.dumps(said, indent=2) + "\n")

    say("it did not end")
    try:
        yield
        _keep(out, rig, planned)
    except BaseException as error:
        with suppress(OSError, Refused):  # there may be no samples; and why it ended counts more
            say(str(error) or type(error).__name__)
            _keep(out, rig, planned)
        raise


def _keep(out: Path, rig: Rig, planned: Samples | None) -> None:
    from torchcmax.rig import picture
    from torchcmax.rig.record import write_whole
    from torchcmax.rig.truth import write_truth

    _, encoder, said = _read(out)
    write_truth(out, rig, _encoded(rig, encoder, said), None)
    cycles = _cycles(rig, said)
    write_whole(out / "motion.png", picture.motion(rig, planned, encoder, cycles))
    if len(cycles) > 1:
        write_whole(out / "repeat.png", picture.repeats(rig, encoder, cycles))


def read_run(out: Path) -> tuple[Rig, Encoded]:
    """What a run left in its folder."""
    rig, encoder, said = _read(out)
    return rig, _encoded(rig, encoder, said)


def _read(out: Path) -> tuple[Rig, Encoder, dict[str, Any]]:
    from torchcmax.rig.config import load
    from torchcmax.rig.errors import Refused
    from torchcmax.rig.record import ENCODER, RUN, read_encoder

    rig = load(out / LOCK)
    encoder, said = read_encoder(out / ENCODER, rig), _json(out / RUN)
    if not isinstance(said.get("status"), str) or not isinstance(said.get("cycles"), list):
        raise Refused(f"{out / RUN}: does not say how the run ended\n  what to do: give the folder that rig run wrote")
    if said.get("configuration") != rig.digest:
        raise Refused(f"{out / LOCK}: is not the configuration of this run\n  what to do: put back the rig's file that it was run with")
    return rig, encoder, said


def _encoded(rig: Rig, encoder: Encoder, said: dict[str, Any]) -> Encoded:
    from torchcmax.rig.truth import Encoded, repeatability

    again = repeatability(rig, encoder.place, _cycles(rig, said))
    time, place = encoder.time, encoder.place
    if not said.get("simulated"):  # a host does not send SYNCs evenly: to even steps of the time at which positions came
        time = np.linspace(time[0], time[-1], len(time))
        place = np.stack([np.interp(time, encoder.time, column) for column in place.T], 1)
    return Encoded(time, place, said["status"], bool(said.get("simulated")), again)


def _cycles(rig: Rig, said: dict[str, Any]) -> list[tuple[int, int]]:
    """First and last sample of each cycle that was run to its end."""
    every = 1 / (rig.rate * rig.bus.sync_period)
    return [(round(first / every), round(last / every)) for first, last in said["cycles"]]


def _json(path: Path) -> dict[str, Any]:
    from torchcmax.rig.errors import Refused

    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise Refused(f"{path}: cannot be read: {error}\n  what to do: give the folder that rig run wrote") from error
    return found if isinstance(found, dict) else {}


def _whose(out: Path, rig: Rig) -> dict[str, str]:
    """What a clock belongs to: SHA-256 of the rig's file and of the record."""
    from torchcmax.rig.record import ENCODER

    return {"configuration": rig.digest, "record": hashlib.sha256((out / ENCODER).read_bytes()).hexdigest()}


def _clock(out: Path, rig: Rig) -> ClockModel | None:
    """As sync left it."""
    from torchcmax.rig.clock import ClockModel
    from torchcmax.rig.errors import Refused

    if not (out / CLOCK).exists():
        return None
    said: dict[str, Any] = {name: np.inf if value is None else value for name, value in _json(out / CLOCK).items() if name != "accepted"}
    if (whose := _whose(out, rig)) != {name: said.pop(name, None) for name in whose}:
        raise Refused(f"{out / CLOCK}: is the clock of another run\n  what to do: torchcmax rig sync {out} --result FOLDER")
    try:
        return ClockModel(**said)
    except TypeError as error:
        raise Refused(f"{out / CLOCK}: is not what sync writes: {error}\n  what to do: torchcmax rig sync {out}") from error


def _driven(rig: Rig, encoded: Encoded) -> tuple[Driven, bool]:
    """The camera's velocity by the encoders: angular, if any axis turned it; and whether."""
    from torchcmax.rig.clock import Driven
    from torchcmax.rig.truth import motion

    inner, v, omega = motion(rig, encoded)
    turning = bool(np.abs(omega).max() > 0)
    wide = [np.ptp(encoded.place[:, k]) if (axis.kind == "rotary") == turning else -1.0 for k, axis in enumerate(rig.axes)]
    return Driven(encoded.time[inner], omega if turning else v, encoded.place[inner, int(np.argmax(wide))]), turning


def _velocities(folder: Path, turning: bool) -> Seen:
    """What a result says of its windows; nan of those in which nothing was seen."""
    from torchcmax.rig.clock import Seen

    result = read_result(folder)
    numbers, statuses = result.numbers, result.texts.get("status")
    start, end = numbers["start_us"] * 1e-6, numbers["end_us"] * 1e-6
    name = "omega" if turning else "v"
    value = np.stack([numbers.get(f"{name}_{axis}", np.full(len(start), np.nan)) for axis in "xyz"], -1)
    rate = numbers["events"] / np.maximum(end - start, 1e-9)
    known = rate > AWAKE * np.quantile(rate, 0.9) if len(rate) else rate > 0
    if statuses is not None:
        known &= np.array([status in ("start", "ok", "weak") for status in statuses], bool)
    return Seen(start, end, np.where(known[:, None], value, np.nan))


def _rates(recording: Recording) -> Seen:
    """Events a second in short bins."""
    from torchcmax.rig.clock import LONGEST, Seen

    counts: dict[int, int] = {}
    for chunk in recording.chunks():
        bins, events = np.unique(chunk.t // round(BIN * 1e6), return_counts=True)
        for k, count in zip(bins.tolist(), events.tolist(), strict=True):
            counts[k] = counts.get(k, 0) + count
    first, last = (min(counts), max(counts)) if counts else (0, 0)
    every = np.arange(first + 1, last) if (last - first) * BIN < LONGEST else np.array([first, last])  # the outer ones are not whole
    value = np.array([counts.get(k, 0) for k in every.tolist()], float).reshape(-1, 1) / BIN
    return Seen(every * BIN, (every + 1) * BIN, value)
