"""numpy's files, npz and npy: columns t, x, y, p, or a table of events, streamed from the disk."""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from torchcmax.io.contents import Contents
from torchcmax.io.errors import DataError
from torchcmax.io.events import Events
from torchcmax.io.tables import ALIASES, LONGEST, SAMPLE, WANTS, WIDEST, as_events, column_of, fields_of, in_seconds, order_of

SIZES = ("resolution", "width", "height")
MAGIC = b"\x93NUMPY"
Arrays = Mapping[str, Callable[[], IO[bytes]]]  # name -> what opens it
FAILURES = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    SyntaxError,
    RuntimeError,
    NotImplementedError,
    TypeError,
    OverflowError,
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
    tokenize.TokenError,
)


@dataclass(frozen=True)
class Part:
    """A stretch of an array that is read in order: where it begins, and how many entries a row of it has."""

    array: str
    skip: int = 0
    width: int = 1


Columns = dict[str, tuple[Part, str | int | None]]  # t, x, y, p -> where it stands, and its field or column, None where it is all of it


@contextmanager
def _arrays(path: Path) -> Iterator[Arrays]:
    """The arrays of an archive by their names, or the one of a .npy file, without a name; what goes wrong with them is a DataError."""
    try:
        with path.open("rb") as stream:
            single = stream.read(len(MAGIC)) == MAGIC
        if single:
            yield {"": lambda: path.open("rb")}
            return
        with zipfile.ZipFile(path) as archive:
            yield {name.removesuffix(".npy"): partial(archive.open, name) for name in archive.namelist() if name.endswith(".npy")}
    except FAILURES as error:
        raise DataError(path, f"cannot be read as npz or npy: {error}", "copy or write it again; it may be cut off or damaged") from error


def knows(path: Path, head: bytes) -> bool:
    """Whether it is a zip archive with .npy members, or a .npy file with a table that could be events."""
    try:
        if head.startswith(MAGIC):
            shape, _, kind = _header(io.BytesIO(head))
            return fields_of(kind) is not None or (len(shape) == 2 and 4 in shape)
        if not head.startswith(b"PK"):
            return False
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except FAILURES:
        return path.suffix in (".npz", ".npy")


def contents(path: Path) -> Contents:
    """What the file holds; only the headers of its arrays are read, and the first events."""
    with _arrays(path) as arrays:
        sensor = _sensor(arrays)
        columns, count = _columns(path, arrays)
        first = _rows(_opened(arrays, columns), min(count, SAMPLE))
    seconds = in_seconds(path, _named(columns, first)["t"])
    events = partial(_events, path, columns, count, seconds)
    return Contents(events, lambda event: f"event {event + 1}", count, sensor=sensor)


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether it is stored by columns, and kind of the array that begins here.

    ValueError where it holds objects, which only pickle would read.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, kind = read(stream)
    if kind.hasobject or not 0 < kind.itemsize <= WIDEST:
        raise ValueError(f"an array of {kind}")
    return shape, fortran, kind


def _columns(path: Path, arrays: Arrays) -> tuple[Columns, int]:
    """Where t, x, y, p stand: in arrays of their own, or in one table, named events or the only one; and how many there are."""
    found = {name: alias for name, aliases in ALIASES.items() for alias in aliases[::-1] if alias in arrays}
    others = [name for name in arrays if name not in SIZES]
    table = "events" if "events" in arrays else others[0] if len(others) == 1 else None
    headers = {}
    for name in {*found.values()} if len(found) == len(ALIASES) else {table} - {None}:
        with arrays[str(name)]() as stream:
            headers[str(name)] = _header(stream)
    shapes = {name: shape for name, (shape, _, _) in headers.items()}
    if len(found) == len(ALIASES):
        if any(len(shape) != 1 for shape in shapes.values()) or len(set(shapes.values())) > 1:
            raise DataError(path, f"has events of different lengths: {shapes}", WANTS)
        columns: Columns = {name: (Part(alias), None) for name, alias in found.items()}
        return columns, _count(path, next(iter(shapes.values()))[0])
    if table is None:
        raise DataError(path, f"has no events; it holds {', '.join(arrays) or 'nothing'}", WANTS)
    shape, fortran, kind = headers[table]
    if len(shape) == 1 and (fields := fields_of(kind)) is not None:
        return {name: (Part(table), field) for name, field in fields.items()}, _count(path, shape[0])
    if len(shape) != 2 or 4 not in shape or kind.names is not None:
        raise DataError(path, f"has no events; {table or 'it'} is an array {shape} of {kind}", WANTS)
    if shape[1] != 4:  # the other way round: its rows are the columns
        shape, fortran = shape[::-1], not fortran
    count = _count(path, shape[0])
    places: list[tuple[Part, int | None]] = [(Part(table, i * count), None) if fortran else (Part(table, 0, 4), i) for i in range(4)]
    first = _named(dict(enumerate(places)), _rows(_opened(arrays, dict(enumerate(places))), min(count, SAMPLE)))
    order = order_of(path, np.stack(list(first.values()), 1), table or "the array")
    return dict(zip(order, places, strict=True)), count


def _count(path: Path, count: int) -> int:
    if count < 1:
        raise DataError(path, "holds no events", "record or copy it again")
    return count


def _sensor(arrays: Arrays) -> tuple[int, int] | None:
    """width and height, or resolution (width, height)."""
    numbers: list[int] = []
    for name in SIZES[:1] if SIZES[0] in arrays else SIZES[1:]:
        if name in arrays:
            with arrays[name]() as stream:
                shape, _, kind = _header(stream)
                numbers += np.frombuffer(stream.read(16), kind).tolist() if kind.itemsize <= 8 and np.prod(shape) <= 2 else []
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


def _opened(arrays: Arrays, columns: Mapping[Any, tuple[Part, str | int | None]]) -> dict[Part, tuple[IO[bytes], np.dtype]]:
    """A stream for every stretch, at its beginning, and the kind of its entries."""
    opened = {}
    for part in {part for part, _ in columns.values()}:
        stream = arrays[part.array]()
        kind = _header(stream)[2]
        stream.seek(part.skip * kind.itemsize, io.SEEK_CUR)
        opened[part] = stream, kind
    return opened


def _rows(opened: Mapping[Part, tuple[IO[bytes], np.dtype]], size: int) -> dict[Part, np.ndarray]:
    """The next rows of every stretch."""
    found = {}
    for part, (stream, kind) in opened.items():
        data = stream.read(size * part.width * kind.itemsize)
        if len(data) < size * part.width * kind.itemsize:
            raise EOFError("it ends before its events do")
        rows = np.frombuffer(data, kind)
        found[part] = rows.reshape(size, part.width) if part.width > 1 else rows
    return found


def _named(columns: Mapping[Any, tuple[Part, str | int | None]], rows: Mapping[Part, np.ndarray]) -> dict[Any, np.ndarray]:
    """The columns by their names."""
    return {name: column_of(rows[part], field) for name, (part, field) in columns.items()}


def _events(path: Path, columns: Columns, count: int, seconds: bool, chunk: int) -> Iterator[Events]:
    """Events as they stand in the file, `chunk` at a time."""
    with ExitStack() as stack:
        with _arrays(path) as arrays:
            opened = _opened(arrays, columns)
        for stream, _ in opened.values():
            stack.callback(stream.close)
        origin = 0.0
        for start in range(0, count, chunk):
            with _failing(path, start):
                found = _named(columns, _rows(opened, min(chunk, count - start)))
            if seconds:
                origin = origin if start else float(found["t"][0])
                if (np.abs(found["t"] - origin) > LONGEST).any():
                    raise DataError(path, "has times as decimal fractions over more than 11 days, which are no seconds", WANTS)
            yield as_events(path, found, start, seconds)


@contextmanager
def _failing(path: Path, start: int) -> Iterator[None]:
    """What goes wrong while an array is read is a DataError that says where."""
    try:
        yield
    except FAILURES as error:
        raise DataError(path, f"is damaged: {error}", "copy or write it again", f"after event {start}") from error
