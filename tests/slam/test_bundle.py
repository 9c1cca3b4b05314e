"""Joint optimization of a globe's keyframes: by hand on rings of wishes, and on windows that were turned away from the truth."""

import math
from types import SimpleNamespace

import pytest
import torch
from test_globe import FOCAL, at, border, events, globe_of, street, turn, windows

from torchcmax.core import so3
from torchcmax.core.match import Matching, loosely
from torchcmax.core.pose import Pose
from torchcmax.score import rotation
from torchcmax.slam import bundle
from torchcmax.slam.bundle import STEADY, Wish, agreed, settled, together, wanted
from torchcmax.slam.globe import Globe
from torchcmax.slam.mapper import LOOSE, WORSE

assert border is not None  # fixtures
assert street is not None
assert windows is not None
FIRST = 14  # keyframes that are used
EYE = torch.eye(3, dtype=torch.float64)
Z = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
CORNER = torch.tensor([[0.6, 0.45, 1.0]])  # sees up to 36.87 degrees from the middle
FIELD = math.atan(0.75)


@pytest.fixture(scope="module")
def true(windows):
    return windows[:FIRST]


@pytest.fixture(scope="module")
def drawn(border, true):
    """The globe that the truth draws."""
    return globe_of(border, *true)


def randn(*shape, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def disturbed(true, degrees):
    """Keyframes turned by some degrees, each in a direction of its own: {number: degrees}."""
    axes = torch.nn.functional.normalize(randn(len(true), 3), dim=-1)
    return [at(k, k.state.pose.R @ so3.exp(axes[i : i + 1] * math.radians(degrees.get(i, 0)))) for i, k in enumerate(true)]


def off(keyframes, true):
    """degrees from the truth, with one rotation of all between them."""
    here, there = (Pose(torch.cat([k.state.pose.R for k in some]), torch.zeros(len(some), 3).double()) for some in (keyframes, true))
    return so3.log((rotation(here, there) @ here).R.mT @ there.R).norm(dim=-1).rad2deg()


def looking(*R):
    """A globe of keyframes that look so, and show nothing."""
    globe = Globe(FOCAL, CORNER)
    globe.keyframes = [events((0.0, 0.0), R=one) for one in R]
    return globe


def wish(turn, information=None):
    return Wish(turn, torch.zeros(3, dtype=torch.float64), EYE if information is None else information)


def information(seed):
    A = randn(3, 3, seed=seed)
    return 1e4 * (A @ A.mT + 0.1 * EYE)


# together


def test_keyframes_do_not_turn_away_from_the_first_one_together(border, true):
    globe = globe_of(border, *true)
    for _ in range(8):
        globe = settled(globe, Matching())
    turned = torch.cat([so3.log(a.state.pose.R @ b.state.pose.R.mT) for a, b in zip(globe.keyframes, true, strict=True)])[1:]
    assert turned.mean(0).norm().rad2deg() < 0.15


def test_one_keyframe_beside_the_first_gets_what_it_wishes_less_what_keeps_it():
    globe = looking(turn(0.0, 0.0, 0.0), turn(0.1, 0.2, 2.0))
    for known in (EYE, information(0)):
        assert torch.allclose(together(globe, {1: wish(Z, known)})[1], Z / (1 + STEADY))


def test_two_that_wish_the_same_pull_each_other_along():
    """Both sit between the first, which stays, and each other: (theta / 2 - z)^2 + STEADY theta^2 -> min, in whatever frames."""
    R = turn(0.0, 0.0, 0.0), turn(0.0, 0.0, 1.0), turn(0.0, 0.0, -2.0)
    found = together(looking(*R), {i: wish(R[i][0].mT @ Z) for i in (1, 2)})
    for i in (1, 2):
        assert torch.allclose(R[i][0] @ found[i], Z / 2 / (0.25 + STEADY))


def test_a_neighbour_counts_less_the_farther_it_looks_away(monkeypatch):
    """Keyframe 1 looks where the first does, 2 half a field of view away, with a quarter of the weight: theta_1 - theta_2 / 5 = z,
    theta_2 = theta_1 / 2."""
    monkeypatch.setattr(bundle, "STEADY", 0.0)
    R = turn(0.0, 0.0, 0.0), turn(0.0, 0.0, 0.5), turn(0.0, FIELD / 2, 0.0)
    globe = looking(*R)
    assert globe.field_of_view == pytest.approx(FIELD)
    found = together(globe, {1: wish(R[1][0].mT @ Z), 2: wish(0 * Z)})
    assert torch.allclose(R[1][0] @ found[1], Z / 0.9, rtol=1e-6)
    assert torch.allclose(R[2][0] @ found[2], Z / 1.8, rtol=1e-6)


def test_those_who_see_nothing_of_each_other_do_not_follow_each_other():
    globe = looking(turn(0.0, 0.0, 0.0), turn(0.1, 0.0, 0.0), turn(0.0, 2.0, 0.0), turn(0.0, 2.1, 0.0))
    found = together(globe, {1: wish(Z), 2: wish(0 * Z), 3: wish(0 * Z)})
    assert torch.allclose(found[1], Z / (1 + STEADY))
    assert not found[2].any()
    assert not found[3].any()


def test_only_those_who_wish_move_and_the_others_hold_them():
    R = turn(0.0, 0.0, 0.0), turn(0.0, 0.1, 0.0), turn(0.0, 0.15, 0.0), turn(0.0, 0.2, 0.0)
    found = together(looking(*R), {2: wish(Z)})
    assert found.keys() == {2}
    assert torch.allclose(found[2], Z / (1 + STEADY))


def test_what_is_known_better_is_followed_and_what_is_known_less_gives_way():
    """Two against each other, one a million times as certain: it gets its wish, as if the other one followed it."""
    R = turn(0.0, 0.0, 0.0), turn(0.0, 0.0, 0.0), turn(0.0, 0.0, 0.0)
    sure, unsure = wish(Z, 1e6 * EYE), wish(-Z)
    found = together(looking(*R), {1: sure, 2: unsure})
    A = torch.tensor([[1e3, -5e2], [-0.5, 1.0], [STEADY**0.5 * 1e3, 0.0], [0.0, STEADY**0.5]], dtype=torch.float64)
    share = torch.linalg.lstsq(A, torch.tensor([[1e3], [-1.0], [0.0], [0.0]], dtype=torch.float64)).solution[:, 0]
    assert torch.allclose(found[1], share[0] * Z)
    assert torch.allclose(found[2], share[1] * Z)
    assert (found[1] @ Z) > 0 > (found[2] @ Z)


def test_it_does_not_matter_how_the_world_is_turned():
    R = [so3.exp(0.2 * randn(1, 3, seed=i)) for i in range(6)]
    wishes = {i: wish(0.01 * randn(3, seed=10 + i), information(i)) for i in range(1, 6)}
    W = turn(1.5, -2.0, 0.7)
    here, there = together(looking(*R), wishes), together(looking(*(W @ one for one in R)), wishes)
    for i in wishes:
        assert torch.allclose(here[i], there[i], atol=1e-9)


def ring(count):
    return [turn(0.0, 2 * math.pi * i / count, 0.0) @ turn(0.2 * math.sin(i), 0.0, 0.3 * i) for i in range(count)]


def wishes_of(globe, error, known):
    """What keyframes wish that are turned by `error` [n, 3] rad in the world: each sees how far it is from the mean of its neighbours."""
    axes = torch.cat([k.state.pose.R[:, :, 2] for k in globe.keyframes])
    found = {}
    for i in range(1, len(axes)):
        weight = (1 - (axes @ axes[i]).clamp(-1, 1).arccos() / globe.field_of_view).clamp_min(0).square()
        weight[i] = 0
        seen = error[i] - (weight / weight.sum()) @ error
        found[i] = wish(-globe.keyframes[i].state.pose.R[0].mT @ seen, known(i))
    return found


@pytest.mark.parametrize("known", [lambda i: EYE, information], ids=["all alike", "each otherwise"])
def test_a_ring_whose_wishes_agree_is_put_right_at_once(monkeypatch, known):
    """Errors of any size and direction, and wishes about neighbours alone: all of it is undone but for what keeps keyframes in place."""
    monkeypatch.setattr(bundle, "STEADY", 0.0)
    globe = looking(*ring(24))
    error = 0.05 * randn(24, 3)
    error[0] = 0
    found = together(globe, wishes_of(globe, error, known))
    turns = torch.stack([globe.keyframes[i].state.pose.R[0] @ found[i] for i in range(1, 24)])
    assert torch.allclose(turns, -error[1:], atol=1e-9)


def test_what_a_ring_is_off_where_it_closes_is_spread_over_all_of_it():
    """A drift of 0.1 rad over a full circle: from round to round the gap at its end shrinks, until there are larger steps elsewhere."""
    count, drift = 24, torch.tensor([0.02, 0.1, -0.03], dtype=torch.float64)
    globe = looking(*ring(count))
    error = torch.arange(count, dtype=torch.float64)[:, None] / count * drift
    gaps = [float(error[-1].norm())]
    for _ in range(25):
        found = together(globe, wishes_of(globe, error, lambda i: EYE))
        turns = torch.stack([torch.zeros(3).double(), *(globe.keyframes[i].state.pose.R[0] @ found[i] for i in range(1, count))])
        error = error + turns
        gaps.append(float(error[-1].norm()))
        steps = (error - error.roll(1, 0)).norm(dim=-1)
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[1] < 0.5 * gaps[0]
    assert gaps[-1] < float(steps.max()) < 0.2 * gaps[0]


# what keyframes want


def test_a_keyframe_wants_back_to_where_it_was(border, true):
    """Of 0.3 degrees at least two thirds, in the right direction, and then little."""
    degrees = {5: 0.3, 10: 0.3}
    globe = globe_of(border, *disturbed(true, degrees))
    found = wanted(globe, [4, 5, 10], Matching(), [5])
    for i in degrees:
        needed = so3.log(globe.keyframes[i].state.pose.R.mT @ true[i].state.pose.R)[0]
        assert (found[i].turn - needed).norm() < needed.norm() / 3
    assert found[4].turn.norm().rad2deg() < 0.1


def test_what_is_known_of_a_turn_is_symmetric_positive_and_more_across_the_view(drawn):
    for one in wanted(drawn, [3, 8], Matching(), []).values():
        A = one.information
        assert torch.allclose(A, A.mT, rtol=1e-6)
        values, vectors = torch.linalg.eigh(A)
        assert values[0] > 0
        assert vectors[:, 0].abs().argmax() == 2  # of the turn about the view itself it knows least: corners move less
        assert values[2] ** -0.5 < math.radians(0.3)  # and of the others it is sure


def test_what_is_known_of_a_turn_is_known_whatever_the_angular_velocity_is(drawn, monkeypatch):
    """The inverse of its share of the covariance of both, in rad: of information [14, 14] per px^2 that is given, and a loose prior."""
    A = randn(14, 14)
    A = A @ A.mT + EYE.new_ones(14).diag()
    x = randn(1, 14, seed=2)
    monkeypatch.setattr(bundle, "match", lambda q, task, how: SimpleNamespace(x=x, information=A[None]))
    one = drawn.keyframes[4]
    unit = torch.tensor([1 / FOCAL] * 3 + [1 / FOCAL / float(one.seconds)] * 3, dtype=torch.float64)  # of a px, in rad and rad/s
    numbers = [0, 1, 2, 6, 7, 8]
    covariance = torch.linalg.inv((A + loosely(*LOOSE))[numbers][:, numbers]) * unit[:, None] * unit
    found = wanted(drawn, [4], Matching(), [])[4]
    assert torch.allclose(found.information, torch.linalg.inv(covariance[:3, :3]), rtol=1e-6)
    assert torch.allclose(torch.cat([found.turn, found.rate]), x[0, numbers] * unit)


def test_those_that_judge_say_what_they_met(drawn):
    found = wanted(drawn, [2, 3, 4], Matching(), [3])
    assert found[2].met == found[4].met == 0
    assert 0.2 < found[3].met < 1
    assert agreed(drawn, [3], Matching(), drawn.typical()) == pytest.approx(found[3].met, rel=1e-6)


def test_a_keyframe_that_looks_where_no_other_does_wants_nothing(border, true):
    alone = at(true[3], turn(0.0, 2.5, 0.0))
    globe = globe_of(border, *true[:3], alone)
    assert not wanted(globe, [3], Matching(), [3])
    assert agreed(globe, [3], Matching(), globe.typical()) == 0
    found = settled(globe, Matching())
    assert torch.equal(found.keyframes[3].state.pose.R, alone.state.pose.R)


def test_keyframes_meet_more_where_they_truly_are(border, true, drawn):
    wrong = globe_of(border, *disturbed(true, dict.fromkeys(range(1, FIRST), 1.0)))
    numbers = [3, 6, 9, 12]
    assert agreed(wrong, numbers, Matching(), drawn.typical()) < 0.8 * agreed(drawn, numbers, Matching(), drawn.typical())


# rounds


@pytest.mark.parametrize("degrees", [{6: 0.3}, {13: 0.3}, {2: 0.3, 7: 0.3, 11: 0.3}], ids=["one", "the last one", "three"])
def test_a_round_brings_keyframes_nearer_to_the_truth(border, true, degrees):
    globe = globe_of(border, *disturbed(true, degrees))
    once = settled(globe, Matching())
    twice = settled(once, Matching())
    which = list(degrees)
    assert off(once.keyframes, true)[which].max() < 0.15
    assert off(twice.keyframes, true)[which].max() < 0.1
    rest = [i for i in range(1, FIRST) if i not in degrees]
    assert off(twice.keyframes, true)[rest].max() < 0.1


def test_rounds_bring_all_of_them_nearer_to_the_truth(border, true):
    globe = globe_of(border, *disturbed(true, dict.fromkeys(range(1, FIRST), 0.3)))
    for _ in range(4):
        globe = settled(globe, Matching())
    assert off(globe.keyframes, true).mean() < 0.1


def test_where_keyframes_truly_are_they_stay(drawn, true):
    globe = settled(drawn, Matching())
    assert off(globe.keyframes, true).max() < 0.15
    assert off(globe.keyframes, true).mean() < 0.08


@pytest.mark.parametrize("last", [None, 5, 100])
def test_the_first_keyframe_never_moves_and_no_position_does(border, true, last):
    globe = globe_of(border, *disturbed(true, dict.fromkeys(range(FIRST), 0.2)))
    found = settled(globe, Matching(), last)
    assert found is not globe
    assert torch.equal(found.keyframes[0].state.pose.R, globe.keyframes[0].state.pose.R)
    assert torch.equal(found.keyframes[0].state.motion.omega, globe.keyframes[0].state.motion.omega)
    for keyframe in found.keyframes:
        assert not keyframe.state.pose.t.any()
        assert not keyframe.state.motion.velocity.any()
        assert torch.allclose(keyframe.state.pose.R @ keyframe.state.pose.R.mT, EYE, atol=1e-9)


@pytest.mark.parametrize(("last", "moved"), [(None, FIRST - 1), (3, 3), (1, 1), (FIRST, FIRST - 1)])
def test_the_last_ones_move_that_are_asked_and_no_other(border, true, last, moved):
    globe = globe_of(border, *disturbed(true, dict.fromkeys(range(1, FIRST), 0.2)))
    found = settled(globe, Matching(), last)
    same = [torch.equal(a.state.pose.R, b.state.pose.R) for a, b in zip(globe.keyframes, found.keyframes, strict=True)]
    assert same == [True] * (FIRST - moved) + [False] * moved


def test_angular_velocities_are_put_right_with_the_turns(border, true):
    wrong = [at(k, omega=k.state.motion.omega * (1.2 if i == 6 else 1)) for i, k in enumerate(true)]
    globe = globe_of(border, *wrong)
    for _ in range(2):
        globe = settled(globe, Matching())
    here, there, before = (some[6].state.motion.omega for some in (globe.keyframes, true, wrong))
    assert (here - there).norm() < 0.5 * (before - there).norm()


def test_a_round_leaves_the_globe_that_it_was_given_and_draws_a_new_one(border, true):
    globe = globe_of(border, *disturbed(true, {4: 0.3}))
    globe.number = 7
    votes, keyframes = globe.layers.votes.clone(), list(globe.keyframes)
    found = settled(globe, Matching())
    assert torch.equal(globe.layers.votes, votes)
    assert globe.keyframes == keyframes
    assert found.number == 7
    again = globe_of(border, *found.keyframes)
    assert torch.equal(found.layers.votes, again.layers.votes)
    assert torch.equal(found.layers.exposure, again.layers.exposure)


def test_a_round_is_the_same_each_time(border, true):
    globe = globe_of(border, *disturbed(true, {3: 0.3, 8: 0.2}))
    one, other = (settled(globe, Matching()) for _ in range(2))
    for a, b in zip(one.keyframes, other.keyframes, strict=True):
        assert torch.equal(a.state.pose.R, b.state.pose.R)


@pytest.mark.parametrize(("degrees", "kept"), [(1.5, True), (0.0, False)])
def test_a_round_that_makes_it_worse_is_not_taken(drawn, monkeypatch, degrees, kept):
    wrong = math.radians(degrees) * torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    monkeypatch.setattr(bundle, "together", lambda _, wishes: {i: wrong * (-1) ** i for i in wishes})
    assert (settled(drawn, Matching()) is drawn) == kept


@pytest.mark.parametrize(("share", "kept"), [(0.99, True), (1.01, False)])
def test_a_little_worse_is_allowed(drawn, monkeypatch, share, kept):
    monkeypatch.setattr(bundle, "wanted", lambda globe, numbers, *_: {i: Wish(0 * Z, 0 * Z, EYE, 0.5) for i in numbers})
    monkeypatch.setattr(bundle, "agreed", lambda *_: share * WORSE * 0.5)
    assert (settled(drawn, Matching()) is drawn) == kept


def test_a_globe_with_nothing_to_move_stays(border, true):
    for globe in (Globe(FOCAL, border), globe_of(border, true[0])):
        assert settled(globe, Matching()) is globe
        assert settled(globe, Matching(), 3) is globe


def test_keyframes_over_the_pole_find_their_place_as_well(border, true):
    W = turn(-1.5, 0.0, 0.0)
    there = [at(k, W @ k.state.pose.R) for k in true]
    assert max(float(k.state.pose.R[0, 1, 2].abs()) for k in there) > 0.99
    globe = globe_of(border, *disturbed(there, {5: 0.3, 9: 0.3}))
    for _ in range(2):
        globe = settled(globe, Matching())
    assert off(globe.keyframes, there)[[5, 9]].max() < 0.12
    assert not torch.cat([Pose(k.state.pose.R, k.state.pose.t).t for k in globe.keyframes]).any()
