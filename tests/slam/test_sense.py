"""What a window says of itself: supported events beyond chance, and directions of motion that events decide."""

import math
from dataclasses import replace

import pytest
import torch

from torchcmax.core.camera import Camera
from torchcmax.core.window import Window
from torchcmax.slam.sense import NAMES, Sensing, around, beyond_chance, decided, name_of, support

CAMERA = Camera.pinhole((90, 120), 100 / 120)
HOW = Sensing(slice=0.01, busy=0.04)
SECONDS = 0.04


def window_of(x, y, dt, seconds=SECONDS, camera=CAMERA):
    """Events at pixels and moments, sorted, in a window that lasts so long."""
    x, y, dt = (torch.as_tensor(part) for part in (x, y, dt))
    order = dt.argsort()
    ray, polarity = camera.rays()[y[order], x[order]].float(), torch.ones(1, len(dt))
    return Window(ray[None], dt[order][None].float(), polarity, torch.tensor([0]), torch.tensor([seconds]))


def noise(count, seed=0, seconds=SECONDS, camera=CAMERA):
    random = torch.Generator().manual_seed(seed)
    x, y = (torch.randint(n, (count,), generator=random) for n in (120, 90))
    return window_of(x, y, torch.rand(count, generator=random) * seconds, seconds, camera)


def information_of(seed=0, rank=12, size=1.0):
    """Symmetric, of some rank."""
    random = torch.randn(12, rank, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return size * random @ random.mT


@pytest.mark.parametrize("count", [200, 1000, 3000])
@pytest.mark.parametrize("distortion", [0.0, -0.35])
def test_events_that_are_anywhere_are_supported_as_often_as_chance_says(count, distortion):
    camera = Camera((90, 120), 100, 100, 59.5, 44.5, (distortion, -0.37 * distortion, 0.0, 0.0, 0.0))
    how = Sensing(slice=0.01, busy=0.2)
    many = [support(noise(count, seed, camera=camera), camera, how) for seed in range(8)]
    supported, chance = (sum(part) / len(many) for part in zip(*many, strict=True))
    assert chance == pytest.approx(1 - math.exp(-8 * count / (4 * 90 * 120)))
    assert supported == pytest.approx(chance, abs=0.012)  # at the sensor's edge there are fewer pixels around


@pytest.mark.parametrize("count", [3000, 20_000])
def test_of_a_busy_window_so_few_events_are_looked_at_together_that_chance_says_little(count):
    supported, chance = support(noise(count), CAMERA, HOW)
    assert 0.2 < chance <= 1 - math.exp(-8 * HOW.busy) + 1e-3
    assert supported == pytest.approx(chance, abs=0.05)


def test_events_of_a_moving_edge_support_each_other():
    x = torch.arange(10, 70).repeat_interleave(20)
    y, dt = torch.arange(20, 40).repeat(60), (x - 10) / 60 * SECONDS
    supported, chance = support(window_of(x, y, dt), CAMERA, HOW)
    assert supported == 1
    assert chance < 0.25


def test_a_pixel_that_fires_again_and_again_does_not_support_itself():
    pixels = torch.tensor([[10, 10], [10, 50], [80, 30], [119, 89], [0, 0]]).repeat(40, 1)
    dt = torch.linspace(0, SECONDS, len(pixels))
    assert support(window_of(*pixels.T, dt), CAMERA, HOW)[0] == 0
    beside = window_of(torch.tensor([10, 11]).repeat(40), torch.full((80,), 10), torch.linspace(0, SECONDS, 80))
    assert support(beside, CAMERA, HOW)[0] == 1


@pytest.mark.parametrize(("dx", "dy", "supported"), [(1, 0, 1), (0, -1, 1), (-1, 1, 1), (1, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 0)])
def test_support_comes_from_the_eight_pixels_around(dx, dy, supported):
    assert support(window_of([40, 40 + dx], [40, 40 + dy], [0.011, 0.012]), CAMERA, HOW)[0] == supported


def test_support_does_not_wrap_around_the_sensor():
    assert support(window_of([119, 0, 60, 60], [20, 21, 0, 89], [0.011] * 4), CAMERA, HOW)[0] == 0


@pytest.mark.parametrize(("seconds", "supported"), [(0.01, 0.0), (0.05, 1.0)])
def test_events_that_are_farther_apart_in_time_than_a_slice_do_not_support_each_other(seconds, supported):
    assert support(window_of([40, 41], [40, 40], [0.0, SECONDS]), CAMERA, Sensing(slice=seconds))[0] == supported


def test_padding_neither_counts_nor_supports():
    one = window_of([40, 60], [40, 40], [0.0, 0.001])
    beside = CAMERA.rays()[40, torch.tensor([41, 61, 61])].float()[None]
    padded = replace(
        one,
        ray=torch.cat([one.ray, beside], 1),
        dt=torch.cat([one.dt, one.dt[:, -1:].expand(-1, 3)], 1),
        polarity=torch.cat([one.polarity, torch.zeros(1, 3)], 1),
    )
    assert support(padded, CAMERA, HOW) == support(one, CAMERA, HOW)
    assert support(padded, CAMERA, HOW)[0] == 0
    assert support(replace(padded, polarity=-torch.ones(1, 5)), CAMERA, HOW)[0] == 1


def test_a_window_without_duration_or_events_has_a_number_too():
    assert support(window_of([40, 41], [40, 40], [0.0, 0.0], 0.0), CAMERA, HOW)[0] == 1
    one = window_of([40], [40], [0.0])
    assert support(replace(one, polarity=torch.zeros(1, 1)), CAMERA, HOW)[0] == 0


def test_motion_is_told_from_noise(sheet):
    how = Sensing()
    for i in (5, 15, 25):
        assert beyond_chance(*support(sheet.windows[i], sheet.camera, how)) > 1.5 * how.noise
    for seed in range(5):
        for count in (800, 3000):
            assert beyond_chance(*support(noise(count, seed, camera=sheet.camera), sheet.camera, how)) < how.noise


@pytest.mark.parametrize("dim", [1, 2])
def test_around_is_the_sum_of_three(dim):
    image = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0))
    before, n = image.clone(), image.shape[dim]
    found = around(image, dim)
    assert torch.equal(image, before)
    for i in range(n):
        torch.testing.assert_close(found.select(dim, i), image.narrow(dim, max(0, i - 1), min(n, i + 2) - max(0, i - 1)).sum(dim))


@pytest.mark.parametrize("chance", [0.0, 0.3, 0.9])
def test_beyond_chance_goes_from_zero_to_one(chance):
    assert beyond_chance(chance, chance) == 0
    assert beyond_chance(chance / 2, chance) == 0
    assert beyond_chance(1.0, chance) == pytest.approx(1)
    assert beyond_chance((1 + chance) / 2, chance) == pytest.approx(0.5)


def test_where_chance_supports_all_nothing_is_beyond_it():
    assert beyond_chance(1.0, 1.0) == 0


@pytest.mark.parametrize("rank", [0, 5, 12])
def test_shares_are_ascending_and_zero_where_only_the_prediction_speaks(rank):
    share, directions = decided(information_of(0, rank), information_of(1))
    assert share.shape == (12,)
    assert directions.shape == (12, 12)
    assert bool((share >= 0).all() and (share <= 1).all())
    assert torch.equal(share, share.sort().values)
    assert float(share[: 12 - rank].sum()) == pytest.approx(0, abs=1e-9)
    assert bool((share[12 - rank :] > 1e-6).all())


def test_much_information_decides_everything():
    prior = information_of(1)
    shares = [float(decided(information_of(0, size=size), prior)[0][0]) for size in (1e-3, 1.0, 1e3, 1e9)]
    assert shares == sorted(shares)
    assert shares[0] < 0.1
    assert shares[-1] > 0.999


def test_as_much_information_as_was_known_decides_half():
    prior = information_of(1)
    torch.testing.assert_close(decided(prior, prior)[0], torch.full((12,), 0.5, dtype=torch.float64))


@pytest.mark.parametrize("rank", [5, 12])
def test_directions_are_eigenvectors_in_the_metric_of_all_that_is_known(rank):
    A, P = information_of(0, rank), information_of(1)
    share, v = decided(A, P)
    torch.testing.assert_close(A @ v, (A + P) @ v * share, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(v.norm(dim=0), torch.ones(12, dtype=torch.float64))
    away = v.mT @ (A + P) @ v
    assert float((away - away.diagonal().diag()).abs().max()) < 1e-8 * float(away.diagonal().max())


def test_shares_do_not_depend_on_the_units_of_a_step():
    A, P = information_of(0), information_of(1)
    units = torch.logspace(-2, 2, 12, dtype=torch.float64)
    share, v = decided(A, P)
    other, w = decided(A * units[:, None] * units, P * units[:, None] * units)
    torch.testing.assert_close(other, share, rtol=1e-6, atol=1e-9)
    back = torch.nn.functional.normalize(w * units[:, None], dim=0)
    torch.testing.assert_close((back * v).sum(0).abs(), torch.ones(12, dtype=torch.float64), rtol=1e-6, atol=0)


def test_a_direction_is_named_by_the_number_it_has_most_of():
    assert len(set(NAMES)) == 12
    for i, name in enumerate(["turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z", "omega_x", "omega_y", "omega_z"]):
        assert name_of(torch.eye(12)[i] * -0.9 + 0.1, torch.arange(12)) == name
    assert name_of(torch.eye(12)[11] - 0.3, torch.arange(12)) == "v_z"


def test_the_direction_that_nothing_is_known_of_is_named():
    information = torch.ones(12, dtype=torch.float64)
    information[5] = 1e-6
    share, directions = decided(information.diag(), torch.eye(12, dtype=torch.float64))
    assert name_of(directions[:, 0], torch.arange(12)) == "shift_z"
    assert float(share[0]) == pytest.approx(1e-6, rel=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"slice": 0.0}, {"busy": 0.0}, {"certain": 0.0}, {"hopeless": 0.0}, {"patience": 0.0}, {"recent": 0},
        {"noise": -0.1}, {"noise": 1.1}, {"weak": 1.1},
    ],
)  # fmt: skip
def test_sensing_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match="sensing wants"):
        Sensing(**wrong)


def test_nothing_is_decided_where_the_numbers_are_none():
    share, directions = decided(torch.full((12, 12), float("nan"), dtype=torch.float64), torch.eye(12, dtype=torch.float64))
    assert not share.any()
    assert torch.equal(directions, torch.eye(12, dtype=torch.float64))
