"""npz files: columns t, x, y, p, or a table of events, streamed out of the archive."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from torchcmax.io.contents import Contents
from torchcmax.io.errors import DataError
from torchcmax.io.events import LATEST, Events

ALIASES = {
    "t": ("t", "ts", "timestamp", "timestamps", "time"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "polarities"),
}
KINDS = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}
LIMITS = {"t": (1 - LATEST, LATEST - 1), "x": (0, 65535), "y": (0, 65535), "p": (-1, 1)}
LONGEST = 1e6  # s: times as decimal fractions beyond, from the first, are no seconds
WANTS = (
    "it wants the arrays t (integer us, or decimal fractions of seconds), x, y (px), p (0 or 1), of one length; or events with these fields"
)
FAILURES = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    SyntaxError,
    RuntimeError,
    NotImplementedError,
    TypeError,
    zipfile.BadZipFile,
    zlib.error,
    tokenize.TokenError,
)


@contextmanager
def _archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """An archive to read; what goes wrong with it is a DataError."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except FAILURES as error:
        raise DataError(path, f"cannot be read as npz: {error}", "copy or write it again; it may be cut off or damaged") from error


def knows(path: Path, head: bytes) -> bool:
    """Whether it is a zip archive with .npy members."""
    if not head.startswith(b"PK"):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except FAILURES:
        return path.suffix == ".npz"


def contents(path: Path) -> Contents:
    """What the archive holds; only the headers of its arrays are read."""
    with _archive(path) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        sensor = _sensor(archive, members)
        columns = _columns(path, archive, members)
        counts = {member: _header(stream)[0] for member in set(columns.values()) for stream in [archive.open(member)]}
    if any(len(shape) != 1 for shape in counts.values()) or len(set(counts.values())) > 1:
        raise DataError(path, f"has events of different lengths: {counts}", WANTS)
    count = next(iter(counts.values()))[0]
    if not count:
        raise DataError(path, "holds no events", "record or copy it again")
    return Contents(partial(_events, path, columns), lambda event: f"event {event + 1}", count, sensor=sensor)


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and kind of the array that begins here; ValueError where it holds objects, which only pickle would read."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, kind = read(stream)
    if kind.hasobject or (fortran and len(shape) > 1):
        raise ValueError(f"an array of {kind}{' by columns' if fortran else ''}")
    return shape, kind


def _columns(path: Path, archive: zipfile.ZipFile, members: dict[str, str]) -> dict[str, str]:
    """t, x, y, p -> the member it stands in, which may be one table for all."""
    found = {name: members[alias] for name, aliases in ALIASES.items() for alias in aliases[::-1] if alias in members}
    if len(found) == len(ALIASES):
        return found
    if "events" in members:
        with archive.open(members["events"]) as stream:
            _, kind = _header(stream)
        if set(ALIASES) <= set(kind.names or ()):
            return dict.fromkeys(ALIASES, members["events"])
    raise DataError(path, f"has no events; it holds {', '.join(members)}", WANTS)


def _sensor(archive: zipfile.ZipFile, members: dict[str, str]) -> tuple[int, int] | None:
    """width and height, or resolution (width, height)."""
    numbers: list[int] = []
    for name in ("resolution",) if "resolution" in members else ("width", "height"):
        if name in members:
            with archive.open(members[name]) as stream:
                shape, kind = _header(stream)
                numbers += np.frombuffer(stream.read(16), kind).tolist() if kind.itemsize <= 8 and np.prod(shape) <= 2 else []
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


def _events(path: Path, columns: dict[str, str], chunk: int) -> Iterator[Events]:
    """Events as they stand in the archive, `chunk` at a time."""
    with ExitStack() as stack:
        with _archive(path) as checked:
            streams = {member: checked.open(member) for member in set(columns.values())}
            headers = {member: _header(stream) for member, stream in streams.items()}
        start, count, origin = 0, next(iter(headers.values()))[0][0], 0.0
        for stream in streams.values():
            stack.callback(stream.close)
        while start < count:
            size = min(chunk, count - start)
            with _failing(path, start):
                parts = {member: _part(streams[member], headers[member][1], size) for member in streams}
            found = {name: parts[member][name] if parts[member].dtype.names else parts[member] for name, member in columns.items()}
            if start == 0:
                origin = float(found["t"][0])
            yield _converted(path, found, start, origin)
            start += size


@contextmanager
def _failing(path: Path, start: int) -> Iterator[None]:
    """What goes wrong while an array is read is a DataError that says where."""
    try:
        yield
    except FAILURES as error:
        raise DataError(path, f"is damaged: {error}", "copy or write it again", f"after event {start}") from error


def _part(stream: IO[bytes], kind: np.dtype, size: int) -> np.ndarray:
    """The next entries of an array."""
    data = stream.read(size * kind.itemsize)
    if len(data) < size * kind.itemsize:
        raise EOFError("it ends before its events do")
    return np.frombuffer(data, kind)


def _converted(path: Path, found: dict[str, np.ndarray], start: int, origin: float) -> Events:
    """Columns as Events; decimal times are seconds, polarity -1 is darker, as 0."""
    whole = {}
    for name, column in found.items():
        if column.dtype.kind not in "iufb":
            raise DataError(path, f"{name} is of the kind {column.dtype}", WANTS)
        if column.dtype.kind == "f":
            column = column.astype(np.float64)
            if name == "t" and (np.abs(column - origin) > LONGEST).any():
                raise DataError(path, "has times as decimal fractions over more than 11 days, which are no seconds", WANTS)
            column = np.rint(column * 1e6) if name == "t" else column
        least, most = LIMITS[name]
        wrong = np.zeros(len(column), bool) if column.dtype.kind == "b" else ~((column >= least) & (column <= most))
        if column.dtype.kind == "f":
            wrong |= column != np.rint(column)
        if wrong.any():
            i = int(wrong.argmax())
            raise DataError(path, f"{name} is {column[i]}, no whole number within {least}..{most}", WANTS, f"event {start + i + 1}")
        whole[name] = (column > 0 if name == "p" else column).astype(KINDS[name])
    return Events(**whole)
