"""The windows of a recording, each as long as the image takes to move by what is wanted, and whether they hold more than noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.state import State
from torchcmax.core.window import Window
from torchcmax.slam.options import Panorama, Slam
from torchcmax.slam.sense import beyond_chance, support
from torchcmax.slam.tracker import speed


class Source(Protocol):
    """Consecutive windows of a recording, whose size the caller decides: as io.Stream."""

    def look(self, events: int, seconds: float) -> Window | None:
        """The next window, without going past it; None at the end."""

    def skip(self, events: int) -> None:
        """Goes past the first events of what was last looked at."""


@dataclass(frozen=True)
class Seen:
    """A window with what is known of it before it is tracked: how supported its events are, whether it is noise, or comes after a gap."""

    window: Window
    supported: float
    noise: bool
    gap: bool

    @property
    def time(self) -> int:
        """µs of its middle."""
        return int(self.window.middle[0])


class Windows:
    """The windows of one source, one after the other."""

    def __init__(self, source: Source, camera: Camera, options: Slam | Panorama, rays: Tensor, focal: float) -> None:
        """rays [M, 3]: a grid over the sensor, by which the speed of the image is told | focal: of these, px"""
        self.source, self.camera, self.tracking, self.sensing = source, camera, options.tracking, options.sensing
        self.rays, self.focal = rays, focal
        self.ended: int | None = None  # µs of the last window's end

    def longest(self) -> Seen | None:
        """The longest that the next window can be, without going past it; None at the end."""
        return self._seen(self.source.look(self.tracking.most, self.tracking.seconds))

    def sized(self, state: State, plane: Plane) -> Seen | None:
        """The next window of a camera [1] that moves so before a plane [1], without going past it; None at the end."""
        how = self.tracking
        seconds = min(how.seconds, how.displacement / max(speed(state, plane, self.rays, self.focal), 1e-6))
        found = self.source.look(how.most, seconds)
        if found is not None and found.ray.shape[1] < how.fewest and seconds < how.seconds:
            found = self.source.look(how.fewest, how.seconds)
        return self._seen(found)

    def past(self, seen: Seen | None) -> Seen | None:
        """Goes past a window that was seen, and gives it back."""
        if seen is not None:
            self.source.skip(seen.window.ray.shape[1])
            self.ended = int(seen.window.start[0]) + round(float(seen.window.duration[0]) * 1e6)
        return seen

    def _seen(self, window: Window | None) -> Seen | None:
        if window is None:
            return None
        beyond = beyond_chance(*support(window, self.camera, self.sensing))
        gap = self.ended is not None and (int(window.start[0]) - self.ended) * 1e-6 > self.sensing.patience
        return Seen(window, beyond, self.sensing.still and beyond < self.sensing.noise, gap)
