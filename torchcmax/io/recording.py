"""A recording: events in chunks from a file, its camera, and ground truth where there is some."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.core.window import Window
from torchcmax.io.errors import DataError
from torchcmax.io.events import Events, Packed
from torchcmax.io.stream import Stream


@dataclass(frozen=True)
class Recording:
    """What `open` returns.  Events are read from the file each time they are asked for, chunk by chunk, never all at once.

    truth is T_wc in metres, plane (normal [1, 3], distance [1] m) in the same world; either may be missing.
    count is the number of events, None where only reading the whole file would tell.
    guessed: the sensor's size comes from the events alone, as nothing else told it.
    later: what `since` asks; None: all events are read.
    pieces: from event, to event -> those events as they stand in a file that can be read anywhere, neither checked nor sorted.
    """

    path: Path
    name: str
    camera: Camera
    chunks: Callable[[], Iterator[Events]]
    count: int | None = None
    truth: Trajectory | None = None
    plane: Plane | None = None
    guessed: bool = False
    later: Callable[[int], tuple[int, Iterator[Events]]] | None = None
    pieces: Callable[[int, int], Events] | None = None

    def since(self, time: int) -> tuple[int, Iterator[Events]]:
        """How many events are left out, all before a time, µs, and the rest in chunks: quick where the file has an index by time."""
        return (0, self.chunks()) if self.later is None else self.later(time)

    def windows(
        self, events: int, stride: int | None = None, batch: int = 1, device: torch.device | str = "cpu"
    ) -> Generator[Window, None, None]:
        """Windows of `events` events, each `stride` events after the last (default: end to end), `batch` at a time.

        -> Window [B, N] float32 on the device, B <= batch.  What is left at the end and fills no window is not used.
        """
        stride, device = events if stride is None else stride, torch.device(device)
        if events < 2 or stride < 1 or batch < 1:
            raise ValueError(f"a window wants at least 2 events, a stride and batch of at least 1, got {events}, {stride}, {batch}")
        table = self.camera.rays().view(-1, 3).to(device, torch.float32)
        for block in self.blocks(events, stride, batch):
            yield Packed.of(block, self.camera.size, device.type == "cuda").window(table)

    def stream(self, start: float | None = None, end: float | None = None, device: torch.device | str = "cpu") -> Stream:
        """Consecutive windows of a size that is decided each time, of the events from start (inclusive) to end (exclusive).

        start, end: seconds of the recording's own clock, to the nearest µs; None: from the first event, to the last.  DataError where
        that is no stretch of time; where it lies outside the recording, the first `take` says so.
        """
        return Stream(self, start, end, device)

    def blocks(self, events: int, stride: int, batch: int) -> Iterator[Events]:
        """The events of `batch` windows at a time, [batch, events]; fewer windows only at the end."""
        parts: list[Events] = []
        waiting = skip = seen = 0
        span, found = events + (batch - 1) * stride, False
        for chunk in self.chunks():
            seen += len(chunk)
            if len(chunk) > skip:
                parts.append(chunk[skip:])
                waiting += len(parts[-1])
            skip = max(skip - len(chunk), 0)
            if waiting < span:
                continue
            kept = Events.join(parts)
            while len(kept) >= span:
                yield kept[:span].strided(events, stride)
                found = True
                skip = max(batch * stride - len(kept), 0)  # a stride beyond the window leaves events out
                kept = kept[batch * stride :]
            parts, waiting = [kept], len(kept)
        kept = Events.join(parts) if parts else Events(*(np.empty(0, dtype) for dtype in ("i8", "u2", "u2", "u1")))
        if len(kept) >= events:
            yield kept.strided(events, stride)
        elif not found:
            remedy = f"take smaller windows: --events {seen}" if seen > 1 else "record or copy it again"
            raise DataError(self.path, f"holds {seen} events, fewer than one window of {events}", remedy)
