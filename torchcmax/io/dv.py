"""AEDAT4 (iniVation's DV) and ES (Event Stream) files, through the library faery."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchcmax.io.contents import Contents
from torchcmax.io.errors import DataError, DataWarning, tell
from torchcmax.io.events import LATEST, Events
from torchcmax.io.member import reading

HEADS = {b"#!AER-DAT4.": "aedat", b"Event Stream": "es"}
STREAMS = ("EVTS", "FRME", "IMUS", "TRIG")  # of AEDAT4
LONGEST = 1 << 20  # bytes of its header
AGAIN = "copy or download it again; it may be cut off or damaged"


def knows(path: Path, head: bytes) -> bool:
    """Whether a file begins as AEDAT4 or ES files do."""
    return any(head.startswith(start) for start in HEADS)


def contents(path: Path) -> Contents:
    """What the file's header says; the events are decoded when they are asked for."""
    with reading(path), path.open("rb") as stream:
        head = stream.read(LONGEST)
    kind = next(kind for start, kind in HEADS.items() if head.startswith(start))
    if kind == "aedat":
        _check_streams(path, head)
    decoder = _opened(_faery(path), path, kind)
    return Contents(partial(_decoded, path, kind), lambda event: f"event {event + 1}", sensor=decoder.dimensions())


def _check_streams(path: Path, head: bytes) -> None:
    """The XML that names the streams of an AEDAT4 file is whole: faery dies, with the process, of a name that it cannot decode."""
    start, end = head.find(b"<dv"), head.find(b"</dv>")
    try:
        text = head[max(start, 0) : end + len(b"</dv>")].decode("ascii")
        if start < 0 or end < start or "<!" in text:
            raise ValueError("it holds no description of its streams")
        kinds = [found.text or "" for found in ElementTree.fromstring(text).iter("attr") if found.get("key") == "typeIdentifier"]
        if unknown := [kind for kind in kinds if kind not in STREAMS]:
            raise ValueError(f"it holds a stream of type {unknown[0]!r}")
    except (ValueError, ElementTree.ParseError) as error:
        raise DataError(path, f"its header is broken: {error}", AGAIN) from error
    if "EVTS" not in kinds:
        raise DataError(path, f"holds no events, only {', '.join(kinds) or 'nothing'}", "record the stream of events too")


def _faery(path: Path) -> ModuleType:
    """The library, which is an extra."""
    try:
        import faery
    except ImportError as error:
        raise DataError(path, f"needs the library faery to be read ({error})", "pip install 'torchcmax[io]'") from error
    module: ModuleType = faery
    return module


def _opened(faery: ModuleType, path: Path, kind: str) -> Any:
    """faery's decoder, at the beginning of the file; DataError where it finds none to begin with."""
    return _guarded(lambda: faery.events_stream_from_file(path, file_type=kind), path)


def _guarded(call: Callable[[], Any], path: Path) -> Any:
    """What the library returns; what it raises, a panic among it, is about the file."""
    try:
        return call()
    except (StopIteration, KeyboardInterrupt, MemoryError, SystemExit):
        raise
    except BaseException as error:  # a panic of the library's Rust is no Exception
        raise DataError(path, f"cannot be read: {_line(error)}", AGAIN) from error


def _line(error: BaseException) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _decoded(path: Path, kind: str, chunk: int) -> Iterator[Events]:
    """The events, packet by packet, gathered to chunks; where the file is broken, those before, with a warning."""
    packets = iter(_opened(_faery(path), path, kind))
    parts: list[np.ndarray] = []
    waiting = seen = 0
    while True:
        try:
            packet = _guarded(lambda: next(packets), path)
        except StopIteration:
            break
        except DataError as error:
            if not seen:
                raise
            tell(DataWarning(f"{path}: is read up to event {seen}, and broken from there on: {error.problem}"))
            break
        parts.append(packet)
        waiting, seen = waiting + len(packet), seen + len(packet)
        if waiting >= chunk:
            yield _events(path, np.concatenate(parts), seen - waiting)
            parts, waiting = [], 0
    if waiting:
        yield _events(path, np.concatenate(parts), seen - waiting)


def _events(path: Path, packet: np.ndarray, before: int) -> Events:
    """faery's packed records (t u8, x u2, y u2, on bool) as columns."""
    if (wrong := packet["t"] >= LATEST).any():
        i = int(wrong.argmax())
        raise DataError(path, f"{packet['t'][i]} us is no time", AGAIN, f"event {before + i + 1}")
    x, y = (np.ascontiguousarray(packet[name]) for name in ("x", "y"))
    return Events(packet["t"].astype(np.int64), x, y, packet["on"].astype(np.uint8))
