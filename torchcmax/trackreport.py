"""What `track` leaves in its folder: trajectory, tables of windows and keyframes, the map, pictures, summary.json, TensorBoard."""

from __future__ import annotations

import csv
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcmax.board import Board
from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.core.warp import TERMS, polynomial, still
from torchcmax.folder import COLUMNS, LIVE, RUNNING, SUMMARY, TRACKED, WINDOWS, check_place, clear, unwritable, versions, writing
from torchcmax.io import DataError
from torchcmax.io.trajectory import write_trajectory
from torchcmax.judge import Judge, on_cpu
from torchcmax.mapfile import save_map
from torchcmax.mapimage import LARGEST, picture
from torchcmax.page import write_page
from torchcmax.picture import captioned, pictures, png
from torchcmax.slam.map import Map
from torchcmax.slam.system import Track
from torchcmax.track import Tracks, in_metres
from torchcmax.tracktable import KEYFRAMES, POSE, SIGNS, TABLE, Row, cells, keyframe_rows, row, set_placements, set_poses, write_table

SHOWN = [*COLUMNS[4:], *(name for name in SIGNS if name != "weakest")]  # of the table, on the board
STATUS = {"ok": 0.0, "weak": 1.0, "lost": 2.0, "start": 3.0, "still": 4.0}
SHOW = 1.0  # s between moments at which what is done can be seen
SMALL = 1024  # px of the map on the board


def compensation(track: Track) -> Tensor:
    """How the events of a window come to the camera at its middle: H_k [1, K, 3, 3]."""
    there, span = track.state.seen(track.map.plane), track.window.duration[:, None].to(track.state.pose.t)
    shift = track.state.motion.velocity * span / there.distance[:, None]
    return polynomial(track.state.motion.omega * span, shift, there.normal, TERMS)


class TrackReport:
    """The folder of one run before a plane.  What is done stays, and is said to be incomplete, when the run ends before its time.

    Nothing is written, and nothing of an earlier run is replaced, before the first window is done.
    """

    names: tuple[str, ...] = TRACKED

    def __init__(self, folder: Path, tracks: Tracks, config: str, every: int) -> None:
        """config: YAML | every: a picture of each every-th window; 0: none."""
        own = tracks.options.map
        if own is not None and Path(own).resolve().parent == folder.resolve():
            raise DataError(folder, "is where the map to track against is; it would be replaced", "give another --out")
        check_place(folder, tracks.recording, self.names)
        self.folder, self.tracks, self.config, self.every = folder, tracks, config, every
        self.canvas, self.judge = Canvas.around(tracks.recording.camera), Judge(tracks)
        self.table: list[Row] = []
        self.files: list[str] = []
        self.error: dict[str, Any] | None = None
        self.truth: Trajectory | None = None
        self.curves: dict[int, dict[str, float]] = {}
        self.failed: DataError | OSError | None = None
        self.events = self.pictured = 0
        self.fresh: list[tuple[Row, Pose, int]] = []  # not yet shown, and the keyframes at that time
        self.spent = self.shown = 0.0
        self.began, self.ended = time.perf_counter(), 0.0
        self.board: Board | None = None

    @property
    def seconds(self) -> float:
        """Of the recording, from the first window's begin to the last one's end."""
        return (self.table[-1]["end_us"] - self.table[0]["start_us"]) * 1e-6 if self.table else 0.0

    @property
    def factor(self) -> float:
        """Seconds of the recording per second of work so far; at the end, of all work with its files."""
        return self.seconds / max((self.ended or time.perf_counter()) - self.began, 1e-9)

    def _begin(self) -> Board:
        clear(self.folder)
        (self.folder / "images").mkdir(exist_ok=True)
        self._csv = (self.folder / LIVE).open("w", newline="")
        self._lines = csv.writer(self._csv)
        self._lines.writerow(TABLE)
        board = Board(self.folder)
        board.config(self.config)
        self._summarize(RUNNING)
        return board

    def add(self, track: Track) -> None:
        """The next window."""
        begin = time.perf_counter()
        line = row(track)
        try:
            if self.board is None:
                self.board = self._begin()
            self.fresh.append((line, track.state.pose, len(track.map.keyframes)))
            self.table.append(line)
            self.events += line["events"]
            if self.every and track.index % self.every == 0:
                self._draw(self.board, track, line)
            if begin - self.shown > SHOW:
                self._show(self.board)
        except OSError as error:
            raise unwritable(self.folder, error) from error
        self.spent += time.perf_counter() - begin

    def _show(self, board: Board) -> None:
        """Windows not yet shown, all at once, which takes a tenth of the time: into the table and onto the board, to be seen now."""
        self.shown = time.perf_counter()
        if not self.fresh:
            return
        lines, poses, keyframes = zip(*self.fresh, strict=True)
        self.fresh = []
        pose = Pose(torch.cat([p.R for p in poses]).cpu().double(), torch.cat([p.t for p in poses]).cpu().double())
        set_poses(lines, pose)
        turns = torch.rad2deg(so3.log(pose.R)).tolist()
        for line, turn, error, count in zip(lines, turns, self._live(lines, pose), keyframes, strict=True):
            self._lines.writerow(cells(line if line["status"] != "lost" else line | dict.fromkeys(POSE, math.nan)))
            board.scalars(_scalars(line, turn) | {"map/keyframes": float(count)} | error, line["index"])
        self._csv.flush()
        board.flush()

    def _live(self, lines: Sequence[Row], pose: Pose) -> list[dict[str, float]]:
        """Errors of poses [M] as far as they are known now: of the windows on the main map."""
        m = self.tracks.map
        here = [i for i, line in enumerate(lines) if line["status"] != "lost" and line["map"] == m.number]
        found = [dict[str, float]() for _ in lines]
        plane = Plane(*(part.cpu().double() for part in (m.plane.normal, m.plane.distance)))
        live = self.judge.live(torch.tensor([lines[i]["time_us"] for i in here], dtype=torch.int64), pose[here], plane)
        for i, error in zip(here, live, strict=True):
            found[i] = error
        return found

    def _draw(self, board: Board, track: Track, line: Row) -> None:
        """The window before | after, and the map as it is, for TensorBoard at the 1st, 2nd, 3rd, 5th, 9th ... picture."""
        H_k = compensation(track)
        drawn = pictures(track.window, (still(H_k), H_k.to(track.window.ray)), self.canvas, 0.5)[0]
        milliseconds = (line["end_us"] - line["start_us"]) * 1e-3
        text = f"window {track.index}: {line['events']} events in {milliseconds:.1f} ms, {track.status}; at rest | compensated"
        page = captioned(drawn, text)
        packed = png(page)
        with writing(self.folder / "images" / f"window_{track.index:05d}.png") as name:
            name.write_bytes(packed)
        if self.pictured.bit_count() < 2:
            board.image("before_after", packed, page.shape[:2], track.index)
            self._show_map(board, track.index)
        self.pictured += 1

    def _show_map(self, board: Board, step: int) -> None:
        page = self._page(SMALL)
        board.image("map", png(page), page.shape[:2], step)

    def _here(self, names: Sequence[str]) -> Tensor:
        """Some numbers of the windows on the main map, so far: [M, len(names)]."""
        number = self.tracks.map.number
        here = [[line[name] for name in names] for line in self.table if line["map"] == number and line["status"] != "lost"]
        return torch.tensor(here, dtype=torch.float64).view(-1, len(names))

    def _title(self) -> str:
        stem = self.names[-1].removesuffix(".h5")
        return f"{stem} of {self.tracks.recording.name}, {len(self.tracks.map.keyframes)} keyframes"

    def __enter__(self) -> TrackReport:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.board is None:
            return
        self._finish(self.board, None if kind is None else f"{kind.__name__}: {error}")
        if self.failed is not None and error is None:  # else the first error is the one to tell
            raise self.failed if isinstance(self.failed, DataError) else unwritable(self.folder, self.failed) from self.failed

    def _finish(self, board: Board, stopped: str | None) -> None:
        """Writes all that there is, whatever of it cannot be written."""
        self._attempt(lambda: self._show(board))
        trajectory = self._settle()
        self._attempt(lambda: self._show_end(board))
        for name, write in self._outputs(trajectory).items():
            self._attempt(write, name)
        for last in (self._csv.close, self._keep_live, board.close, lambda: self._summarize(stopped), lambda: write_page(self.folder)):
            self._attempt(last)

    def _attempt(self, write: Callable[[], object], name: str = "") -> None:
        """The first thing that cannot be written is kept in mind."""
        try:
            write()
            self.files += [name] if name else []
        except (OSError, DataError) as error:
            self.failed = self.failed or error

    def _settle(self) -> Trajectory | None:
        """The final poses, also into the table, and their errors; None where fewer than two windows have one."""
        set_placements(self.table, self.tracks.placements)  # where a run was broken off, a window may not have come here
        try:
            trajectory = self.tracks.trajectory()
        except ValueError:
            return None
        keep = trajectory.time <= self.table[-1]["time_us"]
        if int(keep.sum()) < 2:
            return None
        trajectory = Trajectory(trajectory.time[keep].cpu(), on_cpu(trajectory.pose[keep]))
        found = self.judge.final(trajectory, self.tracks.map.plane.normal)
        if found is not None:
            self.error, self.curves, self.truth = found.error, found.curves, found.truth
        return trajectory

    def _show_end(self, board: Board) -> None:
        for line in self.table:
            if line["time_us"] in self.curves:
                board.scalars(self.curves[line["time_us"]], line["index"])
        self._show_map(board, self.table[-1]["index"])

    def _outputs(self, trajectory: Trajectory | None) -> dict[str, Callable[[], None]]:
        """How each file is written."""
        m, unit = self.tracks.map, self.tracks.unit
        outputs: dict[str, Callable[[], None]] = {
            WINDOWS: lambda: self._write(WINDOWS, lambda name: write_table(name, TABLE, self.table)),
            "keyframes.csv": lambda: self._write("keyframes.csv", lambda name: write_table(name, KEYFRAMES, keyframe_rows(m))),
        }
        for name, page in self._pages().items():
            outputs[name] = partial(self._write, name, partial(_save_page, page))
        if trajectory is not None:
            outputs["trajectory.txt"] = self._poses("trajectory.txt", in_metres(trajectory, unit))
        if self.truth is not None:
            outputs["truth.txt"] = self._poses("truth.txt", in_metres(self.truth, unit))
        if self.tracks.options.map is None:
            stem = self.names[-1].removesuffix(".h5")
            outputs[f"{stem}.h5"] = partial(save_map, self.folder / f"{stem}.h5", m)
            for other in self.tracks.atlas[1:]:
                name = f"{stem}_{other.number}.h5"
                outputs[name] = partial(save_map, self.folder / name, other)
        return outputs

    def _poses(self, name: str, trajectory: Trajectory) -> Callable[[], None]:
        return lambda: self._write(name, lambda temporary: write_trajectory(temporary, trajectory))

    def _write(self, name: str, write: Callable[[Path], object]) -> None:
        with writing(self.folder / name) as temporary:
            write(temporary)

    def _pages(self) -> dict[str, Callable[[], np.ndarray]]:
        """The pictures of the map."""
        return {"map.png": self._page}

    def _page(self, most: int = LARGEST) -> np.ndarray:
        """The map, no side longer than `most` px."""
        assert isinstance(self.tracks.map, Map)
        return picture(self.tracks.map, self._here(POSE[:3]), self._title(), self.tracks.options.distance, most)

    def _world(self) -> dict[str, Any]:
        """What the summary says of the map."""
        plane = self.tracks.map.plane if self.table else None
        return {"plane": None if plane is None else {"normal": plane.normal[0].tolist(), "distance": plane.distance[0].item()}}

    def _keep_live(self) -> None:
        """The table as it was written on the way stays only where the final one could not be written."""
        if WINDOWS in self.files:
            (self.folder / LIVE).unlink(missing_ok=True)
        else:
            (self.folder / LIVE).replace(self.folder / WINDOWS)
            self.files.append(WINDOWS)

    def _summarize(self, stopped: str | None) -> None:
        self.ended = 0.0 if stopped == RUNNING else time.perf_counter()
        with writing(self.folder / SUMMARY) as name:
            name.write_text(json.dumps(self.summary(stopped), indent=1) + "\n")

    def summary(self, stopped: str | None = None) -> dict[str, Any]:
        """The run in numbers."""
        wall, read = (self.ended or time.perf_counter()) - self.began, self.tracks.stream.waited
        lost = sum(line["end_us"] - line["start_us"] for line in self.table if line["status"] == "lost") * 1e-6
        m = self.tracks.map if self.table else None
        return {
            "complete": stopped is None,
            "stopped_by": stopped,
            "recording": self.tracks.recording.name,
            "path": str(self.tracks.recording.path.resolve()),
            "model": self.tracks.options.slam.model,
            "windows": len(self.table),
            "status": dict(Counter(line["status"] for line in self.table)),
            "events": self.events,
            "seconds": round(self.seconds, 6),
            "lost_seconds": round(lost, 6),
            "losses": self.tracks.losses,
            "recoveries": self.tracks.recoveries,
            "maps": len(self.tracks.atlas),
            "maps_joined": self.tracks.joins,
            "keyframes": 0 if m is None else len(m.keyframes),
            **self._world(),
            "error": self.error,
            "wall_seconds": round(wall, 3),
            "read_seconds": round(read, 3),
            "report_seconds": round(self.spent, 3),
            "compute_seconds": round(wall - read - self.spent, 3),
            "real_time_factor": round(self.factor, 4),
            "pictures": self.pictured,
            "files": [WINDOWS, *self.names] if stopped == RUNNING else self.files,
            "config": self.config,
            "versions": versions(),
        }


def _save_page(page: Callable[[], np.ndarray], name: Path) -> None:
    """A picture as PNG."""
    name.write_bytes(png(page()))


def _scalars(line: Row, turn: list[float]) -> dict[str, float]:
    """What the board shows of a window; turn [3] deg."""
    seconds = (line["end_us"] - line["start_us"]) * 1e-6
    shown = {f"window/{name}": float(line[name]) for name in SHOWN if line[name] == line[name]}
    shown["window/status"] = STATUS[line["status"]]
    if seconds > 0:
        shown["window/events_per_second"] = line["events"] / seconds
    if line["status"] == "lost":  # nobody knows where
        return shown
    shown |= {f"pose/{name}": line[name] for name in POSE[:3]}
    return shown | {f"pose/r{axis}_deg": value for axis, value in zip("xyz", turn, strict=True)}
