"""Pictures of a panorama: grey where nothing was seen, cropped in one piece, the path in colour, a scale in degrees."""

import numpy as np
import pytest
import torch
from PIL import Image

from torchcmax.core import so3
from torchcmax.mapimage import BORDER, UNSEEN
from torchcmax.panoimage import picture
from torchcmax.slam.globe import Globe
from torchcmax.slam.tiles import CELL

FOCAL = 120.0
HEIGHT, WIDTH = 376, 752  # of its sphere, wider than any scale below it
ROWS, COLUMNS = HEIGHT // CELL, WIDTH // CELL
SEAM = (*range(COLUMNS - 6, COLUMNS), *range(4))
NONE = torch.zeros(0, 3, 3, dtype=torch.float64)


def seen(columns=(), rows=range(40, 50), votes=0.0):
    """A globe of which cells were seen: blank, or with an edge in the middle row of them."""
    globe = Globe(FOCAL, torch.tensor([[-0.5, -0.4, 1.0], [0.5, 0.4, 1.0]]))
    assert globe.sphere.size == (HEIGHT, WIDTH)
    for column in columns:
        globe.layers.exposure[0, rows.start : rows.stop, column] = 30.0
        middle = (rows.start + rows.stop) // 2 * CELL
        globe.layers.votes[middle, column * CELL : (column + 1) * CELL] = votes
    return globe


def looking(*degrees):
    """Orientations of cameras that look so far to the right of z, and down: [M, 3, 3]."""
    right, down = torch.tensor([d if isinstance(d, tuple) else (d, 0.0) for d in degrees], dtype=torch.float64).deg2rad().T
    none = torch.zeros_like(right)
    return so3.exp(torch.stack([none, right, none], -1)) @ so3.exp(torch.stack([-down, none, none], -1))


def colour(page):
    """Which pixels have one."""
    return page.max(-1).astype(int) - page.min(-1) > 40


def extent(mask, axis):
    """First and last row or column."""
    found = np.flatnonzero(mask.any(1 - axis))
    return int(found[0]), int(found[-1])


def shown(page):
    """Without the scale below."""
    return page[:-26] if page.shape[1] < 1040 else page[: -2 * (page.shape[1] // 80)]


def test_the_picture_is_as_large_as_the_sphere_and_a_scale_below():
    page = picture(seen(range(3)), NONE, "street")
    assert page.dtype == np.uint8
    assert page.shape == (HEIGHT + 2 * 13, WIDTH, 3)
    assert Image.fromarray(page).mode == "RGB"


def test_what_was_never_seen_is_grey_what_was_seen_is_white_and_edges_are_dark():
    page = picture(seen(range(100, 110), votes=100.0), NONE, "street")
    there = np.zeros((HEIGHT, WIDTH), bool)
    there[160:200, 400:440] = True
    assert (page[:HEIGHT][~there] == UNSEEN).all()
    inner = page[160:200, 400:440]
    assert (inner[:15] == 255).all()
    assert (inner[-15:] == 255).all()
    assert (inner[20, 5:-5] < 10).all()  # the edge
    assert (inner == inner[..., :1]).all()


@pytest.mark.parametrize("cropped", [False, True])
@pytest.mark.parametrize("turns", [NONE, looking(0.0), looking(-20.0, 30.0), looking(0.0, 1.0) * torch.nan], ids=["0", "1", "2", "nan"])
def test_an_empty_globe_has_a_picture(cropped, turns):
    page = picture(seen(), turns, "nothing", cropped=cropped)
    assert page.shape == (HEIGHT + 26, WIDTH, 3)
    assert (page[:150] == UNSEEN).all()
    assert colour(page).any() == (len(turns) == 2 and not turns.isnan().any())
    assert page[HEIGHT:].min() == 0  # its scale


def test_the_scale_is_as_long_as_it_says_in_degrees():
    """A fifth of 360 degrees, rounded: 50 degrees, of 180 in the height."""
    bar = picture(seen(range(3)), NONE, "")[HEIGHT + 13]
    dark = np.flatnonzero((bar == 0).all(-1))
    assert dark[0] == 13
    assert abs(np.flatnonzero(np.diff(dark) > 1)[0] - 50 * HEIGHT / 180) <= 2


def test_a_reduced_picture_shows_the_same_and_its_path_lies_in_the_same_place():
    globe, turns = seen(range(100, 110), votes=100.0), looking((-90.0, -40.0), (-60.0, -40.0))
    full, half = picture(globe, turns, ""), picture(globe, turns, "", most=WIDTH // 2)
    assert half.shape == (HEIGHT // 2 + 26, WIDTH // 2, 3)
    white = [extent(shown(page).min(-1) > 250, axis) for page in (full, half) for axis in (0, 1)]
    assert white == [(160, 199), (400, 439), (80, 99), (200, 219)]
    inner = half[80:100, 200:220]
    assert inner.min() == 0
    assert (inner[10, 1:-1] < 10).all()
    for axis in (0, 1):
        one, other = (np.array(extent(colour(shown(page)), axis)) for page in (full, half))
        np.testing.assert_allclose(one.mean() / 2, other.mean(), atol=1)


@pytest.mark.parametrize("most", [4096, 752, 500, 100, 10, 2])
def test_no_side_is_longer_than_asked_for_but_for_the_scale(most):
    page = picture(seen(range(100, 120), votes=50.0), looking(0.0, 20.0), "", most=most)
    height = min(HEIGHT, most // 2)
    assert page.shape[:2] == (height + 26, max(360, 2 * height))
    assert (page[:height] != UNSEEN).any()


# cropped


def test_the_cropped_picture_is_what_was_seen_and_a_border():
    page = picture(seen(range(60, 160), votes=50.0), NONE, "", cropped=True)
    assert page.shape == (10 * CELL + 2 * BORDER + 26, 100 * CELL + 2 * BORDER, 3)
    white = shown(page).min(-1) == 255
    assert extent(white, 0) == (BORDER, BORDER + 39)
    assert extent(white, 1) == (BORDER, BORDER + 399)


@pytest.mark.parametrize(("rows", "border"), [(range(0, 10), (0, BORDER)), (range(ROWS - 10, ROWS), (BORDER, 0))], ids=["up", "down"])
def test_at_the_poles_there_is_no_border(rows, border):
    page = picture(seen(range(60, 160), rows), NONE, "", cropped=True)
    assert page.shape[0] == 40 + sum(border) + 26
    assert extent(shown(page).min(-1) == 255, 0) == (border[0], border[0] + 39)


def test_what_goes_over_the_seam_is_in_one_piece():
    """The edges left of the seam are left of those that are right of it."""
    globe = seen(SEAM)
    globe.layers.votes[170, :16], globe.layers.votes[190, -24:] = 50.0, 50.0
    page = shown(picture(globe, NONE, "", cropped=True))
    white = (page.min(-1) == 255)[BORDER : BORDER + 8]
    first, last = extent(white, 1)
    assert last - first + 1 == 40  # ten cells
    assert white[:, first : last + 1].all()
    dark = page.max(-1) < 100
    left, right = extent(dark[BORDER + 28 : BORDER + 32], 1), extent(dark[BORDER + 8 : BORDER + 12], 1)
    assert left == (first, first + 23)
    assert right == (first + 24, last)


@pytest.mark.parametrize("only", [range(0, 110), range(COLUMNS - 110, COLUMNS)], ids=["right of it", "left of it"])
def test_what_ends_at_the_seam_is_not_torn_apart(only):
    page = picture(seen(only), NONE, "", cropped=True)
    assert page.shape[1] == 440 + 2 * BORDER
    assert extent(shown(page).min(-1) == 255, 1) == (BORDER, BORDER + 439)


def test_what_goes_all_the_way_round_keeps_its_whole_width():
    page = picture(seen(range(COLUMNS)), looking(-20.0, 20.0), "", cropped=True)
    assert page.shape == (40 + 2 * BORDER + 26, WIDTH, 3)


def test_what_is_seen_nearly_all_the_way_round_is_opened_in_the_gap():
    page = shown(picture(seen([c for c in range(COLUMNS) if c not in range(20, 30)]), NONE, "", cropped=True))
    assert page.shape[1] == WIDTH - 40 + 2 * BORDER
    assert (page[BORDER + 3, BORDER:-BORDER] == 255).all()


@pytest.mark.parametrize("gaps", [(COLUMNS - 4,), (2,), (COLUMNS - 3, 1)], ids=["left of it", "right of it", "on both sides"])
def test_a_small_gap_beside_the_seam_does_not_open_it_there(gaps):
    """Seen on both sides of the seam, and gaps of one cell near it: the widest gap is behind the camera."""
    page = shown(picture(seen([c for c in SEAM if c not in gaps]), NONE, "", cropped=True))
    first, last = extent(page.min(-1) == 255, 1)
    assert last - first + 1 == len(SEAM) * CELL
    assert (page[BORDER + 3, first : last + 1] == UNSEEN).all(-1).sum() == len(gaps) * CELL


def test_a_whole_picture_is_not_turned():
    white = shown(picture(seen(SEAM), NONE, "")).min(-1) == 255
    assert white[170, :16].all()
    assert white[170, -24:].all()
    assert not white[:, 16:-24].any()


# the path


def test_the_path_goes_from_blue_to_red_where_the_camera_looked():
    page = picture(seen(range(COLUMNS)), looking(*np.linspace(-60, 60, 40)), "").astype(int)
    x = [round(WIDTH / 2 + degrees * HEIGHT / 180) for degrees in (-60, 60)]
    y = HEIGHT // 2
    blue, red = (page[y - 4 : y + 5, c - 4 : c + 5] for c in x)
    assert (blue[..., 2] - blue[..., 0]).max() > 150
    assert (red[..., 0] - red[..., 2]).max() > 150
    first, last = extent(colour(page[:HEIGHT]), 1)
    assert (first, last) == (pytest.approx(x[0], abs=6), pytest.approx(x[1], abs=6))
    top, bottom = extent(colour(page[:HEIGHT]), 0)
    assert y - 6 <= top <= bottom <= y + 6


def test_a_camera_that_looks_up_is_drawn_above_the_middle():
    page = picture(seen(), looking((-30.0, -50.0), (-25.0, -50.0)), "")
    assert np.mean(extent(colour(page[:HEIGHT]), 0)) == pytest.approx(HEIGHT / 2 - 50 * HEIGHT / 180, abs=2)
    assert np.mean(extent(colour(page[:HEIGHT]), 1)) == pytest.approx(WIDTH / 2 - 27.5 * HEIGHT / 180, abs=2)


@pytest.mark.parametrize("degrees", [(170.0, 175.0, 185.0, 190.0), (-170.0, -175.0, -185.0, -190.0)])
def test_the_path_is_not_drawn_across_the_picture_at_the_seam(degrees):
    columns = np.flatnonzero(colour(picture(seen(), looking(*degrees), "")[:HEIGHT]).any(0))
    right, left = columns[columns > WIDTH / 2], columns[columns < WIDTH / 2]
    assert left.max() < 30
    assert right.min() > WIDTH - 30
    assert min(len(left), len(right)) > 8  # of both sides something


def test_a_path_over_the_seam_is_in_one_piece_where_what_was_seen_is():
    page = shown(picture(seen(SEAM), looking(*np.linspace(172, 188, 17)), "", cropped=True))
    marks = colour(page)
    first, last = extent(marks, 1)
    assert marks[:, first : last + 1].any(0).all()
    assert last - first == pytest.approx(16 * HEIGHT / 180, abs=10)
    white = extent(page.min(-1) == 255, 1)
    seam = white[0] + 24  # columns of six cells are left of it
    assert (first + last) / 2 == pytest.approx(seam, abs=2)


@pytest.mark.parametrize("sign", [-1, 1], ids=["up", "down"])
def test_a_path_over_a_pole_crosses_the_picture_only_there(sign):
    """Up to the pole on one side, down again half way round."""
    turns = looking(*((0.0, sign * degrees) for degrees in (70, 80, 88, 92, 100)))
    marks = colour(picture(seen(), turns, "")[:HEIGHT])
    columns = np.arange(WIDTH)
    side = (np.abs(columns - WIDTH / 2) > 8) & (columns > 8) & (columns < WIDTH - 9)
    rows = np.flatnonzero(marks[:, side].any(1))
    assert (sign * (rows - HEIGHT / 2)).min(initial=HEIGHT) > 85 * HEIGHT / 180
    for there in (np.abs(columns - WIDTH / 2) < 4, (columns < 4) | (columns > WIDTH - 5)):
        assert marks[:, there].any()


def test_directions_that_are_no_numbers_are_left_out_of_the_path():
    turns = looking(-20.0, 0.0, 20.0)
    turns[1] = torch.nan
    marks = colour(picture(seen(), turns, "")[:HEIGHT])
    first, last = extent(marks, 1)
    assert last - first == pytest.approx(40 * HEIGHT / 180, abs=10)
