"""A camera that only turns: the order of things is that of a camera before a plane, the map is a sphere."""

from __future__ import annotations

from torchcmax.core.plane import Plane
from torchcmax.core.window import Window
from torchcmax.slam.bundle import settled
from torchcmax.slam.compass import Compass
from torchcmax.slam.globe import Globe
from torchcmax.slam.options import Panorama
from torchcmax.slam.record import Site
from torchcmax.slam.run import Run
from torchcmax.slam.seek import Searchable
from torchcmax.slam.tracker import Sight, World


class PanoramaRun(Run):
    """A camera that turns: `Run` on a globe."""

    least = 1

    def _blank(self, plane: Plane, number: int = 0) -> World:
        return Globe(self.canvas.focal, self.border, self.options.texture, number=number)

    def _round(self, site: Site, last: int | None) -> World:
        assert isinstance(site.map, Globe)
        return settled(site.map, self.options.tracking.matching, last)

    def _refined(self, site: Site, window: Window, before: Sight, reason: str) -> Sight | None:
        if reason:  # it may be elsewhere
            return super()._refined(site, window, before, reason)
        return before.moved(self._belief.state, window.duration.double())

    def _searchable(self, m: World) -> Searchable:
        assert isinstance(m, Globe)
        assert isinstance(self.options, Panorama)
        return Compass(m, self.options.relocalizing)
