"""Event counts, voxel grids and time surfaces."""

import math

import pytest
import torch

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.model import Displacement
from torchcmax.core.window import Window
from torchcmax.data import event_count, time_surface, voxel_grid

CANVAS = Canvas.around(Camera.pinhole((4, 6)), 0.0)


def window(events, seconds=0.1, padding=0):
    """One window of (x px, y px, share of the window, polarity)."""
    x, y, phase, p = (torch.tensor(column, dtype=torch.float64) for column in zip(*events, strict=True))
    centre = torch.tensor(CANVAS.centre, dtype=torch.float64)
    ray = torch.cat([(torch.stack([x, y], -1) - centre) / CANVAS.focal, torch.ones(len(x), 1, dtype=torch.float64)], -1)
    ray = torch.cat([ray, torch.ones(padding, 3, dtype=torch.float64)])
    dt, p = (torch.cat([part, torch.zeros(padding, dtype=torch.float64)]) for part in (phase * seconds, p))
    return Window(ray[None], dt[None], p[None], torch.zeros(1, dtype=torch.int64), torch.tensor([seconds], dtype=torch.float64))


EVENTS = [(1, 2, 0.0, 1), (3, 1, 0.25, -1), (3, 1, 0.5, -1), (2.5, 3, 0.9, 1), (5, 0, 1.0, 1), (9, 9, 0.5, 1)]  # the last is outside


@pytest.mark.parametrize("padding", [0, 5])
def test_counts_are_of_each_polarity_and_bilinear(padding):
    found = event_count(window(EVENTS, padding=padding), CANVAS)
    expected = torch.zeros(1, 2, 4, 6, dtype=torch.float64)
    expected[0, 0, 2, 1] = expected[0, 0, 0, 5] = 1
    expected[0, 0, 3, 2] = expected[0, 0, 3, 3] = 0.5
    expected[0, 1, 1, 3] = 2
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("padding", [0, 5])
def test_a_voxel_grid_shares_an_event_between_two_moments(padding):
    found = voxel_grid(window(EVENTS, padding=padding), CANVAS, bins=3)
    assert found.shape == (1, 3, 4, 6)
    torch.testing.assert_close(found[0, :, 2, 1], torch.tensor([1.0, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(found[0, :, 1, 3], torch.tensor([-0.5, -1.5, 0], dtype=torch.float64))
    torch.testing.assert_close(found[0, :, 3, 2], torch.tensor([0, 0.1, 0.4], dtype=torch.float64))
    torch.testing.assert_close(found[0, :, 0, 5], torch.tensor([0.0, 0, 1], dtype=torch.float64))
    signed = event_count(window(EVENTS), CANVAS)
    torch.testing.assert_close(found.sum(1), signed[:, 0] - signed[:, 1])


@pytest.mark.parametrize("padding", [0, 5])
def test_a_time_surface_has_the_last_event_of_each_pixel(padding):
    found = time_surface(window(EVENTS[:3] + EVENTS[4:], padding=padding), CANVAS, tau=0.05)
    expected = torch.zeros(1, 2, 4, 6, dtype=torch.float64)
    expected[0, 0, 2, 1], expected[0, 0, 0, 5], expected[0, 1, 1, 3] = math.exp(-2), 1, math.exp(-1)
    torch.testing.assert_close(found, expected)


def test_compensated_events_of_one_point_meet():
    """A camera that turns: what one point left along a line is one pixel at the reference."""
    turn = torch.tensor([[0.0, 0.3, 0.0]], dtype=torch.float64)
    H_k = Displacement(turn, torch.zeros_like(turn), torch.tensor([[0.0, 0, -1]], dtype=torch.float64)).homography()
    angle = [0.15 - 0.3 * phase for phase in (0.0, 0.5, 1.0)]  # of the point (0, 0, 1) at the middle
    events = [(CANVAS.centre[0] + CANVAS.focal * math.tan(a), CANVAS.centre[1], p, 1) for a, p in zip(angle, (0.0, 0.5, 1.0), strict=True)]
    before, after = (event_count(window(events), CANVAS, warp) for warp in (None, H_k))
    together = event_count(window([(*CANVAS.centre, 0.5, 1)] * 3), CANVAS)
    torch.testing.assert_close(after, together, rtol=0, atol=1e-3)  # of the warp's power series
    assert before.amax() < 0.7 * together.amax()
    assert voxel_grid(window(events), CANVAS, 2, H_k).sum() == pytest.approx(3)


def test_gradients_to_the_warp():
    turn = torch.tensor([[0.1, 0.3, 0.2]], dtype=torch.float64, requires_grad=True)

    def images(turn):
        H_k = Displacement(turn, torch.zeros_like(turn), torch.tensor([[0.0, 0, -1]], dtype=torch.float64)).homography()
        return voxel_grid(window(EVENTS), CANVAS, 3, H_k).square().sum((2, 3)), event_count(window(EVENTS), CANVAS, H_k).square().sum(
            (2, 3)
        )

    assert torch.autograd.gradcheck(images, turn)


def test_what_means_nothing_is_refused():
    with pytest.raises(ValueError, match="at least 2 bins"):
        voxel_grid(window(EVENTS), CANVAS, 1)
    with pytest.raises(ValueError, match="tau above 0"):
        time_surface(window(EVENTS), CANVAS, tau=0.0)
