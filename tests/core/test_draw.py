import pytest
import torch

from torchcmax import kernels
from torchcmax.core.camera import Canvas
from torchcmax.core.draw import Ink, draw, draw_sum, draw_twin
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


def test_joined_ink_draws_what_its_parts_draw(window, H_k, device):
    ink = Ink.of(window, window.polarity)
    parts = [Ink(*(part[i : i + 1, :n] for part in (ink.x, ink.y, ink.s, ink.weight))) for i, n in enumerate((70, 20, 45))]
    joined, owner = Ink.join(parts), torch.arange(3, device=device)
    assert joined.x.shape == (3, 70)
    for i, n in enumerate((70, 20, 45)):
        assert (joined.weight[i, n:] == 0).all()
        assert torch.equal(joined.weight[i, :n], parts[i].weight[0])
    together = draw(H_k[:3], joined, CANVAS, owner)
    for i, part in enumerate(parts):
        alone = draw(H_k[i : i + 1], part, CANVAS, owner[:1])[0]
        torch.testing.assert_close(together[i], alone, rtol=1e-4, atol=1e-5)


def test_thinned_ink_is_every_so_manieth_event(window):
    ink = Ink.of(window, window.weight)
    assert ink.thinned(1) is ink
    assert torch.equal(ink.thinned(4).s, ink.s[:, ::4])


@pytest.fixture
def plain(monkeypatch):
    """Switches the kernels off from here on."""
    return lambda: monkeypatch.setenv(kernels.SWITCH, "0")


@pytest.mark.parametrize("compiled", [True, False])
def test_the_sum_of_drawings_is_one_drawing_of_all(window, H_k, rand, dtype, device, plain, compiled):
    if not compiled:
        plain()
    tolerance = {torch.float32: {"rtol": 1e-3, "atol": 1e-3}, torch.float64: {"rtol": 1e-9, "atol": 1e-9}}[dtype]
    ink, back, results = Ink.of(window, window.polarity), rand(1, *CANVAS.size), []
    for how in (draw_sum, lambda *args: draw(*args, torch.arange(3, device=device)).sum(0, keepdim=True)):
        H = H_k[:3].clone().requires_grad_()
        image = how(H, ink, CANVAS)
        assert image.shape == (1, *CANVAS.size)
        results.append((image, torch.autograd.grad((image * back).sum(), H)[0]))
    for one, many in zip(*results, strict=True):
        torch.testing.assert_close(one, many, **tolerance)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_gradient_of_the_sum_is_that_of_central_differences(window, H_k, rand, threads, monkeypatch):
    """Where the image is weighed by a plane the vote has no kinks: it is c + a x + b y of every event that is inside."""
    window = window.to("cpu", torch.float64)
    monkeypatch.setattr(pytest.importorskip("torchcmax.kernels.cpu"), "PART", 50)  # so that two threads share the windows
    kernels.set_threads(threads)
    ink, H = Ink.of(window, window.weight), H_k[:3].cpu().double().requires_grad_()
    y, x = torch.meshgrid(torch.arange(25).double(), torch.arange(32).double(), indexing="ij")
    back = 0.3 + 0.2 * x - 0.1 * y
    wide = Canvas(5.0, CANVAS.centre, CANVAS.size)  # all events are inside

    def weighed(H):
        return (draw_sum(H, ink, wide)[0] * back).sum()

    assert draw_sum(H, ink, wide).sum().item() == pytest.approx(ink.weight.sum().item())
    (gradient,) = torch.autograd.grad(weighed(H), H)
    h, flat = 1e-6, torch.zeros(H.numel(), dtype=torch.float64)
    for i in range(0, H.numel(), 7):
        side = flat.clone()
        side[i] = h
        side = side.view_as(H)
        difference = (weighed(H + side) - weighed(H - side)) / (2 * h)
        assert gradient.flatten()[i].item() == pytest.approx(difference.item(), rel=1e-6, abs=1e-6)


def test_a_sum_wants_a_homography_for_each_window(window, H_k):
    with pytest.raises(ValueError, match=r"draw_sum wants H_k \[W, K, 3, 3\] for ink of 3 windows, got \[5, 6, 3, 3\]"):
        draw_sum(H_k, Ink.of(window, window.weight), CANVAS)
