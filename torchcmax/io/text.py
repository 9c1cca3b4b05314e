"""Events from text: lines `t x y p`, that is seconds, column, row, 1 (brighter) or 0 or -1 (darker)."""

from __future__ import annotations

import codecs
import re
import shlex
import zipfile
from collections.abc import Iterator
from itertools import islice
from typing import IO

import numpy as np

from torchcmax.io.errors import DataError
from torchcmax.io.events import LATEST, Events
from torchcmax.io.member import Member, reading, refuse_foreign, size_in_bytes

BLOCK = 1 << 20  # bytes taken apart at a time: fits the processor's cache
LONGEST = 1 << 16  # bytes of a line; more is no text of events
FORM = "t x y p, separated by blanks: seconds, column, row, 0 or 1, like 0.003811 96 133 0"
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
BETWEEN = (b".   \n", b".   \r\n")  # what stands between the digits of a line: 1.234567 12 34 1
MOST = (12, 5, 5, 1)  # digits of whole seconds, column, row, polarity
SPELLINGS = ((b"\r\n", b"\n"), (b"\t", b" "), (b" -1\n", b" 0\n"))


def check_text(file: Member) -> None:
    """Finds a file of another form and a last line that is cut off, before anything is computed.  A .zip is unpacked once for that."""
    size = size_in_bytes(file)
    if not size:
        raise DataError(str(file), "is empty", "record or copy it again")
    with reading(file), file.open("rb") as stream:
        refuse_foreign(file, stream.read(LONGEST))
    _check_first(file)
    _check_last(file, size)


def _check_first(file: Member) -> None:
    """A first line that is no event: the whole file is of another form, so dropping the line would not help."""
    for number, first in islice(_data_lines(file), 1):
        row = first.decode("ascii", "backslashreplace").strip()
        try:
            _row(row)
        except ValueError as error:
            problem = f"its first line is no event, {error}: {_quoted(row)}"
            raise DataError(str(file), problem, f"events want lines of {FORM}; put a # before a header", f"line {number}") from error


def _check_last(file: Member, size: int) -> None:
    with reading(file), file.open("rb") as stream:
        stream.seek(max(size - LONGEST, 0))
        last = stream.read().rsplit(b"\n", 1)[-1].removeprefix(codecs.BOM_UTF8)
    if last.strip() and not last.lstrip().startswith(b"#") and len(last.split()) < 4:
        with reading(file), file.open("rb") as stream:
            number = sum(block.count(b"\n") for block in _blocks(stream, BLOCK, file))
        cut = _quoted(last.decode("ascii", "backslashreplace"))
        remedy = f"the file was not copied or written to its end; copy it again, or drop the line: {_dropping(file, '$')}"
        raise DataError(str(file), f"the last line is cut off: {cut}", remedy, f"line {number}")


def _dropping(file: Member, line: str) -> str:
    """How to drop a line of a file: its number, or $ for the last."""
    if isinstance(file, zipfile.Path):
        return f"unpack {file.root.filename}, drop the line there, and open the folder"
    return f"sed -i '{line}d' {shlex.quote(str(file))}"


def read_text(file: Member, chunk: int, block: int = BLOCK) -> Iterator[Events]:
    """Events as they stand in the file, `chunk` at a time; fewer only at the end.  `block`: bytes taken apart at a time."""
    parts: list[Events] = []
    count, line = 0, 1
    with reading(file), file.open("rb") as stream:
        for text in _blocks(stream, block, file):
            events, lines = _parse(text, line, file)
            parts.append(events)
            count, line = count + len(events), line + lines
            if count >= chunk:
                whole = Events.join(parts)
                for start in range(0, count - chunk + 1, chunk):
                    yield whole[start : start + chunk]
                parts, count = [whole[count - count % chunk :]], count % chunk
    if count:
        yield Events.join(parts)


def line_of(file: Member, event: int) -> str:
    """Where an event, counted from 0, stands in the file; reads it again up to there."""
    return next((f"line {number}" for number, _ in islice(_data_lines(file), event, None)), "at its end")


def _data_lines(file: Member) -> Iterator[tuple[int, bytes]]:
    """Lines that are neither empty nor comments, with their numbers, from 1."""
    with reading(file), file.open("rb") as stream:
        rows = (row for text in _blocks(stream, BLOCK, file) for row in text.split(b"\n")[:-1])
        for number, row in enumerate(rows, 1):
            if row.strip() and not row.lstrip().startswith(b"#"):
                yield number, row


def _blocks(stream: IO[bytes], size: int, file: Member) -> Iterator[bytes]:
    """Whole lines, about `size` bytes of them, without a byte order mark before the first."""
    if stream.read(len(codecs.BOM_UTF8)) != codecs.BOM_UTF8:
        stream.seek(0)
    passed, rest = 0, b""
    while piece := stream.read(size):
        cut = piece.rfind(b"\n") + 1
        if len(rest) + (piece.find(b"\n") if cut else len(piece)) > LONGEST:
            raise DataError(str(file), f"a line of more than {LONGEST} bytes: no text of events", f"lines are {FORM}", f"byte {passed + 1}")
        if cut:
            yield rest + piece[:cut]
            passed, rest = passed + len(rest) + cut, piece[cut:]
        else:
            rest += piece
    if rest:
        yield rest + b"\n"


def _parse(text: bytes, line: int, file: Member) -> tuple[Events, int]:
    """A block of lines as events, and the number of lines: the quick way where every line is plain, else line by line."""
    events = _plain(text)
    if events is not None:
        return events, len(events)
    for spelling, plain in SPELLINGS:
        text = text.replace(spelling, plain)
    events = _plain(text)
    return _by_line(text, line, file) if events is None else events, text.count(b"\n")


def _plain(text: bytes) -> Events | None:
    """Lines of digits like `1.234567 12 34 1`, all at once, twice as fast as np.loadtxt; None where one line is of another form."""
    digit = np.frombuffer(text, np.uint8) - np.uint8(48)
    found = _between(digit, BETWEEN[b"\r\n" in text[:LONGEST]])
    if found is None:
        return None
    dot, *end, last = found
    first = np.concatenate([[0], last[:-1] + 1])
    starts = [first, *(before + 1 for before in end[:3])]
    widths = [stop - start for start, stop in zip(starts, [dot, *end[1:]], strict=True)]
    if any(width.min() < 1 for width in [*widths, end[0] - dot - 1]) or any(w.max() > most for w, most in zip(widths, MOST, strict=True)):
        return None
    x, y, p = (_whole(digit, width, stop, np.int32) for width, stop in zip(widths[1:], end[1:], strict=True))
    if max(x.max(), y.max()) > 65535 or p.max() > 1:
        return None
    t = _whole(digit, widths[0], dot, np.int64) * 1_000_000 + _millionths(digit, dot, end[0])
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def _between(digit: np.ndarray, marks: bytes) -> list[np.ndarray] | None:
    """Where the dots, the blanks after seconds, column and row, the ends of the polarities and the line feeds are: six rows.

    None where anything but these marks stands between the digits of a line.
    """
    other = np.flatnonzero(digit > 9)
    if len(other) % len(marks):
        return None
    place = list(other.reshape(-1, len(marks)).T.copy())
    if any((digit.take(row) != (mark - 48) % 256).any() for row, mark in zip(place, marks, strict=True)):
        return None
    if len(marks) > 5 and (place[5] != place[4] + 1).any():
        return None
    return [*place[:5], place[-1]]


def _whole(digit: np.ndarray, width: np.ndarray, end: np.ndarray, dtype: type[np.signedinteger]) -> np.ndarray:
    """Numbers of `width` digits that end before `end`, from the last digit to the first."""
    value: np.ndarray = digit[end - 1].astype(dtype)
    least = width.min()
    for k in range(1, int(width.max())):
        place = digit.take(end - 1 - k, mode="clip")
        value += (place * (k < width) if k >= least else place) * dtype(10**k)
    return value


def _millionths(digit: np.ndarray, dot: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The six digits behind the dot, rounded by the seventh: exact, however large the number before the dot."""
    width = end - dot - 1
    least, most = width.min(), width.max()
    value = np.zeros(len(dot), np.int32)
    if least >= 6:
        pair = digit[:-1] * np.uint8(10) + digit[1:]  # two digits at a time; nonsense where a mark is one of them
        for k in (1, 3, 5):
            value = value * np.int32(100) + pair.take(dot + k)
    else:
        for k in range(1, 7):
            place = digit.take(dot + k, mode="clip")
            value = value * np.int32(10) + (place * (k <= width) if k > least else place)
    return value + ((digit.take(dot + 7, mode="clip") >= 5) & (width >= 7)) if most >= 7 else value


def _by_line(text: bytes, line: int, file: Member) -> Events:
    """Events line by line, from line number `line` on, with comments, exponents, minus signs; the first line that is wrong is named."""
    rows = []
    for number, raw in enumerate(text.decode("ascii", "backslashreplace").split("\n"), line):
        row = raw.strip()
        if row and not row.startswith("#"):
            try:
                rows.append(_row(row))
            except ValueError as error:
                remedy = f"a line is {FORM}; to drop this one: {_dropping(file, str(number))}"
                raise DataError(str(file), f"{error}: {_quoted(row)}", remedy, f"line {number}") from error
    t, x, y, p = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Events(np.array(t, np.int64), np.array(x, np.uint16), np.array(y, np.uint16), np.array(p, np.uint8))


def _row(row: str) -> tuple[int, int, int, int]:
    """One event, t in µs; ValueError says what is wrong."""
    columns = row.split()
    if len(columns) != 4:
        raise ValueError(f"{len(columns)} columns instead of 4")
    for column in columns:
        if column.lower().lstrip("+-") in ("nan", "inf", "infinity"):
            raise ValueError(f"{column} is no measurement")
        if not NUMBER.fullmatch(column):
            raise ValueError(f"{_quoted(column)} is not a number")
    t, x, y, p = map(float, columns)
    if not abs(t * 1e6) < LATEST:
        raise ValueError(f"{columns[0]} is no time in seconds")
    if not (x.is_integer() and y.is_integer() and 0 <= x <= 65535 and 0 <= y <= 65535):
        raise ValueError(f"({columns[1]}, {columns[2]}) is no pixel")
    if p not in (-1, 0, 1):
        raise ValueError(f"polarity {columns[3]} is neither 0 nor 1")
    return round(t * 1e6), int(x), int(y), int(p > 0)


def _quoted(text: str) -> str:
    """Offending text, not all of it where it is long."""
    return repr(text if len(text) <= 60 else text[:57] + "...")
