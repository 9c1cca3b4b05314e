"""Prophesee's RAW files (EVT2, EVT2.1, EVT3) and DAT files: words of a fixed size behind a text header, taken apart many at a time.

The layouts are those of Prophesee's documentation, "Data encoding formats".  Time is in µs since the sensor was started.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchcmax.io.contents import Contents
from torchcmax.io.errors import DataError, DataNote, DataWarning, tell
from torchcmax.io.events import Events
from torchcmax.io.member import reading

LONGEST = 1 << 16  # bytes of a header
SIZES = {  # px of the sensors that old headers name only by the plugin of the camera
    "gen31": (640, 480), "gen3": (640, 480), "gen4": (1280, 720), "imx636": (1280, 720), "genx320": (320, 320),
}  # fmt: skip
WANTS = "a RAW file's header names its format: % evt 2.0, 2.1 or 3.0, or % format EVT2, EVT21 or EVT3"
AGAIN = "copy or record the file again"
EVT3_WORDS = 1 << 15  # taken apart at once
IS_EVENT = np.array([0, 0, 1, 0, 1, 1, *[0] * 10], bool)  # of EVT3's kinds of words: a single event, a vector of 12, of 8
STEPS = np.array([0, 0, 0, 0, 12, 8, *[0] * 10], np.int64)  # columns that its vectors pass
FLAGS = np.array([0, 0, 0, 0, 0xFFF, 0xFF, *[0] * 10], np.uint16)  # bits of its vectors that are pixels
UNKNOWN = np.array([0, 1, *[0] * 7, 1, 0, 1, 1, 1, 0, 0], bool)


@dataclass
class Gate:
    """What is known so far of the time, and of words that tell nothing, from one block of words to the next."""

    high: int = -1  # the last high part of the time; -1: none yet
    turns: int = 0  # how often it began anew
    early: int = 0  # events before the first time
    unknown: int = 0  # words of a kind that the format does not have
    rest: dict[str, int] = field(default_factory=dict)  # of the format's own

    def unrolled(self, high: np.ndarray, bits: int) -> np.ndarray:
        """High parts of the time, in order, each `bits` wide, as numbers that go on: half of their range backwards is a new turn."""
        before = np.concatenate([[self.high if self.high >= 0 else high[:1].sum()], high[:-1]])
        turns = self.turns + np.cumsum(high - before < -(1 << (bits - 1)))
        if len(high):
            self.high, self.turns = int(high[-1]), int(turns[-1])
        unrolled: np.ndarray = high + (turns << bits)
        return unrolled


Decoder = Callable[[np.ndarray, Gate], Events]


def knows(path: Path, head: bytes) -> bool:
    """Whether a file begins as RAW or DAT files do."""
    if not head.startswith(b"% "):
        return False
    told = _told(head[: _header_end(head)])
    return "evt" in told or "format" in told or "Data" in told or ({"Height", "Width"} <= set(told)) or path.suffix in (".raw", ".dat")


def contents(path: Path) -> Contents:
    """What the header says; the events are decoded when they are asked for."""
    with reading(path), path.open("rb") as stream:
        head = stream.read(LONGEST)
        size = stream.seek(0, 2)
    start = _header_end(head)
    told = _told(head[:start])
    form = _format(path, told)
    if form == "dat":
        if head[start + 1 : start + 2] != b"\x08":
            raise DataError(path, "holds no events of 8 bytes behind its header", "write a DAT file of CD events", f"byte {start + 2}")
        start += 2
    kind, decode = FORMATS[form]
    if size <= start:
        raise DataError(path, "holds no events behind its header", AGAIN, f"byte {start + 1}")
    count = (size - start) // 8 if form == "dat" else None
    events = partial(_decoded, path, start, kind, decode)
    return Contents(events, lambda event: f"event {event + 1}", count, sensor=_sensor(told))


def _header_end(head: bytes) -> int:
    """Where the lines that begin with % end."""
    at = 0
    while head[at : at + 1] == b"%" and head[at + 1 : at + 2] in (b" ", b"\n", b"\r"):
        end = head.find(b"\n", at)
        if end < 0:
            return len(head)
        line, at = head[at:end].strip(), end + 1
        if line == b"% end":
            break
    return at


def _told(header: bytes) -> dict[str, str]:
    """The header's lines as names and values; of `format EVT3;height=720;width=1280` each part."""
    told: dict[str, str] = {}
    for line in header.decode("ascii", "replace").splitlines():
        name, _, value = line.removeprefix("%").strip().partition(" ")
        told.setdefault(name, value.strip())
        if name == "format":
            told |= dict(part.split("=", 1) for part in value.split(";") if "=" in part)
    return told


def _format(path: Path, told: dict[str, str]) -> str:
    name = told.get("format", "").partition(";")[0].upper() or "EVT" + told.get("evt", "").removesuffix(".0").replace(".", "")
    if name in ("EVT2", "EVT21", "EVT3"):
        legacy = name == "EVT21" and told.get("endianness", "little") == "legacy"
        return name.lower() + ("_legacy" if legacy else "")
    if name == "EVT" and ("Data" in told or {"Height", "Width"} <= set(told)):
        return "dat"
    raise DataError(path, f"is of a format that we do not read: {name if name != 'EVT' else 'none is named'}", WANTS, "header")


def _sensor(told: dict[str, str]) -> tuple[str, str] | tuple[int, int] | None:
    """Width and height as the header says, or as the camera's plugin tells."""
    if match := re.fullmatch(r"(\d+)x(\d+)", told.get("geometry", "")):
        return match[1], match[2]
    for width, height in (("width", "height"), ("Width", "Height")):
        if width in told and height in told:
            return told[width], told[height]
    plugin = (told.get("plugin_name", "") + told.get("sensor_name", "")).lower()
    return next((size for name, size in SIZES.items() if name in plugin), None)


def _decoded(path: Path, start: int, kind: np.dtype[Any], decode: Decoder, chunk: int) -> Iterator[Events]:
    """The events of all words behind the header, block by block."""
    gate, at = Gate(), start
    while True:
        with reading(path), path.open("rb") as stream:
            stream.seek(at)
            data = stream.read(chunk * kind.itemsize)
        whole = len(data) - len(data) % kind.itemsize
        if whole:
            events = decode(np.frombuffer(data[:whole], kind), gate)
            if len(events):
                yield events
        at += whole
        if len(data) < chunk * kind.itemsize:
            break
    if len(data) > whole:
        text = f"{path}: ends within a word, at byte {at + 1}; the last {len(data) - whole} bytes are left out"
        tell(DataWarning(f"{text}: the file was not copied or written to its end"))
    if gate.unknown:
        tell(DataWarning(f"{path}: {gate.unknown} words of a kind that the format does not have are passed over; it may be damaged"))
    if gate.early:
        tell(DataNote(f"{path}: {gate.early} events before the first time stamp are left out"))


def _timed(high: np.ndarray, word: np.ndarray, gate: Gate) -> np.ndarray:
    """The high part of the time of each word, -1 before the first: high [N] bool, which words tell it | word [N], what they tell."""
    told: np.ndarray = _unrolled_from(gate, word[high], 28)[np.cumsum(high)]
    return told


def _unrolled_from(gate: Gate, high: np.ndarray, bits: int = 12) -> np.ndarray:
    """The high part of the time that is known from before, or -1, and those that follow."""
    before = -1 if gate.high < 0 else gate.high + (gate.turns << bits)
    return np.concatenate([[before], gate.unrolled(high.astype(np.int64), bits)])


def _kept(t: np.ndarray, columns: tuple[np.ndarray, np.ndarray, np.ndarray], gate: Gate) -> Events:
    """Events with their types, without those before the first time, whose t is below zero."""
    x, y = (part.astype(np.uint16, copy=False) for part in columns[:2])
    events, known = Events(t.astype(np.int64, copy=False), x, y, columns[2].astype(np.uint8, copy=False)), t >= 0
    if known.all():
        return events
    gate.early += int(len(known) - np.count_nonzero(known))
    return events[known]


def evt2(word: np.ndarray, gate: Gate) -> Events:
    """32 bits: kind 4, and of an event (kind 0 OFF, 1 ON) low time 6, x 11, y 11; of kind 8 high time 28."""
    kind = word >> 28
    high = _timed(kind == 8, word & 0xFFFFFFF, gate)
    gate.unknown += int(np.count_nonzero(~np.isin(kind, (0, 1, 8, 10, 14, 15))))
    event = kind <= 1
    word, high = word[event], high[event]
    t = (high << 6) + ((word >> 22) & 63)
    return _kept(t, ((word >> 11) & 0x7FF, word & 0x7FF, word >> 28), gate)


def evt21(word: np.ndarray, gate: Gate) -> Events:
    """64 bits: kind 4, and of events (kind 0 OFF, 1 ON) low time 6, x 11 of the first, y 11, 32 flags of pixels from x on."""
    kind = (word >> np.uint64(60)).astype(np.uint8)
    top = (word >> np.uint64(32)).astype(np.uint32)
    high = _timed(kind == 8, top & 0xFFFFFFF, gate)
    gate.unknown += int(np.count_nonzero(~np.isin(kind, (0, 1, 8, 10, 14, 15))))
    event = np.flatnonzero(kind <= 1)
    flags = np.ascontiguousarray((word[event] & np.uint64(0xFFFFFFFF)).astype("<u4"))
    row, bit = np.nonzero(np.unpackbits(flags.view(np.uint8), bitorder="little").reshape(-1, 32))
    head, high = top[event][row], high[event][row]
    t = (high << 6) + ((head >> 22) & 63)
    return _kept(t, (((head >> 11) & 0x7FF) + bit, head & 0x7FF, head >> 28), gate)


def evt21_legacy(word: np.ndarray, gate: Gate) -> Events:
    """As EVT2.1, the two halves of each word the other way round."""
    return evt21((word >> np.uint64(32)) | (word << np.uint64(32)), gate)


def evt3(word: np.ndarray, gate: Gate) -> Events:
    """16 bits: kind 4; a state of time, row and column is told word by word, and events are single columns or vectors of 12 and 8."""
    parts = [_evt3(word[i : i + EVT3_WORDS], gate) for i in range(0, len(word), EVT3_WORDS)]
    return Events.join(parts) if len(parts) > 1 else parts[0]


def _evt3(word: np.ndarray, gate: Gate) -> Events:
    """Some words, few enough for the processor's cache."""
    rest = gate.rest
    carried = np.array([0x6000 | rest.get("low", 0), rest.get("row", 0), 0x3000 | rest.get("base", 0)], "<u2")
    word = np.concatenate([carried, word])
    kind, value = (word >> 12).astype(np.uint8), word & np.uint16(0xFFF)
    both = np.cumsum((STEPS << 32 | IS_EVENT).take(kind))  # two sums at once: it is their number that costs time
    passed, columns = both & 0xFFFFFFFF, both >> 32  # events up to each word; columns that vectors passed, with it

    def state(here: np.ndarray, values: np.ndarray) -> np.ndarray:
        """What was told last, at each event: the words that tell it, and what they tell, with that before the first of them."""
        known: np.ndarray = np.repeat(values, np.diff(passed[here], prepend=0, append=passed[-1]))
        return known

    places = {k: np.flatnonzero(kind == k) for k in (6, 0, 3, 8)}
    low, row, base = (state(places[k][1:], value[places[k]]) for k in (6, 0, 3))
    start = state(places[8], _unrolled_from(gate, value[places[8]]))
    source = np.flatnonzero(IS_EVENT.take(kind))
    told, single = value[source], kind[source] == 2
    ahead = columns[source - 1] - state(places[3][1:], columns[places[3]])
    x = np.where(single, told & 0x7FF, (base & 0x7FF) + ahead.astype(np.uint16))
    p = (np.where(single, told, base) >> 11).astype(np.uint8)
    flags = (value & FLAGS.take(kind))[source] | single
    bit = np.flatnonzero(np.unpackbits(flags.view(np.uint8), bitorder="little").view(bool))  # of bytes it takes four times as long
    which = bit >> 4
    gate.unknown += int(np.count_nonzero(UNKNOWN.take(kind)))
    last = places[3][-1]
    position = (int(value[last]) & 0x7FF) + int(columns[-1] - columns[last])  # where the next vector begins
    gate.rest = {"low": int(value[places[6][-1]]), "row": int(value[places[0][-1]])}
    gate.rest["base"] = int(value[last]) & 0x800 | min(position, 0x7FF)
    t = (start << 12) + low
    return _kept(t[which], (x[which] + (bit & 15).astype(np.uint16), (row & 0x7FF)[which], p[which]), gate)


def dat(word: np.ndarray, gate: Gate) -> Events:
    """Time 32 bits, then x 14, y 14, polarity 4."""
    t = gate.unrolled(word["t"].astype(np.int64), 32)
    place = word["place"]
    return _kept(t, (place & 0x3FFF, (place >> 14) & 0x3FFF, (place >> 28) & 1), gate)


FORMATS: dict[str, tuple[np.dtype[Any], Decoder]] = {
    "evt2": (np.dtype("<u4"), evt2),
    "evt21": (np.dtype("<u8"), evt21),
    "evt21_legacy": (np.dtype("<u8"), evt21_legacy),
    "evt3": (np.dtype("<u2"), evt3),
    "dat": (np.dtype([("t", "<u4"), ("place", "<u4")]), dat),
}
