"""How a text file has its events: in which columns, in what unit of time, behind what lines.  Told by names, or by the values."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from torchcmax.io.tables import ALIASES

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
WHOLE = re.compile(r"[+-]?\d+", re.ASCII)
NAMES = {name: {*ALIASES[name], *more} for name, more in {"t": ("times",), "x": ("column", "col"), "y": ("row",), "p": ("on",)}.items()}
UNITS = {
    Fraction(10**6): {"s", "sec", "secs", "second", "seconds"},
    Fraction(10**3): {"ms", "millis", "millisecond", "milliseconds"},
    Fraction(1): {"us", "µs", "μs", "usec", "micros", "microsecond", "microseconds"},
    Fraction(1, 10**3): {"ns", "nsec", "nanos", "nanosecond", "nanoseconds"},
}
SECONDS, MICRO, NANO = Fraction(10**6), Fraction(1), Fraction(1, 10**3)
ORDERS = {"t x y p": (0, 1, 2, 3), "x y p t": (3, 0, 1, 2), "x y t p": (2, 0, 1, 3), "t p x y": (0, 2, 3, 1)}
ONLY_NANO = 10**17  # of whole-number times: µs of the year 5138, ns of 1973
SPARSE, FEW = 100_000, 100  # µs between events on average, of so many: hardly µs
ADVICE = "name the columns and the unit in a first line, like t_us,x,y,p or # t x y p"


@dataclass(frozen=True)
class Form:
    """order: columns of t, x, y, p | columns: of a line | separator: a blank, which means any number of blanks and tabs, a comma or ;

    decimal: t has a fraction | unit: µs in one of t | told: somebody or something tells the unit
    line: number of the first event's line | skip: lines before it that are no comments | sensor: (width, height) px
    """

    order: tuple[int, int, int, int] = (0, 1, 2, 3)
    columns: int = 4
    separator: str = " "
    decimal: bool = True
    unit: Fraction = SECONDS
    told: bool = True
    line: int = 1
    skip: int = 0
    sensor: tuple[int, int] | None = None

    def split(self, row: str) -> list[str]:
        """The columns of a line."""
        return row.split() if self.separator == " " else [word.strip() for word in row.split(self.separator)]


def form_of(rows: Sequence[tuple[int, str]], comment: str = "") -> Form:
    """The form that the first lines of a file have; ValueError says why nobody can tell.

    rows: number and text of lines that are neither empty nor comments | comment: the last one before them, without its #
    """
    sensor, names, skip = None, _names(comment), 0
    if len(rows) > 1 and (size := _size(rows[0][1])) and len(words_of(rows[1][1])) > 2:
        sensor, skip = size, 1
    if len(rows) > skip and (found := _names(rows[skip][1])):
        names, skip = found, skip + 1
    if len(rows) == skip:
        return Form(skip=skip, line=rows[-1][0] + 1 if rows else 1, sensor=sensor)
    line, first = rows[skip]
    separator = next((mark for mark in ",;" if mark in first), " ")
    columns = len(words_of(first))
    if names and len(names) == columns:
        order = tuple(next(i for i, (name, _) in enumerate(names) if name == wanted) for wanted in NAMES)
        unit = names[order[0]][1]
    elif columns == 4:
        order, unit = None, None
    else:
        raise ValueError(f"{columns} columns instead of 4")
    table = [words for _, row in rows[skip:] if len(words := words_of(row)) == columns and all(map(NUMBER.fullmatch, words))]
    t, x, y, p = order = order or _order(table)
    times = [words[t] for words in table]
    decimal = not times or not all(map(WHOLE.fullmatch, times))
    told = decimal or unit is not None
    unit = unit or (SECONDS if decimal else _whole_unit([int(time) for time in times]))
    return Form((t, x, y, p), columns, separator, decimal, unit, told or unit == NANO, line, skip, sensor)


def words_of(row: str) -> list[str]:
    """The columns of a line whose separator is not known yet."""
    return next(([word.strip() for word in row.split(mark)] for mark in ",;" if mark in row), row.split())


def _size(row: str) -> tuple[int, int] | None:
    """Width and height, where a line holds nothing else."""
    words = words_of(row)
    return (int(words[0]), int(words[1])) if len(words) == 2 and all(re.fullmatch(r"\d{1,5}", word, re.ASCII) for word in words) else None


def _names(row: str) -> list[tuple[str, Fraction | None]]:
    """Names of columns, t, x, y, p once each and anything else, with the unit that a name tells; empty where it is no such line."""
    row = re.sub(r"\s+([\[(])", r"\1", row.strip())  # timestamp [us]
    found = [_name(word.strip("\"' ")) for word in words_of(row)]
    return found if all(sum(name == wanted for name, _ in found) == 1 for wanted in NAMES) else []


def _name(word: str) -> tuple[str, Fraction | None]:
    """t, x, y, p, or the word as it is; and its unit."""
    plain, _, unit = re.sub(r"[\[(](.*)[\])]", r"_\1", word.lower()).rpartition("_")
    for value, names in UNITS.items():
        if unit in names and plain in NAMES["t"]:
            return "t", value
    if unit == "px":
        word = plain
    return next((name for name, words in NAMES.items() if word.lower() in words), word), None


def _order(table: Sequence[Sequence[str]]) -> tuple[int, int, int, int]:
    """Columns of t, x, y, p by the values of four columns: x before y, polarities are 0, 1 or -1, times do not decrease."""
    values = np.array([[float(word) for word in words] for words in table]).reshape(-1, 4)

    def fits(order: tuple[int, int, int, int]) -> bool:
        _, x, y, p = order
        pixel = values[:, [x, y]]
        return bool(np.isin(values[:, p], (-1, 0, 1)).all() and ((pixel >= 0) & (pixel <= 65535) & (pixel == np.rint(pixel))).all())

    fitting = {name: order for name, order in ORDERS.items() if fits(order)}
    if len(fitting) > 1:
        written = [i for i in range(4) if any(not WHOLE.fullmatch(words[i]) for words in table)]
        if len(written) == 1:  # only a time is written with a fraction
            fitting = {name: order for name, order in fitting.items() if order[0] == written[0]}
    if len(fitting) > 1:
        rising = {name: order for name, order in fitting.items() if (np.diff(values[:, order[0]]) >= 0).all()}
        fitting = rising or fitting
        if written == [0] and "t x y p" in fitting:
            return ORDERS["t x y p"]  # too few events to tell: what is usual
    if len(fitting) > 1:
        raise ValueError(f"its columns may be {' or '.join(fitting)}")
    return next(iter(fitting.values()), ORDERS["t x y p"])


def _whole_unit(times: Sequence[int]) -> Fraction:
    """Of whole-number times that nobody tells the unit of: µs, or ns where they are too large for anything else."""
    if max(map(abs, times)) >= ONLY_NANO:
        return NANO
    if len(times) >= FEW and (max(times) - min(times)) / (len(times) - 1) > SPARSE:
        raise ValueError("its times are whole numbers in no unit that anybody tells, too far apart for us")
    return MICRO
