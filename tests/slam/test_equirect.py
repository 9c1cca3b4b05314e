"""Equirectangular images: where pixels look, how wide they are, and blurs, borders and lookups that know neither seam nor poles."""

import math

import pytest
import torch
from torch.nn.functional import grid_sample, normalize

from torchcmax.core.camera import Sphere
from torchcmax.slam.equirect import NARROW, ROUND, around, bordered, cosines, directions, elevations, grid_at, smooth, steady, tangents

SPHERE = Sphere(64)
HEIGHT, WIDTH = SPHERE.size


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def point(row, column):
    image = torch.zeros(SPHERE.size)
    image[row, column] = 1
    return image


def spans(image, row, column):
    """px, how far an image reaches east and south of a pixel, rms, each bit of the sphere counted alike."""
    ray = directions(SPHERE)
    weight = (image * cosines(SPHERE)).double()
    off = ((ray - ray[row, column]) @ tangents(ray[row, column]).mT) * SPHERE.focal
    return ((weight[..., None] * off.square()).sum((0, 1)) / weight.sum()).sqrt().tolist()


def test_the_middle_looks_ahead_a_quarter_on_looks_right_and_lower_rows_look_down():
    """Four pixels around each of these directions, half a pixel off."""
    ray = directions(SPHERE)
    places = {(32, 64): (0, 0, 1), (32, 96): (1, 0, 0), (32, 32): (-1, 0, 0), (32, 0): (0, 0, -1), (0, 5): (0, -1, 0), (64, 5): (0, 1, 0)}
    for (row, column), expected in places.items():
        rows = slice(max(0, row - 1), row + 1)
        mean = normalize(ray[rows].roll(1 - column, 1)[:, :2].mean((0, 1)), dim=0)
        corner = math.cos(math.radians(1.0 if 0 < row < 64 else 1.5))
        assert float(mean @ torch.tensor(expected, dtype=torch.float64)) > corner


def test_directions_are_unit_rays_that_the_sphere_projects_to_their_pixels():
    ray = directions(SPHERE)
    y, x = torch.meshgrid(torch.arange(HEIGHT).double(), torch.arange(WIDTH).double(), indexing="ij")
    assert torch.allclose(ray.norm(dim=-1), torch.ones(SPHERE.size, dtype=torch.float64))
    assert torch.allclose(SPHERE.pixels(ray), torch.stack([x, y], -1), atol=1e-9)


def test_pixels_of_any_ray_look_along_it_within_half_a_pixel():
    ray = normalize(torch.randn(1000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1)
    column, row = SPHERE.pixels(ray).round().long().unbind(-1)
    there = directions(SPHERE)[row, column % WIDTH]
    assert (there - ray).norm(dim=-1).max() * SPHERE.focal < math.sqrt(0.5) + 0.01


def test_rows_are_as_far_apart_as_columns_on_the_equator_and_their_widths_make_a_sphere():
    lat = elevations(SPHERE)
    assert torch.allclose(lat.diff(), torch.full((HEIGHT - 1,), math.pi / HEIGHT, dtype=torch.float64))
    assert torch.allclose(lat, -lat.flip(0))
    assert float(lat[-1]) == pytest.approx(math.pi / 2 - math.pi / HEIGHT / 2)
    width = cosines(SPHERE)
    assert width.shape == (HEIGHT, 1)
    assert torch.allclose(width[:, 0].double(), directions(SPHERE)[:, 0, ::2].norm(dim=-1), atol=1e-6)
    assert float(width.sum()) * WIDTH / SPHERE.focal**2 == pytest.approx(4 * math.pi, rel=1e-3)


def test_at_the_middle_east_is_x_and_south_is_y_and_at_a_pole_they_are_still_across():
    assert torch.equal(tangents(torch.tensor([0.0, 0.0, 1.0])), torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    assert torch.equal(tangents(torch.tensor([1.0, 0.0, 0.0])), torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
    near = normalize(torch.tensor([1e-6, -1.0, 2e-6], dtype=torch.float64), dim=0)
    frame = torch.cat([tangents(near), near[None]])
    assert torch.allclose(frame @ frame.mT, torch.eye(3, dtype=torch.float64), atol=1e-9)


# blur


@pytest.mark.parametrize("sigma", [1.0, 3.0])
def test_a_blur_keeps_the_sum_over_the_sphere_and_what_is_the_same_everywhere(sigma):
    image = noise(*SPHERE.size)
    area = cosines(SPHERE)
    assert float((smooth(image, sigma, SPHERE) * area).sum()) == pytest.approx(float((image * area).sum()), rel=1e-3)
    assert torch.allclose(smooth(torch.ones(SPHERE.size), sigma, SPHERE), torch.ones(SPHERE.size), atol=1e-5)


@pytest.mark.parametrize("row", [10, 31, 50])
def test_a_blurred_point_keeps_its_sum_away_from_the_poles(row):
    area = cosines(SPHERE)
    assert float((smooth(point(row, 9), 2.0, SPHERE) * area).sum()) == pytest.approx(float(area[row]), rel=0.01)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("row", [0, 1, 3, 10, 31, 62])
def test_a_blur_reaches_equally_far_east_and_south_at_the_poles_and_on_the_equator(row, sigma):
    """An image that is blurred along its columns alone would reach 40 times less far east in the first row than on the equator."""
    assert spans(smooth(point(row, 3), sigma, SPHERE), row, 3) == pytest.approx([sigma, sigma], rel=0.26)


def test_on_the_equator_a_blur_is_a_gaussian():
    column = smooth(point(32, 64), 2.0, SPHERE)[:, 64]
    expected = torch.exp(-0.5 * ((torch.arange(HEIGHT) - 32) / 2.0).square())
    assert torch.allclose(column / column.max(), expected, atol=2e-3)


@pytest.mark.parametrize("shift", [1, 40, 64, -5])
def test_a_blur_is_the_same_wherever_the_seam_is(shift):
    image = noise(*SPHERE.size)
    assert torch.allclose(smooth(image.roll(shift, 1), 2.0, SPHERE), smooth(image, 2.0, SPHERE).roll(shift, 1), atol=1e-6)


@pytest.mark.parametrize("dim", [0, 1])
def test_a_blur_is_the_same_upside_down_and_in_a_mirror(dim):
    image = noise(*SPHERE.size)
    assert torch.allclose(smooth(image.flip(dim), 2.0, SPHERE), smooth(image, 2.0, SPHERE).flip(dim), atol=1e-6)


def test_a_blur_reaches_over_the_pole_half_way_round():
    """As far behind the pole as before it: a point 1.5 px from the pole is seen 1.5 px beyond it, 3 px away."""
    soft = smooth(point(1, 20), 2.0, SPHERE)
    beyond, before = float(soft[1, 20 + WIDTH // 2]), float(soft[1, 20])
    assert beyond / before == pytest.approx(math.exp(-0.5 * (3 / 2.0) ** 2), rel=0.35)
    assert not soft[20:].any()


@pytest.mark.parametrize("sigma", [0.3, 2.0])
def test_a_blur_of_what_is_not_negative_is_not_negative(sigma):
    assert smooth((noise(*SPHERE.size) > 0.98).float(), sigma, SPHERE).min() > -1e-6


def test_a_blur_as_wide_as_the_sphere_leaves_its_mean():
    image = noise(*SPHERE.size)
    mean = float((image * cosines(SPHERE)).sum() / (cosines(SPHERE).sum() * WIDTH))
    assert torch.allclose(smooth(image, 40.0, SPHERE), torch.full(SPHERE.size, mean), atol=0.03)


# rows that close on themselves


@pytest.mark.parametrize("width", [128, 9])
def test_rows_are_blurred_by_discrete_gaussians(width):
    """Their variance is sigma^2 exactly, and two in a row are one with the sum of their variances; of 0 px they leave all as it is."""
    rows = noise(3, width)
    sigma = torch.tensor([[0.0], [0.5], [1.5]])
    assert torch.allclose(around(rows, sigma).sum(1), rows.sum(1), atol=1e-4)
    assert torch.allclose(around(rows, sigma)[0], rows[0], atol=1e-6)
    assert torch.allclose(around(around(rows, sigma), 2 * sigma), around(rows, 5**0.5 * sigma), atol=1e-6)
    one = torch.zeros(1, 128)
    one[0, 0] = 1
    away = torch.arange(128.0).minimum(128 - torch.arange(128.0))
    assert float((around(one, torch.tensor([[1.5]])) * away.square()).sum()) == pytest.approx(1.5**2, rel=1e-4)


def test_votes_keep_their_rows():
    votes = noise(*SPHERE.size) * (noise(*SPHERE.size, seed=1) > 0.9)
    spread = steady(votes, SPHERE)
    assert torch.allclose(spread.sum(1), votes.sum(1), rtol=1e-4)
    assert spread.min() >= 0
    wide = cosines(SPHERE)[:, 0] >= NARROW
    assert torch.equal(spread[wide], votes[wide])
    assert (spread[~wide] != votes[~wide]).any(1).all()


@pytest.mark.parametrize("row", [0, 3, 8, 12, 63])
def test_a_vote_near_a_pole_is_as_wide_as_one_on_the_equator(row):
    """Bilinear, it has ROUND px of blur anywhere; what it has on the sphere is made up to that: both variances add."""
    votes = point(row, 0)
    spread = steady(votes, SPHERE)[row].double()
    away = torch.arange(WIDTH).minimum(WIDTH - torch.arange(WIDTH)).double()
    cosine = float(cosines(SPHERE)[row])
    variance = float((spread * away.square()).sum())
    assert variance * cosine**2 + (ROUND * cosine) ** 2 == pytest.approx(ROUND**2, rel=0.01)


def test_votes_are_spread_alike_wherever_the_seam_is_and_left_where_there_are_none():
    votes = noise(*SPHERE.size)
    assert torch.allclose(steady(votes.roll(33, 1), SPHERE), steady(votes, SPHERE).roll(33, 1), atol=1e-6)
    votes[cosines(SPHERE)[:, 0] < NARROW] = 0
    assert torch.equal(steady(votes, SPHERE), votes)


def test_spreading_leaves_what_it_was_given():
    votes = point(1, 7)
    steady(votes, SPHERE)
    assert torch.equal(votes, point(1, 7))


# lookups


def test_a_border_goes_on_over_the_seam_and_half_way_round_over_the_poles():
    framed = bordered(noise(2, *SPHERE.size), SPHERE)
    assert framed.shape == (1, 2, HEIGHT + 2, WIDTH + 2)
    image = noise(2, *SPHERE.size)
    framed = bordered(image, SPHERE)[0]
    assert torch.equal(framed[:, 1:-1, 1:-1], image)
    assert torch.equal(framed[:, 1:-1, 0], image[..., -1])
    assert torch.equal(framed[:, 1:-1, -1], image[..., 0])
    for edge, row in ((0, 0), (-1, -1)):
        assert torch.equal(framed[:, edge, 1:-1], image[:, row].roll(WIDTH // 2, -1))
        assert torch.equal(framed[:, edge, 0], image[:, row, WIDTH // 2 - 1])  # the corner is beyond both
        assert torch.equal(framed[:, edge, -1], image[:, row, WIDTH // 2])


def test_pixels_find_themselves():
    image = noise(*SPHERE.size)
    places = grid_at(tuple(directions(SPHERE).float().unbind(-1)), SPHERE)
    assert torch.allclose(grid_sample(bordered(image, SPHERE), places, align_corners=True)[0, 0], image, atol=1e-4)


@pytest.mark.parametrize("where", [(0.3, 0.2, 1), (0.001, 0, -1), (-0.001, 0.4, -1), (1e-4, 1, 1e-4), (0, -1, 1e-5), (0.02, 1, -0.03)])
def test_a_lookup_is_continuous_over_seam_and_poles(where):
    """Of an image that shows where its pixels look, any ray finds itself, however long it is."""
    image = directions(SPHERE).float().permute(2, 0, 1)
    ray = torch.tensor([where], dtype=torch.float32)
    places = grid_at(tuple((5 * ray)[None].unbind(-1)), SPHERE)
    found = grid_sample(bordered(image, SPHERE), places, align_corners=True)[0, :, 0, 0]
    assert torch.allclose(found, normalize(ray[0], dim=0), atol=1e-3)
