"""What the drives told, SYNC by SYNC: encoder.csv, and log.jsonl of what was done."""

from __future__ import annotations

import json
import math
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from torchcmax.rig.axis import from_quadcounts
from torchcmax.rig.config import Rig
from torchcmax.rig.errors import Refused, RigError
from torchcmax.rig.objects import from_rpm

if TYPE_CHECKING:  # what reads records needs no bus
    from torchcmax.rig.drive import Drive, Told

ENCODER, LOG, RUN = "encoder.csv", "log.jsonl", "run.json"
COLUMNS = "k,t_drive_s,axis,pos_qc,x,v,current_a,following_qc,statusword"
RECEIVED = "rx_host_s"  # column of real drives only: simulated ones give the same file every time
LAST = 200  # samples that run.json tells of a run that was aborted
STEP = 0.1  # s by which the interface's clock may not jump against the host's


@dataclass(frozen=True)
class Encoder:
    """time [K] s on the drives' clock | place, velocity [K, axes] m, rad and /s | current A, following

    following: demanded minus actual position, quadcounts | positions are those at the SYNC, one for each; where one was not sent in time or
    not answered they are on the cubic through its neighbours' places and velocities.  Times of simulated drives are SYNC's number times its
    period; those of real ones are when the first axis' positions came, as a host does not send SYNCs evenly, and the other axes' are
    brought to these.
    """

    time: np.ndarray
    place: np.ndarray
    velocity: np.ndarray
    current: np.ndarray
    following: np.ndarray


class Recorder:
    """Writes down what drives told, at the rate of the rig's record, into a folder.  last: the latest rows of encoder.csv"""

    def __init__(self, rig: Rig, simulated: bool, out: Path) -> None:
        self.rig, self.simulated, self.out = rig, simulated, out
        self.every = max(1, round(1 / (rig.rate * rig.bus.sync_period)))
        self.last: deque[str] = deque(maxlen=LAST)
        self.first: tuple[float, float] | None = None  # s: the record's beginning by the interface's and the host's clock
        self.apart = 0.0  # s by which the former has gone on more than the latter
        self.stamps = [-math.inf for _ in rig.axes]  # s, of the latest samples
        self.events: list[dict[str, Any]] = []
        self.taken = -1
        self.part = out / f".{ENCODER}.{os.getpid()}.part"
        self.file = self.part.open("w", encoding="utf-8")
        self.file.write((COLUMNS if simulated else f"{COLUMNS},{RECEIVED}") + "\n")

    def take(self, k: int, drives: list[Drive]) -> None:
        """What was told with SYNC k, of those that are recorded the next; nothing where a drive did not answer it."""
        if k // self.every == self.taken // self.every and self.taken >= 0:
            return
        silent = [drive.axis.name for drive in drives if not drive.complete]
        if silent:
            self.note(k, "not answered", axes=silent)
            return
        self.taken = k
        when = k * self.rig.bus.sync_period if self.simulated else self._since([drive.told for drive in drives])
        for drive in drives:
            told, axis = drive.told, drive.axis
            x, v = float(from_quadcounts(axis, told.position)), from_rpm(axis, told.velocity)
            row = f"{k},{when:.6f},{axis.name},{told.position},{x:.9g},{v:.9g},{told.current / 1e3:g},{told.following},{told.statusword}"
            row = row if self.simulated else f"{row},{told.stamp:.6f}"
            self.last.append(row)
            try:
                self.file.write(f"{row}\n")
            except OSError as error:
                raise _unwritten(self.part, error) from error

    def _since(self, told: list[Told]) -> float:
        """s since the record began; RigError where the clock that tells so stands, or was set meanwhile."""
        stamp, heard = told[0].stamp, told[0].heard
        self.first = self.first or (stamp, heard)
        before, self.apart = self.apart, (stamp - self.first[0]) - (heard - self.first[1])
        if abs(self.apart - before) > STEP:
            remedy = "let no time service set this machine's clock while the rig runs (slewing is no harm)"
            raise RigError(f"the interface's clock jumped by {self.apart - before:.3f} s, and times are of no use\n  what to do: {remedy}")
        before_that, self.stamps = self.stamps, [each.stamp for each in told]
        if not all(now > then for now, then in zip(self.stamps, before_that, strict=True)):
            remedy = "take an interface that stamps what it receives (socketcan), or a longer sync_period_s"
            raise RigError(f"the interface's clock does not go on from SYNC to SYNC, at {stamp:.6f} s\n  what to do: {remedy}")
        return stamp - self.first[0]

    def note(self, k: int, what: str, **more: Any) -> None:
        """An event for the log."""
        self.events.append({"k": k, "what": what, **more})

    def write(self, said: dict[str, Any]) -> RigError | None:
        """encoder.csv, log.jsonl and run.json, each appearing when it is whole -> what went wrong; whatever else can be written is."""
        failed: RigError | None = None
        log = "".join(json.dumps(event) + "\n" for event in self.events)
        writes: list[tuple[str, Callable[[], object]]] = [
            (ENCODER, self._finish),
            (LOG, lambda: write_whole(self.out / LOG, log)),
            (RUN, lambda: write_whole(self.out / RUN, json.dumps(said, indent=2) + "\n")),
        ]
        for name, write in writes:
            try:
                write()
            except OSError as error:
                failed = failed or _unwritten(self.out / name, error)
                said["status"] = f"aborted: {failed}" if said["status"] == "complete" else said["status"]
        return failed

    def _finish(self) -> None:
        self.file.close()
        self.part.replace(self.out / ENCODER)


def _unwritten(path: Path, error: OSError) -> RigError:
    return RigError(f"{path}: cannot be written: {error.strerror}\n  what to do: make room on its disk; what is there of it is kept")


def write_whole(path: Path, content: str | bytes) -> None:
    """Under another name until it is whole."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def read_encoder(path: Path | str, rig: Rig) -> Encoder:
    """encoder.csv of a run; Refused where it is none of this rig, or damaged."""
    file, names = Path(path), [axis.name for axis in rig.axes]
    remedy = "give the folder that rig run wrote, with the rig's file of that run"
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise Refused(f"{file}: cannot be read: {error}\n  what to do: {remedy}") from error
    if not lines or not lines[0].startswith(COLUMNS):
        raise Refused(f"{file}: is no record of a rig, which begins with {COLUMNS}\n  what to do: {remedy}")
    width, columns = lines[0].count(",") + 1, []
    for number, line in enumerate(lines[1:], 2):
        parts = line.split(",")
        try:
            if len(parts) != width or parts[2] != names[(number - 2) % len(names)]:
                raise ValueError("its axes and columns do not fit")
            columns.append([float(part) for i, part in enumerate(parts) if i != 2])
        except ValueError as error:
            raise Refused(f"{file}, line {number}: {error}\n  what to do: {remedy}") from error
    if not columns or len(columns) % len(names):
        what = "ends in the middle of a sample" if columns else "holds no sample"
        raise Refused(f"{file}: {what}\n  what to do: {remedy}")
    table = np.array(columns).reshape(-1, len(names), width - 1)
    k, when = table[:, 0, 0], table[:, 0, 1]
    came = table[..., 8] - table[:1, :1, 8] + when[0] if width > len(COLUMNS.split(",")) else np.repeat(when[:, None], len(names), 1)
    if not np.isfinite(table).all() or (np.diff(k) <= 0).any() or (np.diff(came, axis=0) <= 0).any() or (np.diff(when) <= 0).any():
        raise Refused(f"{file}: its samples are not in order, or not finite\n  what to do: {remedy}")
    every = max(1, round(1 / (rig.rate * rig.bus.sync_period)))
    times = np.interp(np.arange(k[0], k[-1] + 1, every), k, when)
    if len(times) == len(when) and (came == when[:, None]).all():
        return Encoder(when, table[..., 3], table[..., 4], table[..., 5], table[..., 6])
    place = [CubicHermiteSpline(came[:, i], table[:, i, 3], table[:, i, 4])(times) for i in range(len(names))]
    others = [[np.interp(times, came[:, i], table[:, i, column]) for i in range(len(names))] for column in (4, 5, 6)]
    velocity, current, following = (np.stack(columns, 1) for columns in others)
    return Encoder(times, np.stack(place, 1), velocity, current, following)
