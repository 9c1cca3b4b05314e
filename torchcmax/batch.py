"""Many recordings: which they are, what is to be done with each, what is done already, and the tables of all results."""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
import os
import re
import shutil
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import h5py

from torchcmax.config import UsageError
from torchcmax.folder import PAGE, SUMMARY, versions, writing
from torchcmax.io import DataError
from torchcmax.io.opening import HEAD, OTHERS, TEXTS
from torchcmax.io.text import like_text
from torchcmax.job import FAILED, MANIFEST, RUNNING, Job, Manifest, fingerprint, numbers, read_manifest, stamps

LOCK, TABLE, ALL = ".lock", "batch.csv", "batch.json"
INSIDE = ("events.h5", "events.txt")  # a folder with one of these is a recording
HEADS = {  # how the files begin that are recordings by themselves
    ".h5": b"\x89HDF", ".hdf5": b"\x89HDF", ".zip": b"PK", ".npz": b"PK", ".npy": b"\x93NUMPY", ".raw": b"% ", ".dat": b"% ",
    ".aedat4": b"#!AER-DAT4", ".es": b"Event Stream", ".bag": b"#ROSBAG V2",
}  # fmt: skip
AGAIN = "give another --out, or --again to replace it"


def found(paths: Sequence[str], out: Path) -> tuple[list[Path], list[Path]]:
    """The recordings that the paths name, absolute and each once, and the files in searched folders that are none.

    A folder that is no recording is searched at any depth, but for results and for what is hidden.  Files named one by one are taken
    as they are: whether one can be read shows when it is opened.
    """
    recordings: dict[Path, None] = {}
    skipped: list[Path] = []
    for name in paths:
        path = Path(name).resolve()
        if not name or not path.exists():
            raise UsageError(f"there is no recording {name!r}")
        before = len(recordings)
        if path.is_dir() and not _holds_events(path):
            for one, is_recording in _searched(path, out):
                if is_recording:
                    recordings[one] = None
                else:
                    skipped.append(one)
            if len(recordings) == before:
                raise UsageError(f"there is no recording in the folder {name!r}")
        else:
            recordings[path] = None
    return list(recordings), skipped


def _holds_events(folder: Path) -> bool:
    return any((folder / name).is_file() for name in INSIDE)


def _searched(folder: Path, out: Path) -> Iterator[tuple[Path, bool]]:
    """The recordings below a folder, and the files that are none, in the order of their names."""
    for here, folders, files in os.walk(folder):
        place = Path(here)
        if place == out or MANIFEST in files or SUMMARY in files:
            folders.clear()
        elif _holds_events(place):
            folders.clear()
            yield place, True
        else:
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            for name in sorted(files):
                if not name.startswith("."):
                    yield place / name, is_recording(place / name)


def is_recording(file: Path) -> bool:
    """Whether a file looks like a recording, by its ending and its beginning; quick, so that it can be wrong about a broken one."""
    head = HEADS.get(file.suffix.lower())
    try:
        with file.open("rb") as stream:
            first = stream.read(HEAD)
        if file.suffix.lower() in TEXTS:
            return file.name not in OTHERS and like_text(first)
        if head is None or not first.startswith(head):
            return False
        return not head.endswith(b"HDF") or _names_events(file)
    except OSError:
        return head is not None  # it will say so when it is opened


def _names_events(file: Path) -> bool:
    """Whether something near the top of an HDF5 file is called events: maps, depths and calibrations have the same ending."""
    with h5py.File(file, "r") as store:
        first = [(name, store.get(name, getlink=False)) for name in store]
        second = [name for _, group in first if isinstance(group, h5py.Group) for name in _names(group, 2)]
    return any("event" in name.lower() or name == "CD" for name in [*(name for name, _ in first), *second])


def _names(group: h5py.Group, depth: int) -> Iterator[str]:
    for name in group:
        yield name
        if depth > 1 and isinstance(group.get(name), h5py.Group):
            yield from _names(group[name], depth - 1)


def named(recordings: Sequence[Path]) -> dict[Path, str]:
    """A name for each recording: of its file or folder, with the folders above it where two would be alike."""
    full = {path: (path.parent if path.name in INSIDE else path).parts[1:] or ("root",) for path in recordings}
    depth = dict.fromkeys(recordings, 1)
    while True:
        names = {path: _plain("_".join(full[path][-depth[path] :])) for path in recordings}
        count = Counter(names.values())
        alike = [path for path in recordings if count[names[path]] > 1]
        if not alike:
            return names
        if all(depth[path] >= len(full[path]) for path in alike):  # events.txt and events.h5 of one folder
            return names | {path: f"{names[path]}_{path.name}" for path in alike}
        for path in alike:
            depth[path] += 1


def _plain(name: str) -> str:
    """A name that nothing of ours has in the folder of the results."""
    taken = name.startswith(".") or name.endswith(FAILED) or name in (TABLE, ALL, PAGE)
    return f"_{name}_" if taken else name


def swept(texts: Sequence[str]) -> list[dict[str, str]]:
    """All combinations of what texts like key=a,b,c allow.  A comma within brackets belongs to the value."""
    choices: dict[str, list[str]] = {}
    for text in texts:
        key, sign, values = text.partition("=")
        parts = re.findall(r"(?:\[[^\]]*\]|[^,\[])+", values)
        if not (key and sign and parts):
            raise UsageError(f"--sweep wants key=a,b,c, got {text!r}")
        if key in choices:
            raise UsageError(f"--sweep names {key} twice")
        choices[key] = list(dict.fromkeys(parts))
    return [dict(zip(choices, values, strict=True)) for values in itertools.product(*choices.values())]


def folder_of(settings: dict[str, str]) -> str:
    """The folder of all results of one setting of a sweep, as key=value,..., with a mark where a value is no name for a folder."""
    text = ",".join(f"{key}={value}" for key, value in settings.items())
    plain = re.sub(r"[^\w.,+=\[\]-]", "_", text)
    return plain if plain == text and len(text) < 200 else f"{plain[:150]}.{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def config_hash(task: str, config: dict[str, Any]) -> str:
    """SHA-256 over a task, its settings as they are understood, and the contents of the files that they name."""
    total = hashlib.sha256(json.dumps([task, config], sort_keys=True).encode())
    for name in ("camera", "map"):
        file = Path(config.get(name) or "")
        if file.is_file():
            total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


def missing(jobs: Sequence[Job]) -> list[Job]:
    """The jobs that are still to be done.  A result of something else in a job's place is refused, before any work."""
    return [job for job in jobs if not _is_done(job) or job.again]


def _is_done(job: Job) -> bool:
    for folder in (job.place, job.failure):
        if folder.exists() and read_manifest(folder) is None:
            raise DataError(folder, "is there, and no batch of ours wrote it", "give another --out, or remove it")
    there = read_manifest(job.place)
    if there is None or job.again:
        return False
    if there["task"] != job.task or there["config_hash"] != job.config_hash:
        raise DataError(job.place, f"is there with other settings: {_difference(there, job)}", AGAIN)
    try:
        same = there["files"] == stamps(job.recording) or there["input"] == fingerprint(job.recording)[0]
    except OSError as error:
        raise DataError(job.recording, f"cannot be read: {error.strerror}", "check the recording") from error
    if not same:
        raise DataError(job.place, f"is there, of a recording that was another then: {there['recording']}", AGAIN)
    return True


def _difference(there: Manifest, job: Job) -> str:
    """The first setting in which an earlier result differs."""
    if there["task"] != job.task:
        return f"it is of {there['task']}, wanted is {job.task}"
    then, now = dict(_leaves(there.get("config", {}))), dict(_leaves(job.config))
    for name in sorted({*then, *now}):
        if then.get(name) != now.get(name):
            return f"{name} was {then.get(name)}, wanted is {now.get(name)}"
    return "a file that they name has changed"


def _leaves(values: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{before}{name}.")
        else:
            yield before + name, value


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """The folder of the results for one run of the batch alone, without what a killed run left half-done."""
    with _own(out):
        try:
            yield
        finally:
            _sweep_out(out)


def _own(out: Path) -> TextIO:
    """The lock of the folder, which is held until it is closed, however the process ends."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = (out / LOCK).open("w")
        _lock(lock.fileno(), out)
        _sweep_out(out)
        (out / RUNNING).mkdir()
    except OSError as error:
        raise DataError(out, f"cannot be written to: {error.strerror}", "free some space, or give another --out") from error
    return lock


def _lock(file: int, out: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not on Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DataError(out, "another batch is writing there", "wait for it, or give another --out") from None


def _sweep_out(out: Path) -> None:
    """Remove what is half-done.  It is renamed first: a worker that is just dying can no longer put its folder into place."""
    if (out / RUNNING).exists():
        (out / RUNNING).rename(out / f"{RUNNING}.{uuid.uuid4().hex[:8]}")
    for old in out.glob(f"{RUNNING}.*"):
        shutil.rmtree(old, ignore_errors=True)


def results(out: Path, jobs: Iterable[Job]) -> list[Manifest]:
    """The manifests of all results in the folder: of these jobs in their order, then of others from earlier; failures among them."""
    wanted = [place for job in jobs for place in (job.failure, job.place)]
    others = sorted(path.parent for pattern in ("*", "*/*") for path in out.glob(f"{pattern}/{MANIFEST}"))
    kept = {path: None for path in (*wanted, *others) if RUNNING not in str(path.relative_to(out).parts[0])}
    rows = [(place, read_manifest(place)) for place in kept]
    return [manifest | {"folder": place.relative_to(out).as_posix()} for place, manifest in rows if manifest is not None]


def write_tables(out: Path, rows: Sequence[Manifest]) -> None:
    """batch.json, all manifests and their totals; batch.csv, a line for each with the numbers of its summary."""
    keep = [{name: value for name, value in row.items() if name != "files"} for row in rows]
    totals = {
        "results": len(rows),
        "finished": sum(row["exit"] == 0 for row in rows),
        "failed": sum(row["exit"] != 0 for row in rows),
        "seconds": round(sum(row["seconds"] for row in rows), 3),
    }
    with writing(out / ALL) as name:
        name.write_text(json.dumps({"totals": totals, "versions": versions(), "results": keep}, indent=1) + "\n")
    lines = [_line(out, row) for row in rows]
    columns = list(dict.fromkeys(column for line in lines for column in line))
    with writing(out / TABLE) as name, name.open("w", newline="") as stream:
        table = csv.DictWriter(stream, columns, restval="")
        table.writeheader()
        table.writerows(lines)


def _line(out: Path, row: Manifest) -> dict[str, Any]:
    first = {"name": row["name"], "task": row["task"], **row["settings"], "status": "finished" if row["exit"] == 0 else "failed"}
    last = {"job_seconds": row["seconds"], "attempts": row["attempts"], "folder": row["folder"], "error": row["error"] or ""}
    return first | last | {name: value for name, value in numbers(out / row["folder"]).items() if name not in first | last}
