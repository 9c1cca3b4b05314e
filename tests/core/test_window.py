"""Windows of events: joined, thinned, moved."""

import pytest
import torch

from torchcmax.core.window import Window


@pytest.fixture
def make(rand, device):
    """Windows of so many events."""

    def make(windows, count):
        ray = torch.cat([rand(windows, count, 2) - 0.5, torch.ones_like(rand(windows, count, 1))], -1)
        dt = (0.1 * rand(windows, count)).sort(-1).values
        dt = dt - dt[:, :1]
        polarity = torch.where(rand(windows, count) > 0.5, 1.0, -1.0).to(ray)
        return Window(ray, dt, polarity, 1000 * torch.arange(windows, device=device), dt[:, -1])

    return make


def test_joined_windows_are_themselves_and_behind_their_end_nothing(make):
    parts = [make(2, 30), make(1, 50), make(3, 7)]
    joined = Window.join(parts)
    assert joined.ray.shape == (6, 50, 3)
    row = 0
    for part in parts:
        count = part.ray.shape[1]
        for i in range(len(part)):
            for name in ("ray", "dt", "polarity"):
                assert torch.equal(getattr(joined, name)[row, :count], getattr(part, name)[i])
            assert joined.start[row] == part.start[i]
            assert joined.duration[row] == part.duration[i]
            assert (joined.weight[row, count:] == 0).all()
            assert (joined.weight[row, :count] == 1).all()
            row += 1


def test_the_padding_of_joined_windows_is_at_a_place_and_a_time_of_theirs(make):
    joined = Window.join([make(1, 40), make(1, 10)])
    assert torch.equal(joined.ray[1, 10:], joined.ray[1, 9].expand(30, 3))
    assert (joined.phase[1, 9:] == 1).all()
    assert (joined.dt.diff(dim=1) >= 0).all()


def test_one_window_needs_no_padding(make):
    part = make(2, 30)
    assert Window.join([part]) is part


def test_joined_windows_of_one_length_are_the_windows(make):
    window = make(4, 30)
    joined = Window.join([window[:1], window[1:]])
    for name in ("ray", "dt", "polarity", "start", "duration"):
        assert torch.equal(getattr(joined, name), getattr(window, name))


def test_the_phase_goes_from_zero_to_one_and_is_a_number_where_nothing_lasts(make):
    window = make(3, 20)
    assert (window.phase[:, 0] == 0).all()
    assert (window.phase[:, -1] == 1).all()
    instant = Window(window.ray, 0 * window.dt, window.polarity, window.start, 0 * window.duration)
    assert (instant.phase == 0).all()


def test_a_thinned_window_lasts_as_long(make):
    window = make(2, 20)
    thin = window.thinned(3)
    assert torch.equal(thin.ray, window.ray[:, [0, 3, 6, 9, 12, 15, 18]])
    assert torch.equal(thin.phase, window.phase[:, [0, 3, 6, 9, 12, 15, 18]])
    assert torch.equal(thin.duration, window.duration)


def test_another_precision_leaves_the_clock_whole(make):
    window = make(2, 20)
    single = window.to("cpu", torch.float32)
    assert single.start.dtype == torch.int64
    assert {single.ray.dtype, single.dt.dtype, single.polarity.dtype, single.duration.dtype} == {torch.float32}
