"""What an event finds in the texture of a map, by hand; charts together; how far a search goes on a blurred one."""

import math
from dataclasses import replace

import pytest
import torch

from torchcmax.core.draw import Ink
from torchcmax.core.match import NUMBERS, Chart, Matching, evaluate, lookup
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State

DOUBLE = torch.float64


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def test_a_lookup_by_hand():
    """Value, slope along x, slope along y in the picture 1 2 / 3 4, and where half of the four pixels are missing."""
    texture = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]], dtype=DOUBLE)
    by_hand = {
        (0.0, 0.0): (1.0, 1.0, 2.0),
        (0.5, 0.5): (2.5, 1.0, 2.0),
        (0.25, 0.75): (2.75, 1.0, 2.0),
        (-0.5, 0.0): (0.5, 1.0, 1.0),
        (0.0, -0.25): (0.75, 0.75, 1.0),
        (1.5, 0.0): (1.0, -2.0, 1.0),
        (1.75, 1.75): (0.25, -1.0, -1.0),
    }
    strength, slope = lookup(texture, torch.tensor([list(by_hand)], dtype=DOUBLE))
    expected = torch.tensor(list(by_hand.values()), dtype=DOUBLE)
    torch.testing.assert_close(strength[0], expected[:, 0])
    torch.testing.assert_close(slope[0], expected[:, 1:])


@pytest.mark.parametrize("place", [(-1.0, 0.5), (2.0, 0.5), (0.5, -1.0), (0.5, 2.0), (1e9, 0), (-1e30, 0), (math.nan, 0.5), (0, math.inf)])
def test_nothing_is_found_outside(place):
    strength, slope = lookup(torch.ones(1, 2, 2, dtype=DOUBLE), torch.tensor([[place]], dtype=DOUBLE))
    assert strength.tolist() == [[0]]
    assert slope.tolist() == [[[0, 0]]]


def test_a_lookup_is_what_grid_sample_finds_and_its_slope_that_of_autograd():
    texture, xy = rand(2, 9, 14), (rand(2, 300, 2, seed=1) * torch.tensor([18, 13], dtype=DOUBLE) - 2).requires_grad_()
    grid = xy * torch.tensor([2 / 13, 2 / 8], dtype=DOUBLE) - 1
    expected = torch.nn.functional.grid_sample(texture[:, None], grid[:, None], padding_mode="zeros", align_corners=True)[:, 0, 0]
    (expected_slope,) = torch.autograd.grad(expected.sum(), xy)
    strength, slope = lookup(texture, xy.detach())
    torch.testing.assert_close(strength, expected.detach(), rtol=0, atol=1e-12)
    torch.testing.assert_close(slope, expected_slope, rtol=0, atol=1e-12)


def test_one_event_by_hand():
    """On an edge of strength T it is worth T^2/2 - T; padded, outside or behind the camera it is worth nothing."""
    rest = torch.zeros(4, 3, dtype=DOUBLE)
    eye = torch.eye(3, dtype=DOUBLE).expand(4, 3, 3)
    wall, state = Plane.tilted(rest[:, :2]), State(Pose(eye, rest), Motion(rest, rest))
    texture = torch.zeros(4, 5, 5, dtype=DOUBLE)
    texture[:, 2, 3] = 0.8
    chart = Chart(texture, torch.full((4, 2), -2.0, dtype=DOUBLE), eye, 10.0)
    ink = Ink(*(torch.tensor(part, dtype=DOUBLE)[:, None] for part in ([0.05, 0.05, 5.0, 0.05], [0.0] * 4, [0.0] * 4, [1.0, 0, 1, 1])))
    state = State(Pose(torch.cat([eye[:3], -eye[:1]]), rest), state.motion)  # the last looks the other way
    value, gradient, found = evaluate(torch.zeros(4, NUMBERS, dtype=DOUBLE), state, wall, torch.ones(4, dtype=DOUBLE), chart, ink)
    torch.testing.assert_close(value, torch.tensor([0.4**2 / 2 - 0.4, 0, 0, 0], dtype=DOUBLE))
    torch.testing.assert_close(found, torch.tensor([0.4, 0, 0, 0], dtype=DOUBLE))
    assert gradient[0, 3].item() == pytest.approx((0.4 - 1) * 0.8)  # a shift to the right by one px
    assert (gradient[1:] == 0).all()


@pytest.mark.parametrize(("sigma", "tolerance"), [(0.5, 0.02), (1.0, 0.02), (4.0, 0.08)])
def test_on_a_blurred_map_the_search_is_done_earlier(sigma, tolerance):
    how = Matching(weight=0.5)
    coarse = how.coarse(sigma)
    assert coarse.stop.tolerance == pytest.approx(tolerance)
    assert replace(coarse, stop=how.stop) == how


def test_charts_are_joined_with_nothing_around_the_smaller():
    eye = torch.eye(3, dtype=DOUBLE)
    chart = Chart(rand(2, 60, 70), rand(2, 2, seed=1), eye.expand(2, 3, 3), 90.0)
    small = Chart(rand(1, 40, 50, seed=2), rand(1, 2, seed=3), eye[None], 90.0)
    joined = Chart.join([small, chart])
    assert joined.texture.shape == (3, 60, 70)
    assert torch.equal(joined.corner, torch.cat([small.corner, chart.corner]))
    assert torch.equal(joined.texture[0, :40, :50], small.texture[0])
    assert (joined.texture[0, 40:] == 0).all()
    assert (joined.texture[0, :, 50:] == 0).all()
    assert torch.equal(joined.texture[1:], chart.texture)
    filled = joined.filled([small.texture[0], chart.texture[0], chart.texture[1]])
    assert torch.equal(filled, joined.texture)
    assert torch.equal(joined.frame[:, 1:-1, 1:-1], joined.texture)
    assert Chart.join([small]) is small
