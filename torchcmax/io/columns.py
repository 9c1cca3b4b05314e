"""How a text file has its events: in which columns, in what unit of time, behind what lines.  Told by names, or by the values."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import isfinite

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
SPARSE, FEW = 100_000, 100  # times between events on average, in µs, of so many events: hardly that unit
SHUFFLED, SOME = 0.25, 10  # share of values that are less than the last one, of so many: hardly times
USUAL = "t x y p"
ADVICE = "name the columns and the unit in a first line, like t_us,x,y,p or # t x y p"

Names = Sequence[tuple[str, Fraction | None]]  # of the columns, and the unit that a name tells


@dataclass(frozen=True)
class Form:
    """order: columns of t, x, y, p | columns: of a line | separator: a blank, which means any number of blanks and tabs, a comma or ;

    decimal: t is written with a fraction or an exponent | unit: µs in one of t | taken: what nobody tells, and how it is taken
    line: number of the first event's line | skip: lines before it that are no comments | sensor: (width, height) px
    """

    order: tuple[int, int, int, int] = (0, 1, 2, 3)
    columns: int = 4
    separator: str = " "
    decimal: bool = True
    unit: Fraction = SECONDS
    taken: str = ""
    line: int = 1
    skip: int = 0
    sensor: tuple[int, int] | None = None

    def split(self, row: str) -> list[str]:
        """The columns of a line."""
        return row.split() if self.separator == " " else [word.strip() for word in row.split(self.separator)]


def form_of(rows: Sequence[tuple[int, str]], names: Names = ()) -> Form:
    """The form that the first lines of a file have; ValueError says why nobody can tell.

    rows: number and text of lines that are neither empty nor comments | names: `names_of` a comment before them
    """
    sensor, skip = None, 0
    if len(rows) > 1 and (size := size_of(rows[0][1])) and len(words_of(rows[1][1])) > 2:
        sensor, skip = size, 1
    if len(rows) > skip and (found := names_of(rows[skip][1])):
        names, skip = found, skip + 1
    if len(rows) == skip:
        return Form(skip=skip, line=rows[-1][0] + 1 if rows else 1, sensor=sensor)
    line, first = rows[skip]
    separator = next((mark for mark in ",;" if mark in first), " ")
    columns = len(words_of(first))
    table = [words for _, row in rows[skip:] if len(words := words_of(row)) == columns]
    unit, taken = None, list[str]()
    if names and len(names) == columns:
        order = tuple(next(i for i, (name, _) in enumerate(names) if name == wanted) for wanted in NAMES)
        unit = names[order[0]][1]
    elif columns == 4:
        name = _order([words for words in table if all(map(NUMBER.fullmatch, words))])
        order, taken = ORDERS[name], [f"its columns are taken to be {name}"] if name != USUAL else []
    else:
        raise ValueError(f"{columns} columns instead of 4")
    t, x, y, p = order
    times = [words[t] for words in table if NUMBER.fullmatch(words[t])]
    decimal = not times or not all(map(WHOLE.fullmatch, times))
    if unit is None:
        unit, doubt = _unit(times, decimal)
        taken += [doubt] if doubt else []
    return Form((t, x, y, p), columns, separator, decimal, unit, ", ".join(taken), line, skip, sensor)


def words_of(row: str) -> list[str]:
    """The columns of a line whose separator is not known yet."""
    return next(([word.strip() for word in row.split(mark)] for mark in ",;" if mark in row), row.split())


def size_of(row: str) -> tuple[int, int] | None:
    """Width and height, where a line holds nothing else."""
    words = words_of(row)
    return (int(words[0]), int(words[1])) if len(words) == 2 and all(re.fullmatch(r"\d{1,5}", word, re.ASCII) for word in words) else None


def names_of(row: str) -> Names:
    """Names of columns, t, x, y, p once each and anything else, with the unit that a name tells; empty where it is no such line."""
    row = re.sub(r"\s+([\[(])", r"\1", row.strip())  # timestamp [us]
    found = [_name(word.strip("\"' ")) for word in words_of(row)]
    return found if all(sum(name == wanted for name, _ in found) == 1 for wanted in NAMES) else ()


def _name(word: str) -> tuple[str, Fraction | None]:
    """t, x, y, p, or the word as it is; and its unit."""
    plain, _, unit = re.sub(r"[\[(](.*)[\])]", r"_\1", word.lower()).rpartition("_")
    for value, names in UNITS.items():
        if unit in names and plain in NAMES["t"]:
            return "t", value
    if unit == "px":
        word = plain
    return next((name for name, words in NAMES.items() if word.lower() in words), word), None


def _order(table: Sequence[Sequence[str]]) -> str:
    """The order of four columns by their values: x before y, polarities are 0, 1 or -1, times do not decrease."""
    values = np.array([[float(word) for word in words] for words in table]).reshape(-1, 4)
    back = np.count_nonzero(values[1:] < values[:-1], axis=0)

    def fits(order: tuple[int, int, int, int]) -> bool:
        _, x, y, p = order
        pixel = values[:, [x, y]]
        return bool(np.isin(values[:, p], (-1, 0, 1)).all() and ((pixel >= 0) & (pixel <= 65535) & (pixel == np.rint(pixel))).all())

    fitting = [name for name, order in ORDERS.items() if fits(order)] if len(values) else []
    if len(fitting) > 1:
        written = [i for i in range(4) if any(not WHOLE.fullmatch(words[i]) for words in table)]
        if len(written) == 1:  # only a time is written with a fraction
            fitting = [name for name in fitting if ORDERS[name][0] == written[0]]
    if len(fitting) > 1:
        rising = [name for name in fitting if not back[ORDERS[name][0]]]
        shuffled = len(values) >= SOME and back[0] > SHUFFLED * len(values)
        if USUAL in rising or USUAL not in fitting or shuffled:  # else its times may be out of order
            fitting = rising or fitting
        if written == [0] and USUAL in fitting:
            return USUAL  # too few events to tell: what is usual
    if len(fitting) > 1:
        raise ValueError(f"its columns may be {' or '.join(fitting)}")
    return next(iter(fitting), USUAL)


def _unit(times: Sequence[str], decimal: bool) -> tuple[Fraction, str]:
    """Of times that nobody tells the unit of, and the doubt that stays.

    s where they are written with fractions, µs where they are whole numbers, or ns where these are too large for anything else.
    """
    values = [Fraction(float(time)) if decimal else Fraction(time) for time in times if not decimal or isfinite(float(time))]
    apart = (max(values) - min(values)) / (len(values) - 1) if len(values) >= FEW else Fraction(0)
    if decimal:
        if apart <= SPARSE / SECONDS:
            return SECONDS, ""
        if all(value.denominator == 1 for value in values):
            return MICRO, "its times are whole numbers, and taken for us"
        return SECONDS, "its times are far apart, and taken for seconds"
    if max(map(abs, values)) >= ONLY_NANO:
        return NANO, ""
    if apart > SPARSE:
        raise ValueError("its times are whole numbers in no unit that anybody tells, too far apart for us")
    return MICRO, "its times are whole numbers, and taken for us"
