"""The one gate that events of every reader pass: on the sensor, and in order of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from torchcmax.io.errors import DataError, DataNote, DataWarning, tell
from torchcmax.io.events import Events

TEXTS = (".txt", ".csv")


@dataclass(frozen=True)
class Source:
    """Where events come from.  sensor (width, height) px | place: event, counted from 0 -> where it stands, in words."""

    path: str
    sensor: tuple[int, int]
    place: Callable[[int], str]
    strict: bool = False


class Reordered(DataWarning):
    """Events that were out of order and have been sorted; `count` says how many."""

    def __init__(self, text: str, count: int) -> None:
        super().__init__(text)
        self.count = count


def checked(raw: Iterator[Events], source: Source) -> Iterator[Events]:
    """Events on the sensor, in order of time; equal times stay in the order of the file.

    An event that is late by less than a chunk is put in its place, and one DataWarning at the end of the pass counts them; a
    DataNote counts the equal times.
    """
    return _in_order(_on_sensor(raw, source), source)


def _on_sensor(chunks: Iterator[Events], source: Source) -> Iterator[Events]:
    """Passes events on and stops at the first that is not on the sensor."""
    (width, height), seen = source.sensor, 0
    for chunk in chunks:
        if len(chunk) and (chunk.x.max() >= width or chunk.y.max() >= height):
            i = int(((chunk.x >= width) | (chunk.y >= height)).argmax())
            x, y = int(chunk.x[i]), int(chunk.y[i])
            raise DataError(
                source.path,
                f"event {seen + i + 1} at pixel ({x}, {y}) is not on the sensor of {width} x {height}",
                f"give the sensor's true size, at least --sensor {max(x + 1, width)}x{max(y + 1, height)}, or drop the event",
                source.place(seen + i),
            )
        seen += len(chunk)
        yield chunk


def _in_order(chunks: Iterator[Events], source: Source) -> Iterator[Events]:
    """Sorts within two chunks: one is held back, so that late events of the next can still go before it."""
    held: Events | None = None
    handed, seen, late, equal, where = np.iinfo(np.int64).min, 0, 0, 0, ""
    try:
        for chunk in chunks:
            if not len(chunk):
                continue
            newest = chunk.t[0] if held is None else held.t[-1]
            if source.strict:
                _refuse(chunk, _before(chunk, newest), seen, source)
            if chunk.t[0] >= newest and (chunk.t[1:] >= chunk.t[:-1]).all():
                ready, held = held, chunk
            else:
                behind = np.flatnonzero(chunk.t < np.maximum.accumulate(_before(chunk, newest)))
                if chunk.t.min() < handed:
                    raise _too_late(chunk, handed, seen, source)
                late, where = late + len(behind), where or source.place(seen + int(behind[0]))
                ready, held = _merged(held, chunk)
            equal += int((chunk.t[1:] == chunk.t[:-1]).sum()) + int(seen > 0 and chunk.t[0] == newest)
            seen += len(chunk)
            if ready is not None and len(ready):
                handed = int(ready.t[-1])
                yield ready
        if held is not None:
            yield held
    finally:  # also when nobody wants the rest of the events
        if late:
            text = f"{source.path}: {late} of {seen} events were out of order and have been sorted, the first at {where}"
            tell(Reordered(text, late))
        if equal:
            text = f"{source.path}: {equal} of {seen} events have the time of the one before; they stay in the order of the file"
            tell(DataNote(f"{text} (--strict refuses them)"))


def _before(chunk: Events, newest: np.int64) -> np.ndarray:
    """The time of the event before each of a chunk, `newest` before the first."""
    return np.concatenate([[newest], chunk.t[:-1]])


def _merged(held: Events | None, chunk: Events) -> tuple[Events, Events]:
    """Two chunks sorted together, equal times in the order they came: what can be handed on, what is held back."""
    both = chunk if held is None else Events.join([held, chunk])
    both = both[np.argsort(both.t, kind="stable")]
    cut = len(both) - len(chunk)
    return both[:cut], both[cut:]


def _refuse(chunk: Events, before: np.ndarray, seen: int, source: Source) -> None:
    """Strict: an event earlier than the one before it is an error, and so is one at the same time."""
    wrong = chunk.t <= before
    wrong[0] &= seen > 0  # the first of all has none before it
    if wrong.any():
        i = int(wrong.argmax())
        how = "at the same time as" if chunk.t[i] == before[i] else "earlier than"
        remedy = f"leave out --strict, or {_sorting(source)}"
        raise DataError(source.path, f"event {seen + i + 1} is {how} the one before it", remedy, source.place(seen + i))


def _sorting(source: Source) -> str:
    """How to bring a file in order."""
    if not source.path.endswith(TEXTS):
        return "sort it by time with the tool that wrote it, or open it in larger chunks: torchcmax.io.OpenOptions(chunk=...)"
    name = source.path.rpartition("/")[2]
    return f"sort the file by the column of its times, where that is the first: sort -s -n -k1,1 {name} > sorted.txt"


def _too_late(chunk: Events, handed: int, seen: int, source: Source) -> DataError:
    """The first event that is older than what was already handed on."""
    i = int((chunk.t < handed).argmax())
    problem = f"event {seen + i + 1} at {int(chunk.t[i])} us comes after too many later ones to be sorted, up to {handed} us"
    return DataError(source.path, problem, _sorting(source), source.place(seen + i))
