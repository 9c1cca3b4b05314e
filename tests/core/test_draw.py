import pytest
import torch

from torchcmax.core.camera import Canvas
from torchcmax.core.draw import Ink, draw, draw_twin
from torchcmax.core.warp import polynomial
from torchcmax.core.window import Window

CANVAS = Canvas(20.0, (15.3, 11.7), (25, 32))


@pytest.fixture
def window(rand):
    """Three windows of 80 events; the last ten of each are padding."""
    ray = torch.cat([rand(3, 80, 2) - 0.5, torch.ones_like(rand(3, 80, 1))], -1)
    polarity = torch.where(rand(3, 80) > 0.5, 1.0, -1.0).to(ray)
    polarity[:, 70:] = 0
    dt = (0.1 * rand(3, 80)).sort(-1).values
    dt = dt - dt[:, :1]
    return Window(ray, dt, polarity, torch.zeros(3, dtype=torch.int64), dt[:, -1])


@pytest.fixture
def H_k(rand):
    normal = torch.nn.functional.normalize(torch.tensor([[0.1, 0.2, -1.0]]), dim=-1).to(rand(1)).expand(5, 3)
    return polynomial(0.4 * (rand(5, 3) - 0.5), 0.3 * (rand(5, 3) - 0.5), normal)


@pytest.mark.parametrize("signed", [False, True])
def test_draw_is_its_readable_twin_in_value_and_gradient(window, H_k, rand, dtype, device, signed):
    tolerance = {torch.float32: {"rtol": 2e-3, "atol": 2e-3}, torch.float64: {"rtol": 1e-9, "atol": 1e-9}}[dtype]
    ink, owner = Ink.of(window, window.polarity if signed else window.weight), torch.tensor([0, 0, 1, 2, 1], device=device)
    back = rand(5, *CANVAS.size)
    results = []
    for how in (draw, draw_twin):
        H = H_k.clone().requires_grad_()
        image = how(H, ink, CANVAS, owner)
        results.append((image, torch.autograd.grad((image * back).sum(), H)[0]))
    for fast, readable in zip(*results, strict=True):
        torch.testing.assert_close(fast, readable, **tolerance)


def test_a_row_is_the_same_alone_and_in_any_batch(window, H_k, device):
    ink, owner = Ink.of(window, window.weight), torch.tensor([0, 0, 1, 2, 1], device=device)
    together = draw(H_k, ink, CANVAS, owner)
    for i in range(5):
        assert torch.equal(draw(H_k[i : i + 1], ink, CANVAS, owner[i : i + 1])[0], together[i])


def test_padding_draws_nothing(window, H_k, device, close):
    owner = torch.arange(3, device=device)
    short = Window(window.ray[:, :70], window.dt[:, :70], window.polarity[:, :70], window.start, window.duration)
    close(draw(H_k[:3], Ink.of(window, window.weight), CANVAS, owner), draw(H_k[:3], Ink.of(short, short.weight), CANVAS, owner))


def test_signed_votes_cancel_and_unsigned_add(window, H_k, device):
    ray, dt = window.ray.repeat(1, 2, 1), window.dt.repeat(1, 2)
    both = Window(ray, dt, torch.cat([window.weight, -window.weight], 1), window.start, window.duration)
    owner = torch.arange(3, device=device)
    assert draw(H_k[:3], Ink.of(both, both.polarity), CANVAS, owner).abs().max() < 1e-5
    assert draw(H_k[:3], Ink.of(both, both.weight), CANVAS, owner).sum() > 100


def test_events_behind_the_camera_are_left_out_without_nan(window, device):
    owner = torch.arange(3, device=device)
    backwards = torch.zeros(3, 6, 3, 3).to(window.ray)
    backwards[:, 0] = -torch.eye(3).to(window.ray)
    H = backwards.requires_grad_()
    for how in (draw, draw_twin):
        image = how(H, Ink.of(window, window.weight), CANVAS, owner)
        (gradient,) = torch.autograd.grad(image.sum(), H)
        assert (image == 0).all()
        assert gradient.isfinite().all()
