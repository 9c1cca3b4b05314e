"""Track a recording: its events through the system, from a moment to a moment, against a map of its own or a saved one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace

import torch

from torchcmax.core.camera import Camera
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.core.window import Window
from torchcmax.io import DataError, Recording
from torchcmax.mapfile import load_map
from torchcmax.slam.globe import Globe
from torchcmax.slam.system import Panorama, Placement, Slam, System, Track
from torchcmax.slam.tracker import World


@dataclass(frozen=True)
class TrackOptions:
    """Which part of a recording is tracked, where, and in which units its positions are told."""

    slam: Slam | Panorama = field(default_factory=Slam)
    """How it is tracked and mapped."""
    begin: float | None = None
    """Seconds of the recording's clock to start from; default: the first event."""
    end: float | None = None
    """Seconds of the recording's clock to stop before; default: the last event."""
    distance: float | None = None
    """Metres from the plane to the camera at the first event: trajectory.txt is then in metres, else in this distance. With --map: at
    the first event of the recording that the map was drawn from."""
    map: str | None = None
    """A map.h5, or of a panorama the panorama.h5, of an earlier run: it is tracked against and not changed; default: the map is made on
    the way."""
    device: str = "cpu"
    """cpu, cuda, or cuda:1 and so on."""

    def __post_init__(self) -> None:
        if self.distance is not None and not 0 < self.distance < math.inf:
            raise ValueError(f"--distance wants metres above 0, got {self.distance}")
        for name, value in (("from", self.begin), ("to", self.end)):
            if value is not None and not math.isfinite(value):
                raise ValueError(f"--{name} wants seconds of the recording's clock, got {value}")
        if self.begin is not None and self.end is not None and self.begin >= self.end:
            raise ValueError(f"--from must come before --to, got {self.begin} and {self.end}")


class Tracks:
    """The tracks of a recording, to go through once, and afterwards what became of it all."""

    def __init__(self, recording: Recording, options: TrackOptions) -> None:
        """Nothing is read before the first track is asked for, but for the saved map."""
        self.recording, self.options = recording, options
        saved = None if options.map is None else [_saved(options)]
        try:
            self.system = System([recording.camera], options.slam, saved)
        except ValueError as error:
            if options.map is None:
                raise
            raise DataError(options.map, f"cannot be tracked against: {error}", "give a map that this camera drew") from error
        self.stream = recording.stream(options.begin, options.end, options.device)

    def __iter__(self) -> Iterator[Track]:
        """One track for each window, in the order of the recording; at the end all keyframes are optimized once more."""
        begun = False
        with self.stream:
            try:
                for track in self.system.run([self.stream]):
                    begun = True
                    yield track
            except ValueError as error:
                if begun:
                    raise
                remedy = "give a longer stretch between --from and --to, or an earlier --from"
                raise DataError(self.recording.path, f"cannot be tracked: {error}", remedy) from error

    @property
    def map(self) -> World:
        """As it is now; ValueError before the first plane is found."""
        return self.system.maps[0]

    @property
    def atlas(self) -> list[World]:
        """All maps that were not joined, the main one first."""
        return self.system.atlas(0)

    @property
    def placements(self) -> list[Placement]:
        """Where each window belongs, as is known now, one for each track."""
        return self.system.placements(0)

    @property
    def losses(self) -> int:
        """How often the camera was lost."""
        return self.system.runs[0].losses

    @property
    def recoveries(self) -> int:
        """How often it was found again in the map."""
        return self.system.runs[0].recoveries

    @property
    def joins(self) -> int:
        """How many maps, begun while it was lost, became part of the main one."""
        return self.system.runs[0].joins

    @property
    def unit(self) -> float:
        """What positions are to be multiplied with to be in metres, or, where no distance is given, 1."""
        return 1.0 if self.options.distance is None else self.options.distance

    def trajectory(self) -> Trajectory:
        """Poses T_wc at the middles of the windows so far that belong to the main map, as they are now, in plane distances: float64.

        ValueError where there are fewer than two.
        """
        return self.system.trajectory(0)


def track(recording: Recording, options: TrackOptions | None = None) -> Tracks:
    """Follow the camera of a recording through the plane that it sees.  Options default to those of the command line."""
    return Tracks(recording, options or TrackOptions())


def _saved(options: TrackOptions) -> World:
    """The map to track against, of the kind that the camera wants."""
    assert options.map is not None
    found, turns = load_map(options.map), isinstance(options.slam, Panorama)
    if isinstance(found, Globe) != turns:
        kind, other = ("map of a plane", "track") if turns else ("panorama", "panorama")
        raise DataError(options.map, f"is a {kind}", f"go on with it by `torchcmax {other} --map`")
    return found


def in_metres(trajectory: Trajectory, unit: float) -> Trajectory:
    """Positions times a unit."""
    return Trajectory(trajectory.time, Pose(trajectory.pose.R, trajectory.pose.t * unit))


class _Dots:
    """Windows of dots on a wall that the camera moves along: enough for a system to run."""

    def __init__(self, camera: Camera, device: str) -> None:
        random, count = torch.Generator().manual_seed(0), 4000
        self.dots = torch.rand(40, 2, generator=random) * 2 - 0.5  # plane distances
        time, which = torch.arange(count) * 1e-4, torch.randint(0, 40, (count,), generator=random)
        xy = self.dots[which] - torch.stack([0.8 * time, 0.5 * time], 1)
        low, high = camera.rays()[0, 0, :2].float(), camera.rays()[-1, -1, :2].float()
        keep = ((xy > low) & (xy < high)).all(1)
        self.ray = torch.cat([xy, torch.ones(count, 1)], 1)[keep].to(device)
        self.time, self.done = time[keep].to(device), 0

    def look(self, events: int, seconds: float) -> Window | None:
        """As `Source`."""
        last = min(self.done + min(events, 150), len(self.time))
        if last - self.done < 150:
            return None
        part, time = slice(self.done, last), self.time[self.done : last]
        start = (time[:1] * 1e6).long()
        return Window(self.ray[None, part], (time - time[0])[None], torch.ones_like(time)[None], start, time[-1:] - time[:1])

    def skip(self, events: int) -> None:
        """As `Source`."""
        self.done += events


def load_kernels(slam: Slam | Panorama, device: str = "cpu") -> None:
    """Track a few windows of dots: what is compiled, or loaded, for this device is there afterwards, and later times are of work."""
    camera = Camera.pinhole((32, 40))
    with suppress(ValueError):  # options that want more than a few dots: they are told of, if they must, on the recording
        brief = replace(slam, mapping=replace(slam.mapping, first=2))  # type: ignore[arg-type]  # of its own kind
        for _ in System([camera], brief).run([_Dots(camera, device)]):
            pass
