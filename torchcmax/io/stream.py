"""A stream: consecutive windows of a recording, whose size whoever takes them decides each time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator
from time import perf_counter
from typing import TYPE_CHECKING, Self

import numpy as np
import torch

from torchcmax.core.window import Window
from torchcmax.io.ahead import ahead
from torchcmax.io.errors import DataError
from torchcmax.io.events import Events, Packed

if TYPE_CHECKING:
    from torchcmax.io.recording import Recording

FAR = 3e12  # s: beyond every event (LATEST), and twice that many µs still fit into int64


class Stream:
    """What `Recording.stream` returns: the events from start to end, window after window, none lost and none twice.

    Nothing is read before it is asked for; then a thread reads the next chunk while the caller works.  Memory is that of a few
    chunks, or of the largest window.  After `close`, or an error, there is nothing more to take: ValueError.

    consumed: events handed out so far | waited: seconds spent waiting for the reader.
    """

    def __init__(
        self, recording: Recording, start: float | None = None, end: float | None = None, device: torch.device | str = "cpu"
    ) -> None:
        """See `Recording.stream`."""
        first, last = -math.inf if start is None else start, math.inf if end is None else end
        if math.isnan(first) or math.isnan(last) or _micro(first) >= _micro(last):
            remedy = "give a start before the end, both in seconds of the recording's own clock, as `torchcmax info` shows it"
            raise DataError(recording.path, f"from {first} s to {last} s is no stretch of time", remedy)
        self.consumed, self.waited = 0, 0.0
        self._recording, self._end, self._device = recording, last, torch.device(device)
        self._table = recording.camera.rays().view(-1, 3).to(self._device, torch.float32)
        self._pieces = ahead(_between(recording, _micro(first), _micro(last)))
        self._parts: deque[Events] = deque()  # read and not yet taken; each has an event
        self._first: int | None = None  # µs of the first event after the start
        self._last = 0  # µs of the last event handed out
        self._before = 0  # events before the start
        self._ended = self._closed = False

    def take(self, events: int, seconds: float) -> Window | None:
        """The next window, and goes past it: see `look`."""
        window = self.look(events, seconds)
        if window is not None:
            self.skip(window.ray.shape[1])
        return window

    def look(self, events: int, seconds: float) -> Window | None:
        """The next window: at most `events` events, all within `seconds` (to the nearest µs) of its first.

        -> Window [1, N] float32 on the device, 2 <= N <= events: a window has a second event also where that comes later than
        `seconds`.  None where fewer than 2 events are left, so that a single last event is never handed out.
        """
        if events < 2 or not seconds > 0:
            raise ValueError(f"a window wants at least 2 events and more than 0 seconds, got {events}, {seconds}")
        span = _micro(seconds)
        part = self._front(events, span)
        if len(part) < 2:
            return None
        count = max(int(np.searchsorted(part.t, int(part.t[0]) + span, "right")), 2)
        row = Events(part.t[None, :count], part.x[None, :count], part.y[None, :count], part.p[None, :count])
        return Packed.of(row, self._recording.camera.size, self._device.type == "cuda").window(self._table)

    @property
    def position(self) -> int | None:
        """µs of the next event, None at the end.  Reads where nothing is in hand."""
        front = self._front(1, 0)
        return int(front.t[0]) if len(front) else None

    @property
    def share(self) -> float | None:
        """How much is done, 0 to 1: in time where there is an end, in events where their number is known, whichever says more.

        None where nothing tells: no end, and a file that does not say how many events it holds.  Never reads.
        """
        if self._ended and sum(map(len, self._parts)) < 2:
            return 1.0
        if not self.consumed or self._first is None:
            return 0.0
        known = []
        if self._recording.count is not None:
            known.append(self.consumed / max(self._recording.count - self._before, 1))
        if self._end < FAR:
            known.append((self._last - self._first) / (_micro(self._end) - self._first))
        return min(max(known), 1.0) if known else None

    def close(self) -> None:
        """Ends the thread, after the chunk that it is just reading, and closes the file."""
        self._ended = self._ended and sum(map(len, self._parts)) < 2  # what is dropped here was not done
        self._closed = True
        self._parts.clear()
        self._pieces.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _front(self, events: int, span: int) -> Events:
        """The next `events` events, or fewer, of which the second is there and the last is more than `span` µs after the first.

        Reads where these are not in hand, and copies only where they lie in several chunks; fewer still at the end of all.
        """
        if self._closed:
            raise ValueError("the stream is closed")
        parts: list[Events] = []
        count = 0
        while count < events and (count < 2 or int(parts[-1].t[-1]) - int(parts[0].t[0]) <= span):
            if len(parts) == len(self._parts) and not self._read():
                break
            parts.append(self._parts[len(parts)][: events - count])
            count += len(parts[-1])
        return parts[0] if len(parts) == 1 else Events.join(parts or [_nothing()])

    def skip(self, events: int) -> None:
        """Goes past so many events of those that were last looked at; ValueError where there are not as many."""
        count = events
        if not 1 <= count <= sum(map(len, self._parts)):
            raise ValueError(f"only events that were looked at can be skipped, {sum(map(len, self._parts))} at most, got {count}")
        self.consumed += count
        while len(self._parts[0]) < count:
            count -= len(self._parts.popleft())
        self._last = int(self._parts[0].t[count - 1])
        rest = self._parts.popleft()[count:]
        if len(rest):
            self._parts.appendleft(rest)

    def _read(self) -> bool:
        """Takes the next events from the reader in hand, unless there are no more."""
        begin = perf_counter()
        try:
            for before, piece in self._pieces:
                self._before += before
                if len(piece):
                    self._first = int(piece.t[0]) if self._first is None else self._first
                    self._parts.append(piece)
                    return True
        except BaseException:
            self.close()  # what comes after is lost: never take it for the end
            raise
        finally:
            self.waited += perf_counter() - begin
        self._ended = True
        return False


def _micro(seconds: float) -> int:
    """The nearest µs; 0.1 + 0.2 s are 300,000."""
    return round(min(max(seconds, -FAR), FAR) * 1e6)


def _nothing() -> Events:
    return Events(*(np.empty(0, dtype) for dtype in ("i8", "u2", "u2", "u1")))


def _between(recording: Recording, start: int, end: int) -> Generator[tuple[int, Events], None, None]:
    """Chunk by chunk: how many events come before the start, and those from start to end, µs; after the end nothing is read.

    A chunk with none of them is handed on too, so that closing never waits for more than one chunk.
    """
    first = last = None
    before, chunks = recording.since(start)
    if before:
        yield before, _nothing()
    for chunk in chunks:
        if not len(chunk):
            continue
        last = int(chunk.t[-1])
        if first is None:
            first = int(chunk.t[0])
            if end <= first and not before:
                remedy = (
                    f"its clock begins at {first * 1e-6:.6f} s, `torchcmax info` tells where it stops: give an end after the first event"
                )
                raise DataError(recording.path, f"has no event before the end at {end * 1e-6:.6f} s", remedy)
        low, high = (int(i) for i in np.searchsorted(chunk.t, np.array([start, end])))
        yield low, chunk[low:high]
        if high < len(chunk):
            return
    if not before and last is None:
        raise DataError(recording.path, "holds no events", "record or copy it again")
    if last is None or last < start:
        clock = "" if before or first is None or last is None else f"its clock runs from {first * 1e-6:.6f} s to {last * 1e-6:.6f} s: "
        remedy = f"{clock}give a start before the last event"
        raise DataError(recording.path, f"has no event from the start at {start * 1e-6:.6f} s on", remedy)
