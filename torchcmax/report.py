"""What a run leaves in its folder: windows.csv, pictures before | after, summary.json, TensorBoard."""

from __future__ import annotations

import csv
import json
import math
import time
from functools import partial
from pathlib import Path
from types import TracebackType

import numpy as np
import torch

from torchcmax.board import Board
from torchcmax.compensate import Compensation
from torchcmax.core.camera import Canvas
from torchcmax.core.estimate import Estimate
from torchcmax.core.objective import REFERENCES
from torchcmax.core.warp import still
from torchcmax.core.window import Window
from torchcmax.folder import COLUMNS, LIVE, RUNNING, SUMMARY, WHOLE, WINDOWS, cell, check_place, clear, unwritable, versions, writing
from torchcmax.io import DataError, Recording
from torchcmax.page import write_page
from torchcmax.picture import captioned, pictures, png

CURVES = 5  # windows whose optimizer is shown evaluation by evaluation, of those that are pictured


def rows(window: Window, estimate: Estimate, first: int) -> list[dict[str, float]]:
    """One line of windows.csv for each window, in COLUMNS; nan where the model has no such number.

    Times are whole µs, which float64 holds exactly for 285 years.
    """
    normal = torch.full_like(estimate.motion.omega, torch.nan) if estimate.normal is None else estimate.normal
    end = window.start + (window.duration.double() * 1e6).round().long()
    index = torch.arange(first, first + len(window), device=end.device)
    columns = [
        *(index, window.start, end, (window.polarity != 0).sum(-1)),
        *(estimate.contrast_zero, estimate.contrast, estimate.gain),
        *(vector[:, axis] for vector in (estimate.motion.omega, estimate.motion.velocity, normal) for axis in range(3)),
        *(estimate.evaluations, estimate.converged),
    ]
    table = torch.stack([column.double() for column in columns], 1)  # each by itself: together they would become float32
    return [dict(zip(COLUMNS, line, strict=True)) for line in table.tolist()]


class Report:
    """The folder of one run.  What is done stays, and is said to be incomplete, when the run ends before its time.

    Nothing is written, and nothing of an earlier run is replaced, before the first window is done.
    """

    def __init__(self, folder: Path, recording: Recording, options: Compensation, config: str, every: int) -> None:
        """every: a picture of each every-th window; 0: none."""
        check_place(folder, recording)
        self.folder, self.recording, self.options, self.every, self.config = folder, recording, options, every, config
        self.canvas = Canvas.around(recording.camera, options.search.margin)
        self.table: list[dict[str, float]] = []
        self.pictured = 0
        self.began = time.perf_counter()
        self.board: Board | None = None

    def _begin(self) -> Board:
        clear(self.folder)
        (self.folder / "images").mkdir(exist_ok=True)
        self._csv = (self.folder / LIVE).open("w", newline="")
        self._lines = csv.writer(self._csv)
        self._lines.writerow(COLUMNS)
        board = Board(self.folder)
        board.config(self.config)
        self._summarize(RUNNING)
        return board

    def add(self, window: Window, estimate: Estimate) -> None:
        """A batch of windows, in the order of the recording."""
        lines = rows(window, estimate, len(self.table))
        try:
            if self.board is None:
                self.board = self._begin()
            self._write(lines)
            self._draw(window, estimate, lines)
            self._csv.flush()
            self.board.flush()
        except OSError as error:
            raise unwritable(self.folder, error) from error
        self.table += lines

    def _write(self, lines: list[dict[str, float]]) -> None:
        assert self.board is not None
        for line in lines:
            self._lines.writerow(cell(v, k in WHOLE) for k, v in line.items())
            seconds = (line["end_us"] - line["start_us"]) * 1e-6
            shown = {f"window/{k}": v for k, v in line.items() if k not in ("index", "start_us", "end_us", "events") and v == v}
            shown["window/events_per_second"] = line["events"] / seconds if seconds > 0 else float("nan")
            self.board.scalars(shown, int(line["index"]))

    def _draw(self, window: Window, estimate: Estimate, lines: list[dict[str, float]]) -> None:
        chosen = [i for i, line in enumerate(lines) if self.every and line["index"] % self.every == 0]
        if not chosen or self.board is None:
            return
        index = torch.tensor(chosen, device=window.ray.device)
        warps = still(estimate.H_k[index]), estimate.H_k[index]
        drawn = pictures(window[index], warps, self.canvas, REFERENCES[self.options.look.reference])
        for i, picture in zip(chosen, drawn, strict=True):
            line, number = lines[i], int(lines[i]["index"])
            seconds = (line["end_us"] - line["start_us"]) * 1e-6
            text = f"window {number}: {line['events']:.0f} events in {1e3 * seconds:.1f} ms, gain {line['gain']:.3f}; at rest | compensated"
            page = captioned(picture, text)
            packed = png(page)
            with writing(self.folder / "images" / f"window_{number:05d}.png") as name:
                name.write_bytes(packed)
            if self.pictured.bit_count() < 2:  # TensorBoard shows ten; each costs it 40 ms, so it gets the 1st, 2nd, 3rd, 5th, 9th, ...
                self.board.image("before_after", packed, page.shape[:2], number)
            if self.pictured < CURVES:
                for turn, (blur, trace) in enumerate(zip(self.options.search.blur, estimate.traces, strict=True), 1):
                    self.board.curve(f"optimizer/window_{number:05d}/round_{turn}_blur_{blur:g}_px", trace[i])
            self.pictured += 1

    def __enter__(self) -> Report:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.board is None:
            return
        stopped, failed = None if kind is None else f"{kind.__name__}: {error}", None
        for last in (
            self.board.close,
            self._close_table,
            partial(self._summarize, stopped),
            lambda: write_page(self.folder),
        ):
            try:  # to keep all that there is, whatever of it cannot be written
                last()
            except (OSError, DataError) as full:
                failed = failed or full
        if failed is not None and error is None:  # else the first error is the one to tell
            raise failed if isinstance(failed, DataError) else unwritable(self.folder, failed) from failed

    def _close_table(self) -> None:
        """The table gets its name when all of it is written; else it stays as one that a run is still writing."""
        self._csv.close()
        (self.folder / LIVE).replace(self.folder / WINDOWS)

    def _summarize(self, stopped: str | None) -> None:
        with writing(self.folder / SUMMARY) as name:
            name.write_text(json.dumps(self.summary(stopped), indent=1) + "\n")

    def summary(self, stopped: str | None = None) -> dict[str, object]:
        """The run in numbers."""
        wall = time.perf_counter() - self.began
        events = sum(line["events"] for line in self.table)

        def median(name: str) -> float | None:
            numbers = [line[name] for line in self.table if math.isfinite(line[name])]  # JSON has no nan
            return float(np.median(numbers)) if numbers else None

        return {
            "complete": stopped is None,
            "stopped_by": stopped,
            "recording": self.recording.name,
            "path": str(self.recording.path.resolve()),
            "model": self.options.model,
            "windows": len(self.table),
            "events": int(events),
            "seconds": (self.table[-1]["end_us"] - self.table[0]["start_us"]) * 1e-6 if self.table else 0.0,
            "contrast_median": median("contrast"),
            "gain_median": median("gain"),
            "evaluations_median": median("evaluations"),
            "converged_share": float(np.mean([line["converged"] for line in self.table])) if self.table else None,
            "pictures": self.pictured,
            "wall_seconds": round(wall, 3),
            "mega_events_per_second": round(events / wall * 1e-6, 4),
            "config": self.config,
            "files": [WINDOWS, SUMMARY],
            "versions": versions(),
        }
