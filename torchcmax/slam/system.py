"""Tracking and mapping as a whole: recordings in, one track for each window out; several recordings side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.core.window import Window
from torchcmax.slam.options import Panorama, Slam
from torchcmax.slam.panorama import PanoramaRun
from torchcmax.slam.record import Placement, Site, Status, Track
from torchcmax.slam.run import Run, TooShort
from torchcmax.slam.tracker import Belief, World, front, step
from torchcmax.slam.windows import Seen, Source

__all__ = ["Panorama", "Placement", "Slam", "Source", "Status", "System", "TooShort", "Track"]
_Task = tuple[Run, Site, Seen, Belief]
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
                raise ValueError("the given map has no keyframe, and nothing of it could be seen")
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
        with ThreadPoolExecutor(1, "torchcmax-sight") as beside:
            while turn := [(run, seen) for run in self.runs if (seen := run.next()) is not None]:
                tasks: list[_Task] = []
                for run, seen in turn:
                    if seen.gap and run.site is not None:
                        run.lose()
                    if (site := run.site) is None:
                        yield from run.wander(seen)
                    elif seen.noise:
                        yield run.hold(site, seen)
                    else:
                        tasks.append((run, site, seen, run.predicted(seen.window)))
                if tasks:
                    yield from self._step(tasks, beside)
        for run in self.runs:
            yield from run.finish()

    def _step(self, tasks: Sequence[_Task], beside: ThreadPoolExecutor) -> Iterator[Track]:
        """Windows on their maps.  What they see there is looked up beside the search for what they show alone."""
        sights = [beside.submit(run.sight, site, seen.window, before) for run, site, seen, before in tasks]
        windows, before = Window.join([task[2].window for task in tasks]), Belief.join([task[3] for task in tasks])
        plane, (how, model) = Plane.join([task[1].map.plane for task in tasks]), (self.options.tracking, self.options.model)
        alone = front(windows, self.canvas, before.state, plane, how, model)
        seeing = {i: sight for i, future in enumerate(sights) if (sight := future.result()) is not None}
        if 0 < len(seeing) < len(tasks):
            rows = torch.tensor(list(seeing))
            windows, before, alone = windows[rows], before[rows], alone[rows]
        if seeing:
            found = step(windows, self.canvas, before, list(seeing.values()), how, model, alone)
        order = {i: row for row, i in enumerate(seeing)}
        for i, (run, site, seen, _) in enumerate(tasks):
            yield from run.follow(site, seen, found, order[i], seeing[i]) if i in order else run.blind(seen)
