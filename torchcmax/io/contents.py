"""What a reader of any format hands over: the events as they stand in a file, and what the file says beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.io.calibration import Lens
from torchcmax.io.events import Events


@dataclass(frozen=True)
class Contents:
    """events: chunk -> the events as they stand in the file, about so many at a time, each time from the start

    place: event, counted from 0 -> where it stands, in words | count: None where only reading all would tell
    name: of the recording; empty: as its path | own: a file of ours | sensor: (width, height) px as the file says, not checked
    since: µs, chunk -> how many events are left out at the beginning, all before that time, and the rest; of a file with an index
    pieces: of a file that can be read anywhere: from event, to event -> those events as they stand there; each process opens its own file
    """

    events: Callable[[int], Iterator[Events]]
    place: Callable[[int], str]
    count: int | None = None
    name: str = ""
    own: bool = False
    sensor: tuple[Any, Any] | None = None
    lens: Lens | None = None
    truth: Trajectory | None = None
    plane: Plane | None = None
    since: Callable[[int, int], tuple[int, Iterator[Events]]] | None = None
    pieces: Callable[[int, int], Events] | None = None
