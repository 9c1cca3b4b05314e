"""Windows of events: B stretches of N events each, as rays, ready to be warped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn.functional import pad


@dataclass(frozen=True)
class Window:
    """B windows of N events each; shorter ones are padded at their end with polarity 0.

    ray [B, N, 3] (x, y, 1), undistorted | dt [B, N] s since the window's first event | polarity [B, N] in -1, 0, +1
    start [B] int64 µs | duration [B] s, from the first to the last event
    """

    ray: Tensor
    dt: Tensor
    polarity: Tensor
    start: Tensor
    duration: Tensor

    def __len__(self) -> int:
        return len(self.ray)

    @property
    def weight(self) -> Tensor:
        """1 for an event, 0 for padding: [B, N]."""
        return self.polarity.abs()

    @property
    def phase(self) -> Tensor:
        """Time within the window, 0 at its first event and 1 at its last: [B, N]."""
        return self.dt / torch.where(self.duration > 0, self.duration, 1.0)[:, None]

    @property
    def middle(self) -> Tensor:
        """Its time, half way from the first to the last event: [B] int64 µs."""
        return self.start + (self.duration.double() * 5e5).round().long()

    def __getitem__(self, index: Tensor | slice) -> Window:
        return Window(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def join(cls, parts: Sequence[Window]) -> Window:
        """Windows of different lengths together, the shorter ones padded."""
        longest = max(part.ray.shape[1] for part in parts)
        if len(parts) == 1:
            return parts[0]
        spare = [longest - part.ray.shape[1] for part in parts]
        return cls(
            torch.cat([torch.cat([p.ray, p.ray[:, -1:].expand(-1, n, -1)], 1) for p, n in zip(parts, spare, strict=True)]),
            torch.cat([torch.cat([p.dt, p.dt[:, -1:].expand(-1, n)], 1) for p, n in zip(parts, spare, strict=True)]),
            torch.cat([pad(p.polarity, (0, n)) for p, n in zip(parts, spare, strict=True)]),
            torch.cat([p.start for p in parts]),
            torch.cat([p.duration for p in parts]),
        )

    def thinned(self, step: int) -> Window:
        """Every step-th event of each window; start and duration stay those of the whole."""
        return Window(self.ray[:, ::step], self.dt[:, ::step], self.polarity[:, ::step], self.start, self.duration)

    def to(self, device: torch.device | str, dtype: torch.dtype) -> Window:
        """The same windows elsewhere, or in another precision; start stays int64."""
        moved = (getattr(self, f.name).to(device=device) for f in fields(self))
        return Window(*(x if x.dtype == torch.int64 else x.to(dtype) for x in moved))
