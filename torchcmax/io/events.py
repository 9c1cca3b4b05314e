"""Events as a sensor gives them, and windows of them as small integers, which become rays on the device that wants them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from torchcmax.core.window import Window

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

    def __getitem__(self, index: int | slice | np.ndarray) -> Events:
        return Events(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def join(cls, parts: list[Events]) -> Events:
        """One after the other."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def strided(self, events: int, stride: int) -> Events:
        """All windows of `events` events, each `stride` after the last, [B, events]; nothing is copied."""
        return Events(*(sliding_window_view(getattr(self, f.name), events)[::stride] for f in fields(self)))


@dataclass(frozen=True)
class Packed:
    """B windows of N events in 9 bytes an event, for the way to a device.

    pixel [B, N] int32, row * width + column | offset [B, N] µs since the window's first event, int32, or int64 where a window is
    longer than that holds (36 minutes) | polarity [B, N] int8, -1 or +1 | start [B] int64 µs
    """

    pixel: Tensor
    offset: Tensor
    polarity: Tensor
    start: Tensor

    @classmethod
    def of(cls, block: Events, size: tuple[int, int], pinned: bool = False) -> Packed:
        """block [B, N], in order of time | size (H, W) px of the sensor | pinned: in memory that a GPU reads by itself.

        ValueError where an event is not on the sensor.
        """
        x, y = int(block.x.max()), int(block.y.max())
        if x >= size[1] or y >= size[0]:
            raise ValueError(f"events up to pixel ({x}, {y}) are not on the sensor of {size[1]} x {size[0]}")
        first = block.t[:, :1]
        short = int((block.t[:, -1:] - first).max()) <= np.iinfo(np.int32).max

        def empty(kind: torch.dtype) -> Tensor:
            return torch.empty(block.t.shape, dtype=kind, device="cpu", pin_memory=pinned)

        start = torch.from_numpy(first[:, 0].copy())
        made = cls(empty(torch.int32), empty(torch.int32 if short else torch.int64), empty(torch.int8), start)
        pixel, offset, polarity = made.pixel.numpy(), made.offset.numpy(), made.polarity.numpy()
        np.multiply(block.y, size[1], out=pixel, dtype=np.int32)
        np.add(pixel, block.x, out=pixel)
        np.subtract(block.t, first, out=offset, casting="unsafe")  # it fits, see `short`
        np.multiply(block.p > 0, 2, out=polarity, dtype=np.int8)
        np.subtract(polarity, 1, out=polarity)
        return made

    def window(self, table: Tensor) -> Window:
        """The windows as rays, on the device of table [H * W, 3] float32, the ray of every pixel: -> Window [B, N] float32."""
        pixel, offset, polarity, start = (getattr(self, f.name).to(table.device, non_blocking=True) for f in fields(self))
        ray = table.index_select(0, pixel.view(-1)).view(*pixel.shape, 3)
        dt = offset.to(torch.float32) / 1e6
        return Window(ray, dt, polarity.to(torch.float32), start, dt[:, -1])
