"""What `panorama` leaves in its folder: as `track`, with a panorama in place of the map of a plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from torchcmax.core import so3
from torchcmax.folder import TURNED
from torchcmax.mapimage import LARGEST
from torchcmax.panoimage import picture
from torchcmax.quality import quality
from torchcmax.slam.globe import Globe
from torchcmax.slam.tiles import spread
from torchcmax.trackreport import TrackReport
from torchcmax.tracktable import POSE


class PanoramaReport(TrackReport):
    """The folder of one run of a camera that only turns."""

    names = TURNED

    def _globe(self) -> Globe:
        assert isinstance(self.tracks.map, Globe)
        return self.tracks.map

    def _turns(self) -> Tensor:
        """Orientations [M, 3, 3] of the windows on the main map, so far."""
        turns = self._here(POSE[3:])
        return so3.from_quaternion(turns[turns.isfinite().all(-1)])

    def _pages(self) -> dict[str, Callable[[], np.ndarray]]:
        return {"panorama.png": self._page, "panorama_cropped.png": partial(self._page, cropped=True)}

    def _page(self, most: int = LARGEST, cropped: bool = False) -> np.ndarray:
        return picture(self._globe(), self._turns(), self._title(), most, cropped)

    def _world(self) -> dict[str, Any]:
        """How good the panorama is."""
        if not self.table or not self.tracks.map.keyframes:
            return {"panorama": None}
        globe = self._globe()
        found = quality(globe.layers.votes, spread(globe.layers.most) > 0, globe.sphere)
        return {"panorama": {"height": globe.sphere.size[0], "width": globe.sphere.size[1], **asdict(found)}}
