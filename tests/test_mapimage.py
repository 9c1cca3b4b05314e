import numpy as np
import pytest
import torch
from PIL import Image

from torchcmax.core.plane import Plane
from torchcmax.mapimage import UNSEEN, before, picture, rounded, sheet
from torchcmax.slam.map import Map
from torchcmax.slam.tiles import CELL, TILE, Layers


def wall(places, focal=100.0, tilt=(0.0, 0.0)):
    """Tiles at these places, all seen; each has one line of strong edge, 2 px wide, along its row 20."""
    plane = Plane.tilted(torch.tensor([tilt], dtype=torch.float64))
    m = Map(plane, focal, torch.tensor([[-0.5, -0.5, 1.0], [0.5, 0.5, 1.0]]))
    for place in places:
        votes, exposure = torch.zeros(TILE, TILE), torch.zeros(3, TILE // CELL, TILE // CELL)
        votes[20:22] = 100.0
        exposure[0] = 50.0
        m.tiles[place] = Layers(votes, exposure)
    return m


def test_edges_are_dark_on_white_and_what_was_never_seen_is_grey():
    page = picture(wall([(0, 0), (1, 1)]), None, "map")
    left = (page.shape[1] - 128) // 2
    shown = page[:128, left : left + 128]
    assert (shown[20:22, :64] == 0).all()
    assert (shown[30:60, :60] == 255).all()
    assert (shown[70:120, :60] == UNSEEN).all()
    assert (shown[64 + 20, 64:] == 0).all()


def test_a_map_of_any_size_fits_the_picture():
    m = wall([(0, 0), (3, 40), (-70, -30)])
    for most in (4096, 1000, 100, 10):
        drawn = sheet(m, most)
        assert max(drawn.strength.shape) <= most
        assert drawn.strength.max() > 0.01
    far = wall([(0, 0), (100_000, -3)])
    assert max(sheet(far).strength.shape) <= 4096
    assert sheet(far).seen.sum() == 2


def test_an_empty_map_has_a_picture():
    assert (picture(wall([]), torch.zeros(3, 3), "nothing").min(-1) < 200).any()  # its scale


def test_reduced_places_are_where_the_tiles_are():
    full, half = (sheet(wall([(0, 0), (0, 3)]), most) for most in (256, 128))
    assert (full.reduced, half.reduced) == (1, 2)
    xy = np.array([[200.0, 20.5]])
    for drawn in (full, half):
        x, y = drawn.place(xy)[0]
        assert drawn.strength[round(y), round(x)] > 0.4
    np.testing.assert_allclose(full.place(xy)[0], [200, 20.5])
    np.testing.assert_allclose(half.place(xy)[0], [99.75, 10.0])


def test_the_paper_is_cut_to_what_was_seen():
    m = wall([(5, 5)])
    m.tiles[5, 5].exposure[:, :, 8:] = 0  # the right half
    drawn = sheet(m)
    assert drawn.strength.shape == (64, 32 + 12)
    assert drawn.corner == (5 * TILE, 5 * TILE)
    m.tiles[5, 5].exposure[:, :, :4] = 0
    drawn = sheet(m)
    assert drawn.strength.shape == (64, 16 + 12 + 12)
    np.testing.assert_allclose(drawn.place(np.array([[5 * TILE + 16.0, 5 * TILE + 20.0]])), [[12, 20]])


def test_the_path_is_straight_before_the_plane():
    """The point of the plane that is nearest to the camera, seen from the origin, is where the camera is drawn."""
    m = wall([(0, 0)], tilt=(0.3, -0.2))
    positions = torch.tensor([[0.0, 0.0, 0.0], [0.2, -0.1, 0.4]], dtype=torch.float64)
    n, d = m.plane.normal, m.plane.distance
    foot = positions - (positions @ n.mT + d) * n
    ray = foot @ m.view[0].mT
    np.testing.assert_allclose(before(m, positions), (ray[:, :2] / ray[:, 2:] * m.focal).numpy(), atol=1e-9)


def test_the_path_goes_from_blue_to_red():
    m = wall([(row, column) for row in range(4) for column in range(4)])
    t = torch.zeros(50, 3, dtype=torch.float64)
    t[:, 0], t[:, 1] = torch.linspace(0.2, 2.2, 50), 1.4
    page = picture(m, t, "map").astype(int)[:256]
    page = page[:, (page.shape[1] - 256) // 2 :][:, :256]
    blue, red = page[135:146, 20:24], page[135:146, 217:221]
    assert (blue[..., 2] - blue[..., 0]).max() > 150
    assert (red[..., 0] - red[..., 2]).max() > 150
    assert (page[60:120].max(-1) - page[60:120].min(-1)).max() == 0


@pytest.mark.parametrize("positions", [[[torch.nan] * 3] * 3, [[1e9, 0, 0], [2e9, 0, 0]], [[-1e5, 0.3, 0], [1e5, 0.3, 0]]])
def test_a_path_that_leaves_the_map_does_no_harm(positions):
    page = picture(wall([(0, 0)]), torch.tensor(positions, dtype=torch.float64), "map")
    assert page.shape[0] < 200


def test_the_scale_is_as_long_as_it_says():
    """A map px is 0.01 plane distances, of 3 m each: a bar of 2 m is 2 / 0.03 = 66.7 px."""
    m = wall([(0, column) for column in range(6)])
    page = picture(m, None, "", metres=3.0)
    bar = page[64 + 13]
    dark = np.flatnonzero((bar == 0).all(-1))
    assert dark[0] == 13
    assert abs(np.flatnonzero(np.diff(dark) > 1)[0] - 2 / 0.03) <= 2


@pytest.mark.parametrize(("value", "round_"), [(0.7, 0.5), (1.0, 1.0), (2.3, 2.0), (49.0, 20.0), (0.0051, 0.005)])
def test_rounded(value, round_):
    assert rounded(value) == pytest.approx(round_)


def test_the_picture_is_colour_for_pillow():
    assert Image.fromarray(picture(wall([(0, 0)]), None, "map")).mode == "RGB"
