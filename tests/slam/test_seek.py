"""The search of a lost camera: it is believed once it has moved, fits well, is certain, and fits better than elsewhere."""

import math
import time
from dataclasses import replace
from threading import Event

import pytest
import torch
from scenes import drawn, map_of, pixels, state_of, wall

from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.state import State
from torchcmax.slam.relocalize import Found, Grid, Relocalizing
from torchcmax.slam.seek import MOST, SAME, SIGMA, Candidate, Searching, Seeker
from torchcmax.slam.tiles import TILE
from torchcmax.slam.tracker import Belief, Tracking, before_plane, covariance_of, rays_of, speed

QUICK = Relocalizing(turn=30.0, tilts=((0.0, 1),), wait=0.05)
FIRST = 8  # window at which the search begins


@pytest.fixture(scope="module")
def home(sheet):
    """The map that every second window draws."""
    return drawn(sheet, range(0, len(sheet.windows), 2))


@pytest.fixture
def seeker_on(sheet):
    """Makes seekers, and closes them."""
    made = []

    def make(m, how=QUICK, certain=1.0):
        canvas, sensor = Canvas.around(sheet.camera), Canvas.around(sheet.camera, 0.0)
        made.append(Seeker(m, Grid(m, how), canvas, sensor, rays_of(sheet.camera), Searching(how, Tracking(), "planar", certain)))
        return made[-1]

    yield make
    for seeker in made:
        seeker.close()


def shown(scene, i):
    """A window with the motion that makes it sharp and the plane's normal."""
    motion, there = before_plane(scene.states[i], scene.plane)
    return scene.windows[i], motion, there.normal


def offered(seeker, scene, which):
    """Windows until the camera is found: the number of the last one, and where."""
    for i in which:
        found = seeker.offer(*shown(scene, i))
        if found is not None:
            return i, found
    return None


def from_first(scene, first=FIRST):
    return range(first, len(scene.windows))


def error(scene, state, i):
    return pixels([state], scene.plane, [scene.states[i]], scene.plane, scene.camera)


def degrees(scene, state, i):
    return math.degrees(float(so3.log(state.pose.R.mT @ scene.states[i].pose.R).norm()))


def moved_px(scene, which):
    """px that the image truly moves in some windows."""
    rays = rays_of(scene.camera)
    return sum(speed(scene.states[i], scene.plane, rays, scene.focal) * float(scene.windows[i].duration[0]) for i in which)


def noise(scene, i, random):
    """The window with its events anywhere on the sensor."""
    flat, (window, motion, normal) = scene.camera.rays().view(-1, 3).float(), shown(scene, i)
    return replace(window, ray=flat[torch.randint(len(flat), (window.ray.shape[1],), generator=random)][None]), motion, normal


def scored(score, x=0.0):
    """A candidate before a wall that has shifted by so many px."""
    belief = Belief(torch.tensor([0]), state_of(shift=(x / 100, 0.0, 0.0)), covariance_of(SIGMA))
    return Candidate(belief, [score])


@pytest.mark.parametrize("first", [0, FIRST])
def test_a_camera_is_found_from_consecutive_windows(sheet, home, seeker_on, first):
    seeker = seeker_on(home)
    i, found = offered(seeker, sheet, from_first(sheet, first))
    assert i > first
    assert error(sheet, found.state, i) < 1
    assert degrees(sheet, found.state, i) < 1
    assert torch.equal(found.time, sheet.windows[i].middle)
    assert seeker.searches >= 1
    assert seeker.candidates[0].score >= QUICK.accept
    assert float((found.state.motion.omega - sheet.states[i].motion.omega).norm()) < 0.5


@pytest.mark.parametrize("confirm", [(0.0, 3), (0.0, 12), (45.0, 0), (60.0, 3)])
def test_a_place_is_believed_only_after_motion_and_windows(sheet, home, seeker_on, confirm):
    seeker = seeker_on(home, replace(QUICK, confirm=confirm))
    i, _ = offered(seeker, sheet, from_first(sheet))
    px, windows = confirm
    best = seeker.candidates[0]
    count = len(best.scores) - 1
    followed = range(i - count + 1, i + 1)
    assert count >= windows
    assert followed[0] >= FIRST
    assert best.moved >= px
    assert best.moved == pytest.approx(moved_px(sheet, followed), rel=0.05)


def test_windows_after_which_a_place_is_believed_are_those_since_it_was_found(sheet, home, seeker_on):
    few, many = (offered(seeker_on(home, replace(QUICK, confirm=(0.0, n))), sheet, from_first(sheet))[0] for n in (0, 14))
    assert few < FIRST + 8
    assert FIRST + 13 <= many < FIRST + 20


def test_too_little_motion_is_never_enough(sheet, home, seeker_on):
    seeker = seeker_on(home, replace(QUICK, confirm=(1000.0, 3)))
    assert offered(seeker, sheet, from_first(sheet)) is None
    assert seeker.candidates[0].score > QUICK.accept
    assert error(sheet, seeker.candidates[0].belief.state, len(sheet.windows) - 1) < 1


def test_a_doubtful_place_is_never_sure(sheet, home, seeker_on):
    seeker = seeker_on(home, certain=0.0)
    assert offered(seeker, sheet, from_first(sheet)) is None
    best = seeker.candidates[0]
    assert best.moved > QUICK.confirm[0]
    assert best.score > QUICK.accept
    assert 0 < seeker.doubt(best) < 1


def test_a_place_that_fits_too_little_is_never_sure(sheet, home, seeker_on):
    seeker = seeker_on(home, replace(QUICK, accept=0.95))
    assert offered(seeker, sheet, range(FIRST, FIRST + 12)) is None
    assert seeker.candidates[0].moved > QUICK.confirm[0]
    assert 0.6 * 0.95 < seeker.candidates[0].score < 0.95


def test_windows_of_noise_are_never_sure(sheet, home, seeker_on):
    seeker, random = seeker_on(home), torch.Generator().manual_seed(0)
    for i in from_first(sheet):
        assert seeker.offer(*noise(sheet, i, random)) is None
    assert seeker.searches >= 2
    assert not seeker.candidates


@pytest.mark.parametrize(("ratio", "sure"), [(1.1, False), (0.9, True)])
def test_of_two_places_that_look_the_same_none_is_believed(sheet, home, seeker_on, ratio, sure):
    """The poster hangs twice on the wall, whole tiles apart."""
    away = 8 * TILE / sheet.focal * sheet.plane.across()[:, 0]
    twice = map_of(sheet.camera, sheet.plane)
    for keyframe in home.keyframes:
        pose = keyframe.state.pose
        twice.draw([keyframe, keyframe.at(State(replace(pose, t=pose.t + away), keyframe.state.motion))])
    seeker = seeker_on(twice, replace(QUICK, ratio=ratio))
    found = offered(seeker, sheet, from_first(sheet))
    best, other = seeker.candidates[:2]
    assert (found is not None) == sure
    assert other.score > max(QUICK.accept, best.score / 1.1)
    assert best.moved >= QUICK.confirm[0]
    assert float((best.belief.state.pose.t - other.belief.state.pose.t).norm()) == pytest.approx(float(away.norm()), rel=0.02)


def test_a_place_that_fits_no_more_is_given_up(sheet, home, seeker_on):
    seeker, random = seeker_on(home, replace(QUICK, confirm=(1000.0, 3), far=False)), torch.Generator().manual_seed(0)
    seeker.guess(*shown(sheet, FIRST))
    assert offered(seeker, sheet, range(FIRST, FIRST + 4)) is None
    assert len(seeker.candidates) == 1
    for i in range(FIRST + 4, FIRST + 9):
        seeker.offer(*noise(sheet, i, random))
    assert not seeker.candidates


def test_every_run_is_the_same(sheet, home, seeker_on):
    (i, one), (j, other) = (offered(seeker_on(home), sheet, from_first(sheet)) for _ in range(2))
    assert i == j
    assert torch.equal(one.time, other.time)
    for a, b in ((one.state.pose, other.state.pose), (one.state.motion, other.state.motion), (one, other)):
        for name in ("R", "t", "omega", "velocity", "covariance"):
            assert not hasattr(a, name) or torch.equal(getattr(a, name), getattr(b, name))


def test_a_camera_that_is_at_a_keyframe_is_found_without_a_search(sheet, home, seeker_on):
    seeker = seeker_on(home, replace(QUICK, far=False))
    seeker.guess(*shown(sheet, FIRST))
    best = seeker.candidates[0]
    assert error(sheet, best.belief.state, FIRST) < 1
    assert len(best.scores) == 1
    i, found = offered(seeker, sheet, from_first(sheet))
    assert error(sheet, found.state, i) < 1
    assert seeker.searches == 0
    assert len(seeker.candidates[0].scores) == i - FIRST + 2


def test_what_nothing_is_guessed_of_has_no_places(sheet, home, seeker_on):
    seeker = seeker_on(home)
    seeker.guess(*noise(sheet, FIRST, torch.Generator().manual_seed(0)))
    assert not seeker.candidates


def test_without_far_nothing_is_searched(sheet, home, seeker_on):
    seeker = seeker_on(home, replace(QUICK, far=False))
    assert offered(seeker, sheet, range(FIRST, FIRST + 4)) is None
    assert seeker.searches == 0
    assert seeker.flight is None


def nowhere(*_):
    one = torch.zeros(1)
    return Found(state_of(), one, one, one)


def test_searches_become_rarer_while_nothing_is_found(sheet, home, seeker_on, monkeypatch):
    monkeypatch.setattr(Grid, "far", nowhere)
    seeker, begun = seeker_on(home, replace(QUICK, wait=0.1, again=0.5)), []
    window, motion, normal = shown(sheet, FIRST)
    for ms in range(0, 2500, 10):
        before = seeker.searches
        assert seeker.offer(replace(window, start=torch.tensor([ms * 1000])), motion, normal) is None
        begun += [ms] * (seeker.searches - before)
    assert begun == [0, 200, 600, 1100, 1600, 2100]


def test_a_result_counts_after_the_wait_and_not_before(sheet, home, seeker_on, monkeypatch):
    monkeypatch.setattr(Grid, "far", nowhere)
    seeker = seeker_on(home, replace(QUICK, wait=0.1))
    window, motion, normal = shown(sheet, FIRST)
    flying = []
    for ms in (0, 50, 99, 100):
        seeker.offer(replace(window, start=torch.tensor([ms * 1000])), motion, normal)
        flying.append((seeker.flight is not None, len(seeker.since)))
    assert flying == [(True, 1), (True, 2), (True, 3), (False, 0)]


def test_windows_do_not_wait_for_a_search_where_runs_need_not_be_the_same(sheet, home, seeker_on, monkeypatch):
    go, search = Event(), Grid.far
    monkeypatch.setattr(Grid, "far", lambda grid, glimpse: search(grid, glimpse) if go.wait(30) else None)
    seeker = seeker_on(home, replace(QUICK, steady=False))
    began = time.monotonic()
    assert offered(seeker, sheet, range(FIRST, FIRST + 10)) is None
    assert time.monotonic() - began < 20
    assert seeker.searches == 1
    assert len(seeker.since) == 10
    go.set()
    seeker.flight.result()
    i, found = offered(seeker, sheet, from_first(sheet, FIRST + 10))
    assert i == FIRST + 10
    assert error(sheet, found.state, i) < 1


def test_a_better_place_nearby_is_taken_instead(sheet, home, seeker_on):
    seeker = seeker_on(home)
    true = Belief(sheet.windows[FIRST].middle, sheet.states[FIRST], covariance_of((0.1, 0.1, 0.1, 0.1)))
    beside = replace(true, state=true.state.moved(torch.tensor([[0.0] * 3 + [0.04, 0.03] + [0.0] * 7], dtype=torch.float64)))
    for belief, other in ((true, False), (beside, True)):
        score = seeker.judge(sheet.windows[FIRST], belief.state)
        found = seeker._polished(Candidate(belief, [score]), sheet.windows[FIRST])
        assert error(sheet, found.state, FIRST) < 1
        assert torch.equal(found.time, true.time)
        assert (found is not belief) == other
    torch.testing.assert_close(found.covariance, covariance_of(SIGMA))


def test_the_best_places_are_kept_and_of_those_that_fell_together_the_best(sheet, seeker_on):
    m = drawn(sheet, range(1))
    m.plane = wall()
    m.__dict__.pop("view", None)
    seeker = seeker_on(m)
    kept = seeker._merged([scored(0.4, 0.0), scored(0.6, SAME - 1), scored(0.5, 40), scored(0.45, 200), scored(0.7, 300), scored(0.3, 400)])
    assert [one.scores[0] for one in kept] == [0.7, 0.6, 0.5, 0.45]
    assert len(kept) == MOST
    assert seeker.apart(scored(1.0).belief.state, scored(1.0, 12.0).belief.state) == pytest.approx(12)


def test_the_score_of_a_place_is_that_of_the_last_five_windows():
    one = scored(0.0)
    one.scores = [0.0, 1.0]
    assert one.score == 0.5
    one.scores = [0.0, 0.0, 0.5, 0.6, 0.7, 0.8, 0.9]
    assert one.score == pytest.approx(0.7)


def test_a_motion_in_the_distances_of_a_camera_from_its_plane():
    state = state_of((0.2, 0.1, 0.3), (0.1, -0.2, 0.5), (1.0, 2.0, 3.0), (0.2, 0.4, -0.6))
    plane = wall(0.1, 0.2)
    motion, there = before_plane(state, plane)
    assert torch.equal(motion.omega, state.motion.omega)
    torch.testing.assert_close(motion.velocity * there.distance, state.motion.velocity)
    torch.testing.assert_close(there.normal, plane.seen_from(state.pose).normal)
    assert float(there.distance) == pytest.approx(float(plane.seen_from(state.pose).distance))


def test_a_covariance_has_the_squares_of_its_sigmas():
    wanted = torch.tensor([0.1] * 3 + [0.2] * 3 + [0.3] * 3 + [0.4] * 3, dtype=torch.float64).square().diag()
    torch.testing.assert_close(covariance_of((0.1, 0.2, 0.3, 0.4))[0], wanted)
