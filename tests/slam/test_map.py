"""The map: tiles that grow, exposures, and how strong its edges are."""

from dataclasses import replace

import pytest
import torch
from scenes import drawn, keyframe_of, map_of, state_of, wall
from torch.nn.functional import max_pool2d

from torchcmax.core.camera import Camera
from torchcmax.core.draw import Ink
from torchcmax.core.state import State
from torchcmax.slam.map import KEPT, Keyframe, Texture
from torchcmax.slam.tiles import CELL, TILE, Box, Layers, apart, joined, spread
from torchcmax.slam.tracker import rays_of

CAMERA = Camera.pinhole((90, 120), 100 / 120)
RIGHT = 0.3, 0.0, 0.0  # px / focal in a second: the image moves by 30 px


def seen(state, points=((0.0, 0.0, 0.0),), seconds=1.0):
    """A keyframe of one second whose events are at rays x, y and moments s."""
    x, y, s = (torch.tensor([part], dtype=torch.float32) for part in zip(*points, strict=True))
    return Keyframe(0, state, torch.tensor([seconds], dtype=torch.float64), Ink(x, y, s, torch.ones_like(x)))


def warp(m, state, seconds=1.0):
    return m.warp(state, torch.tensor([seconds], dtype=torch.float64))


def area_of(m, state):
    return m.area(m.box(warp(m, state)))


def overlap(m, state):
    """Of the view but for its edge, which falls on cells whose middle the sensor may not have seen."""
    inner = rays_of(CAMERA) * torch.tensor([0.93, 0.93, 1.0])
    return m.overlap(warp(m, state), inner, area_of(m, state))


@pytest.fixture
def across():
    """A map before a wall that the camera passed by once, to the right."""
    m = map_of(CAMERA, wall())
    m.draw([seen(state_of(velocity=RIGHT))])
    return m


def test_it_grows_in_tiles_with_the_camera_and_what_is_there_stays_where_it_is(sheet):
    m = drawn(sheet, range(6))
    before = {name: (tile.votes.data_ptr(), tile.exposure.data_ptr(), tile.votes.clone()) for name, tile in m.tiles.items()}
    here = sheet.states[6]
    away = State(replace(here.pose, t=here.pose.t + torch.tensor([[-3.0, 1.0, 0.0]])), here.motion)
    m.draw([keyframe_of(sheet.windows[6], away)])
    new = set(m.tiles) - set(before)
    assert new
    assert all(column < 0 for _, column in new)
    assert m.whole().contains(Box(*next(iter(new)), 1, 1))
    for name, (votes, exposure, values) in before.items():
        assert m.tiles[name].votes.data_ptr() == votes
        assert m.tiles[name].exposure.data_ptr() == exposure
        assert torch.equal(m.tiles[name].votes, values)
    m.draw([keyframe_of(sheet.windows[7], sheet.states[7])])
    assert all(m.tiles[name].votes.data_ptr() == there[0] for name, there in before.items())


def test_a_window_in_which_nothing_moves_adds_nothing():
    m = map_of(CAMERA, wall())
    m.draw([seen(state_of())])
    assert not m.tiles
    assert m.assembled(m.whole()).votes.sum() == 0
    assert len(m.keyframes) == 1


def test_a_map_drawn_window_by_window_is_the_one_drawn_at_once(sheet):
    together, one_by_one = drawn(sheet, range(5)), map_of(sheet.camera, sheet.plane)
    for i in range(5):
        one_by_one.draw([keyframe_of(sheet.windows[i], sheet.states[i])])
    assert together.tiles.keys() == one_by_one.tiles.keys()
    assert all(torch.equal(tile.votes, one_by_one.tiles[name].votes) for name, tile in together.tiles.items())


def test_tiles_side_by_side_are_those_that_they_are_cut_into():
    box = Box(-1, 2, 2, 3)
    for shape in ((TILE, TILE), (3, TILE // CELL, TILE // CELL)):
        tiles = list(torch.rand(6, *shape))
        image = joined(tiles, box)
        assert torch.equal(apart(image, box), torch.stack(tiles))
        assert torch.equal(image[..., : shape[-2], -shape[-1] :], tiles[2])
        assert torch.equal(joined(list(apart(image, box)), box), image)


def test_the_assembled_map_holds_its_tiles_in_their_places_and_zero_elsewhere(sheet):
    m = drawn(sheet, range(6))
    whole = m.whole()
    box = Box(whole.row - 1, whole.column - 2, whole.rows + 2, whole.columns + 3)
    layers = m.assembled(box)
    assert layers.votes.shape == box.size
    votes, exposure = apart(layers.votes, box), apart(layers.exposure, box)
    for i, name in enumerate(box.tiles()):
        tile = m.tiles.get(name, Layers(torch.zeros(TILE, TILE), torch.zeros(3, TILE // CELL, TILE // CELL)))
        assert torch.equal(votes[i], tile.votes)
        assert torch.equal(exposure[i], tile.exposure)


def test_votes_of_a_window_are_its_events_where_they_meet_the_plane():
    m = map_of(CAMERA, wall())
    points = [(0.1, 0.2, 0.0), (0.1, 0.2, 0.5), (-0.3, 0.1, -0.5)]
    m.draw([seen(state_of(shift=(0.05, 0.02, 0.0), velocity=RIGHT), points)])
    votes = m.assembled(m.whole()).votes
    x, y = m.whole().corner
    for place in ((15, 22), (30, 22), (-40, 12)):
        assert votes[place[1] - y, place[0] - x] == pytest.approx(1, abs=1e-3)
    assert float(votes.sum()) == pytest.approx(3, abs=1e-3)


def test_exposure_is_the_way_in_px_along_the_motion_and_none_across_it(across):
    layers = across.assembled(across.whole())
    xx, xy, yy = layers.exposure
    there = layers.most > 0
    torch.testing.assert_close(xx[there], torch.full_like(xx[there], 30.0), rtol=1e-3, atol=0)
    assert float(xy.abs().max()) < 1e-3
    assert float(yy.abs().max()) < 1e-3
    assert int(there.sum()) == pytest.approx(90 * 120 / CELL**2, rel=0.05)


def test_exposure_adds_up_and_most_is_that_along_the_direction_of_most(across):
    across.draw([seen(state_of(velocity=(0.0, 0.3, 0.0))), seen(state_of(velocity=(0.2, 0.2, 0.0)))])
    layers = across.assembled(across.whole())
    diagonal = 20 * 2**0.5
    middle = layers.exposure[:, -across.whole().corner[1] // CELL, -across.whole().corner[0] // CELL]
    torch.testing.assert_close(middle, torch.tensor([30 + diagonal / 2, diagonal / 2, 30 + diagonal / 2]), rtol=1e-3, atol=0)
    assert float(layers.most.max()) == pytest.approx(30 + diagonal, rel=1e-3)


def test_a_near_camera_exposes_as_much_more_as_its_pixels_are_smaller():
    near, far = map_of(CAMERA, wall()), map_of(CAMERA, wall())
    far.draw([seen(state_of(velocity=RIGHT))])
    near.draw([seen(state_of(shift=(0.0, 0.0, 0.5), velocity=RIGHT))])
    assert float(near.assembled(near.whole()).most.max()) == pytest.approx(4 * float(far.assembled(far.whole()).most.max()), rel=1e-3)


def test_a_view_is_known_along_the_motion_that_was_seen_and_not_across_it(across):
    assert overlap(across, state_of(velocity=RIGHT)) == 1
    assert overlap(across, state_of(velocity=(0.0, 0.3, 0.0))) == 0
    across.draw([seen(state_of(velocity=(0.0, 0.3, 0.0)))])
    assert overlap(across, state_of(velocity=(0.0, 0.3, 0.0))) == 1


def test_a_glimpse_of_little_motion_makes_nothing_known():
    m = map_of(CAMERA, wall())
    m.draw([seen(state_of(velocity=(0.2, 0.0, 0.0)))])
    assert overlap(m, state_of(velocity=RIGHT)) == 0
    m.draw([seen(state_of(velocity=(0.2, 0.0, 0.0)))])
    assert overlap(m, state_of(velocity=RIGHT)) == 1


@pytest.mark.parametrize(("shift", "share"), [(0.0, 1.0), (0.3, 0.75), (0.6, 0.5), (-0.9, 0.25), (1.4, 0.0)])
def test_the_overlap_is_the_share_of_the_view_that_was_seen(across, shift, share):
    assert overlap(across, state_of(shift=(shift, 0.0, 0.0), velocity=RIGHT)) == pytest.approx(share, abs=0.07)


def test_what_is_unknown_has_no_strength(across):
    layers = across.assembled(Box(-6, -6, 12, 12))
    unseen = spread(layers.most) == 0
    assert bool(unseen.any())
    assert float(across.strength(layers)[unseen].abs().max()) == 0
    assert float(map_of(CAMERA, wall()).strength(layers).isfinite().all())


def test_a_camera_that_looks_along_its_plane_has_no_box(across):
    assert across.box(warp(across, state_of())) == Box(-1, -2, 2, 4)
    for turn in ((0.0, 1.45, 0.0), (1.5, 0.0, 0.0), (0.0, 3.0, 0.0)):
        assert across.box(warp(across, state_of(turn))) is None
    assert across.box(warp(across, state_of(shift=(0.0, 0.0, float("nan"))))) is None
    tiles = set(across.tiles)
    across.draw([seen(state_of((0.0, 1.45, 0.0)))])
    assert set(across.tiles) == tiles
    assert across.drawn(1) is None
    assert len(across.keyframes) == 2


def test_a_window_without_any_motion_adds_nothing(across):
    before = {name: tile.votes.clone() for name, tile in across.tiles.items()}
    across.draw([seen(state_of(), [(0.1, 0.1, 0.0)])])
    assert before.keys() == across.tiles.keys()
    assert all(torch.equal(votes, across.tiles[name].votes) for name, votes in before.items())
    assert len(across.keyframes) == 2


def test_strength_lies_between_zero_and_one_whatever_was_drawn(sheet):
    m = drawn(sheet, range(8))
    strength = m.strength(m.assembled(m.whole()))
    assert float(strength.min()) == 0
    assert 0.5 < float(strength.max()) < 1


def test_strength_does_not_depend_on_how_many_keyframes_drew_a_place(sheet):
    once, often = drawn(sheet, range(8)), drawn(sheet, [*range(8)] * 3)
    sure = spread(once.assembled(once.whole()).most) > Texture().least
    first, second = (m.strength(m.assembled(m.whole())) for m in (once, often))
    assert float(sure.float().mean()) > 0.3
    torch.testing.assert_close(second[sure], first[sure], rtol=0, atol=0.02)
    assert once.typical() == pytest.approx(often.typical(), rel=0.05)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.2, -0.3)])
def test_typical_is_what_the_whole_map_gives_directly(sheet, tilt):
    m = map_of(sheet.camera, wall(*tilt))
    assert m.typical() == 0
    for i in range(4):
        m.draw([keyframe_of(sheet.windows[i], sheet.states[i])])
        rate = m.rate(m.assembled(m.whole())).double()
        assert m.typical() == pytest.approx(float(rate.square().sum() / rate.sum()), rel=1e-4)


def test_events_near_what_is_not_known_are_not_trusted(across):
    x = torch.linspace(-0.9, 0.9, 181)[None]
    ink = Ink(x, torch.zeros_like(x), torch.zeros_like(x), torch.full_like(x, 2.0))
    area = area_of(across, state_of())
    kept = across.trusted(ink, warp(across, state_of()), area).weight[0] > 0
    known = area.layers.most >= Texture().exposure / 2
    strange = max_pool2d((~known).float()[None], 3, 1, 1)[0] > 0
    column, row = (x[0] * 100).round().long() - area.box.corner[0], torch.tensor(-area.box.corner[1])
    assert torch.equal(kept, ~strange[row // CELL, column.clamp(0, area.box.size[1] - 1) // CELL])
    inner = x[0][kept]
    assert 0.5 < float(inner.max()) < 0.6 - CELL / 100 + 1e-3
    assert -0.6 + CELL / 100 - 1e-3 < float(inner.min()) < -0.5
    assert bool(kept[(x[0] > inner.min()) & (x[0] < inner.max())].all())


def test_nothing_is_trusted_on_an_empty_map():
    m = map_of(CAMERA, wall())
    ink = seen(state_of()).ink
    assert not m.trusted(ink, warp(m, state_of()), area_of(m, state_of())).weight.any()


def test_less_what_a_keyframe_drew_is_what_the_others_drew(sheet):
    m = drawn(sheet, range(5))
    for number in (0, 2, 4):
        one = m.drawn(number)
        others = map_of(sheet.camera, sheet.plane)
        others.draw([k for i, k in enumerate(m.keyframes) if i != number])
        left, wanted = m.assembled(one.box) - one.layers, others.assembled(one.box)
        torch.testing.assert_close(left.votes, wanted.votes, rtol=0, atol=1e-4)
        torch.testing.assert_close(left.exposure, wanted.exposure, rtol=0, atol=1e-4)
        assert float(left.votes.min()) >= 0


def test_what_a_keyframe_drew_long_ago_is_drawn_again_the_same(sheet):
    m = drawn(sheet, range(1))
    first = m.drawn(0)
    m.draw([keyframe_of(sheet.windows[i], sheet.states[i]) for i in range(1, KEPT + 2)])
    again = m.drawn(0)
    assert again is not first
    assert again.box == first.box
    torch.testing.assert_close(again.layers.votes, first.layers.votes, rtol=0, atol=1e-5)
    torch.testing.assert_close(again.layers.exposure, first.layers.exposure, rtol=1e-5, atol=1e-5)


def test_an_area_is_kept_until_the_map_changes_or_the_camera_leaves_it(across):
    whole = area_of(across, state_of())
    assert across.area(Box(-1, -1, 1, 1)) is whole
    assert area_of(across, state_of(shift=(2.0, 0.0, 0.0))) is not whole
    fresh = area_of(across, state_of())
    across.draw([seen(state_of(velocity=RIGHT))])
    assert area_of(across, state_of()) is not fresh


def test_the_map_of_a_tilted_plane_is_seen_from_straight_before_it():
    """Two points of the plane are as far apart on the map as they are on the plane."""
    plane = wall(0.3, -0.4)
    m = map_of(CAMERA, plane)
    m.draw([seen(state_of(velocity=(0.01, 0.0, 0.0)), [(0.2, 0.1, 0.0), (-0.3, -0.2, 0.0)])])
    ray = torch.tensor([[0.2, 0.1, 1.0], [-0.3, -0.2, 1.0]], dtype=torch.float64)
    points = ray / -(ray @ plane.normal[0])[:, None]
    votes = m.assembled(m.whole()).votes.double()
    places = (m.view[0] @ points.mT)[:2].mT * m.focal - torch.tensor(m.whole().corner)
    assert float((places[0] - places[1]).norm()) == pytest.approx(100 * float((points[0] - points[1]).norm()))
    for x, y in places.tolist():
        assert float(votes[int(y) : int(y) + 2, int(x) : int(x) + 2].sum()) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("wrong", [{"exposure": 0.0}, {"least": -1.0}, {"blur": ()}, {"blur": (-1.0,)}])
def test_textures_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="a texture wants"):
        Texture(**wrong)
