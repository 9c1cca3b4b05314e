"""The map on a sphere and the planes that are cut from it: what windows draw there, by hand and against a plane's own map."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch.nn.functional import max_pool2d

from torchcmax.core import so3
from torchcmax.core.draw import Ink
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.simulator import Simulation, simulate
from torchcmax.slam.equirect import cosines, directions
from torchcmax.slam.globe import KEPT, SPACING, WALL, WIDEST, Globe
from torchcmax.slam.map import Keyframe, Map, Texture
from torchcmax.slam.run import BORDER, keyframe_of
from torchcmax.slam.tiles import CELL, Layers, spread

FOCAL = 100.0
ZERO = torch.zeros(1, 3, dtype=torch.float64)
EVENTS = 3000
PLACES = {
    "middle": (0.0, 0.0, 0.0), "right": (0.0, 1.4, 0.3), "seam": (0.0, 3.13, 0.0), "up": (1.5, 0.0, 0.4), "down": (-1.65, 0.0, 0.0),
}  # fmt: skip


def turn(*w):
    return so3.exp(torch.tensor([w], dtype=torch.float64))


def looking(*w):
    return Pose(turn(*w), ZERO)


@pytest.fixture(scope="module")
def street():
    """A small sensor that turns for 0.3 s in a panorama, with the truth."""
    return simulate(Simulation(scene="panorama", motion="rotation", duration=0.3, width=120, height=90, focal=FOCAL))


@pytest.fixture(scope="module")
def border(street):
    rays = street.camera.rays()
    return torch.cat([rays[0], rays[-1], rays[:, 0], rays[:, -1]])[::BORDER].float()


@pytest.fixture(scope="module")
def windows(street):
    """Keyframes of 3,000 events, all there are, where they truly are."""
    found = []
    for window in street.windows(EVENTS):
        omega = street.truth.motion(window.start, window.duration.double()).omega
        found.append(keyframe_of(window, State(Pose(street.truth.at(window.middle).R, ZERO), Motion(omega, ZERO))))
    return found


def at(keyframe, R=None, omega=None):
    """The same events of a camera that looks elsewhere, or turns otherwise."""
    state = keyframe.state
    R, omega = state.pose.R if R is None else R, state.motion.omega if omega is None else omega
    return keyframe.at(State(Pose(R, ZERO), Motion(omega, ZERO)))


def globe_of(border, *keyframes):
    globe = Globe(FOCAL, border)
    globe.draw(keyframes)
    return globe


def events(*ray, R=None, omega=(0.0, 1e-9, 0.0)):
    """A window of one second: events at its middle, on these rays (x, y)."""
    x, y = (torch.tensor([part]) for part in zip(*ray, strict=True))
    state = State(Pose(turn(0.0, 0.0, 0.0) if R is None else R, ZERO), Motion(torch.tensor([omega], dtype=torch.float64), ZERO))
    return Keyframe(0, state, torch.ones(1, dtype=torch.float64), Ink(x, y, torch.zeros_like(x), torch.ones_like(x)))


def sight(globe, keyframe):
    """The facet straight before a keyframe, its warp and its box there."""
    facet = globe.facing(keyframe.state.pose)
    H_k = facet.warp(keyframe.state, keyframe.seconds)
    return facet, H_k, facet.box(H_k)


def correlation(a, b):
    return float(torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1])


# votes


def test_a_globe_has_pixels_as_wide_as_the_sensors_and_whole_cells(border):
    for focal in (30.0, 100.0, 199.0):
        globe = Globe(focal, border)
        height, width = globe.sphere.size
        assert height % (2 * CELL) == 0
        assert width == 2 * height
        assert globe.sphere.focal == pytest.approx(focal, abs=2 * CELL / 2 / math.pi + 1e-9)
        assert not globe.layers.votes.any()
        assert spread(globe.layers.exposure).shape == (3, height, width)


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (0.2, 0.7, 0.0), (-0.5, -2.0, 1.0)])
def test_an_event_is_where_it_came_from_and_as_strong_as_on_the_equator(border, where):
    """An event in the middle of the image is one vote where the camera looks: the mean of its pixels, and its votes per area."""
    globe = globe_of(border, events((0.0, 0.0), R=turn(*where)))
    votes, area = globe.layers.votes.double(), cosines(globe.sphere).double()
    assert float((votes * area).sum()) == pytest.approx(1, abs=1e-4)
    mean = ((votes * area)[..., None] * directions(globe.sphere)).sum((0, 1))
    assert (mean / mean.norm() - turn(*where)[0, :, 2]).norm() * globe.sphere.focal < 0.1
    assert float(votes.sum()) == pytest.approx(1 / math.cos(math.asin(float(turn(*where)[0, 1, 2]))), rel=0.02)


@pytest.mark.parametrize("where", PLACES)
def test_no_event_is_lost_wherever_the_camera_looks(border, windows, where):
    """Of those that are well on the sensor; what moves off it before the window's middle is where the camera does not look then."""
    keyframe, (right, down) = at(windows[4], turn(*PLACES[where])), border[:, :2].amax(0)
    ink = keyframe.ink
    well = (ink.x.abs() < 0.85 * right) & (ink.y.abs() < 0.85 * down)
    assert well.float().mean() > 0.5
    keyframe = replace(keyframe, ink=Ink(ink.x, ink.y, ink.s, ink.weight * well))
    votes = globe_of(border, keyframe).layers.votes
    area = cosines(Globe(FOCAL, border).sphere)
    assert float((votes * area).sum()) == pytest.approx(float(keyframe.ink.weight.sum()), rel=1e-3)
    assert votes.min() >= 0


@pytest.mark.parametrize("where", PLACES)
def test_a_facet_shows_what_a_plane_shows_that_the_same_window_was_drawn_on(border, windows, where):
    """A map of the wall before a camera that looks straight at it, and the facet of a globe wherever that looks."""
    ahead = at(windows[4], turn(0.0, 0.0, 0.0))
    wall = Map(WALL, FOCAL, border)
    wall.draw([ahead])
    there = at(windows[4], turn(*PLACES[where]))
    facet, H_k, box = sight(globe_of(border, there), there)
    assert torch.allclose(H_k, wall.warp(ahead.state, ahead.seconds), atol=1e-9)
    ours, straight = facet.assembled(box), wall.assembled(box)
    assert correlation(ours.votes, straight.votes) > 0.8
    x, y, _ = facet._world(box, 1, torch.eye(3))
    solid = (1 + (x * x + y * y)) ** -1.5  # of a pixel of the facet, as a share of one in its middle: votes are those on the sphere
    assert float((ours.votes * solid).sum() / straight.votes.sum()) == pytest.approx(1, abs=0.02)
    assert correlation(ours.exposure, straight.exposure) > 0.9
    inner = max_pool2d(-(straight.most[None, None] > 0).float(), 5, 1, 2)[0, 0] < 0
    assert float(ours.most[inner].mean() / straight.most[inner].mean()) == pytest.approx(1, abs=0.15)


def test_a_facet_that_the_camera_does_not_look_straight_at_shows_the_same_edges(border, windows):
    one = at(windows[4], turn(0.3, 2.9, 0.0))
    globe = globe_of(border, one)
    facet = globe.facing(Pose(one.state.pose.R @ turn(0.12, -0.15, 1.0), ZERO))
    H_k = facet.warp(one.state, one.seconds)
    box = facet.box(H_k)
    assert correlation(facet.assembled(box).votes, facet.layers_of(one, H_k, box).votes) > 0.8


@pytest.mark.parametrize("where", PLACES)
def test_what_a_camera_meets_does_not_depend_on_how_the_world_is_turned(border, windows, where):
    """All windows turned alike: the strength of the edges before the last one, blurred as pixels fall on pixels otherwise."""
    W = turn(*PLACES[where])

    def shown(W):
        globe = globe_of(border, *(at(k, W @ k.state.pose.R) for k in windows[:5]))
        facet, _, box = sight(globe, globe.keyframes[4])
        (chart,) = facet.charts(facet.assembled(box), box, (1.5,))
        return chart.texture, globe.typical()

    (texture, typical), (expected, usual) = shown(W), shown(turn(0.0, 0.0, 0.0))
    assert correlation(texture, expected) > 0.97
    assert float(texture.mean()) == pytest.approx(float(expected.mean()), rel=0.08)
    assert typical == pytest.approx(usual, rel=0.15)


def test_windows_add_up_whether_they_are_drawn_together_or_one_after_another(border, windows):
    together, one, other = globe_of(border, *windows[:2]), globe_of(border, windows[0]), globe_of(border, windows[1])
    after = globe_of(border, windows[0])
    after.draw([windows[1]])
    for layer in ("votes", "exposure"):
        total = getattr(one.layers, layer) + getattr(other.layers, layer)
        assert torch.allclose(getattr(together.layers, layer), total, atol=2e-4)
        assert torch.allclose(getattr(after.layers, layer), total, atol=1e-5)
    assert after.keyframes == together.keyframes == [*one.keyframes, *other.keyframes]


def test_more_windows_than_are_drawn_at_a_time_add_up(border):
    one = events((0.1, -0.2), (0.3, 0.25), R=turn(1.3, 0.4, 0.0), omega=(0.0, 0.1, 0.0))
    many, single = (globe_of(border, *[one] * n).layers for n in (9, 1))
    assert torch.allclose(many.votes, 9 * single.votes, rtol=1e-4, atol=1e-5)
    assert torch.allclose(many.exposure, 9 * single.exposure, rtol=1e-4, atol=1e-5)


def test_a_window_taken_from_the_layers_leaves_the_others(border, windows):
    both, one = globe_of(border, *windows[:2]), globe_of(border, windows[0])
    left = both.layers - both.layers_of([windows[1]])
    assert torch.allclose(left.votes, one.layers.votes, atol=2e-4)
    assert torch.allclose(left.exposure, one.layers.exposure, atol=1e-3)


def test_a_window_at_rest_draws_nothing_but_is_a_keyframe(border, windows):
    globe = globe_of(border, at(windows[2], omega=ZERO))
    assert not globe.layers.votes.any()
    assert not globe.layers.exposure.any()
    assert len(globe.keyframes) == 1
    assert globe.typical() == 0
    assert not globe.strength().any()
    assert not globe.known().any()


def test_drawing_nothing_changes_nothing(border, windows):
    globe = globe_of(border, windows[0])
    before = globe.layers
    globe.draw([])
    assert torch.equal(globe.layers.votes, before.votes)
    assert len(globe.keyframes) == 1


# exposure


@pytest.mark.parametrize(
    ("roll", "expected"), [(0.0, (8.0, 0.0, 0.0)), (90.0, (0.0, 0.0, 8.0)), (45.0, (4.0, 4.0, 4.0)), (-45.0, (4.0, -4.0, 4.0))]
)
@pytest.mark.parametrize("away", [0.0, 1.2, math.pi])
def test_exposure_is_how_far_the_image_moves_and_along_what(border, roll, expected, away):
    """A camera that turns right by 8 px, rolled: in the middle of the image p p^T / |p|, along east-east, east-south, south-south."""
    globe = Globe(FOCAL, border)
    omega = (0.0, 8.0 / globe.sphere.focal, 0.0)
    globe.draw([events((0.0, 0.0), R=turn(0.0, away, 0.0) @ turn(0.0, 0.0, math.radians(roll)), omega=omega)])
    x, y = globe.sphere.pixels(turn(0.0, away, 0.0)[0, :, 2]).tolist()
    cells = globe.layers.exposure.roll(3 - int(x) // CELL, -1)[:, int(y) // CELL - 1 : int(y) // CELL + 1, 2:5]
    assert cells.mean((1, 2)).tolist() == pytest.approx(expected, abs=0.15)


def test_a_camera_that_rolls_exposes_in_circles_and_more_the_farther_from_the_middle(border):
    """By 0.1 rad: 0.1 focal lengths times the distance from the axis, along the circle, seen by pixels that are smaller outside."""
    globe = globe_of(border, events((0.0, 0.0), omega=(0.0, 0.0, 0.1)))
    cells = globe.layers.exposure
    height, width = cells.shape[1:]
    lon = (torch.arange(width) - width / 2 + 0.5) * math.pi / height
    row = cells[:, height // 2]
    seen = row[2] > 0
    assert seen.nonzero()[:, 0].tolist() == list(range(int(seen.nonzero()[0]), int(seen.nonzero()[-1]) + 1))
    assert torch.allclose(row[2][seen], (0.1 * globe.sphere.focal * lon.sin().abs() / lon.cos() ** 3)[seen], rtol=0.05, atol=0.15)
    assert row[0][seen].max() < 0.05 * row[2].max()


@pytest.mark.parametrize("where", PLACES)
def test_what_was_seen_is_exposed_and_nothing_behind_the_camera(border, where):
    R = turn(*PLACES[where])
    globe = globe_of(border, events((0.0, 0.0), R=R, omega=(0.1, 0.2, 0.0)))
    ray = directions(globe.sphere) @ R[0]
    exposed = spread(globe.layers.most) > 0
    low, high = border[:, :2].amin(0), border[:, :2].amax(0)
    xy = ray[..., :2] / ray[..., 2:]
    rim, wide = 1 / FOCAL, 3 * CELL / FOCAL
    inside = ((xy >= low + rim) & (xy <= high - rim)).all(-1) & (ray[..., 2] > 0)
    assert exposed[inside].all()
    assert not exposed[~(((xy >= low - wide) & (xy <= high + wide)).all(-1) & (ray[..., 2] > 0))].any()


@pytest.mark.parametrize("where", ["middle", "seam", "up"])
def test_motion_is_known_along_the_motion_that_was_seen_and_not_across(border, street, where):
    """Three windows that turn right by 12 px: a fourth such is known there, one that nods is not, one that goes both ways is by half."""
    W = turn(*PLACES[where])
    omega = {"right": (0.0, 0.12, 0.0), "nod": (0.12, 0.0, 0.0)}
    globe = globe_of(border, *(events((0.0, 0.0), R=W, omega=omega["right"]) for _ in range(3)))
    rays = street.camera.rays()[8:-8:12, 8:-8:12].reshape(-1, 3)

    def overlap(name):
        one = events((0.0, 0.0), R=W, omega=omega[name])
        facet, H_k, box = sight(globe, one)
        return facet.overlap(H_k, rays, facet.area(box))

    assert overlap("right") > 0.95
    assert overlap("nod") < 0.05
    globe.draw([events((0.0, 0.0), R=W, omega=omega["nod"])] * 3)
    assert overlap("nod") > 0.95


# what is typical, strong, known


def handmade(border, votes, exposure):
    """A globe with layers by hand: numbers for each half of the sphere."""
    globe = Globe(FOCAL, border)
    middle = globe.layers.exposure.shape[1] // 2
    for half, cells, v, e in ((0, slice(middle), votes[0], exposure[0]), (1, slice(middle, None), votes[1], exposure[1])):
        globe.layers.votes[half * middle * CELL : (half + 1) * middle * CELL] = v
        globe.layers.exposure[0, cells] = e
    return globe


def test_what_is_typical_is_the_rate_that_events_meet(border):
    """Half of the sphere with 0.1 votes per px, half with 0.4: sum r^2 / sum r = 0.34, and an edge of that rate has strength 1/2."""
    globe = handmade(border, (1.0, 8.0), (10.0, 20.0))
    rate = globe.rate()
    assert rate[0].tolist() == pytest.approx([0.1] * rate.shape[1])
    assert rate[-1].tolist() == pytest.approx([0.4] * rate.shape[1])
    assert globe.typical() == pytest.approx(0.17 / 0.5)
    assert globe.strength()[0, 0] == pytest.approx(0.1 / 0.44)
    assert globe.strength()[-1, 0] == pytest.approx(0.4 / 0.74)


def test_a_glimpse_makes_no_edge(border):
    """Less than 6 px of motion count as so many."""
    assert handmade(border, (6.0, 6.0), (1.0, 12.0)).rate()[[0, -1], 0].tolist() == pytest.approx([1.0, 0.5])


def test_rows_of_the_rate_are_the_rate_of_these_rows(border, windows):
    globe = globe_of(border, *windows[:3])
    rows = slice(10 * CELL, 30 * CELL)
    assert torch.equal(globe.rate(rows), globe.rate()[rows])


def test_a_place_is_known_from_so_many_px_of_motion_on(border):
    known = handmade(border, (0.0, 0.0), (24.9, 25.0)).known()
    assert not known[: len(known) // 2].any()
    assert known[len(known) // 2 :].eq(1).all()


def test_typical_of_part_of_the_sphere_is_that_of_what_was_seen(border, windows):
    globe = globe_of(border, *windows[:3])
    rate, area = globe.rate().double(), cosines(globe.sphere).double()
    assert globe.typical() == pytest.approx(float((rate.square() * area).sum() / (rate * area).sum()), rel=1e-4)
    assert globe.facing(looking(0.0, 0.0, 0.0)).typical() == globe.typical()


def test_drawing_renews_what_was_known(border, windows):
    globe = globe_of(border, windows[0])
    pose = windows[0].state.pose
    facet, typical = globe.toward(pose), globe.typical()
    box = facet.box(facet.warp(windows[0].state, windows[0].seconds))
    before = facet.area(box)
    assert facet.area(box) is before
    globe.draw([windows[1]] * 3)
    assert globe.toward(pose) is facet
    after = facet.area(box)
    fresh = globe.facing(pose)
    assert after is not before
    assert after.layers.votes.sum() > 2 * before.layers.votes.sum()
    assert torch.equal(after.layers.votes, replace(fresh, turn=facet.turn).assembled(box).votes)
    assert globe.typical() != typical
    assert globe.typical() == pytest.approx(globe_of(border, windows[0], *[windows[1]] * 3).typical(), rel=1e-4)


def test_a_copy_stays_as_it_is_and_so_does_what_was_copied(border, windows):
    globe = globe_of(border, windows[0])
    copy = globe.copy()
    votes, exposure, typical = globe.layers.votes.clone(), globe.layers.exposure.clone(), globe.typical()
    globe.layers.votes.add_(1)
    globe.layers.exposure.add_(1)
    globe.draw([windows[1]])
    assert torch.equal(copy.layers.votes, votes)
    assert torch.equal(copy.layers.exposure, exposure)
    assert copy.typical() == typical
    assert [k.time for k in copy.keyframes] == [windows[0].time]
    copy.draw([windows[2]])
    assert [k.time for k in globe.keyframes] == [windows[0].time, windows[1].time]
    assert not copy.facets


def test_a_texture_and_a_number_go_with_the_copy(border):
    globe = Globe(FOCAL, border, Texture(exposure=7.0), number=3)
    globe.layers.exposure[0] = 8.0
    assert globe.copy().number == 3
    assert globe.copy().known().all()


# facets


def test_a_facet_has_a_box_up_to_its_edge_and_none_beyond(border):
    facet = Globe(FOCAL, border).facing(looking(0.4, 3.0, 0.0))
    still = torch.ones(1, dtype=torch.float64)

    def box(degrees, about=(0.0, 1.0, 0.0)):
        R = facet.turn @ turn(*(math.radians(degrees) * a for a in about))
        return facet.box(facet.warp(State(Pose(R, ZERO), Motion(ZERO, ZERO)), still))

    ahead = box(0)
    x, y = ahead.corner
    low, high = (border[:, :2].amin(0) * FOCAL).tolist(), (border[:, :2].amax(0) * FOCAL).tolist()
    assert x < low[0] < high[0] < x + ahead.size[1]
    assert y < low[1] < high[1] < y + ahead.size[0]
    edge = math.tan(math.radians(WIDEST)) * FOCAL
    for about in ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.6, 0.8, 0.0)):
        for degrees in (20, 50, 90):
            found = box(degrees, about)
            assert found is not None
            far = max(abs(c) for c in (*found.corner, found.corner[0] + found.size[1], found.corner[1] + found.size[0]))
            assert far <= edge + 64
        assert box(140, about) is None
        assert box(180, about) is None
    assert box(20).column > ahead.column  # it looks right


def test_what_is_not_a_number_is_nowhere(border):
    facet = Globe(FOCAL, border).facing(looking(0.0, 0.0, 0.0))
    state = State(Pose(turn(0.0, 0.0, 0.0) * torch.nan, ZERO), Motion(ZERO, ZERO))
    assert facet.box(facet.warp(state, torch.ones(1, dtype=torch.float64))) is None


def test_a_facet_serves_a_camera_until_it_looks_elsewhere(border):
    globe = Globe(FOCAL, border)
    facet = globe.toward(looking(0.0, 0.0, 0.0))
    assert torch.equal(facet.turn, turn(0.0, 0.0, 0.0))
    assert globe.toward(looking(0.0, math.radians(SPACING - 1), 0.0)) is facet
    assert globe.toward(looking(0.0, 0.0, 3.0)) is facet  # turned upside down
    other = globe.toward(looking(0.0, math.radians(SPACING + 1), 0.0))
    assert other is not facet
    assert globe.toward(looking(0.0, math.radians(SPACING - 1), 0.0)) is other  # it is nearer
    assert globe.facets == [facet, other]


def test_only_the_facets_that_were_looked_at_last_are_kept(border):
    globe = Globe(FOCAL, border)
    every = [globe.toward(looking(0.0, 0.4 * i, 0.0)) for i in range(KEPT)]
    assert [id(f) for f in globe.facets] == [id(f) for f in every]
    globe.toward(looking(0.0, 0.0, 0.0))
    new = globe.toward(looking(1.5, 0.0, 0.0))
    assert [id(f) for f in globe.facets] == [id(f) for f in (*every[2:], every[0], new)]


def test_the_field_of_view_is_the_angle_to_the_farthest_corner():
    corners = torch.tensor([[-0.3, 0.4, 1.0], [0.3, 0.4, 1.0], [0.6, -0.8, 1.0], [-0.1, -0.4, 1.0]])
    assert Globe(FOCAL, corners).field_of_view == pytest.approx(math.pi / 4)


def test_votes_and_motion_on_a_facet_are_those_of_the_sphere(border):
    """Uniform votes are uniform anywhere on a facet; uniform motion keeps its trace at the middle and turns with the facet."""
    globe = handmade(border, (3.0, 3.0), (0.0, 0.0))
    globe.layers.exposure[2] = 9.0  # south
    for roll, expected in ((0.0, (0.0, 0.0, 9.0)), (math.pi / 2, (9.0, 0.0, 0.0)), (math.pi / 4, (4.5, 4.5, 4.5))):
        facet = globe.facing(Pose(turn(0.0, 2.0, 0.0) @ turn(0.0, 0.0, roll), ZERO))
        layers = facet.assembled(facet.box(facet.warp(State(Pose(facet.turn, ZERO), Motion(ZERO, ZERO)), torch.ones(1).double())))
        assert isinstance(layers, Layers)
        assert torch.allclose(layers.votes, torch.full_like(layers.votes, 3.0), atol=1e-4)
        height, width = layers.exposure.shape[1:]
        assert layers.exposure[:, height // 2, width // 2].tolist() == pytest.approx(expected, abs=0.4)


def test_a_recording_is_drawn_sharper_with_the_true_poses_than_with_others(border, windows):
    """What the truth says, and the same with each window turned by half a degree more than the one before."""
    sharp, *blurred = (
        globe_of(border, *(at(k, k.state.pose.R @ turn(0.0, math.radians(d) * i, 0.0)) for i, k in enumerate(windows[:6])))
        for d in (0.0, 0.5, 1.0)
    )
    typical = [globe.typical() for globe in (sharp, *blurred)]
    assert all(one > 1.05 * other for one, other in pairwise(typical))
