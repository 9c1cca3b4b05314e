"""One job of a batch: a recording under one setting, worked on in a folder of its own, which is put in its place when it is whole."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import sys
import time
import traceback
import uuid
import warnings
from collections.abc import Iterator
from contextlib import chdir, contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any, TextIO

from torchcmax import __version__
from torchcmax.board import Board
from torchcmax.folder import SUMMARY, versions
from torchcmax.io import DataError
from torchcmax.io.opening import LENSES, TRUTHS

TASKS = ("compensate", "track", "panorama")
LINE = "torchcmax.cli"  # its main() does the work; it stands above this file, so it is imported when it is called
RUNNING, FAILED, MANIFEST, LOG = ".running", ".failed", "manifest.json", "log.txt"
UNEXPECTED = 70  # exit of a job that ended in a traceback
BESIDE = (*LENSES, "groundtruth.txt", "plane.txt", "images.txt", *(f"*{end}" for end in TRUTHS))  # what belongs to one that is a file
DATA = frozenset(".txt .csv .tsv .yaml .yml .json .h5 .hdf5 .hdf .npz .npy .zip .gz .raw .dat .aedat4 .es .bag".split())
TOO_DEEP = ("config", "versions", "files")  # of summary.json: no numbers of the result

Manifest = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """What is to be done, and where the result goes."""

    number: int
    task: str
    recording: Path  # absolute
    name: str  # of the recording among the results
    out: Path  # of the batch, absolute
    folder: str  # of the result, below `out`
    settings: dict[str, str]  # those of the sweep
    options: tuple[str, ...]  # of the command line, all but recording and --out
    config: dict[str, Any]  # all settings as they are understood
    config_hash: str
    batch: str  # the run of the batch that wants it
    again: bool = False  # take the place of an earlier result
    home: str = ""  # where relative names of files start

    @property
    def place(self) -> Path:
        """The folder of the finished result."""
        return self.out / self.folder

    @property
    def failure(self) -> Path:
        """The folder of the last try that failed."""
        return self.place.with_name(self.place.name + FAILED)

    def attempt(self) -> Path:
        """A new folder to work in, which no other attempt has."""
        return self.out / RUNNING / f"{self.number:05d}.{self.place.name}.{time.time_ns():x}.{uuid.uuid4().hex[:6]}"

    def attempts(self) -> list[Path]:
        """The folders of attempts that go on or died, the first one first."""
        return sorted((self.out / RUNNING).glob(f"{self.number:05d}.*"))

    def finished(self) -> Manifest | None:
        """The manifest of the result, if this run of the batch has it already."""
        there = read_manifest(self.place)
        return there if there is not None and (not self.again or there.get("batch") == self.batch) else None


def work(job: Job) -> Manifest:
    """Do the job in this process, once, and put its folder in its place.  What goes wrong stands in the manifest, not in an exception."""
    done = job.finished()  # by an attempt that died, or was thought dead, right behind its end
    if done is not None:
        return done
    manifest = begun(job, len(job.attempts()) + 1)
    attempt, clock = job.attempt(), time.perf_counter()
    try:
        attempt.mkdir()
        manifest["input"], manifest["files"] = fingerprint(job.recording)
        manifest["exit"] = _call(job, attempt)
        _move_names(attempt / LOG, attempt, job.failure if manifest["exit"] else job.place)
        manifest["error"] = said(attempt / LOG, job.task) if manifest["exit"] else None
    except OSError as error:  # of the recording, the folder or the log: unreadable, the disk is full, not seen from this host
        manifest |= {"exit": 1, "error": f"{error.filename or attempt}: {error.strerror or error}"}
    manifest["seconds"] = round(time.perf_counter() - clock, 3)
    return put(job, attempt, manifest)


def begun(job: Job, attempts: int) -> Manifest:
    """The manifest of a job at its beginning."""
    return {
        "name": job.name,
        "recording": str(job.recording),
        "task": job.task,
        "folder": job.folder,
        "settings": job.settings,
        "exit": None,
        "error": None,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "seconds": 0.0,
        "attempts": attempts,
        "host": platform.node(),
        "batch": job.batch,
        "input": None,
        "files": {},
        "config_hash": job.config_hash,
        "config": job.config,
        "version": __version__,
        "versions": versions(),
    }


def fingerprint(recording: Path) -> tuple[str, dict[str, list[int]]]:
    """SHA-256 over names and contents of a recording's files, and each file's size in bytes and time of change in ns."""
    total, files = hashlib.sha256(), stamps(recording)
    folder = recording if recording.is_dir() else recording.parent
    for name in files:
        with (folder / name).open("rb") as stream:
            total.update(f"{name}\0{hashlib.file_digest(stream, 'sha256').hexdigest()}\n".encode())
    return total.hexdigest(), files


def stamps(recording: Path) -> dict[str, list[int]]:
    """Size and time of change of each file of a recording: the data files of a folder, or one file and what belongs to it."""
    if recording.is_dir():
        paths = [path for path in recording.iterdir() if path.suffix.lower() in DATA and not path.name.startswith(".") and path.is_file()]
    else:
        beside = {path for name in BESIDE for path in recording.parent.glob(name)}
        paths = [recording, *(path for path in beside if path != recording and path.is_file())]
    return {path.name: [path.stat().st_size, path.stat().st_mtime_ns] for path in sorted(paths)}


def _call(job: Job, attempt: Path) -> int:
    """Run the command line's own function; -> its exit status.  All that it says goes to the log."""
    arguments = [job.task, str(job.recording), "--out", str(attempt), "--quiet", "--threads", "1", *job.options]
    home = chdir(job.home) if Path(job.home).is_dir() else nullcontext()
    with (attempt / LOG).open("w", buffering=1) as log, _into(log), warnings.catch_warnings(), home:
        try:
            return int(import_module(LINE).main(arguments))
        except SystemExit as stop:  # wrong usage
            return stop.code if isinstance(stop.code, int) else 1
        except Exception:  # a fault of ours, or no memory left: this job's, not the batch's
            traceback.print_exc()
            return UNEXPECTED


@contextmanager
def _into(log: TextIO) -> Iterator[None]:
    """What this process writes to its standard output and error goes to a file, that of C libraries too."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(number) for number in (1, 2)]
    try:
        for number in (1, 2):
            os.dup2(log.fileno(), number)
        with redirect_stdout(log), redirect_stderr(log):
            yield
    finally:
        for number, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, number)
            os.close(copy)


def _move_names(log: Path, attempt: Path, place: Path) -> None:
    """The log names the files where they will be found; where that cannot be written, it stays as it is."""
    moved = log.with_name(f".{log.name}.part")
    try:
        moved.write_text(log.read_text(errors="replace").replace(str(attempt), str(place)))
        moved.replace(log)
    except OSError:  # a full disk takes neither the log nor the job's own error
        with suppress(OSError):
            moved.unlink(missing_ok=True)


def said(log: Path, task: str) -> str:
    """The first line of what a job complained of in the end."""
    try:
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    except OSError:
        lines = []
    start = f"torchcmax {task}: "
    told = [line.removeprefix(start) for line in lines if line.startswith(start)]
    return told[-1] if told else lines[-1].strip() if lines else "ended without a word"


def put(job: Job, attempt: Path, manifest: Manifest) -> Manifest:
    """Write the manifest and rename the folder to its place; -> the manifest of what stands there.

    A folder appears whole or not at all.  Where another attempt at the same job was first, this one gives way.
    """
    try:
        if manifest["exit"] == 0 and job.settings:
            show_settings(attempt, job.settings)
        attempt.mkdir(exist_ok=True)
        (attempt / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
        _flush(attempt)
        first = job.finished()
        if first is None:
            target = job.failure if manifest["exit"] else job.place
            target.parent.mkdir(exist_ok=True)
            if read_manifest(target) is not None:  # an earlier failure; or an earlier result, where that is wanted
                discard(job.out, target)
            attempt.rename(target)
    except OSError as error:
        first = job.finished()  # in the last moment
        manifest |= {"exit": manifest["exit"] or 1, "error": manifest["error"] or f"{error.filename}: {error.strerror}"}
    if manifest["exit"] == 0 or first is not None:
        discard(job.out, job.failure)
    if first is not None:
        discard(job.out, attempt)
    return first or manifest


def _flush(folder: Path) -> None:
    """What is in the folder is on the disk: a rename must not be there before it when the power fails."""
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as stream:
                os.fsync(stream.fileno())


def discard(out: Path, folder: Path) -> None:
    """Remove a folder, which is gone from its place at once."""
    gone = out / RUNNING / f"gone.{uuid.uuid4().hex[:8]}"
    if folder.exists():
        folder.rename(gone)
        shutil.rmtree(gone, ignore_errors=True)


def died(job: Job, error: str, exit: int, attempts: int = 1) -> Manifest:
    """What is left to write for a job whose process died at every attempt."""
    left = job.attempts()
    attempt = left[-1] if left else job.attempt()
    return put(job, attempt, begun(job, max(attempts, len(left))) | {"exit": exit, "error": error})


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest in a folder; None where there is none of ours."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise DataError(folder / MANIFEST, f"cannot be read: {error}", "remove the folder, so that it is made again") from error
    ours = isinstance(manifest, dict) and {"name", "recording", "task", "exit", "input", "files", "config_hash"} <= set(manifest)
    return manifest if ours else None


def numbers(folder: Path) -> dict[str, float]:
    """The numbers of a result's summary.json, those within others as `error.position_rmse`."""
    try:
        summary = json.loads((folder / SUMMARY).read_text())
    except (OSError, ValueError):
        return {}
    return dict(_flat({name: value for name, value in summary.items() if name not in TOO_DEEP}))


def _flat(values: dict[str, Any], before: str = "") -> Iterator[tuple[str, float]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield before + name, value


def show_settings(folder: Path, settings: dict[str, str]) -> None:
    """Tell TensorBoard's table of hyperparameters what was swept and what came out, in the run's own folder."""
    found = {f"result/{name.replace('.', '/')}": value for name, value in numbers(folder).items()}
    board = Board(folder)
    try:
        board.hparams(settings, found)
    finally:
        board.close()
