"""Equirectangular images without seam or poles, and the globe that is drawn on one."""

import math

import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.camera import Sphere
from torchcmax.core.contrast import blur
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.io.opening import open
from torchcmax.simulator import Simulation, write
from torchcmax.slam.equirect import bordered, cosines, directions, smooth, steady, tangents
from torchcmax.slam.globe import Globe
from torchcmax.slam.run import keyframe_of
from torchcmax.slam.tiles import CELL, spread

SPHERE = Sphere(64)
EVERYWHERE = {
    "middle": (0.0, 0.0, 0.0), "right": (0.0, 1.5, 0.0), "seam": (0.0, 3.1, 0.3), "up": (1.45, 0.2, 0.0), "down": (-1.57, 0.0, 0.5),
}  # fmt: skip


def turn(*w):
    return so3.exp(torch.tensor([w], dtype=torch.float64))


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    folder = tmp_path_factory.mktemp("street") / "street"
    write(Simulation(scene="panorama", motion="rotation", duration=0.3, width=120, height=90, focal=100.0), folder)
    return open(folder)


@pytest.fixture(scope="module")
def border(street):
    rays = street.camera.rays()
    return torch.cat([rays[0], rays[-1], rays[:, 0], rays[:, -1]])[::4].float()


def keyframe(street, number, R=None, omega=None):
    """The number-th window of 3,000 events, where it was, or elsewhere."""
    window = next(street.windows(3000, 3000 * (number + 1) if number else 3000, 1)) if number == 0 else None
    if window is None:
        for i, one in enumerate(street.windows(3000)):
            if i == number:
                window = one
                break
    motion, pose = street.truth.motion(window.start, window.duration.double()), street.truth.at(window.middle)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    state = State(Pose(pose.R if R is None else R, zero), Motion(motion.omega if omega is None else omega, zero))
    return keyframe_of(window, state)


def globe_of(border, *keyframes):
    globe = Globe(100.0, border)
    globe.draw(keyframes)
    return globe


def test_directions_are_what_the_sphere_projects_back():
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SPHERE.size), indexing="ij")
    assert torch.allclose(SPHERE.pixels(directions(SPHERE)), torch.stack([x, y], -1), atol=1e-9)


def test_east_and_south_are_across_the_ray_and_each_other():
    ray = directions(SPHERE)
    sides = tangents(ray)
    frame = torch.cat([sides, ray[..., None, :]], -2)
    assert torch.allclose(frame @ frame.mT, torch.eye(3, dtype=torch.float64).expand_as(frame), atol=1e-9)
    step = 1e-6
    here = SPHERE.pixels(ray)[20:40, 30:90]
    for side, axis in ((0, 0), (1, 1)):
        moved = SPHERE.pixels(ray + step * sides[..., side, :])[20:40, 30:90] - here
        assert (moved[..., axis] > 0).all()
        assert moved[..., 1 - axis].abs().max() < 1e-3 * moved[..., axis].min()


@pytest.mark.parametrize("row", [31, 5, 0, 63])
def test_a_blur_is_as_wide_everywhere_and_knows_no_seam(row):
    """The second moment of a blurred point, on the sphere: 2 sigma^2 for small ones."""
    image, sigma = torch.zeros(SPHERE.size), 2.0
    image[row, 3] = 1
    soft = smooth(image, sigma, SPHERE)
    rays, area = directions(SPHERE), cosines(SPHERE).double()
    weight = soft.double() * area
    away = (rays @ rays[row, 3]).clamp(-1, 1).arccos() * SPHERE.focal
    assert float((weight * away.square()).sum() / weight.sum()) == pytest.approx(2 * sigma**2, rel=0.2)
    assert torch.allclose(smooth(image.roll(40, 1), sigma, SPHERE), soft.roll(40, 1), atol=1e-7)


def test_a_border_is_what_is_beyond_the_seam_and_the_poles():
    image = torch.arange(SPHERE.height * 2 * SPHERE.height, dtype=torch.float32).view(SPHERE.size)
    framed = bordered(image, SPHERE)[0, 0]
    assert torch.equal(framed[1:-1, 1:-1], image)
    assert torch.equal(framed[1:-1, 0], image[:, -1])
    assert torch.equal(framed[1:-1, -1], image[:, 0])
    assert torch.equal(framed[0, 1:-1], image[0].roll(SPHERE.height))
    assert torch.equal(framed[-1, 1:-1], image[-1].roll(SPHERE.height))


def test_votes_are_spread_near_the_poles_only_and_none_is_lost():
    votes = torch.zeros(SPHERE.size)
    votes[32, 7] = votes[1, 7] = 1
    spread_out = steady(votes, SPHERE)
    assert torch.equal(spread_out[32], votes[32])
    assert torch.allclose(spread_out.sum(1), votes.sum(1), atol=1e-5)
    assert spread_out[1].max() < 0.2
    assert spread_out.min() >= 0


@pytest.mark.parametrize("where", EVERYWHERE)
def test_a_facet_shows_what_a_window_draws_straight_on_it(street, border, where):
    R = turn(*EVERYWHERE[where])
    one = keyframe(street, 4, R)
    globe = globe_of(border, one)
    facet = globe.facing(Pose(R @ turn(0.05, 0.1, 0.2), torch.zeros(1, 3, dtype=torch.float64)))
    H_k = facet.warp(one.state, one.seconds)
    box = facet.box(H_k)
    ours, straight = facet.assembled(box), facet.layers_of(one, H_k, box)
    both = torch.stack([ours.votes.flatten(), straight.votes.flatten()])
    assert torch.corrcoef(both)[0, 1] > 0.8
    near = straight.most > 0
    assert (ours.most > 0)[near].double().mean() > 0.95
    direction = torch.stack([torch.atan2(2 * x[1], x[0] - x[2]) for x in (ours.exposure, straight.exposure)])  # twice the angle
    away = torch.stack(facet._world(box, CELL, torch.eye(3))[:2]).norm(dim=0)
    inner = near & (away < 0.3)  # farther off, a facet is longer outwards than across
    apart = torch.remainder(direction[0] - direction[1] + math.pi, 2 * math.pi) - math.pi
    assert apart[inner].abs().median() < 0.1


def test_strength_does_not_depend_on_where_the_world_looks(street, border):
    """The same windows on a globe that is turned: what a camera meets is the same, at the poles too."""

    def met(R):
        globe = globe_of(border, *(keyframe(street, i, R @ keyframe(street, i).state.pose.R) for i in range(4)))
        last = keyframe(street, 4, R @ keyframe(street, 4).state.pose.R)
        facet = globe.toward(last.state.pose)
        layers = facet.assembled(facet.box(facet.warp(last.state, last.seconds)))
        return float(blur(facet.strength(layers)[None], 1.0).square().mean())  # finer, it depends on how pixels fall on pixels

    first, *others = (met(turn(*w)) for w in EVERYWHERE.values())
    assert others == pytest.approx([first] * len(others), rel=0.12)


def test_windows_add_up_and_those_at_rest_add_nothing(street, border):
    one, other = keyframe(street, 1), keyframe(street, 3)
    both, parts = globe_of(border, one, other), [globe_of(border, k) for k in (one, other)]
    assert torch.allclose(both.layers.votes, parts[0].layers.votes + parts[1].layers.votes, atol=1e-4)
    assert torch.allclose(both.layers.exposure, parts[0].layers.exposure + parts[1].layers.exposure, atol=1e-4)
    still = globe_of(border, keyframe(street, 1, omega=torch.zeros(1, 3, dtype=torch.float64)))
    assert not still.layers.votes.any()
    assert not still.layers.exposure.any()


def test_what_was_cut_or_counted_before_is_renewed_when_a_window_is_drawn(street, border):
    globe = globe_of(border, keyframe(street, 1))
    kept = globe.copy()
    facet, typical = globe.toward(globe.keyframes[0].state.pose), globe.typical()
    box = facet.box(facet.warp(globe.keyframes[0].state, globe.keyframes[0].seconds))
    before = facet.area(box)
    assert facet.area(box) is before
    globe.draw([keyframe(street, 2)])
    assert facet.area(box) is not before
    assert facet.area(box).layers.votes.sum() > 1.5 * before.layers.votes.sum()
    assert globe.typical() != typical
    assert len(kept.keyframes) == 1
    assert kept.typical() == pytest.approx(typical)


def test_motion_is_known_along_its_direction_only(street, border):
    """Windows that all turn right: what is seen of a camera that turns right is known, of one that nods it is not."""
    right = torch.tensor([[0.0, 2.0, 0.0]], dtype=torch.float64)  # 10 px in each window
    ones = [keyframe(street, i, turn(0.0, 0.02 * i, 0.0), right * 0.05 / keyframe(street, i).seconds) for i in range(6)]
    globe = globe_of(border, *ones)
    rays = street.camera.rays()[::12, ::12].reshape(-1, 3)

    def overlap(omega):
        zero = torch.zeros(1, 3, dtype=torch.float64)
        state = State(Pose(turn(0.0, 0.05, 0.0), zero), Motion(omega, zero))
        facet = globe.toward(state.pose)
        H_k = facet.warp(state, torch.tensor([0.05], dtype=torch.float64))
        return facet.overlap(H_k, rays, facet.area(facet.box(H_k)))

    assert overlap(right) > 0.7
    assert overlap(right.roll(-1, 1)) < 0.1


def test_a_facet_is_kept_while_the_camera_looks_near_it_and_shows_nothing_behind_it(street, border):
    globe = globe_of(border, keyframe(street, 1))
    zero = torch.zeros(1, 3, dtype=torch.float64)
    facet = globe.toward(Pose(turn(0.0, 0.0, 0.0), zero))
    assert globe.toward(Pose(turn(0.1, 0.1, 1.0), zero)) is facet
    assert globe.toward(Pose(turn(0.0, 0.5, 0.0), zero)) is not facet
    behind = State(Pose(turn(0.0, 3.0, 0.0), zero), Motion(zero, zero))
    seconds = torch.ones(1, dtype=torch.float64)
    assert facet.box(facet.warp(behind, seconds)) is None
    assert facet.box(facet.warp(State(Pose(turn(0.0, 0.3, 0.0), zero), Motion(zero, zero)), seconds)) is not None


def test_cells_cover_the_sphere(border):
    globe = Globe(100.0, border)
    height, width = globe.sphere.size
    assert height % (2 * CELL) == 0
    assert spread(globe.layers.exposure[0]).shape == (height, width)
    assert globe.sphere.focal == pytest.approx(100.0, rel=0.03)
