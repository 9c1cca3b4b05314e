"""A recording: events in chunks from a file, its camera, and ground truth where there is some."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.core.window import Window
from torchcmax.io.errors import DataError

LATEST = 1 << 61  # µs before or after zero: the difference of two times fits into int64


@dataclass(frozen=True)
class Events:
    """t [M] int64 µs, within LATEST | x, y [M] uint16 px (column, row) | p [M] uint8, 1 = brighter (ON), 0 = darker (OFF)."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, index: slice | np.ndarray) -> Events:
        return Events(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def join(cls, parts: list[Events]) -> Events:
        """One after the other."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


@dataclass(frozen=True)
class Recording:
    """What `open` returns.  Events are read from the file each time they are asked for, chunk by chunk, never all at once.

    truth is T_wc in metres, plane (normal [1, 3], distance [1] m) in the same world; either may be missing.
    count is the number of events, None where only reading the whole file would tell.
    guessed: the sensor's size comes from the events alone, as nothing else told it.
    """

    path: Path
    name: str
    camera: Camera
    chunks: Callable[[], Iterator[Events]]
    count: int | None = None
    truth: Trajectory | None = None
    plane: Plane | None = None
    guessed: bool = False

    def windows(self, events: int, stride: int | None = None, batch: int = 1) -> Iterator[Window]:
        """Windows of `events` events, each `stride` events after the last (default: end to end), `batch` at a time.

        -> Window [B, N] float32 on the CPU, B <= batch.  What is left at the end and fills no window is not used.
        """
        stride = events if stride is None else stride
        if events < 2 or stride < 1 or batch < 1:
            raise ValueError(f"a window wants at least 2 events, a stride and batch of at least 1, got {events}, {stride}, {batch}")
        table = self.camera.rays().float().numpy()
        kept, skip, starts, seen = Events(*(np.empty(0, dtype) for dtype in ("i8", "u2", "u2", "u1"))), 0, 0, 0
        span = events + (batch - 1) * stride
        for chunk in self.chunks():
            seen += len(chunk)
            kept = Events.join([kept, chunk[skip:]]) if len(chunk) > skip else kept
            skip = max(skip - len(chunk), 0)
            while len(kept) >= span:
                yield _stack(kept, events, stride, batch, table)
                starts += batch
                skip = max(batch * stride - len(kept), 0)  # a stride beyond the window leaves events out
                kept = kept[batch * stride :]
        rest = (len(kept) - events) // stride + 1 if len(kept) >= events else 0
        if rest:
            yield _stack(kept, events, stride, rest, table)
        elif not starts:
            remedy = f"take smaller windows: --events {seen}" if seen > 1 else "record or copy it again"
            raise DataError(self.path, f"holds {seen} events, fewer than one window of {events}", remedy)


def _stack(block: Events, events: int, stride: int, batch: int, table: np.ndarray) -> Window:
    """The first `batch` windows of a block of events as tensors."""
    index = np.arange(batch)[:, None] * stride + np.arange(events)
    t = block.t[index]
    dt = torch.from_numpy((t - t[:, :1]) * 1e-6).float()
    polarity = torch.from_numpy(np.where(block.p[index] > 0, np.float32(1), np.float32(-1)))
    ray = torch.from_numpy(table[block.y[index], block.x[index]])
    return Window(ray, dt, polarity, torch.from_numpy(t[:, 0].copy()), dt[:, -1])
