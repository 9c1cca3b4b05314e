"""What the drives told, SYNC by SYNC: encoder.csv, and log.jsonl of what was done."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchcmax.rig.axis import from_quadcounts
from torchcmax.rig.config import Rig
from torchcmax.rig.drive import Drive
from torchcmax.rig.errors import Refused
from torchcmax.rig.objects import from_rpm

ENCODER, LOG, RUN = "encoder.csv", "log.jsonl", "run.json"
COLUMNS = "k,t_drive_s,axis,pos_qc,x,v,current_a,following_qc,statusword"
RECEIVED = "rx_host_s"  # column of real drives only: simulated ones give the same file every time


@dataclass(frozen=True)
class Encoder:
    """time [K] s on the drives' clock | place, velocity [K, axes] m, rad and /s | current A, following

    following: demanded minus actual position, quadcounts | positions are those at the SYNC, one for each, and between its neighbours'
    where one was not answered.  Times of simulated drives are SYNC's number times its period; those of real ones are when positions came,
    as a host does not send SYNCs evenly.
    """

    time: np.ndarray
    place: np.ndarray
    velocity: np.ndarray
    current: np.ndarray
    following: np.ndarray


class Recorder:
    """Keeps what drives told, at the rate of the rig's record."""

    def __init__(self, rig: Rig, simulated: bool) -> None:
        self.rig, self.simulated = rig, simulated
        self.every = max(1, round(1 / (rig.rate * rig.bus.sync_period)))
        self.rows: list[str] = []
        self.first = 0.0  # s of the interface's clock, at which the record begins
        self.events: list[dict[str, Any]] = []

    def take(self, k: int, drives: list[Drive]) -> None:
        """What was told with SYNC k; nothing where a drive did not answer it."""
        if k % self.every:
            return
        if not all(drive.complete for drive in drives):
            self.note(k, "not answered")
            return
        self.first = self.first or drives[0].stamp
        time = k * self.rig.bus.sync_period if self.simulated else drives[0].stamp - self.first
        for drive in drives:
            told, axis = drive.told, drive.axis
            x, v = float(from_quadcounts(axis, told.position)), from_rpm(axis, told.velocity)
            row = f"{k},{time:.6f},{axis.name},{told.position},{x:.9g},{v:.9g},{told.current / 1e3:g},{told.following},{told.statusword}"
            self.rows.append(row if self.simulated else f"{row},{drive.stamp:.6f}")

    def note(self, k: int, what: str, **more: Any) -> None:
        """An event for the log."""
        self.events.append({"k": k, "what": what, **more})

    def write(self, out: Path, said: dict[str, Any]) -> None:
        """encoder.csv, log.jsonl and run.json, each appearing when it is whole."""
        head = COLUMNS if self.simulated else f"{COLUMNS},{RECEIVED}"
        write_whole(out / ENCODER, "\n".join([head, *self.rows]) + "\n")
        write_whole(out / LOG, "".join(json.dumps(event) + "\n" for event in self.events))
        write_whole(out / RUN, json.dumps(said, indent=2) + "\n")


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
            columns.append([float(part) for i, part in enumerate(parts[:9]) if i != 2])
        except ValueError as error:
            raise Refused(f"{file}, line {number}: {error}\n  what to do: {remedy}") from error
    if not columns or len(columns) % len(names):
        raise Refused(f"{file}: ends in the middle of a sample\n  what to do: {remedy}")
    table = np.array(columns).reshape(-1, len(names), 8)
    k, time = table[:, 0, 0], table[:, 0, 1]
    if not np.isfinite(table).all() or (np.diff(k) <= 0).any() or (np.diff(time) <= 0).any():
        raise Refused(f"{file}: its samples are not in order, or not finite\n  what to do: {remedy}")
    table = _filled(table, np.arange(k[0], k[-1] + 1, max(1, round(1 / (rig.rate * rig.bus.sync_period)))))
    return Encoder(table[:, 0, 1], table[..., 3], table[..., 4], table[..., 5], table[..., 6])


def _filled(table: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Samples [K, axes, 8] for every k."""
    if len(k) == len(table):
        return table
    flat = table.reshape(len(table), -1)
    return np.stack([np.interp(k, table[:, 0, 0], column) for column in flat.T], 1).reshape(len(k), *table.shape[1:])
