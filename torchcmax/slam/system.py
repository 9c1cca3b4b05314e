"""Tracking and mapping as a whole: recordings in, one track for each window out; several recordings side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.pose import Trajectory
from torchcmax.core.window import Window
from torchcmax.slam.options import Panorama, Slam
from torchcmax.slam.panorama import PanoramaRun
from torchcmax.slam.record import Placement, Site, Status, Track
from torchcmax.slam.run import Run, TooShort
from torchcmax.slam.tracker import Belief, Sight, Step, World, step
from torchcmax.slam.windows import Seen, Source

__all__ = ["Panorama", "Placement", "Slam", "Source", "Status", "System", "TooShort", "Track"]
_Task = tuple[Run, Site, Seen, Belief, Sight]
SAME = 1e-6  # share by which the focal length of a map and of the camera before it may differ


class System:
    """Cameras before their planes.  All of one batch have the same sensor; each is tracked as it would be alone."""

    def __init__(self, cameras: Sequence[Camera], options: Slam | Panorama | None = None, maps: Sequence[World] | None = None) -> None:
        """maps: tracked against, and left as they are; None: each camera makes its own."""
        self.options: Slam | Panorama = options or Slam()
        self.canvas = Canvas.around(cameras[0], self.options.tracking.search.margin)
        if any(Canvas.around(camera, self.options.tracking.search.margin) != self.canvas for camera in cameras):
            raise ValueError("recordings of one batch want the same sensor and focal length; track others in a batch of their own")
        if maps is not None and len(maps) != len(cameras):
            raise ValueError(f"{len(cameras)} cameras want as many maps, got {len(maps)}")
        for m in maps or ():
            if abs(m.focal - self.canvas.focal) > SAME * m.focal:
                raise ValueError(f"the map wants the sensor that drew it: focal length {m.focal:.2f} px, not {self.canvas.focal:.2f} px")
            if not m.keyframes:
                raise ValueError("the given map has no keyframe from which its plane could be seen")
        given: Sequence[World | None] = maps or [None] * len(cameras)
        kind = PanoramaRun if isinstance(self.options, Panorama) else Run
        self.runs = [kind(i, camera, self.canvas, self.options, m) for i, (camera, m) in enumerate(zip(cameras, given, strict=True))]

    @property
    def maps(self) -> list[World]:
        """The main one of each recording; ValueError before its first plane."""
        return [run.map for run in self.runs]

    def atlas(self, recording: int = 0) -> list[World]:
        """All maps of a recording that were not joined, the main one first."""
        return [site.map for site in self.runs[recording].sites]

    def trajectory(self, recording: int = 0) -> Trajectory:
        """Poses at the middles of the windows that belong to the main map, as the keyframes that they hang on are now."""
        return self.runs[recording].trajectory()

    def placements(self, recording: int = 0) -> list[Placement]:
        """Where each window belongs, as is known now: one for each track."""
        return self.runs[recording].placements

    def run(self, sources: Sequence[Source]) -> Iterator[Track]:
        """The windows of every recording, side by side, to the end of the longest; then all keyframes are optimized once more."""
        for run, source in zip(self.runs, sources, strict=True):
            run.begin(source)
        while turn := [(run, seen) for run in self.runs if (seen := run.next()) is not None]:
            tasks: list[_Task] = []
            for run, seen in turn:
                if seen.gap and run.site is not None:
                    run.lose()
                if (site := run.site) is None:
                    yield from run.wander(seen)
                elif seen.noise:
                    yield run.hold(site, seen)
                elif (sight := run.sight(site, seen.window, before := run.predicted(seen.window))) is None:
                    yield from run.blind(seen)
                else:
                    tasks.append((run, site, seen, before, sight))
            if tasks:
                found = self._step(tasks)
                for i, (run, site, seen, _, _) in enumerate(tasks):
                    yield from run.follow(site, seen, found, i)
        for run in self.runs:
            yield from run.finish()

    def _step(self, tasks: Sequence[_Task]) -> Step:
        _, _, seen, before, sights = zip(*tasks, strict=True)
        windows = Window.join([one.window for one in seen])
        return step(windows, self.canvas, Belief.join(before), sights, self.options.tracking, self.options.model)
