"""Columns and tables of events, as HDF5 and numpy's files hold them: which column is which, and their numbers as Events."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchcmax.io.errors import DataError, DataNote, tell
from torchcmax.io.events import LATEST, Events

ALIASES = {
    "t": ("t", "ts", "timestamp", "timestamps", "time"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "polarities"),
}
LIMITS = {"t": (1 - LATEST, LATEST - 1), "x": (0, 65535), "y": (0, 65535), "p": (-1, 1)}
KINDS = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.int8}
SAMPLE = 1 << 16  # events by which the columns of a table, or the unit of its times, are known
LONGEST = 1e6  # s, 11 days: times as decimal fractions that span more are no seconds
WIDEST = 256  # bytes of a row: more is a damaged kind
WANTS = "name the columns: arrays or fields t (integer us, or decimal fractions of seconds), x, y (px), p (0 or 1)"


def fields_of(kind: np.dtype) -> dict[str, str] | None:
    """t, x, y, p -> the field of a table that holds it; None where one is missing."""
    found = {name: alias for name, aliases in ALIASES.items() for alias in aliases[::-1] if alias in (kind.names or ())}
    return found if len(found) == len(ALIASES) else None


def column_of(rows: np.ndarray, field: str | int | None) -> np.ndarray:
    """A column of a table, by its field or its number; None: all of it."""
    column: np.ndarray = rows if field is None else rows[field] if isinstance(field, str) else rows[:, field]
    return column


def in_seconds(path: Path, t: np.ndarray) -> bool:
    """Whether times are decimal fractions, which are seconds, and not whole numbers, which are µs; told where the kind is no integer."""
    if t.dtype.kind != "f":
        return False
    fractions = bool((t != np.rint(t)).any())
    if not fractions:
        tell(DataNote(f"{path}: its times are decimal numbers without fractions, and taken to be in us"))
    return fractions


def order_of(path: Path, rows: np.ndarray, name: str) -> str:
    """The columns of a table without names, as "txyp": rows [N, 4], its first events.  DataError where they leave a doubt.

    p is the only column of two of the values -1, 0, 1; t the only other that never decreases and is not always the same; x and y
    are whole numbers, x first.
    """
    flat = rows.dtype.kind in "iufb" and np.isfinite(rows).all()
    values = [np.unique(column) for column in rows.T] if flat else []
    p = [i for i, found in enumerate(values) if found.tolist() in ([0, 1], [-1, 1])]
    rest = [i for i in range(len(values)) if i not in p]
    t = [i for i in rest if len(values[i]) > 1 and (rows[1:, i] >= rows[:-1, i]).all()]
    pixels = [i for i in rest if i not in t]
    if len(p) != 1 or len(t) != 1 or any((values[i] != np.clip(np.rint(values[i]), 0, 65535)).any() for i in pixels):
        problem = f"{name} is a table of 4 columns without names, and its first {len(rows)} events do not tell which is which"
        raise DataError(path, problem, WANTS)
    order = "".join({t[0]: "t", p[0]: "p", pixels[0]: "x", pixels[1]: "y"}[i] for i in range(4))
    tell(DataNote(f"{path}: {name} has columns without names; by their values they are taken to be {', '.join(order)}"))
    return order


def as_events(path: Path, columns: Mapping[str, np.ndarray], start: int, seconds: bool, offset: int = 0, prefix: str = "") -> Events:
    """Columns of any numbers as Events; polarity -1 is darker, as 0.

    start: place of the first in the file, for errors | seconds: unit of t, else µs | offset: µs, added to t | prefix: of the names
    """
    found = {}
    for name, kind in KINDS.items():
        told = columns[name]
        if told.dtype.kind not in "iufb":
            raise DataError(path, f"{prefix}{name} is of the kind {told.dtype}", WANTS)
        column = np.rint(told.astype(np.float64) * 1e6) if name == "t" and seconds else told
        least, most = LIMITS[name]
        if name == "t":
            least, most = max(least, least - offset), min(most, most - offset)
        fits = column.dtype.kind == "b" or (column.min().item() >= least and column.max().item() <= most)
        whole = column.astype(kind, copy=False) if fits else column
        if not fits or (column.dtype.kind == "f" and (whole != column).any()):
            i = int((~((column >= least) & (column <= most) & (column == np.rint(column)))).argmax())
            raise DataError(path, f"{prefix}{name} is {told[i]}, no whole number within {least}..{most}", WANTS, f"event {start + i + 1}")
        found[name] = whole
    t = found["t"] + offset if offset else found["t"]
    return Events(t, found["x"], found["y"], (found["p"] > 0).view(np.uint8))
