"""Events from text: lines `t x y p`, that is seconds, column, row, 1 (brighter) or 0 or -1 (darker), or of any other `Form`."""

from __future__ import annotations

import codecs
import re
import shlex
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from fractions import Fraction
from io import StringIO
from itertools import accumulate, islice
from math import floor
from typing import IO

import numpy as np

from torchcmax.io.columns import ADVICE, MICRO, NUMBER, SECONDS, WHOLE, Form, Names, form_of, names_of, size_of
from torchcmax.io.errors import DataError, DataNote, tell
from torchcmax.io.events import LATEST, Events
from torchcmax.io.member import Member, reading, refuse_foreign, size_in_bytes

BLOCK = 1 << 20  # bytes taken apart at a time: fits the processor's cache
LONGEST = 1 << 16  # bytes of a line; more is no text of events
FORM = "t x y p, separated by blanks: seconds, column, row, 0 or 1, like 0.003811 96 133 0"
LOOKED_AT = 2000  # lines that tell a file's form
DASH = (ord("-") - 48) % 256
MOST = {"t": 12, "x": 5, "y": 5, "p": 1}  # digits of whole seconds, column, row, polarity


def check_text(file: Member) -> Form:
    """The form of its lines.  Finds a file that holds something else, or whose last line is cut off, before anything is computed.

    A .zip is unpacked once for that.
    """
    size = size_in_bytes(file)
    if not size:
        raise DataError(str(file), "is empty", "record or copy it again")
    with reading(file), file.open("rb") as stream:
        refuse_foreign(file, stream.read(LONGEST))
    form = _form(file)
    _check_last(file, size, form)
    if form.taken:
        tell(DataNote(f"{file}: {form.taken}; if they are not: {ADVICE}"))
    return form


def like_text(head: bytes) -> bool:
    """Whether a file that begins like this, and has no ending that says so, may be a text of events."""
    lines = enumerate(head.removeprefix(codecs.BOM_UTF8).split(b"\n")[:-1] or [head], 1)
    try:
        rows, names = _first(lines)
        form = form_of(rows, names)
        _row(rows[form.skip][1], form)
    except (ValueError, IndexError):
        return False
    return True


def _first(lines: Iterable[tuple[int, bytes]]) -> tuple[list[tuple[int, str]], Names]:
    """The first lines that are neither empty nor comments, with their numbers; and the names of columns in a comment before them."""
    rows: list[tuple[int, str]] = []
    names: Names = ()
    for number, raw in lines:
        row = raw.decode("utf-8", "backslashreplace").strip()
        if not row.startswith("#"):
            rows += [(number, row)] if row else []
        elif not rows or (len(rows) == 1 and size_of(rows[0][1])):
            names = names_of(row.lstrip("# ")) or names
        if len(rows) >= LOOKED_AT:
            break
    return rows, names


def _form(file: Member) -> Form:
    """The form of its first lines; where the first is no event the whole file is of another form, so dropping the line would not help."""
    rows, names = _first(_lines(file))
    number, first = 1, ""
    try:
        form = form_of(rows, names)
        if len(rows) > form.skip:
            number, first = rows[form.skip]
            _row(first, form)
    except ValueError as error:
        number, first = (number, first) if first else rows[0]
        problem = f"its first line is no event, {error}: {_quoted(first)}"
        raise DataError(str(file), problem, f"events want lines of {FORM}; {ADVICE}", f"line {number}") from error
    return form


def _check_last(file: Member, size: int, form: Form) -> None:
    with reading(file), file.open("rb") as stream:
        stream.seek(max(size - LONGEST, 0))
        last = stream.read().rsplit(b"\n", 1)[-1].removeprefix(codecs.BOM_UTF8)
    row = last.decode("ascii", "backslashreplace").strip()
    if row and not row.startswith("#") and len(form.split(row)) < form.columns:
        with reading(file), file.open("rb") as stream:
            number = sum(block.count(b"\n") for block in _blocks(stream, BLOCK, file))
        if number < form.line:
            return  # it is the header
        remedy = f"the file was not copied or written to its end; copy it again, or drop the line: {_dropping(file, '$')}"
        raise DataError(str(file), f"the last line is cut off: {_quoted(row)}", remedy, f"line {number}")


def _dropping(file: Member, line: str) -> str:
    """How to drop a line of a file: its number, or $ for the last."""
    if isinstance(file, zipfile.Path):
        return f"unpack {file.root.filename}, drop the line there, and open the folder"
    return f"sed -i '{line}d' {shlex.quote(str(file))}"


def read_text(file: Member, chunk: int, block: int = BLOCK, form: Form = Form()) -> Iterator[Events]:  # noqa: B008
    """Events as they stand in the file, `chunk` at a time; fewer only at the end.  `block`: bytes taken apart at a time."""
    parts: list[Events] = []
    count, line = 0, 1
    with reading(file), file.open("rb") as stream:
        for text in _blocks(stream, block, file):
            header = min(form.line - line, text.count(b"\n")) if line < form.line else 0
            events, lines = _parse(_after(text, header), line + header, file, form)
            parts.append(events)
            count, line = count + len(events), line + header + lines
            if count >= chunk:
                whole = Events.join(parts)
                for start in range(0, count - chunk + 1, chunk):
                    yield whole[start : start + chunk]
                parts, count = [whole[count - count % chunk :]], count % chunk
    if count:
        yield Events.join(parts)


def line_of(file: Member, event: int, form: Form = Form()) -> str:  # noqa: B008
    """Where an event, counted from 0, stands in the file; reads it again up to there."""
    data = (number for number, row in _lines(file) if row.strip() and not row.lstrip().startswith(b"#"))
    return next((f"line {number}" for number in islice(data, form.skip + event, None)), "at its end")


def _lines(file: Member) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers, from 1."""
    with reading(file), file.open("rb") as stream:
        yield from enumerate((row for text in _blocks(stream, BLOCK, file) for row in text.split(b"\n")[:-1]), 1)


def _after(text: bytes, lines: int) -> bytes:
    """What stands behind so many lines."""
    start = 0
    for _ in range(lines):
        start = text.index(b"\n", start) + 1
    return text[start:]


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


def _parse(text: bytes, line: int, file: Member, form: Form) -> tuple[Events, int]:
    """A block of lines as events, and the number of lines: the quickest way that every line allows, line by line in the end."""
    events = _plain(text, form)
    if events is not None:
        return events, len(events)
    events = _plain(_tidy(text, form), form)
    if events is None:
        events = _decimals(text, form)
    return _by_line(text, line, file, form) if events is None else events, text.count(b"\n")


def _tidy(text: bytes, form: Form) -> bytes:
    """The same lines with one separator between columns and nothing else, where that can be said of all at once."""
    text, mark = text.replace(b"\r\n", b"\n").replace(b"\t", b" "), form.separator.encode()
    if mark != b" ":
        return text.replace(mark + b" ", mark).replace(b" " + mark, mark)
    while b"  " in text:
        text = text.replace(b"  ", b" ")
    return text.replace(b"\n ", b"\n").replace(b" \n", b"\n").removeprefix(b" ")


def _plain(text: bytes, form: Form) -> Events | None:
    """Lines of digits like `1.234567 12 34 1`, all at once, twice as fast as np.loadtxt; None where one line is of another form."""
    gaps = _gaps(text[: text.find(b"\n") + 1], form)
    if not gaps or (form.decimal and form.unit not in (SECONDS, MICRO)):
        return None
    digit = np.frombuffer(text, np.uint8) - np.uint8(48)
    found = _between(digit, gaps, form, b"-" in text)
    if found is None:
        return None
    dot, starts, ends = found
    first = dict(zip("txyp", (starts[column] for column in form.order), strict=True))
    last = dict(zip("txyp", (ends[column] for column in form.order), strict=True))
    after = last["t"]
    if form.decimal:
        last["t"] = dot
    width = {name: last[name] - first[name] for name in "txyp"}
    seconds = form.decimal and form.unit == SECONDS
    most = MOST | ({} if seconds else {"t": 19})
    if any(w.min() < 1 or w.max() > most[name] for name, w in width.items()) or (form.decimal and (after - dot).min() < 2):
        return None
    x, y, p = (_whole(digit, width[name], last[name], np.int32) for name in "xyp")
    if max(x.max(), y.max()) > 65535 or p.max() > 1:
        return None
    if b"-" in text:
        p[digit.take(first["p"] - 1, mode="wrap") == DASH] = 0
    t = _whole(digit, width["t"], last["t"], np.int64)
    if seconds:
        t = t * 1_000_000 + _millionths(digit, dot, after)
    elif t.min() < 0 or t.max() > (LATEST - 1) / form.unit:
        return None
    elif form.decimal:
        t += digit.take(dot + 1) >= 5
    elif form.unit < 1:
        t = (t + form.unit.denominator // 2) // form.unit.denominator
    else:
        t = t * int(form.unit)
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def _gaps(line: bytes, form: Form) -> list[bytes]:
    """What stands behind each column of a line; nothing where that is more than a separator, blanks and the line's end."""
    gaps = re.findall(rb"[^0-9.-]+", line)
    marks = [form.separator.strip().encode()] * (form.columns - 1) + [b"\n"]
    return gaps if [gap.strip(b" \t\r") for gap in gaps] == marks else []


def _between(
    digit: np.ndarray, gaps: list[bytes], form: Form, signed: bool
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]] | None:
    """Where the dots of the times are, and where each column begins and ends.

    None where anything but the gaps, dots and the minus of a polarity is between digits.  signed: there is a minus
    """
    parts = [b"." + gap if form.decimal and column == form.order[0] else gap for column, gap in enumerate(gaps)]
    marks, behind = b"".join(parts), list(accumulate(map(len, parts)))
    other = np.flatnonzero(digit > 9)
    minus = other[digit.take(other) == DASH] if signed else other[:0]
    if len(minus):
        other = other[digit.take(other) != DASH]
    if len(other) % len(marks):
        return None
    place = list(other.reshape(-1, len(marks)).T.copy())
    if any((digit.take(row) != (mark - 48) % 256).any() for row, mark in zip(place, marks, strict=True)):
        return None
    ends, last = [place[i - len(gap)] for i, gap in zip(behind, gaps, strict=True)], [place[i - 1] for i in behind]
    if any((stop - end != len(gap) - 1).any() for end, stop, gap in zip(ends, last, gaps, strict=True) if len(gap) > 1):
        return None
    starts = [np.concatenate([[0], last[-1][:-1] + 1]), *(stop + 1 for stop in last[:-1])]
    polarity = form.order[3]
    if signed:
        dark = digit.take(starts[polarity]) == DASH
        if dark.sum() != len(minus):
            return None
        starts[polarity] = starts[polarity] + dark
    return place[marks.find(b".")], starts, ends


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


def _decimals(text: bytes, form: Form) -> Events | None:
    """Numbers in any spelling, like 1.5e-3 or 12.0, through float64; None where times are whole or in ms or ns, or one line is no event."""
    if not form.decimal or form.unit not in (SECONDS, MICRO) or not text.strip():
        return None
    try:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # of blocks of nothing but empty lines
            rows = np.loadtxt(StringIO(text.decode("ascii")), comments=None, delimiter=form.separator.strip() or None, ndmin=2)
    except ValueError:
        return None
    if rows.shape[1] != form.columns:
        return None
    t, x, y, p = rows.T[list(form.order)]
    with np.errstate(over="ignore"):
        t = np.rint(t * 1e6) if form.unit == SECONDS else np.floor(t + 0.5)
    pixel = np.stack([x, y])
    pixels = (pixel >= 0) & (pixel <= 65535) & (pixel == np.rint(pixel))
    if not ((abs(t) < LATEST).all() and pixels.all() and np.isin(p, (-1, 0, 1)).all()):
        return None
    return Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), (p > 0).astype(np.uint8))


def _by_line(text: bytes, line: int, file: Member, form: Form) -> Events:
    """Events line by line, from line number `line` on, with comments, exponents, minus signs; the first line that is wrong is named."""
    rows = []
    for number, raw in enumerate(text.decode("ascii", "backslashreplace").split("\n"), line):
        row = raw.strip()
        if row and not row.startswith("#"):
            try:
                rows.append(_row(row, form))
            except ValueError as error:
                remedy = f"a line is {_told(form)}; to drop this one: {_dropping(file, str(number))}"
                raise DataError(str(file), f"{error}: {_quoted(row)}", remedy, f"line {number}") from error
    t, x, y, p = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Events(np.array(t, np.int64), np.array(x, np.uint16), np.array(y, np.uint16), np.array(p, np.uint8))


def _row(row: str, form: Form) -> tuple[int, int, int, int]:
    """One event, t in µs; ValueError says what is wrong."""
    columns = form.split(row)
    if len(columns) != form.columns:
        raise ValueError(f"{len(columns)} columns instead of {form.columns}")
    columns = [columns[i] for i in form.order]
    for column in columns:
        if column.lower().lstrip("+-") in ("nan", "inf", "infinity"):
            raise ValueError(f"{column} is no measurement")
        if not NUMBER.fullmatch(column):
            raise ValueError(f"{_quoted(column)} is not a number")
    if not form.decimal and form.taken and not WHOLE.fullmatch(columns[0]):
        raise ValueError(f"the time {columns[0]} is no whole number, as those before are")
    t, x, y, p = map(float, columns)
    if not abs(t * float(form.unit)) < LATEST:
        raise ValueError(f"{columns[0]} is no time in {'seconds' if form.unit == SECONDS else 'its unit'}")
    if not (x.is_integer() and y.is_integer() and 0 <= x <= 65535 and 0 <= y <= 65535):
        raise ValueError(f"({columns[1]}, {columns[2]}) is no pixel")
    if p not in (-1, 0, 1):
        raise ValueError(f"polarity {columns[3]} is neither 0 nor 1")
    micro = round(t * 1e6) if form.unit == SECONDS else floor(Fraction(columns[0]) * form.unit + Fraction(1, 2)) if t else 0
    return micro, int(x), int(y), int(p > 0)


def _told(form: Form) -> str:
    """What a line should look like."""
    if form == replace(Form(), taken=form.taken, line=form.line, skip=form.skip, sensor=form.sensor):
        return FORM
    names = [next((name for name, column in zip("txyp", form.order, strict=True) if column == i), "-") for i in range(form.columns)]
    return f"{form.separator.join(names)}, as the first lines are"


def _quoted(text: str) -> str:
    """Offending text, not all of it where it is long."""
    return repr(text if len(text) <= 60 else text[:57] + "...")
