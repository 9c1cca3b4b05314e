"""What a run left in its folder, read back from the files alone."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchcmax.folder import LIVE, SUMMARY, WINDOWS
from torchcmax.io import DataError

AGAIN = "repair it, or run the command that wrote the folder again"
BATCH = "batch.json"
EXTRA = {"manifest.json": "the manifest of its batch", "evaluation.json": "what `evaluate` wrote"}
TEXTS = ("status", "reason", "weakest")  # columns of windows.csv that are no numbers
NEEDED = ("index", "start_us", "end_us", "events", "gain")
PICTURE = re.compile(r"window_(\d+)\.png")
MAPS = ("map.png", "panorama_cropped.png", "panorama.png")


@dataclass(frozen=True)
class Poses:
    """Of a trajectory: time [N] s, position [N, 3], rotation R_wc [N, 3, 3]."""

    time: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class Result:
    """A folder of `compensate`, `track` or `panorama`.

    numbers: columns of windows.csv, float64 [N] with nan where there is none | texts: its columns of words
    pictures: number of a window -> its picture
    """

    folder: Path
    summary: dict[str, Any]
    manifest: dict[str, Any]
    evaluation: dict[str, Any]
    numbers: dict[str, np.ndarray]
    texts: dict[str, list[str]]
    keyframes: int | None
    trajectory: Poses | None
    truth: Poses | None
    maps: list[Path]
    pictures: dict[int, Path]

    @property
    def task(self) -> str:
        """compensate, track or panorama."""
        if "panorama" in self.summary:
            return "panorama"
        return "track" if "plane" in self.summary else "compensate"

    @property
    def unit(self) -> str:
        """Of positions."""
        return "m" if isinstance(self.config.get("distance"), int | float) else "plane distances"

    @property
    def config(self) -> dict[str, Any]:
        """The run's settings; empty where they cannot be understood: they are shown as text all the same."""
        try:
            found = yaml.safe_load(str(self.summary.get("config", "")))
        except yaml.YAMLError:
            return {}
        return found if isinstance(found, dict) else {}


def read_result(folder: Path) -> Result:
    """All that a page shows.  Only files within the folder are opened."""
    summary = read_json(folder, SUMMARY)
    if not isinstance(summary.get("versions"), dict) or "torchcmax" not in summary["versions"]:
        raise DataError(folder / SUMMARY, "is not a summary of a run of ours", "give a folder that compensate, track or panorama wrote")
    numbers, texts = _windows(folder)
    extra = {name: read_json(folder, name) if inside(folder, name) else {} for name in EXTRA}
    followed = "panorama" in summary or "plane" in summary  # else it is of compensate, and a map in its folder is somebody else's

    def ours(name: str) -> Path | None:
        return inside(folder, name) if followed else None

    keyframes = ours("keyframes.csv")
    found = inside(folder, "images")
    images = sorted(found.iterdir()) if found is not None and found.is_dir() else []
    pictures = {int(match[1]): path for path in images if (match := PICTURE.fullmatch(path.name)) and inside(folder, f"images/{path.name}")}
    count = None if keyframes is None else max(0, len(_lines(keyframes)) - 1)
    maps = [path for name in MAPS if (path := ours(name)) is not None]
    poses = (_poses(folder, "trajectory.txt"), _poses(folder, "truth.txt")) if followed else (None, None)
    return Result(folder, summary, extra["manifest.json"], extra["evaluation.json"], numbers, texts, count, *poses, maps, pictures)


def finished(path: Path) -> list[Path]:
    """The results of a batch that came to their end; of any other path, the path."""
    if not inside(path, BATCH):
        return [path]
    places = [inside(path, str(row.get("folder", ""))) for row in batch_rows(path) if row.get("exit") == 0]
    return [place for place in places if place is not None and place.resolve() != path.resolve()]


def batch_rows(folder: Path) -> list[dict[str, Any]]:
    """The manifests of a batch's results."""
    rows = read_json(folder, BATCH).get("results")
    if not isinstance(rows, list) or not all(isinstance(row, dict) and isinstance(row.get("settings", {}), dict) for row in rows):
        raise DataError(folder / BATCH, "has no list of results", AGAIN)
    return rows


def inside(folder: Path, name: str) -> Path | None:
    """A file or folder of this name that is there; a link that leads out of the folder is none."""
    path = folder / name
    return path if path.exists() and path.resolve().is_relative_to(folder.resolve()) else None


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """A JSON object."""
    path = inside(folder, name)
    if path is None:
        raise DataError(folder, f"has no {name}", "give a folder that compensate, track, panorama or batch wrote")
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(path, f"cannot be read: {error}", AGAIN) from error
    if not isinstance(found, dict):
        raise DataError(path, "is no JSON object", AGAIN)
    return found


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except (OSError, ValueError) as error:
        raise DataError(path, f"cannot be read: {error}", AGAIN) from error


def _windows(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, list[str]]]:
    """The table of windows; while a run goes on, or where it was killed, as far as it came."""
    path = inside(folder, WINDOWS) or inside(folder, LIVE)
    if path is None:
        raise DataError(folder, f"has no {WINDOWS}", AGAIN)
    lines = _lines(path)
    try:
        head, *table = csv.reader(lines) if lines else [[]]
    except csv.Error as error:
        raise DataError(path, f"is no table: {error}", AGAIN) from error
    missing = [name for name in NEEDED if name not in head]
    if missing:
        raise DataError(path, f"has no column {missing[0]}", AGAIN, "line 1")
    if path.name == LIVE and table and len(table[-1]) < len(head):
        table.pop()  # it was being written
    for number, line in enumerate(table, 2):
        if len(line) != len(head):
            raise DataError(path, f"has {len(line)} columns, wanted are {len(head)}", AGAIN, f"line {number}")
    columns = dict(zip(head, zip(*table, strict=True) if table else [()] * len(head), strict=True))
    numbers = {name: _column(path, name, column) for name, column in columns.items() if name not in TEXTS}
    return numbers, {name: list(column) for name, column in columns.items() if name in TEXTS}


def _column(path: Path, name: str, column: tuple[str, ...]) -> np.ndarray:
    values = np.full(len(column), np.nan)
    for i, text in enumerate(column):
        try:
            values[i] = float(text or "nan")
        except ValueError:
            raise DataError(path, f"has {text[:40]!r} as {name}, which is no number", AGAIN, f"line {i + 2}") from None
    return values


def _poses(folder: Path, name: str) -> Poses | None:
    """A trajectory in TUM's format; None where there is none."""
    path = inside(folder, name)
    if path is None:
        return None
    lines = [line for line in _lines(path) if line.strip() and not line.startswith("#")]
    try:
        table = np.array([[float(part) for part in line.split()] for line in lines]).reshape(-1, 8)
    except ValueError as error:
        raise DataError(path, f"is no trajectory: {error}", AGAIN) from error
    if not (np.abs(table) < 1e100).all():  # nor nan; what is larger overflows when squared
        raise DataError(path, "has a pose that is no number", AGAIN)
    q = table[:, 4:] / np.maximum(np.linalg.norm(table[:, 4:], axis=1, keepdims=True), 1e-300)
    x, y, z, w = q.T
    rotation = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
         2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
         2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1,
    ).reshape(-1, 3, 3)  # fmt: skip
    return Poses(table[:, 0], table[:, 1:4], rotation)
