"""What a run leaves in its folder: windows.csv, pictures before | after, summary.json, TensorBoard."""

from __future__ import annotations

import csv
import io
import json
import math
import platform
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchcmax import __version__
from torchcmax.board import Board
from torchcmax.compensate import Compensation
from torchcmax.core.camera import Canvas
from torchcmax.core.draw import Ink, draw
from torchcmax.core.estimate import Estimate
from torchcmax.core.objective import REFERENCES
from torchcmax.core.warp import still
from torchcmax.core.window import Window
from torchcmax.io import DataError, Recording

COLUMNS = (
    "index start_us end_us events contrast_zero contrast gain omega_x omega_y omega_z v_x v_y v_z n_x n_y n_z evaluations converged"
).split()
SUMMARY, PART, PICTURES = "summary.json", ".windows.csv.part", "window_*.png"
CURVES = 5  # windows whose optimizer is shown evaluation by evaluation, of those that are pictured
BRIGHT = 0.995  # quantile of the pixels hit that is drawn in full colour


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A temporary name to write to, renamed to `path` at the end; removed when something goes wrong."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise DataError(path, f"cannot be written: {error.strerror}", "free some space, or give another --out") from error
    finally:
        temporary.unlink(missing_ok=True)


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


def pictures(window: Window, warps: tuple[Tensor, ...], canvas: Canvas, reference: float) -> np.ndarray:
    """Each window warped in several ways side by side: brighter (ON) events red, darker (OFF) blue, one scale for all sides.

    warps: H_k [B, K, 3, 3] each -> [B, H, W * len(warps), 3] uint8
    """
    owner = torch.arange(len(window), device=window.ray.device)
    on, off = (Ink.of(window, (sign * window.polarity).clamp_min(0), reference) for sign in (1, -1))
    red, blue = (torch.cat([draw(H_k, ink, canvas, owner) for H_k in warps], -1).cpu() for ink in (on, off))
    return np.stack([coloured(a, b) for a, b in zip(red, blue, strict=True)])


def coloured(on: Tensor, off: Tensor) -> np.ndarray:
    """Two images [H, W] on white paper: -> [H, W, 3] uint8."""
    red, blue = on.numpy().ravel(), off.numpy().ravel()
    hit = np.flatnonzero(red + blue > 0)  # most of the paper stays white
    red, blue = red[hit], blue[hit]
    votes = (red + blue)[red + blue > 0.5]
    full = np.float32(max(np.quantile(votes, BRIGHT), 1)) if len(votes) else np.float32(1)
    red, blue = (np.sqrt(np.clip(part / full, 0, 1)) for part in (red, blue))  # sqrt: single events stay visible
    picture = np.full((on.numel(), 3), 255, np.uint8)
    for channel, paper in enumerate((1 - blue, np.maximum(1 - red - blue, 0), 1 - red)):
        picture[hit, channel] = 255 * paper
    return picture.reshape(*on.shape, 3)


def captioned(picture: np.ndarray, text: str) -> np.ndarray:
    """The picture [H, W, 3] with a line of text above it and a line down the middle."""
    page = Image.new("RGB", (picture.shape[1], picture.shape[0] + 22), "white")
    page.paste(Image.fromarray(picture), (0, 22))
    pen = ImageDraw.Draw(page)
    pen.text((4, 3), text, fill="black", font=ImageFont.load_default(14))
    pen.line([(picture.shape[1] // 2, 22), (picture.shape[1] // 2, page.height)], fill="gray")
    return np.asarray(page)


def png(picture: np.ndarray) -> bytes:
    """A picture [H, W, 3] uint8 as PNG; packed lightly, which takes a quarter of the time and a tenth more room."""
    packed = io.BytesIO()
    Image.fromarray(picture).save(packed, format="PNG", compress_level=1)
    return packed.getvalue()


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
        self._csv = (self.folder / PART).open("w", newline="")
        self._lines = csv.writer(self._csv)
        self._lines.writerow(COLUMNS)
        board = Board(self.folder)
        board.config(self.config)
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
            raise _unwritable(self.folder, error) from error
        self.table += lines

    def _write(self, lines: list[dict[str, float]]) -> None:
        assert self.board is not None
        whole = {"index", "start_us", "end_us", "events", "evaluations", "converged"}
        for line in lines:
            values = (f"{v:.0f}" if k in whole else "" if v != v else f"{v:.9g}" for k, v in line.items())
            self._lines.writerow(values)
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
        try:
            self.board.close()
            self._csv.close()
            (self.folder / PART).replace(self.folder / "windows.csv")
            with writing(self.folder / SUMMARY) as name:
                name.write_text(json.dumps(self.summary(None if kind is None else f"{kind.__name__}: {error}"), indent=1) + "\n")
        except OSError as full:
            if error is None:  # else the first error is the one to tell
                raise _unwritable(self.folder, full) from full

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
            "versions": {"torchcmax": __version__, "torch": torch.__version__, "python": platform.python_version()},
        }


def check_place(folder: Path, recording: Recording) -> None:
    """The folder can be written to, is not the recording's own, and holds nothing of anybody else's that would be replaced."""
    place, own = folder.resolve(), recording.path.resolve()
    if place in (own, own.parent, own / "images", own.parent / "images"):
        raise DataError(folder, "is where the recording is; pictures and tables would mix with it", "give another --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from error
    foreign = [name for name in (SUMMARY, "windows.csv") if (folder / name).exists()]
    if not ours(folder) and (foreign or any((folder / "images").glob(PICTURES))):
        raise DataError(folder, f"holds {foreign[0] if foreign else PICTURES}, which no run of ours wrote", "give another --out")


def ours(folder: Path) -> bool:
    """Whether the folder's summary is one of ours, so that a new run may take its place."""
    try:
        return "torchcmax" in json.loads((folder / SUMMARY).read_text())["versions"]
    except (OSError, ValueError, KeyError, TypeError):
        return False


def clear(folder: Path) -> None:
    """Remove what an earlier run of ours left in the folder, and nothing else, so that old and new do not mix."""
    if ours(folder):
        for old in (*folder.glob("events.out.tfevents.*"), *(folder / "images").glob(PICTURES), folder / "windows.csv", folder / SUMMARY):
            old.unlink(missing_ok=True)


def _unwritable(folder: Path, error: OSError) -> DataError:
    return DataError(folder, f"cannot be written to: {error.strerror}", "free some space, or give another --out; what was done is kept")
