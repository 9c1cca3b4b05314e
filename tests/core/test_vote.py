import pytest
import torch

from torchcmax.core.vote import vote, vote_moved, vote_moved_twin, vote_scatter

BOTH = pytest.mark.parametrize("how", [vote, vote_scatter])


@BOTH
def test_fig_a1_a_point_is_shared_by_area(how, device, dtype, close):
    one = {"device": device, "dtype": dtype}
    image = how(torch.tensor([[[1.25, 2.5]]], **one), torch.ones(1, 1, **one), (4, 4))
    expected = torch.zeros(1, 4, 4, **one)
    expected[0, 2:4, 1:3] = torch.tensor([[0.375, 0.125], [0.375, 0.125]])
    close(image, expected)


@BOTH
def test_rows_do_not_mix(how, rand):
    xy, weight = 8 * rand(3, 40, 2), rand(3, 40)
    alone = torch.cat([how(xy[i : i + 1], weight[i : i + 1], (9, 9)) for i in range(3)])
    assert torch.equal(how(xy, weight, (9, 9)), alone)


@BOTH
def test_padding_and_outside_leave_no_trace(how, rand, close):
    xy, weight = 8 * rand(1, 40, 2), rand(1, 40)
    far = torch.full((1, 5, 2), -100.0).to(xy)
    pad = (torch.cat([xy, far, 0 * far], 1), torch.cat([weight, torch.ones_like(far[..., 0]), torch.zeros_like(far[..., 0])], 1))
    close(how(*pad, (9, 9)), how(xy, weight, (9, 9)))


@BOTH
def test_a_vote_across_the_border_keeps_its_inner_part(how, dtype, device, close):
    image = how(torch.tensor([[[-0.25, 1.0]]], dtype=dtype, device=device), torch.ones(1, 1, dtype=dtype, device=device), (3, 3))
    close(image.sum(), torch.tensor(0.75, dtype=dtype, device=device))
    close(image[0, 1, 0], torch.tensor(0.75, dtype=dtype, device=device))


def test_the_fast_vote_is_its_readable_twin_in_value_and_gradient(rand, dtype):
    tolerance = {torch.float32: {"rtol": 1e-3, "atol": 1e-3}, torch.float64: {"rtol": 1e-9, "atol": 1e-9}}[dtype]
    xy, weight, back = 14 * rand(3, 500, 2) - 2, rand(3, 500) - 0.5, rand(3, 10, 12)
    results = []
    for how in (vote, vote_scatter):
        p, w = xy.clone().requires_grad_(), weight.clone().requires_grad_()
        image = how(p, w, (10, 12))
        results.append((image, *torch.autograd.grad((image * back).sum(), (p, w))))
    for fast, readable in zip(*results, strict=True):
        torch.testing.assert_close(fast, readable, **tolerance)


@BOTH
def test_gradcheck_away_from_the_pixel_lines(how):
    g = torch.Generator().manual_seed(0)
    cell = torch.randint(0, 5, (2, 12, 2), generator=g, dtype=torch.float64)
    xy = (cell + 0.2 + 0.6 * torch.rand(2, 12, 2, generator=g, dtype=torch.float64)).requires_grad_()
    weight = torch.rand(2, 12, generator=g, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, w: how(p, w, (6, 6)).square(), (xy, weight))


@BOTH
def test_wrong_shapes_are_named(how):
    with pytest.raises(ValueError, match=r"weight \[B, N\], got \[2, 5, 2\] and \[2, 4\]"):
        how(torch.zeros(2, 5, 2), torch.zeros(2, 4), (6, 6))


@BOTH
def test_no_events_make_an_empty_image(how, dtype, device):
    image = how(torch.zeros(2, 0, 2, dtype=dtype, device=device), torch.zeros(2, 0, dtype=dtype, device=device), (4, 5))
    assert image.shape == (2, 4, 5)
    assert (image == 0).all()


def test_votes_of_points_that_move_are_their_readable_twin_in_value_and_gradient(rand, dtype, device):
    """Some of them leave the image, some are nowhere, and the last are padding."""
    tolerance = {torch.float32: {"rtol": 1e-3, "atol": 1e-3}, torch.float64: {"rtol": 1e-9, "atol": 1e-9}}[dtype]
    xy, motion, s = 14 * rand(3, 1300, 2) - 2, 4 * rand(3, 1300, 2) - 2, rand(3, 1300) - 0.5
    weight, back = rand(3, 1300) - 0.5, rand(3, 10, 12)
    weight[:, 1200:] = 0
    motion[:, 5], motion[:, 6] = torch.nan, torch.inf
    results = []
    for how in (vote_moved, vote_moved_twin, lambda xy, m, s, *rest: vote_scatter(xy + m * s[..., None], *rest)):
        m, w = motion.mT.contiguous().mT.requires_grad_(), weight.clone().requires_grad_()  # of any strides
        image = how(xy, m, s, w, (10, 12))
        results.append((image, *torch.autograd.grad((image * back).sum(), (m, w))))
    for fast, twin, readable in zip(*results, strict=True):
        known = ~torch.isnan(readable)  # nowhere has no slope
        torch.testing.assert_close(fast[known], readable[known], **tolerance)
        torch.testing.assert_close(twin[known], readable[known], **tolerance)
    assert torch.equal(vote_moved(xy, motion, s, weight, (10, 12))[:1], vote_moved(xy[:1], motion[:1], s[:1], weight[:1], (10, 12)))


def test_gradcheck_of_points_that_move():
    g = torch.Generator().manual_seed(0)
    cell, s = torch.randint(0, 5, (2, 12, 2), generator=g, dtype=torch.float64), 0.5 + torch.rand(2, 12, generator=g, dtype=torch.float64)
    xy = cell + 0.2 + 0.6 * torch.rand(2, 12, 2, generator=g, dtype=torch.float64)
    motion = (torch.randint(-2, 3, (2, 12, 2), generator=g) / s[..., None]).requires_grad_()
    weight = torch.rand(2, 12, generator=g, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda m, w: vote_moved(xy, m, s, w, (6, 6)).square(), (motion, weight))
    assert torch.autograd.gradcheck(lambda p, t: vote_moved(p, motion.detach(), t, weight.detach(), (6, 6)).square(),
                                    (xy.clone().requires_grad_(), s.clone().requires_grad_()))  # fmt: skip
    with pytest.raises(ValueError, match=r"as xy and weight, got \[2, 11, 2\] and \[2, 12\]"):
        vote_moved(xy, motion[:, 1:], s, weight, (6, 6))
