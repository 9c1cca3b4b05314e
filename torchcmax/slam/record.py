"""What is told and kept of each window: its track, and where it belongs."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import nan
from typing import Literal

from torch import Tensor

from torchcmax.core.plane import Plane
from torchcmax.core.state import State
from torchcmax.core.window import Window
from torchcmax.slam.tracker import World

Status = Literal["start", "ok", "weak", "still", "lost"]
FEW, UNSURE, NOISE, ALONG, GAP = "few edges met", "unsure where", "only noise", "looks along the plane", "no events for long"  # reasons


@dataclass(frozen=True)
class Signs:
    """What tells whether a window can be trusted; nan where it was not asked.

    supported: share of its events that have a neighbour, beyond chance | overlap: share of the view that the map knows for this motion
    strength: of the edges that its events meet, 0..1 | doubt: px that the image may be off, one sigma
    weakest: the direction of motion that its events decide least, and share: how much, 0 where only the prediction speaks
    """

    supported: float
    overlap: float = nan
    strength: float = nan
    doubt: float = nan
    weakest: str = ""
    share: float = nan


@dataclass(frozen=True)
class Track:
    """What became of one window.

    recording, index: which it is | window [1, N] | time µs of its middle | state [1] there, in the world of `map`; of a lost camera
    where it was last | normal [1, 3] of the plane, in the camera's frame, nan where there is none | contrast_zero, contrast: at rest
    and with its motion | status, and the reason where it is not ok | keyframe: the one its pose hangs on, -1 where it is lost
    drawn: whether it became that keyframe | map: as it is now, and goes on changing; of a lost camera the one that it was on last
    """

    recording: int
    index: int
    window: Window
    time: int
    state: State
    normal: Tensor
    contrast_zero: float
    contrast: float
    signs: Signs
    status: Status
    reason: str
    evaluations: int
    converged: bool
    keyframe: int
    drawn: bool
    map: World

    @property
    def overlap(self) -> float:
        """Share of the view that the map knows."""
        return self.signs.overlap

    @property
    def strength(self) -> float:
        """Of the edges that its events meet, 0..1."""
        return self.signs.strength


@dataclass(eq=False)
class Site:
    """A map on its way: the plane it began with, what is usual there, and keyframes since the last joint optimization and in all."""

    map: World
    start: Plane
    usual: deque[float]
    fresh: int = 0
    new: int = 0


@dataclass(eq=False)
class Placement:
    """Where a window belongs.  time µs | status | site: the map, None where it is lost | keyframe, and state [1] in its frame"""

    time: int
    status: Status
    site: Site | None = None
    keyframe: int = -1
    state: State | None = None

    def hang(self, site: Site, keyframe: int, state: State, status: Status) -> None:
        """On a keyframe of a map, in a state [1] of its world."""
        self.site, self.keyframe, self.status = site, keyframe, status
        self.state = State(site.map.keyframes[keyframe].state.pose.inverse() @ state.pose, state.motion)

    def lose(self) -> None:
        """It belongs nowhere."""
        self.site, self.keyframe, self.state, self.status = None, -1, None, "lost"

    def there(self) -> State:
        """[1], as its keyframe is now; ValueError where it is lost."""
        if self.site is None or self.state is None:
            raise ValueError("a lost camera is nowhere")
        return State(self.site.map.keyframes[self.keyframe].state.pose @ self.state.pose, self.state.motion)
