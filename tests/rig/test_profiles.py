"""Profiles against closed forms, against ruckig where it is installed, and against their own limits at random."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcmax.rig.profiles import Dwell, Move, Sequence, constant_pass, cruise, repeat, sync

PLACE, LIMIT = st.floats(-2, 2), st.floats(0.01, 50)
JERK = st.one_of(st.just(math.inf), st.floats(0.1, 5000))
MOVES = st.builds(Move, PLACE, PLACE, LIMIT, LIMIT, JERK)


def times(profile):
    """Many, and both sides of every node."""
    nodes = np.append(profile.nodes[:, 0], profile.duration)
    return np.unique(np.concatenate([np.linspace(0, profile.duration, 500), nodes, np.nextafter(nodes, -1)]).clip(0))


def test_a_trapezoid_by_hand():
    """0.6 m at 1 m/s and 10 m/s²: 0.1 s and 50 mm of ramp, 0.5 s between."""
    move = Move(0.1, 0.7, 1.0, 10.0)
    assert move.duration == pytest.approx(0.7, abs=1e-15)
    state = move.sample([-1, 0.05, 0.1, 0.35, 0.65, 0.7, 9])
    np.testing.assert_allclose(state.x, [0.1, 0.1125, 0.15, 0.4, 0.6875, 0.7, 0.7], atol=1e-15)
    np.testing.assert_allclose(state.v, [0, 0.5, 1, 1, 0.5, 0, 0], atol=1e-14)
    np.testing.assert_allclose(state.a, [0, 10, 0, 0, -10, 0, 0], atol=1e-13)


def test_a_triangle_by_hand():
    move = Move(0.0, -0.1, 5.0, 10.0)
    assert move.peak == pytest.approx(1.0)
    assert move.duration == pytest.approx(0.2)
    assert move.sample(0.1).v == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("length", "v", "a", "j", "duration", "pieces"),
    [
        (10.0, 2.0, 1.0, 1.0, 5 + 2 + 1, 7),  # L/v + v/a + a/j
        (10.0, 0.25, 1.0, 1.0, 40 + 2 * 0.5, 5),  # L/v + 2 sqrt(v/j): the acceleration is not reached
        (6.0, 9.0, 1.0, 1.0, 6 / 2 + 3, 6),  # v (v/a + a/j) = L: v = 2, which the limit is above
        (2.0, 9.0, 9.0, 1.0, 4.0, 4),  # (32 L/j)^(1/3): only the jerk is
    ],
)
def test_s_curves_by_hand(length, v, a, j, duration, pieces):
    move = Move(0.0, length, v, a, j)
    assert move.duration == pytest.approx(duration, rel=1e-14)
    ends = np.append(move.nodes[:, 0], move.duration)
    assert (np.diff(ends) > 1e-9).sum() == pieces


@given(move=MOVES)
def test_a_move_arrives_within_its_limits(move):
    t = times(move)
    state = move.sample(t)
    assert state.x[-1] == pytest.approx(move.end, abs=1e-9)
    assert move.sample(move.duration + 1).x == move.end
    assert abs(state.v[[0, -1]]).max() < 1e-7
    assert abs(state.v).max() <= move.v * (1 + 1e-9)
    assert abs(state.a).max() <= move.a * (1 + 1e-9)
    assert abs(state.j).max() <= move.j * (1 + 1e-9)
    assert (np.diff(state.x) * move.way >= -1e-12).all()  # neither back nor beyond
    assert (np.diff(state.x) <= move.v * np.diff(t) * (1 + 1e-9) + 1e-12).all()  # continuous


@given(move=MOVES)
def test_a_move_is_the_integral_of_its_derivatives(move):
    t = times(move)
    state = move.sample(t)
    middle, step = move.sample((t[1:] + t[:-1]) / 2), np.diff(t)
    np.testing.assert_allclose(np.diff(state.x), step * (state.v[1:] + 4 * middle.v + state.v[:-1]) / 6, atol=1e-10)
    if math.isfinite(move.j):
        np.testing.assert_allclose(np.diff(state.v), step * middle.a, atol=1e-9)
        rounded = 2 * np.spacing(t[1:])  # what two times are known to
        assert (abs(np.diff(state.a)) <= move.j * (step * (1 + 1e-6) + rounded) + 1e-9 * move.a).all()


@given(move=MOVES)
def test_a_move_backwards_in_time_is_the_same(move):
    t = np.linspace(0, move.duration, 101)
    forth, back = move.sample(t), move.sample(move.duration - t)
    np.testing.assert_allclose(forth.x - move.begin, move.end - back.x, atol=1e-10)
    np.testing.assert_allclose(forth.v, back.v, atol=1e-7)


@given(move=st.builds(Move, PLACE, PLACE, LIMIT, LIMIT, st.floats(0.1, 5000)))
def test_durations_are_those_of_ruckig(move):
    ruckig = pytest.importorskip("ruckig", reason="ruckig is not installed")
    wanted = ruckig.InputParameter(1)
    wanted.current_position, wanted.target_position = [move.begin], [move.end]
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [move.v], [move.a], [move.j]
    found = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(wanted, found)
    assert move.duration == pytest.approx(found.duration, rel=1e-9, abs=1e-9)


@given(x0=PLACE, length=st.floats(0.001, 2), way=st.sampled_from([-1, 1]), v=LIMIT, a=LIMIT, j=JERK, settle=st.floats(0, 0.5))
def test_a_pass_is_constant_where_it_counts(x0, length, way, v, a, j, settle):
    move = constant_pass(x0, x0 + way * length, v, a, j, settle)
    between = length / v + 2 * settle
    begin = (move.duration - between) / 2
    state = move.sample(begin + between * np.linspace(0.001, 0.999, 100))
    np.testing.assert_allclose(state.v, way * v, rtol=1e-12)
    assert move.sample(begin + settle).x == pytest.approx(x0, abs=1e-9)
    assert move.sample(begin + settle + length / v).x == pytest.approx(x0 + way * length, abs=1e-9)


def test_a_cruise_keeps_its_velocity():
    move = cruise(0.5, -2.0, 10.0, 3.0)
    assert move.duration == pytest.approx(3.4)
    assert move.end == pytest.approx(0.5 - 2.0 * 3.2)
    state = move.sample(np.linspace(0.2, 3.2, 50)[1:-1])
    np.testing.assert_array_equal(state.v, -2.0)
    assert move.mode == "velocity"


def test_a_sequence_tells_its_moves_and_rests_between():
    there, back = Move(0, 1, 1, 2), Move(1, 0, 1, 2)
    both = Sequence((there, Dwell(1, 0.5), back))
    assert [time for time, _ in both.moves] == pytest.approx([0, 2.0])
    assert both.duration == pytest.approx(3.5)
    twice = repeat(both, 2)
    t = np.linspace(-1, 8, 1000)
    expected = np.where(t < 3.5, both.sample(t).x, both.sample(t - 3.5).x)
    np.testing.assert_allclose(twice.sample(t).x, expected, atol=1e-12)
    assert len(twice.moves) == 4
    with pytest.raises(ValueError, match="begins at 0"):
        Sequence((there, Dwell(0, 1)))
    assert Move(1, 1, 1, 1).duration == 0
    assert Move(1, 1, 1, 1).moves == ()


@pytest.mark.parametrize("see", [lambda v: v, abs], ids=["velocity", "speed"])
def test_the_sync_pattern_looks_like_itself_at_one_offset_only(see):
    """Farther off than a move takes, it correlates with itself by about one move of eight, with either sign."""
    pattern = sync(0.2, 0.28, 0.7, 6.0, 0.02)
    t = np.arange(-1, pattern.duration + 1, 0.005)
    signal = see(pattern.sample(t).v)
    signal = signal - signal.mean()
    correlation = np.correlate(signal, signal, "full") / (signal @ signal)
    lag = abs(np.arange(len(correlation)) - len(signal) + 1) * 0.005
    width = pattern.moves[0][1].duration
    assert abs(correlation[lag > width]).max() < 0.2
    assert pattern.end == pattern.begin
    assert len(pattern.moves) == 8


def test_no_two_moves_of_the_sync_pattern_follow_each_other_alike():
    start = np.array([time for time, _ in sync(0.0, 0.1, 1.0, 10.0, 0.03).moves])
    apart = (start[None] - start[:, None])[np.triu_indices(8, 1)]
    assert np.diff(np.sort(apart)).min() > 0.2 + 0.03 - 1e-9  # a whole move and its pause
