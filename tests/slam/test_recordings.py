"""Whole recordings with the default options: the bars that the project set itself."""

import pytest
import torch

from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import gradient_magnitude, normalized
from torchcmax.core.draw import Ink, draw_sum
from torchcmax.core.warp import TERMS, still
from torchcmax.io.opening import OpenOptions, open
from torchcmax.score import score
from torchcmax.track import track

BARS = {  # % of the plane's distance, degrees, coverage
    "poster_6dof_sim": (0.4, 0.4, 0.99),
    "poster_translation_sim": (0.4, 0.4, 0.99),
    "shapes_6dof_sim": (0.7, 0.7, 0.95),
    "slider_far_sim": (0.8, 1.5, 0.97),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BARS)
def test_simulated_recordings_are_tracked_from_nothing_to_the_end(shared, name):
    recording = open(shared / "data/sim" / name)
    tracks = track(recording)
    lost = sum(one.status == "lost" for one in tracks)
    found = score(tracks.trajectory(), recording.truth, recording.plane)
    percent, degrees, coverage = BARS[name]
    assert lost == 0
    assert found.percent_of_distance < percent
    assert found.orientation_rmse_deg < degrees
    assert found.coverage >= coverage


def sharpness(image, weight):
    """Of one image [H, W] of all these events: their gradient energy, in what scattered ones would have."""
    return float(gradient_magnitude(normalized(image[None], weight.flatten()[None])))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["garfield", "stripes"])
def test_real_planes_are_tracked_to_the_end_and_their_map_is_sharp(shared, name):
    recording = open(shared / "data/real/dvs128" / name, OpenOptions(camera="pinhole"))
    tracks = track(recording)
    found = list(tracks)
    assert not [one.index for one in found if one.status == "lost"]
    assert tracks.stream.share == 1
    m = tracks.map
    ink = Ink.join([k.ink for k in m.keyframes])
    plain = draw_sum(still(torch.empty(len(ink.x), TERMS, 3, 3)), ink, Canvas.around(recording.camera))[0]
    assert sharpness(m.assembled(m.whole()).votes, ink.weight) >= 2 * sharpness(plain, ink.weight)
