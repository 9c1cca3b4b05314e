"""A camera found in a map: correlation at all places, hypotheses, scores, and searches near and far."""

import math
from dataclasses import replace

import pytest
import torch
from scenes import Scene, drawn, keyframe_of, map_of, pixels, state_of, wall
from torch.nn.functional import avg_pool2d

from torchcmax import kernels
from torchcmax.core import so3
from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.draw import Ink
from torchcmax.core.pose import Motion
from torchcmax.core.state import State
from torchcmax.core.window import Window
from torchcmax.slam import relocalize
from torchcmax.slam.atlas import Similarity
from torchcmax.slam.map import Keyframe
from torchcmax.slam.relocalize import (
    APART,
    FLAT,
    SHARP,
    Found,
    Glimpse,
    Grid,
    Relocalizing,
    around,
    correlated,
    distinct,
    fast,
    found_at,
    judged,
    searched,
)  # fmt: skip
from torchcmax.slam.tracker import before_plane

CAMERA = Camera.pinhole((90, 120), 100 / 120)
QUICK = Relocalizing(turn=30.0, tilts=((0.0, 1),))
WHICH = 9  # window that is looked for; the map is drawn without it


def glimpse_of(scene, i, m, state=None):
    """What a window shows with the motion of a state, by default the true one."""
    motion, there = before_plane(state or scene.states[i], scene.plane)
    return Glimpse.of(scene.windows[i], motion, there.normal, Canvas.around(scene.camera, 0.0), m.border)


def error(scene, state, i=WHICH):
    return pixels([state], scene.plane, [scene.states[i]], scene.plane, scene.camera)


def elsewhere(scene, turn=(0.1, -0.05, 1.7), shift=(0.3, -0.2, 0.1), scale=1.3):
    """The same scene in another world, where the plane is not at distance one."""
    turn, shift = (torch.tensor([part], dtype=torch.float64) for part in (turn, shift))
    similarity = Similarity(so3.exp(turn), shift, torch.tensor([scale], dtype=torch.float64))
    normal = (similarity.R @ scene.plane.normal[..., None])[..., 0]
    plane = replace(scene.plane, normal=normal, distance=similarity.scale * scene.plane.distance - (normal * shift).sum(-1))
    return Scene(scene.camera, scene.windows, [similarity.state(s) for s in scene.states], plane)


def glance(shift):
    """A keyframe that sees a wall and no edge."""
    none = torch.zeros(1, 1)
    return Keyframe(0, state_of(shift=shift, velocity=(0.3, 0.3, 0.0)), torch.ones(1, dtype=torch.float64), Ink(none, none, none, none))


def window_of_nothing():
    """One event in the middle."""
    return Window(torch.tensor([[[0.0, 0.0, 1.0]]]), torch.zeros(1, 1), torch.ones(1, 1), torch.tensor([0]), torch.tensor([0.02]))


@pytest.fixture(scope="module")
def home(sheet):
    """The map that every second window draws, ready for searching."""
    return Grid(drawn(sheet, range(0, len(sheet.windows), 2)), QUICK)


@pytest.fixture(scope="module")
def glimpse(sheet, home):
    return glimpse_of(sheet, WHICH, home)


@pytest.fixture(scope="module")
def empty():
    """A wall that is known, without an edge, from three heights."""
    m = map_of(CAMERA, wall())
    m.draw([glance((0.0, 0.0, z)) for z in (0.5, 0.0, -1.0)])
    return m


def test_an_fft_is_as_large_as_the_next_product_of_two_three_and_five():
    smooth = sorted(2**a * 3**b * 5**c for a in range(12) for b in range(8) for c in range(6))
    for size in range(1, 700):
        assert fast(size) == next(n for n in smooth if n >= size)


def one_place(image, covered, coarse, row, column):
    """Masked correlation of one template with a map, place by place: -> correlation, places that both know."""
    half, pairs = image.shape[0] // 2, []
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            r, c = row + i - half, column + j - half
            if 0 <= r < coarse.shape[1] and 0 <= c < coarse.shape[2] and covered[i, j] > 0 and coarse[0, r, c] > 0:
                pairs.append((float(image[i, j]), float(coarse[1, r, c])))
    if not pairs:
        return 0.0, 0
    S, T = torch.tensor(pairs, dtype=torch.float64).T
    S, T = S - S.mean(), T - T.mean()
    return float((S * T).mean() / math.sqrt(max(float(S.square().mean()), FLAT) * max(float(T.square().mean()), FLAT))), len(pairs)


def test_correlation_at_all_places_is_that_of_each_place():
    random = torch.Generator().manual_seed(0)
    known = (torch.rand(13, 19, generator=random) > 0.25).double()
    known[4:7, 9:13] = 0
    strength = torch.rand(13, 19, generator=random, dtype=torch.float64) * known
    strength[9:, 14:] = 0.3 * known[9:, 14:]  # flat
    coarse = torch.stack([known, strength, strength.square()])
    covered = (torch.rand(3, 7, 7, generator=random) > 0.3).double()
    image = torch.rand(3, 7, 7, generator=random, dtype=torch.float64) * covered
    score, share = correlated(image, covered, coarse)
    assert score.shape == share.shape == (3, 13, 19)
    for a in range(3):
        for row in range(13):
            for column in range(19):
                wanted, count = one_place(image[a], covered[a], coarse, row, column)
                assert float(share[a, row, column]) == pytest.approx(count / float(covered[a].sum()), abs=1e-9)
                assert count == 0 or float(score[a, row, column]) == pytest.approx(wanted, abs=1e-8)


def test_a_template_that_is_larger_than_the_map_is_correlated_too():
    random = torch.Generator().manual_seed(1)
    coarse = torch.rand(1, 5, 4, generator=random, dtype=torch.float64).expand(3, -1, -1).clone()
    coarse[0], coarse[2] = 1, coarse[1].square()
    image = torch.rand(1, 9, 9, generator=random, dtype=torch.float64)
    score, share = correlated(image, torch.ones_like(image), coarse)
    for row in range(5):
        for column in range(4):
            wanted, count = one_place(image[0], torch.ones(9, 9), coarse, row, column)
            assert float(share[0, row, column]) == pytest.approx(count / 81)
            assert float(score[0, row, column]) == pytest.approx(wanted, abs=1e-8)


def test_a_part_of_the_map_correlates_fully_with_its_place():
    strength = torch.rand(20, 30, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    coarse = torch.stack([torch.ones_like(strength), strength, strength.square()])
    image = 0.2 + 3 * strength[5:14, 11:20][None]
    score, share = correlated(image, torch.ones_like(image), coarse)
    assert divmod(int(score[0].argmax()), 30) == (9, 15)
    assert float(score[0, 9, 15]) == pytest.approx(1, abs=1e-3)
    assert float(share[0, 9, 15]) == pytest.approx(1)


def test_pooled_rays_are_the_means_of_their_pixels(glimpse):
    canvas = Canvas(100.0, (59.5, 44.5), (91, 122))
    strength = torch.rand(91, 122, generator=torch.Generator().manual_seed(0))
    inside = torch.ones_like(strength)
    inside[:, :3] = 0
    y, x = torch.meshgrid(torch.arange(91.0), torch.arange(122.0), indexing="ij")
    each = torch.stack([(x - 59.5) / 100, (y - 44.5) / 100, strength])
    ray, pooled = replace(glimpse, canvas=canvas, strength=strength, inside=inside).pooled(3)
    wanted = avg_pool2d(each, 3)[:, :, 1:].flatten(1)
    assert ray.shape == (3, 30 * 39)
    torch.testing.assert_close(ray[:2], wanted[:2], rtol=0, atol=1e-6)
    assert bool((ray[2] == 1).all())
    torch.testing.assert_close(pooled, wanted[2])


def test_pooled_with_a_blur_is_smoother(glimpse):
    sharp, soft = (glimpse.pooled(2, sigma)[1] for sigma in (0.0, 3.0))
    assert len(sharp) == len(soft)
    assert 0 < float(soft.std()) < 0.8 * float(sharp.std())


def test_a_glimpse_is_between_zero_and_one_and_shows_edges_sharp(sheet, home, glimpse):
    S = glimpse.strength
    assert S.shape == glimpse.inside.shape == sheet.camera.size
    assert float(S.min()) == 0
    assert 0.6 < float(S.max()) < 1
    true = sheet.states[WHICH]
    wrong = glimpse_of(sheet, WHICH, home, State(true.pose, Motion(-2 * true.motion.omega, -2 * true.motion.velocity)))
    sharp, blurred = (float(judged(one, home, true)[0][0]) for one in (glimpse, wrong))
    assert blurred < 0.9 * sharp


def test_a_glimpse_knows_where_the_sensor_is():
    window, canvas = window_of_nothing(), Canvas.around(CAMERA)
    motion, there = before_plane(state_of(), wall())
    inside = Glimpse.of(window, motion, there.normal, canvas, map_of(CAMERA, wall()).border).inside
    wanted = torch.zeros(canvas.size)
    wanted[22:112, 30:150] = 1
    assert torch.equal(inside, wanted)


def test_a_grid_is_the_map_as_it_was(sheet):
    m = drawn(sheet, range(0, 8, 2))
    grid, later = Grid(m, QUICK), Grid(m, QUICK)
    before = [part.clone() for part in (grid.texture, grid.known, grid.chart(2.0).texture, grid.height)]
    coarse = later.coarse.clone()
    m.draw([keyframe_of(sheet.windows[i], sheet.states[i]) for i in range(10, 30, 2)])
    after = Grid(m, QUICK)
    for part, same in zip(before, (grid.texture, grid.known, grid.chart(2.0).texture, grid.height), strict=True):
        assert torch.equal(part, same)
    assert torch.equal(coarse, grid.coarse)
    assert len(after.height) == 14
    assert after.texture.shape != grid.texture.shape or not torch.equal(after.texture, grid.texture)
    assert float(after.known.sum()) > float(grid.known.sum())


def test_the_coarse_map_has_no_strength_where_it_is_not_known(home):
    seen, strength, square = home.coarse
    assert set(seen.unique().tolist()) == {0.0, 1.0}
    assert float((strength * (1 - seen)).abs().max()) == 0
    assert float((strength * seen).max()) > 0.2
    torch.testing.assert_close(square, strength.square())
    assert seen.shape == tuple(-(-n // QUICK.cell) for n in home.texture.shape)


@pytest.mark.parametrize("how", [QUICK, Relocalizing(), Relocalizing(turn=90.0, tilts=((0.0, 1), (10.0, 3), (40.0, 4)), scale=1.6)])
def test_hypotheses_are_turns_and_heights_that_span_those_of_the_keyframes(empty, how):
    R, height = Grid(empty, how).hypotheses
    eye = torch.eye(3, dtype=torch.float64).expand_as(R)
    torch.testing.assert_close(R.mT @ R, eye, rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R), dtype=torch.float64))
    each = math.ceil(360 / how.turn) * sum(count for _, count in how.tilts)
    assert len(R) == len(height)
    assert len(R) % each == 0
    heights = height.unique()
    assert len(heights) == len(R) // each
    low, high = 0.5, 2.0
    assert how.scale**-1 < float(heights[0]) / low < 1
    assert 1 < float(heights[-1]) / high < how.scale
    torch.testing.assert_close(heights[1:] / heights[:-1], torch.full_like(heights[1:], how.scale))
    tilt = R[:, 2, 2].acos().rad2deg()
    for angle, count in how.tilts:
        assert int((tilt - angle).abs().lt(1e-4).sum()) * each == count * math.ceil(360 / how.turn) * len(R)
    between = so3.log(R[:each, None].mT @ R[None, :each]).norm(dim=-1) + 10 * torch.eye(each)
    assert float(between.min()) > math.radians(5)


def test_heights_do_not_depend_on_the_unit_of_length(sheet):
    one, other = (Grid(drawn(scene, range(0, 8, 2)), QUICK) for scene in (sheet, elsewhere(sheet, shift=(0.0, 0.0, 0.0))))
    torch.testing.assert_close(one.height, other.height)
    assert 0.5 < float(one.height.min()) <= float(one.height.max()) < 2


def test_keyframes_that_lie_behind_the_plane_or_far_off_do_not_say_where_to_search(empty):
    empty.keyframes += [glance((0.0, 0.0, 1.5)), glance((0.0, 0.0, -1000.0))]
    height = Grid(empty, QUICK).height
    assert float(height.min()) > 0.1
    assert float(height.max()) < 10
    assert Grid(empty, QUICK).hypotheses[1].isfinite().all()


def test_the_first_place_around_is_the_expected_one_and_they_are_always_the_same(sheet, home):
    state = sheet.states[WHICH]
    one, other = (around(home, state) for _ in range(2))
    assert one.R.shape == (QUICK.starts, 3, 3)
    assert torch.equal(one.R, other.R)
    assert torch.equal(one.t, other.t)
    torch.testing.assert_close(one.R[:1], state.pose.R)
    torch.testing.assert_close(one.t[:1], state.pose.t)


def many(m, **options):
    return Grid(m, replace(QUICK, starts=2000, **options))


@pytest.mark.parametrize("z", [0.0, 0.5, -1.0])
def test_places_around_are_as_far_as_said_two_sigma(empty, z):
    grid, state = many(empty), state_of((0.0, 0.0, 0.7), (0.3, 0.1, z))
    away = state.pose.inverse() @ around(grid, state)
    turn = so3.log(away.R).rad2deg()
    torch.testing.assert_close(turn[1:].std(0), torch.full((3,), 5.0, dtype=torch.float64), rtol=0.06, atol=0)
    shifted = around(many(empty, around=(30.0, 1e-9)), state)
    px = (state.pose.inverse() @ shifted).t * empty.focal / (1 - z)
    torch.testing.assert_close(px[1:].std(0), torch.full((3,), 15.0, dtype=torch.float64), rtol=0.06, atol=0)
    assert float(px.mean(0).abs().max()) < 1.5


def test_a_camera_that_is_turned_around_the_expected_place_still_looks_at_the_same_point(empty):
    state = state_of((0.0, 0.0, 0.4), (0.2, 0.0, -0.5))
    turned = State(around(many(empty, around=(1e-9, 10.0)), state), state.motion)
    ray = torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.4, 1.0]], dtype=torch.float64)

    def seen(s):
        ends = ray @ s.placement(empty.plane.repeated(len(s.pose.t))).mT
        return ends[..., :2] / ends[..., 2:] * empty.focal

    moved = (seen(turned) - seen(state)).norm(dim=-1)[1:]
    assert float(moved[:, 0].median()) < 1
    assert float(moved[:, 1].median()) > 5


def test_the_true_place_is_judged_higher_than_places_beside_it(sheet, home, glimpse):
    true = sheet.states[WHICH]
    best, known = judged(glimpse, home, true)
    assert float(best[0]) > 0.75
    assert float(known[0]) > 0.9
    steps = torch.zeros(12, 12, dtype=torch.float64)
    steps[range(12), [0, 1, 2, 3, 4, 5] * 2] = torch.tensor([0.04] * 3 + [0.05] * 2 + [0.08] + [-0.04] * 3 + [-0.05] * 2 + [-0.08]).double()
    beside = State.join([true] * 12).moved(steps)
    scores, _ = judged(glimpse, home, beside)
    assert float(scores.max()) < 0.9 * float(best[0])
    assert float(scores.median()) < 0.5 * float(best[0])
    torch.testing.assert_close(judged(glimpse, home, State.join([true, beside]))[0], torch.cat([best, scores]))


@pytest.mark.parametrize("away", [{"shift": (2.5, 0.0, 0.0)}, {"turn": (0.0, 0.9, 0.0)}, {"turn": (0.0, math.pi, 0.0)}])
def test_where_the_map_knows_too_little_the_score_is_below_zero(sheet, home, glimpse, away):
    state = State((sheet.states[WHICH].pose @ state_of(**away).pose), sheet.states[WHICH].motion)
    score, known = judged(glimpse, home, state)
    assert float(score[0]) == -1
    assert float(known[0]) <= QUICK.known


@pytest.mark.parametrize("sigma", [SHARP, 3.0])
def test_a_score_is_the_correlation_over_what_is_known_times_the_root_of_that_share(sheet, glimpse, sigma):
    grid = Grid(drawn(sheet, range(0, len(sheet.windows), 2)), QUICK)
    grid.known[:, grid.known.shape[1] // 2 + 25 :] = 0  # part of it is forgotten
    true = sheet.states[WHICH]
    score, known = judged(glimpse, grid, true, sigma)
    ray, S = glimpse.pooled(max(2, round(sigma)), sigma)
    there = true.placement(grid.plane, grid.view)[0].float() @ ray
    column, row = ((there[i] / there[2] * grid.focal - grid.box.corner[i]).round().long() for i in (0, 1))
    ahead = (row >= 0) & (column >= 0) & (row < grid.known.shape[0]) & (column < grid.known.shape[1])
    row, column, S = row[ahead], column[ahead], S[ahead]
    both = grid.known[row, column] > 0
    share = float(both.sum()) / len(ahead)
    correlation = float(torch.corrcoef(torch.stack([S[both], grid.chart(sigma).texture[0][row[both], column[both]]]))[0, 1])
    assert 0.45 < share < 0.95
    assert float(known[0]) == pytest.approx(share)
    assert float(score[0]) == pytest.approx(correlation * math.sqrt(share), rel=1e-4)
    strict = Grid.__new__(Grid)
    strict.__dict__.update(grid.__dict__, how=replace(QUICK, known=share + 0.01))
    assert float(judged(glimpse, strict, true, sigma)[0][0]) == -1


def test_of_states_that_see_the_same_the_best_stays_and_the_best_comes_first(empty):
    grid = Grid(empty, QUICK)
    px = [0.0, 3.0, 5.5, 20.0, 21.0, 40.0]
    state = State.join([state_of(shift=(x / empty.focal, 0.0, 0.0)) for x in px])
    score = torch.tensor([0.5, 0.9, 0.6, 0.2, 0.3, 0.8])
    assert APART == 4
    assert distinct(grid, state, score, 10).tolist() == [1, 5, 4]
    assert distinct(grid, state, score, 2).tolist() == [1, 5]
    assert distinct(grid, state[:1], score[:1], 2).tolist() == [0]


def test_no_two_distinct_states_are_too_near(empty):
    grid, random = Grid(empty, QUICK), torch.Generator().manual_seed(0)
    steps = torch.zeros(80, 12, dtype=torch.float64)
    steps[:, :6] = 0.05 * torch.randn(80, 6, generator=random, dtype=torch.float64)
    state, score = State.join([state_of()] * 80).moved(steps), torch.rand(80, generator=random)
    kept = distinct(grid, state, score, 80)
    assert 10 < len(kept) < 80
    assert kept[0] == score.argmax()
    assert bool((score[kept].diff() <= 0).all())
    ray = grid.border.double()[:: len(grid.border) // 8]
    ends = ray @ state.placement(grid.plane.repeated(80), grid.view).mT
    xy = ends[..., :2] / ends[..., 2:] * grid.focal
    rms = (xy[:, None] - xy[None]).square().sum(-1).mean(-1).sqrt()
    assert float((rms[kept][:, kept] + 100 * torch.eye(len(kept))).min()) > APART
    left = [i for i in range(80) if i not in kept.tolist()]
    for i in left:
        assert bool(((rms[i, kept] <= APART) & (score[kept] >= score[i])).any())


@pytest.mark.parametrize(
    ("scores", "away", "clear"), [([0.9, 0.8, 0.5], [0, 10, 100], 1.8), ([0.9, 0.8], [0, 29], math.inf), ([0.9], [0], math.inf)]
)
def test_a_place_is_clear_by_the_next_one_that_is_elsewhere(scores, away, clear):
    states = State.join([state_of()] * len(scores))
    found = Found(states, torch.tensor(scores), torch.ones(len(scores)), torch.tensor(away))
    assert len(found) == len(scores)
    assert found.clear == pytest.approx(clear)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_camera_is_found_near(sheet, home, glimpse, sign, compiled, monkeypatch):
    """From 15 px and 5 degrees off."""
    if not compiled:
        monkeypatch.setenv(kernels.SWITCH, "0")
    turn, away = math.radians(5), sheet.states[WHICH].seen(sheet.plane).distance
    off = torch.zeros(1, 12, dtype=torch.float64)
    off[0, 2] = sign * turn
    off[0, 3] = -sign * 15 / sheet.focal * away
    expected = sheet.states[WHICH].moved(off)
    assert error(sheet, expected) > 14
    found = home.near(glimpse, expected)
    assert error(sheet, found.state[:1]) < 1
    assert float(found.score[0]) > 0.75
    assert found.clear > 1.5
    assert float(found.away[0]) == 0
    assert bool((found.score.diff() <= 0).all())
    assert len(found) <= QUICK.rounds[-1][2]


@pytest.mark.parametrize("i", [WHICH, 21])
def test_a_camera_is_found_in_the_whole_map(sheet, home, i):
    found = home.far(glimpse_of(sheet, i, home))
    assert error(sheet, found.state[:1], i) < 1
    assert float(found.score[0]) > QUICK.accept
    assert found.clear > 1.5
    again = home.far(glimpse_of(sheet, i, home))
    assert torch.equal(found.state.pose.t, again.state.pose.t)
    assert torch.equal(found.score, again.score)


def test_the_first_search_comes_near_enough(sheet, home, glimpse):
    poses = searched(glimpse, home)
    states = [State(poses[k : k + 1], sheet.states[WHICH].motion) for k in range(len(poses.t))]
    assert len(states) <= QUICK.candidates
    assert min(error(sheet, state) for state in states[:5]) < 2 * QUICK.cell


def test_a_place_of_the_coarse_map_is_where_the_camera_looks(sheet, monkeypatch):
    """In the height and the turn of its hypothesis."""
    scene = elsewhere(sheet)
    m = drawn(scene, range(0, 8, 2))
    grid = Grid(m, replace(QUICK, tilts=((18.0, 3),)))
    R, height = grid.hypotheses
    row, column = 5, 7
    place = row * grid.coarse.shape[2] + column
    monkeypatch.setattr(relocalize, "PEAKS", 1)
    monkeypatch.setattr(relocalize, "_peaks", lambda g, grid, H, half: (torch.ones(len(H), 1), torch.full((len(H), 1), place)))
    poses = searched(glimpse_of(scene, WHICH, m), grid)
    count = len(poses.t)
    assert count == min(QUICK.candidates, len(R))
    aim = State(poses, Motion(poses.t, poses.t)).placement(m.plane.repeated(count), m.view) @ torch.tensor([0.0, 0.0, 1.0]).double()
    first = (torch.tensor([column, row]) + 0.5) * QUICK.cell - 0.5 + torch.tensor(grid.box.corner)
    torch.testing.assert_close(aim[:, :2] / aim[:, 2:] * m.focal, first.double().expand(count, 2), rtol=0, atol=1e-4)
    seen = m.plane.repeated(count).seen_from(poses).distance / m.plane.distance
    alike = (m.view @ poses.R)[:, None] - R[None]
    which = (alike.flatten(2).norm(dim=-1) + (seen[:, None] - height[None]).abs()).amin(1)
    assert float(which.max()) < 1e-9


@pytest.mark.parametrize("size", ["sheet", "poster"])
def test_a_camera_is_found_in_any_world(request, size):
    """Turned, tilted, scaled, and with the plane elsewhere."""
    scene = elsewhere(request.getfixturevalue(size))
    m = drawn(scene, range(0, len(scene.windows), 2))
    grid = Grid(m, Relocalizing())
    glimpse = glimpse_of(scene, WHICH, m)
    assert error(scene, grid.far(glimpse).state[:1]) < 1
    off = scene.states[WHICH].moved(torch.tensor([[0.03, -0.03, 0.04, 0.1, -0.05, 0.05, *[0.0] * 6]], dtype=torch.float64))
    assert error(scene, off) > 10
    assert error(scene, grid.near(glimpse, off).state[:1]) < 1


def test_a_window_of_noise_is_found_nowhere(sheet, home):
    window, random = sheet.windows[WHICH], torch.Generator().manual_seed(0)
    flat = sheet.camera.rays().view(-1, 3).float()
    ray = flat[torch.randint(len(flat), (window.ray.shape[1],), generator=random)][None]
    motion, there = before_plane(sheet.states[WHICH], sheet.plane)
    glimpse = Glimpse.of(replace(window, ray=ray), motion, there.normal, Canvas.around(sheet.camera, 0.0), home.border)
    assert float(home.far(glimpse).score[0]) < 0.5 * QUICK.accept
    assert float(home.near(glimpse, sheet.states[WHICH]).score[0]) < 0.5 * QUICK.accept


def test_a_search_begins_with_the_motion_in_the_distances_of_each_place(sheet, home, glimpse, monkeypatch):
    begun = []
    monkeypatch.setattr(relocalize, "refined", lambda glimpse, grid, state, sigma, events: begun.append(state) or state)
    pose = State.join([sheet.states[WHICH], state_of(shift=(0.0, 0.0, 0.4))]).pose
    found_at(glimpse, home, pose, ((1.0, 100, 2),))
    height = home.plane.repeated(2).seen_from(pose).distance[:, None]
    torch.testing.assert_close(begun[0].motion.velocity, glimpse.motion.velocity * height)
    torch.testing.assert_close(begun[0].motion.omega, glimpse.motion.omega.expand(2, 3))


@pytest.mark.parametrize(
    "wrong",
    [
        {"cell": 0}, {"turn": 0.0}, {"turn": 361.0}, {"scale": 1.0}, {"candidates": 0}, {"starts": 0}, {"tilts": ()}, {"rounds": ()},
        {"confirm": (-1.0, 3)}, {"confirm": (24.0, -1)}, {"wait": 0.0}, {"wait": 0.5, "again": 0.4},
    ],
)  # fmt: skip
def test_relocalizing_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match="relocalizing wants"):
        Relocalizing(**wrong)
