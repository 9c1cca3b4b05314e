"""Joint optimization of a globe's keyframes, and searches over all orientations."""

import math
from dataclasses import replace

import pytest
import torch
from test_sphere import border, globe_of, keyframe, street, turn

from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.match import Matching
from torchcmax.core.pose import Pose
from torchcmax.core.state import State
from torchcmax.score import rotation
from torchcmax.slam.bundle import Wish, settled, together
from torchcmax.slam.compass import Compass, Turning, distinct, orientations
from torchcmax.slam.glimpse import Glimpse
from torchcmax.slam.globe import WALL, Globe
from torchcmax.slam.run import still

assert border is not None
assert street is not None
MANY = 14
QUICK = Turning(steps=(8.0, 4.0, 2.0, 1.0, 0.5), keep=(60, 30, 15, 8, 4))


@pytest.fixture(scope="module")
def windows(street):
    """Keyframes where they truly are."""
    return [keyframe(street, i) for i in range(MANY)]


def off(globe, windows):
    """degrees of each keyframe from the truth, with one rotation of all between them."""
    here, there = (Pose(torch.cat([k.state.pose.R for k in some]), torch.zeros(MANY, 3).double()) for some in (globe.keyframes, windows))
    return so3.log((rotation(here, there) @ here).R.mT @ there.R).norm(dim=-1).rad2deg()


def disturbed(windows, degrees, which):
    step = torch.zeros(1, 12, dtype=torch.float64)
    random = torch.Generator().manual_seed(3)
    made = []
    for i, k in enumerate(windows):
        step = step.clone()
        step[0, :3] = torch.randn(3, generator=random, dtype=torch.float64) * math.radians(degrees) if i in which else 0
        made.append(k.at(k.state.moved(step)))
    return made


def test_keyframes_that_are_off_find_their_place_and_the_first_one_stays(border, windows):
    which = range(2, MANY, 3)
    globe = globe_of(border, *disturbed(windows, 0.4, which))
    before = off(globe, windows)
    for _ in range(3):
        globe = settled(globe, Matching())
    after = off(globe, windows)
    assert after[list(which)].mean() < 0.4 * before[list(which)].mean()
    assert torch.equal(globe.keyframes[0].state.pose.R, windows[0].state.pose.R)
    assert not torch.cat([k.state.pose.t for k in globe.keyframes]).any()
    assert not torch.cat([k.state.motion.velocity for k in globe.keyframes]).any()


def test_only_the_last_ones_move_where_only_these_are_asked(border, windows):
    globe = globe_of(border, *disturbed(windows, 0.3, range(1, MANY)))
    found = settled(globe, Matching(), 4)
    moved = [not torch.equal(a.state.pose.R, b.state.pose.R) for a, b in zip(globe.keyframes, found.keyframes, strict=True)]
    assert moved == [False] * (MANY - 4) + [True] * 4


def test_a_round_that_makes_it_worse_is_not_taken(border, windows, monkeypatch):
    globe = globe_of(border, *windows)
    wrong = torch.tensor([0.05, 0.05, 0.05], dtype=torch.float64)
    monkeypatch.setattr("torchcmax.slam.bundle.together", lambda _, wishes: {i: wrong * (-1) ** i for i in wishes})
    assert settled(globe, Matching()) is globe


def test_a_globe_of_one_keyframe_stays(border, windows):
    globe = globe_of(border, windows[0])
    assert settled(globe, Matching()) is globe


def test_what_a_closed_circle_is_off_is_spread_over_all_of_it(border, windows):
    """A ring of cameras, each a little too far ahead: from round to round all share what the last one is off."""
    count, error = 24, 0.1
    globe, axis = Globe(100.0, border), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    off = [error * i / count for i in range(count)]
    for round_ in range(25):
        poses = (Pose(turn(0.0, 2 * math.pi * i / count + off[i], 0.0), torch.zeros(1, 3, dtype=torch.float64)) for i in range(count))
        globe.keyframes = [windows[0].at(still(pose)) for pose in poses]
        axes = torch.cat([k.state.pose.R[:, :, 2] for k in globe.keyframes])
        wishes = {}
        for i in range(1, count):  # each sees how far it is from its neighbours, and how far it should be
            weight = (1 - (axes @ axes[i]).clamp(-1, 1).arccos() / globe.field_of_view).clamp_min(0).square()
            weight[i] = 0
            gap = torch.tensor([off[i] - off[j] for j in range(count)], dtype=torch.float64)
            wishes[i] = Wish(-axis * (weight * gap).sum() / weight.sum(), torch.zeros(3), 1e6 * torch.eye(3, dtype=torch.float64))
        found = together(globe, wishes)
        if round_ == 0:
            assert -0.9 * error < float(found[count - 1][1]) < -0.4 * error
        off = [0.0, *(off[i] + float(found[i][1]) for i in range(1, count))]
    steps = [abs(one - other) for one, other in zip(off, [*off[1:], off[0]], strict=True)]
    assert max(steps) < 0.2 * error  # where the last one meets the first it was nearly all


def test_orientations_are_everywhere_and_none_is_far():
    R = orientations(20.0)
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), atol=1e-9)
    assert (torch.linalg.det(R) > 0).all()
    random = so3.exp(3 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    trace = torch.einsum("kij,nij->nk", R, random).amax(1)
    assert ((trace - 1) / 2).clamp(-1, 1).arccos().rad2deg().max() < 20.0


def test_the_best_orientations_are_kept_and_none_twice():
    R = torch.cat([turn(0.0, 0.001 * i, 0.0) for i in range(5)] + [turn(0.0, 1.0, 0.0)])
    kept = distinct(R, torch.tensor([1.0, 5.0, 2.0, 3.0, 4.0, 0.5]), 3, 0.1)
    assert kept.tolist() == [1, 5]


@pytest.fixture(scope="module")
def compass(border, windows):
    return Compass(globe_of(border, *windows), QUICK)


def glimpse_of(street, border, one):
    sensor = Canvas.around(street.camera, 0.0)
    return Glimpse.drawn(one.ink, one.seconds, one.state.motion, WALL.normal, sensor, border)


@pytest.mark.parametrize("number", [3, 10])
def test_a_window_is_found_among_all_orientations(street, border, compass, windows, number):
    found = compass.far(glimpse_of(street, border, windows[number]))
    assert so3.log(found.state.pose.R[:1].mT @ windows[number].state.pose.R).norm().rad2deg() < 0.7
    assert found.score[0] > QUICK.accept
    assert found.clear > QUICK.ratio


def test_a_window_is_found_around_a_guess(street, border, compass, windows):
    guess = windows[5].state.pose @ Pose(turn(0.05, -0.1, 0.06), torch.zeros(1, 3, dtype=torch.float64))
    found = compass.near(glimpse_of(street, border, windows[5]), still(guess))
    assert so3.log(found.state.pose.R[:1].mT @ windows[5].state.pose.R).norm().rad2deg() < 0.7


def test_noise_is_found_nowhere(street, border, compass, windows):
    one, random = windows[4], torch.Generator().manual_seed(0)
    order = torch.randperm(one.ink.x.shape[1], generator=random)
    noise = replace(one, ink=replace(one.ink, x=one.ink.x[:, order]))
    found = compass.far(glimpse_of(street, border, noise))
    assert not (found.score[0] >= QUICK.accept and found.clear >= QUICK.ratio)


def test_what_is_hardly_known_is_no_place(street, border, compass, windows):
    away = State(Pose(turn(1.5, 0.0, 0.0), torch.zeros(1, 3, dtype=torch.float64)), windows[0].state.motion)
    assert compass.judge(glimpse_of(street, border, windows[0]), away) == -1


def test_a_compass_stays_as_the_globe_was(border, windows):
    globe = globe_of(border, *windows[:3])
    one = Compass(globe, QUICK)
    before = one.globe.layers.votes.clone()
    globe.draw(windows[3:6])
    assert torch.equal(one.globe.layers.votes, before)


@pytest.mark.parametrize("wrong", [{"steps": ()}, {"keep": (3,)}, {"steps": (1.0, -1.0), "keep": (2, 2)}, {"accept": 2.0}])
def test_searches_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match="relocalizing wants"):
        Turning(**wrong)
