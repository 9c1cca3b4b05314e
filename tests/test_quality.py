"""How good a panorama is by itself: images whose event area and gradient are known by hand."""

import math

import pytest
import torch

from torchcmax.core.camera import Sphere
from torchcmax.quality import SIGMA, quality
from torchcmax.slam.equirect import cosines, smooth

SPHERE = Sphere(64)
HEIGHT, WIDTH = SPHERE.size
EVERYWHERE = torch.ones(SPHERE.size, dtype=torch.bool)
PATCH = (slice(22, 42), slice(40, 90))  # around the equator, away from the seam


def nothing():
    return torch.zeros(SPHERE.size)


def lines():
    """Sharp ones, on the equator."""
    image = nothing()
    image[PATCH][:, ::10] = 3.0
    return image


def test_nothing_has_no_area_and_no_gradient():
    found = quality(nothing(), EVERYWHERE, SPHERE)
    assert (found.event_area, found.event_area_sr, found.gradient_magnitude) == (0, 0, 0)
    assert found.seen_share == pytest.approx(1)


@pytest.mark.parametrize("votes", [0.1, 1.0, 3.0])
@pytest.mark.parametrize("row", [0, 10, 31])
def test_a_pixel_holds_events_as_sure_as_they_are_and_as_wide_as_it_is(row, votes):
    image = nothing()
    image[row, 20] = votes
    found = quality(image, EVERYWHERE, SPHERE)
    expected = float(cosines(SPHERE)[row]) * (1 - math.exp(-votes))
    assert found.event_area == pytest.approx(expected, rel=1e-4)
    assert found.event_area_sr == pytest.approx(expected / SPHERE.focal**2, rel=1e-3)


def test_a_row_at_sixty_degrees_holds_half_as_much_as_one_on_the_equator():
    areas = []
    sphere = Sphere(90)  # rows of two degrees, from -89 on
    for row in (14, 44):  # -61 and -1 degrees
        image = torch.zeros(sphere.size)
        image[row] = 1.0
        areas.append(quality(image, torch.ones(sphere.size, dtype=torch.bool), sphere).event_area)
    assert areas[0] / areas[1] == pytest.approx(math.cos(math.radians(61)) / math.cos(math.radians(1)), rel=1e-4)


def test_events_everywhere_fill_the_sphere():
    found = quality(torch.full(SPHERE.size, 50.0), EVERYWHERE, SPHERE)
    assert found.event_area_sr == pytest.approx(4 * math.pi, rel=1e-5)
    assert found.event_area == pytest.approx(4 * math.pi * SPHERE.focal**2, rel=1e-3)


def test_votes_below_zero_are_none():
    assert quality(torch.full(SPHERE.size, -1.0), EVERYWHERE, SPHERE).event_area == 0


def test_half_of_the_sphere_is_half_and_a_cap_is_as_large_as_it_is():
    seen = torch.zeros(SPHERE.size, dtype=torch.bool)
    seen[: HEIGHT // 2] = True
    assert quality(nothing(), seen, SPHERE).seen_share == pytest.approx(0.5)
    seen[HEIGHT // 6 :] = False  # 30 degrees around the pole, less a third of a row
    assert quality(nothing(), seen, SPHERE).seen_share == pytest.approx((1 - math.cos(math.pi * 10 / HEIGHT)) / 2, rel=1e-3)


@pytest.mark.parametrize("row", [10, 20, 32])
def test_a_slope_is_what_it_rises_by_in_a_pixel_of_the_equator(row):
    """0.1 votes from row to row, or from column to column, where these are nearer to each other."""
    seen = torch.zeros(SPHERE.size, dtype=torch.bool)
    seen[row - 1 : row + 2, 20:100] = True  # with its neighbours above and below: the row alone counts
    down, east = (0.1 * torch.arange(n, dtype=torch.float32) for n in SPHERE.size)
    assert quality(down[:, None].expand(SPHERE.size).clone(), seen, SPHERE).gradient_magnitude == pytest.approx(0.01, rel=1e-3)
    found = quality(east.expand(SPHERE.size).clone(), seen, SPHERE).gradient_magnitude
    assert found == pytest.approx(0.01 / float(cosines(SPHERE)[row]) ** 2, rel=2e-3)


def test_twice_the_votes_have_four_times_the_gradient():
    one, other = (quality(k * lines(), EVERYWHERE, SPHERE).gradient_magnitude for k in (1, 2))
    assert other == pytest.approx(4 * one, rel=1e-5)


def test_the_gradient_is_that_of_what_was_seen():
    """Flat where it was seen, steep elsewhere; and nothing seen has none."""
    image = lines()
    image[:, 40:90] += 1
    seen = torch.zeros(SPHERE.size, dtype=torch.bool)
    seen[20:44, 100:120] = True  # far from the poles, where a blur goes far along a row
    assert quality(image, seen, SPHERE).gradient_magnitude < 1e-12
    seen[PATCH] = True
    assert quality(image, seen, SPHERE).gradient_magnitude > 0.01
    assert quality(image, torch.zeros_like(seen), SPHERE).gradient_magnitude == 0


@pytest.mark.parametrize("sigma", [0.7, 1.5, 3.0])
def test_a_sharp_panorama_has_less_area_and_more_gradient_than_a_blurred_one(sigma):
    sharp, soft = (quality(image, EVERYWHERE, SPHERE) for image in (lines(), smooth(lines(), sigma, SPHERE)))
    assert soft.event_area > 1.05 * sharp.event_area
    assert soft.event_area_sr > 1.05 * sharp.event_area_sr
    assert soft.gradient_magnitude < 0.8 * sharp.gradient_magnitude
    assert soft.seen_share == sharp.seen_share


def test_the_more_it_is_blurred_the_worse_it_is():
    found = [quality(smooth(lines(), sigma, SPHERE), EVERYWHERE, SPHERE) for sigma in (0.5, 1.0, 2.0, 4.0)]
    assert [one.event_area for one in found] == sorted(one.event_area for one in found)
    assert [one.gradient_magnitude for one in found] == sorted((one.gradient_magnitude for one in found), reverse=True)


@pytest.mark.parametrize("shift", [20, -25, 7])
def test_it_does_not_matter_where_it_looks_along_the_equator(shift):
    one, other = (quality(image, EVERYWHERE, SPHERE) for image in (lines(), lines().roll(shift, 1)))
    assert other.event_area == pytest.approx(one.event_area, rel=1e-5)
    assert other.gradient_magnitude == pytest.approx(one.gradient_magnitude, rel=1e-5)


def test_the_gradient_of_a_point_is_that_of_a_gaussian():
    """sum |grad G|^2 = 1 / (4 pi sigma^4) of a Gaussian of volume 1; by differences of two pixels a little less."""
    image = nothing()
    image[32, 64] = 1.0
    whole = float(cosines(SPHERE)[1:-1].sum()) * WIDTH
    steep = quality(image, EVERYWHERE, SPHERE).gradient_magnitude * whole
    assert 0.6 / (4 * math.pi * SIGMA**4) < steep < 1 / (4 * math.pi * SIGMA**4)


@pytest.mark.parametrize(
    ("votes", "seen"), [((64, 127), (64, 127)), ((64, 128), (64, 64)), ((32, 64), (32, 64)), ((1, 64, 128), (64, 128))]
)
def test_images_that_are_no_such_sphere_are_refused(votes, seen):
    with pytest.raises(ValueError, match="quality wants votes and seen"):
        quality(torch.zeros(votes), torch.ones(seen, dtype=torch.bool), SPHERE)


def test_an_even_panorama_has_no_gradient_anywhere():
    sphere = Sphere(64)
    assert quality(torch.ones(sphere.size), torch.ones(sphere.size, dtype=torch.bool), sphere).gradient_magnitude < 1e-9
