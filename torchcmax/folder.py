"""The folder of a run: what may be written there, what an earlier run of ours is replaced by, and names that appear only when whole."""

from __future__ import annotations

import json
import platform
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from torchcmax import __version__
from torchcmax.io import DataError, Recording

SUMMARY, WINDOWS, PICTURES = "summary.json", "windows.csv", "window_*.png"
PAGE = "report.html"
EVALUATION = ("evaluation.json", "evaluation.csv")  # of `evaluate`, about the run that is there
RUNNING = "it is still running, or was killed"  # what a summary says until the end
LIVE = ".windows.live.csv"  # the table while a run goes on
TRACKED = ("trajectory.txt", "truth.txt", "keyframes.csv", "map.png", "map.h5")  # of `track` only
TURNED = ("trajectory.txt", "truth.txt", "keyframes.csv", "panorama.png", "panorama_cropped.png", "panorama.h5")  # of `panorama` only
MORE = re.compile(r"(map|panorama)_\d+\.h5")  # maps that were not joined with the main one
COLUMNS = (
    "index start_us end_us events contrast_zero contrast gain omega_x omega_y omega_z v_x v_y v_z n_x n_y n_z evaluations converged"
).split()  # of windows.csv, those of `track` behind them
WHOLE = frozenset(["index", "start_us", "end_us", "events", "evaluations", "converged"])


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
        with suppress(OSError):  # of a file system that cannot be written to
            temporary.unlink(missing_ok=True)


def cell(value: float, whole: bool) -> str:
    """A number of a table: nothing where there is none."""
    return "" if value != value else f"{value:.0f}" if whole else f"{value:.9g}"


def versions() -> dict[str, str]:
    """What a run was made with; the mark of a summary of ours."""
    return {"torchcmax": __version__, "torch": torch.__version__, "python": platform.python_version()}


def check_place(folder: Path, recording: Recording, names: tuple[str, ...] = ()) -> None:
    """The folder can be written to, is not the recording's own, and holds nothing of anybody else's that would be replaced.

    names: files that the run writes beside windows.csv, summary.json and pictures.
    """
    place, own = folder.resolve(), recording.path.resolve()
    if place in (own, own.parent, own / "images", own.parent / "images"):
        raise DataError(folder, "is where the recording is; pictures and tables would mix with it", "give another --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise unwritable(folder, error) from error
    left = written(folder)
    foreign = [name for name in (SUMMARY, WINDOWS, PAGE, *names) if name not in left and (folder / name).exists()]
    if foreign or (not left and any((folder / "images").glob(PICTURES))):
        raise DataError(folder, f"holds {foreign[0] if foreign else PICTURES}, which no run of ours wrote", "give another --out")


def written(folder: Path) -> set[str]:
    """The files that an earlier run of ours left, so that a new run may take their place; nothing where its summary is not one of ours."""
    try:
        names = _ours(folder / SUMMARY).get("files", [WINDOWS])
        ours = {name for name in names if name in (WINDOWS, *TRACKED, *TURNED) or MORE.fullmatch(name)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        ours |= set(EVALUATION) if _ours(folder / EVALUATION[0]) else set()
    return {SUMMARY, PAGE} | ours


def _ours(path: Path) -> dict[str, Any]:
    """A JSON object that says which version of torchcmax wrote it; KeyError where it does not."""
    found: dict[str, Any] = json.loads(path.read_text())
    return found if found["versions"]["torchcmax"] else {}


def clear(folder: Path) -> None:
    """Remove what an earlier run of ours left in the folder, and nothing else, so that old and new do not mix."""
    left = written(folder)
    if left:
        pictures, curves = (folder / "images").glob(PICTURES), folder.glob("events.out.tfevents.*")
        for old in (*curves, *pictures, folder / LIVE, *(folder / name for name in sorted(left))):
            old.unlink(missing_ok=True)


def unwritable(folder: Path, error: OSError) -> DataError:
    """The error to raise where a folder cannot be written to."""
    return DataError(folder, f"cannot be written to: {error.strerror}", "free some space, or give another --out; what was done is kept")
