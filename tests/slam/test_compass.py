"""Searches over all orientations: the orientations that are tried, how they are scored, and windows of a recording that are found."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from test_globe import FOCAL, ZERO, at, border, globe_of, street, turn, windows
from torch.nn.functional import normalize

from torchcmax.core import so3
from torchcmax.core.camera import Canvas, Sphere
from torchcmax.core.pose import Pose
from torchcmax.slam.compass import Compass, Level, Turning, distinct, orientations
from torchcmax.slam.glimpse import Glimpse
from torchcmax.slam.globe import WALL, Globe
from torchcmax.slam.run import still

assert border is not None  # fixtures
assert street is not None
assert windows is not None
QUICK = Turning(keep=(60, 30, 15, 8, 4))
DRAWN = 14  # windows that draw the globe; those after them look where it is known as well, for a while


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def anywhere(count, seed=0):
    """Rotations, all as likely: [count, 3, 3]."""
    return so3.from_quaternion(normalize(randn(count, 4, seed=seed), dim=-1))


def degrees(R, T):
    """Between each of R [N] and each of T [M]."""
    return ((torch.einsum("nij,mij->nm", R, T) - 1) / 2).clamp(-1, 1).arccos().rad2deg()


# orientations


@pytest.mark.parametrize("step", [8.0, 15.0, 30.0])
def test_every_rotation_is_near_one_that_is_tried_and_no_two_are_the_same(step):
    R = orientations(step)
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), atol=1e-9)
    assert torch.allclose(torch.linalg.det(R), torch.ones(len(R), dtype=torch.float64))
    assert degrees(anywhere(300), R).amin(1).max() < 0.85 * step
    some = R[torch.randperm(len(R), generator=torch.Generator().manual_seed(0))[:100]]
    nearest = degrees(some, R).topk(2, 1, largest=False).values
    assert nearest[:, 0].max() < 1e-4
    assert nearest[:, 1].min() > 0.85 * step


@pytest.mark.parametrize("step", [8.0, 30.0])
def test_there_are_as_many_as_the_volume_of_all_rotations_wants(step):
    """8 pi^2 / step^3."""
    assert len(orientations(step)) == pytest.approx(8 * math.pi**2 / math.radians(step) ** 3, rel=0.05)


def test_the_best_are_kept_and_none_near_a_better_one():
    """As if each were compared with all that are kept, best first."""
    R, score = anywhere(80), torch.rand(80, generator=torch.Generator().manual_seed(1))
    kept = []
    for i in score.argsort(descending=True).tolist():
        if all(degrees(R[i : i + 1], R[j : j + 1]) > 40 for j in kept):
            kept.append(i)
    assert 12 < len(kept) < 80
    assert distinct(R, score, 80, math.radians(40)).tolist() == kept
    assert distinct(R, score, 7, math.radians(40)).tolist() == kept[:7]


def test_two_that_are_apart_are_both_kept_and_two_that_are_not_are_one():
    R = torch.cat([turn(0.0, 0.0, 0.0), turn(0.0, 0.099, 0.0), turn(0.101, 0.0, 0.0), turn(math.pi, 0.0, 0.0)])
    assert distinct(R, torch.tensor([0.5, 0.4, 0.3, 0.9]), 9, 0.1).tolist() == [3, 0, 2]
    assert distinct(R, torch.tensor([0.4, 0.5, 0.3, 0.1]), 1, 0.1).tolist() == [1]


# scores


@dataclass
class Points:
    """A glimpse that shows these strengths [N] at these rays [3, N]."""

    ray: torch.Tensor
    strength: torch.Tensor

    def pooled(self, pool, sigma):
        return self.ray, self.strength


@pytest.fixture
def handmade():
    """A compass with a globe of noise, of which half is known: what is ahead."""
    sphere = Sphere(48)
    strength = torch.rand(sphere.size, generator=torch.Generator().manual_seed(0))
    known = torch.zeros(sphere.size)
    known[:, 24:72] = 1
    compass = Compass(Globe(sphere.focal, torch.tensor([[0.3, 0.3, 1.0]])), Turning(known=0.4))
    compass._levels[2.0] = Level((strength * known).flatten(), known.flatten(), sphere)
    return compass


def rays():
    """A grid of them, 12 degrees to each side and 9 up and down."""
    x, y = torch.meshgrid(torch.linspace(-0.2, 0.2, 15), torch.linspace(-0.15, 0.15, 12), indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), torch.ones(180)])


def shown(compass, R, ray):
    """What the globe shows at the pixels nearest to rays [3, N] of a camera."""
    sphere, level = compass._levels[2.0].sphere, compass._levels[2.0]
    column, row = sphere.pixels((R[0] @ ray.double()).T).round().long().unbind(-1)
    place = row.clamp(0, sphere.height - 1) * 2 * sphere.height + column % (2 * sphere.height)
    return level.strength[place], level.known[place]


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (0.3, -0.4, 2.0), (0.9, 0.5, -1.0)])
def test_the_score_of_what_the_globe_shows_is_one_whatever_its_contrast_and_of_its_negative_minus_one(handmade, where):
    R, ray = turn(*where), rays()
    T, known = shown(handmade, R, ray)
    assert known.all()
    for S, expected in ((T, 1.0), (3 * T + 2, 1.0), (0.1 * T, 1.0), (-T, -1.0)):
        score, share = handmade.scores(Points(ray, S), R, 2.0)
        assert float(score) == pytest.approx(expected, abs=1e-4)
        assert float(share) == 1


def test_the_score_is_the_correlation_of_window_and_globe(handmade):
    R, ray = anywhere(40, seed=2), rays()
    S = torch.rand(180, generator=torch.Generator().manual_seed(3))
    score, known = handmade.scores(Points(ray, S), R, 2.0)
    checked = 0
    for i in range(40):
        T, w = shown(handmade, R[i : i + 1], ray)
        share = float(w.mean())
        assert float(known[i]) == pytest.approx(share, abs=1e-6)
        if share <= 0.4:
            assert float(score[i]) == -1
            continue
        expected = torch.corrcoef(torch.stack([T[w > 0], S[w > 0]]))[0, 1] * share**0.5
        assert float(score[i]) == pytest.approx(float(expected), abs=1e-3)
        checked += 1
    assert 5 < checked < 35


def test_what_is_flat_scores_nothing(handmade):
    score, _ = handmade.scores(Points(rays(), torch.full((180,), 0.7)), turn(0.0, 0.0, 0.0), 2.0)
    assert abs(float(score)) < 1e-3


def test_looking_half_beyond_what_is_known_is_worth_less_and_farther_nothing(handmade):
    """The border of what is known goes through the middle of the view: a score of sqrt(1/2), and so on."""
    ray = rays()
    for away, share in ((0.0, 0.5), (-0.1, 0.73)):
        R = turn(0.0, math.pi / 2 + away, 0.0)
        T, w = shown(handmade, R, ray)
        score, known = handmade.scores(Points(ray, T), R, 2.0)
        assert float(known) == pytest.approx(share, abs=0.06)
        assert float(score) == pytest.approx(float(w.mean()) ** 0.5, abs=1e-3)
    beyond = turn(0.0, math.pi / 2 + 0.08, 0.0)
    score, known = handmade.scores(Points(ray, shown(handmade, beyond, ray)[0]), beyond, 2.0)
    assert float(score) == -1
    assert 0 < float(known) < 0.4


def test_scores_of_many_are_those_of_each(handmade, monkeypatch):
    monkeypatch.setattr("torchcmax.slam.compass.AT_ONCE", 900)  # five orientations at a time
    R, glimpse = anywhere(33, seed=4), Points(rays(), torch.rand(180, generator=torch.Generator().manual_seed(5)))
    score, known = handmade.scores(glimpse, R, 2.0)
    each = [handmade.scores(glimpse, one, 2.0) for one in R.split(1)]
    assert torch.allclose(score, torch.cat([s for s, _ in each]), atol=1e-6)
    assert torch.equal(known, torch.cat([k for _, k in each]))


def test_what_is_known_does_not_fade_towards_what_is_not():
    """Edges as strong everywhere, known ahead: blurred, they are as strong up to the border, which lies where it lay."""
    globe = Globe(FOCAL, torch.tensor([[0.3, 0.3, 1.0]]))
    columns = slice(20, 60)  # of cells
    globe.layers.votes[:] = 5.0
    globe.layers.exposure[0, :, columns] = 50.0
    level = Compass(globe, QUICK).level(4.0)
    strength, known = (part.view(globe.sphere.size) for part in (level.strength, level.known))
    expected = float(globe.strength()[0, 4 * 40])
    inside = torch.zeros(globe.sphere.size, dtype=torch.bool)
    inside[:, 80:240] = True
    flat = slice(len(known) // 4, 3 * len(known) // 4)  # up to 45 degrees: near the poles what is blurred goes round
    assert torch.equal(known[flat] > 0, inside[flat])
    assert torch.allclose(strength[known > 0], torch.full_like(strength[known > 0], expected), atol=1e-4)
    assert not known[~inside].any()


# windows of a recording


@pytest.fixture(scope="module")
def true(windows):
    return windows


@pytest.fixture(scope="module")
def globe(border, windows):
    return globe_of(border, *windows[:DRAWN])


@pytest.fixture(scope="module")
def compass(globe):
    return Compass(globe, QUICK)


@pytest.fixture(scope="module")
def glimpse(street, border):
    """What a keyframe shows, with the angular velocity that it says."""
    sensor = Canvas.around(street.camera, 0.0)
    return lambda k: Glimpse.drawn(k.ink, k.seconds, k.state.motion, WALL.normal, sensor, border)


def off(found, keyframe):
    return float(degrees(found.state.pose.R[:1], keyframe.state.pose.R))


@pytest.mark.parametrize("number", [0, 6, 13, 15])
def test_a_window_is_found_among_all_orientations(compass, true, glimpse, number):
    """Windows that drew the map, and one that did not."""
    found = compass.far(glimpse(true[number]))
    assert off(found, true[number]) < 0.5
    assert found.score[0] > QUICK.accept
    assert found.known[0] > 0.8
    assert found.score.tolist() == sorted(found.score.tolist(), reverse=True)
    assert torch.equal(found.state.motion.velocity, torch.zeros_like(found.state.motion.velocity))


@pytest.mark.parametrize("where", [(0.0, 3.0, 0.0), (-1.5, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_a_window_is_found_over_seam_and_pole(border, true, glimpse, where):
    W = turn(*where)
    there = [at(k, W @ k.state.pose.R) for k in true[:DRAWN]]
    found = Compass(globe_of(border, *there), QUICK).far(glimpse(there[7]))
    assert off(found, there[7]) < 0.5
    assert found.score[0] > QUICK.accept


def test_a_window_is_found_around_a_guess_and_not_beyond(compass, true, glimpse):
    one = true[5]
    for away in ((0.05, -0.1, 0.05), (-0.1, 0.05, -0.08), (0.0, 0.0, 0.0)):
        guess = still(one.state.pose @ Pose(turn(*away), ZERO))
        assert off(compass.near(glimpse(one), guess), one) < 0.5
    far = compass.near(glimpse(one), still(one.state.pose @ Pose(turn(0.0, 0.0, 1.2), ZERO)))
    assert off(far, one) > 30  # it was looked for up to 17 degrees (30 px) around
    assert far.score[0] < QUICK.accept


def test_a_window_is_found_at_the_pose_of_the_keyframe_it_is_near(compass, true, glimpse):
    poses = Pose(torch.cat([k.state.pose.R for k in true[::4]]), torch.zeros(len(true[::4]), 3, dtype=torch.float64))
    found = compass.at(glimpse(true[6]), poses)
    assert off(found, true[6]) < 0.5


def test_where_the_globe_shows_the_same_twice_both_places_are_found_and_neither_is_clear(border, true, glimpse):
    W = turn(0.3, 2.5, 0.0)
    twice = Compass(globe_of(border, *true[:DRAWN], *(at(k, W @ k.state.pose.R) for k in true[:DRAWN])), QUICK)
    found, one = twice.far(glimpse(true[9])), true[9].state.pose.R
    apart = degrees(found.state.pose.R[:2], torch.cat([one, W @ one]))
    assert apart.amin(1).max() < 0.5
    assert apart.amin(0).max() < 0.5
    assert found.score[1] > 0.95 * found.score[0]
    assert found.clear < QUICK.ratio
    assert found.away[0] == 0
    assert float(found.away[1]) == pytest.approx(2 * FOCAL * math.sin(2.5 / 2), rel=0.2)  # px, between points on a sphere
    between = degrees(found.state.pose.R, found.state.pose.R) + 180 * torch.eye(len(found.score))
    assert between.min() > math.degrees(12 / FOCAL) * 0.99


def test_a_place_that_the_globe_shows_once_is_clear(compass, true, glimpse):
    assert compass.far(glimpse(true[9])).clear > QUICK.ratio


def test_a_search_brings_turns_and_angular_velocity_to_the_map(compass, true, glimpse):
    """Where the window says that it turns a little otherwise, the map puts it right."""
    one = true[8]
    wrong = at(one, omega=one.state.motion.omega + torch.tensor([[0.2, 0.2, 0.2]], dtype=torch.float64))
    found = compass.near(glimpse(wrong), still(one.state.pose))
    assert off(found, one) < 0.5
    assert (found.state.motion.omega[0] - one.state.motion.omega[0]).norm() < (wrong.state.motion.omega - one.state.motion.omega).norm()


def test_it_judges_the_true_orientation_best(compass, true, glimpse):
    one = true[8]
    right = compass.judge(glimpse(one), one.state)
    assert right > QUICK.accept
    scores = []
    for axis in torch.eye(3, dtype=torch.float64):
        away = (still(one.state.pose @ Pose(so3.exp(math.radians(d) * axis)[None], ZERO)) for d in (-4, -2, 2, 4))
        scores.append([compass.judge(glimpse(one), state) for state in away])
    assert max(map(max, scores)) < right
    for out, near, other, beyond in scores:
        assert near > out
        assert other > beyond


@pytest.mark.parametrize("seed", [0, 1])
def test_noise_is_nowhere(compass, true, glimpse, seed):
    """As many events as a window has, anywhere on the sensor."""
    one, random = true[4], torch.Generator().manual_seed(seed)
    low, high = compass.globe.border[:, :2].amin(0), compass.globe.border[:, :2].amax(0)
    x, y = (low[i] + (high[i] - low[i]) * torch.rand(one.ink.x.shape, generator=random) for i in (0, 1))
    found = compass.far(glimpse(replace(one, ink=replace(one.ink, x=x, y=y))))
    assert found.score[0] < QUICK.accept


def test_what_a_mirror_shows_is_nowhere(compass, true, glimpse):
    """As many edges as elsewhere, but no turn brings them onto the map."""
    one = true[7]
    mirrored = replace(one, ink=replace(one.ink, x=-one.ink.x))
    assert compass.far(glimpse(mirrored)).score[0] < QUICK.accept


def test_what_is_not_known_is_no_place(compass, true, glimpse):
    away = still(Pose(turn(0.0, 2.5, 0.0), ZERO))
    assert compass.judge(glimpse(true[3]), away) == -1
    score, known = compass.scores(glimpse(true[3]), turn(0.0, 2.5, 0.0), 2.0)
    assert float(score) == -1
    assert float(known) == 0


def test_an_empty_globe_is_no_place_anywhere(border, true, glimpse):
    found = Compass(Globe(FOCAL, border), Turning(steps=(30.0,), keep=(3,))).far(glimpse(true[0]))
    assert (found.score == -1).all()
    assert not found.known.any()


def test_the_sensors_edge_is_seen_where_the_camera_looks(compass):
    """Points on a sphere of one focal length: so far from each other as px, and turned with the camera."""
    xyz = compass.seen(still(Pose(turn(0.3, 1.0, -0.5), ZERO)))
    ahead = compass.seen(still(Pose(turn(0.0, 0.0, 0.0), ZERO)))
    assert torch.allclose(xyz.norm(dim=-1), torch.full(xyz.shape[:2], FOCAL, dtype=torch.float64))
    assert torch.allclose(xyz, ahead @ turn(0.3, 1.0, -0.5).mT)
    side = compass.seen(still(Pose(turn(0.0, 0.01, 0.0), ZERO))) - ahead
    assert float(side.norm(dim=-1).max()) == pytest.approx(0.01 * FOCAL, rel=0.2)


def test_a_compass_is_of_the_globe_as_it_was(border, true, glimpse):
    globe = globe_of(border, *true[:5])
    compass = Compass(globe, QUICK)
    before = compass.judge(glimpse(true[3]), true[3].state)
    fresh = Compass(globe, QUICK)
    globe.draw(true[5:DRAWN])
    globe.layers.votes.mul_(2)
    assert fresh.judge(glimpse(true[3]), true[3].state) == before


@pytest.mark.parametrize("wrong", [{"steps": ()}, {"keep": (3,)}, {"steps": (1.0, 0.0), "keep": (2, 2)}, {"steps": (1.0,), "keep": (0,)}])
def test_steps_and_numbers_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match="relocalizing wants as many steps above 0 as numbers to keep"):
        Turning(**wrong)
