"""Two maps of one plane: the similarity between their worlds, and whether the one fits the other."""

from dataclasses import replace

import pytest
import torch
from scenes import Scene, drawn, pixels, state_of, wall

from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose
from torchcmax.core.state import SIZE
from torchcmax.slam.atlas import FITS, Similarity, agreement, fitting, moved
from torchcmax.slam.relocalize import Grid, Relocalizing

STATES = [
    state_of((0.1, -0.2, 0.3), (0.2, 0.1, -0.3), (1.0, -2.0, 0.5), (0.4, 0.6, -0.8)),
    state_of((-0.2, 0.1, 2.0), (-0.3, 0.5, 0.2), (0.3, 0.2, -0.4), (-0.1, 0.3, 0.2)),
]


def similarity_of(turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), scale=1.0):
    turn, shift = (torch.tensor([part], dtype=torch.float64) for part in (turn, shift))
    return Similarity(so3.exp(turn), shift, torch.tensor([scale], dtype=torch.float64))


TRUE = similarity_of((0.3, -0.2, 1.1), (0.5, -0.7, 0.2), 1.6)


def inverse(similarity):
    R, scale = similarity.R.mT, 1 / similarity.scale
    return Similarity(R, -scale[:, None] * (R @ similarity.t[..., None])[..., 0], scale)


def plane_in(similarity, plane):
    """The plane of the one world in the other: n . X + d = 0 for X = scale R x + t."""
    normal = (similarity.R @ plane.normal[..., None])[..., 0]
    return Plane(normal, similarity.scale * plane.distance - (normal * similarity.t).sum(-1))


def same(one, other):
    torch.testing.assert_close(one.step_to(other), torch.zeros(1, SIZE, dtype=torch.float64), rtol=0, atol=1e-12)


def in_world(scene, similarity):
    return Scene(scene.camera, scene.windows, [similarity.state(s) for s in scene.states], plane_in(similarity, scene.plane))


@pytest.fixture(scope="module")
def maps(sheet):
    """The map of the even windows, ready for searching, and that of the odd ones, in a world of its own: TRUE leads back."""
    count = len(sheet.windows)
    return Grid(drawn(sheet, range(0, count, 2)), Relocalizing()), drawn(in_world(sheet, inverse(TRUE)), range(9, count, 2))


@pytest.fixture(scope="module")
def sensor(sheet):
    return Canvas.around(sheet.camera, 0.0)


@pytest.mark.parametrize("state", STATES)
def test_a_similarity_leads_from_the_one_state_to_the_other(state):
    here, there = wall(0.1, -0.2), wall(-0.05, 0.15)
    other = state_of((0.4, 0.1, -1.0), (0.1, 0.4, 0.35))
    found = Similarity.between(state, here, other, there)
    pose = found.pose(state.pose)
    torch.testing.assert_close(pose.R, other.pose.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(pose.t, other.pose.t, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.scale, other.seen(there).distance / state.seen(here).distance)
    assert float(found.scale) != pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("state", STATES)
def test_the_similarity_between_two_worlds_is_found_from_one_camera(state):
    plane = wall(0.1, -0.2)
    found = Similarity.between(state, plane, TRUE.state(state), plane_in(TRUE, plane))
    for one, other in zip((found.R, found.t, found.scale), (TRUE.R, TRUE.t, TRUE.scale), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)


def test_a_pose_moves_as_the_points_that_its_camera_sees():
    point = torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)  # in the camera's frame
    for state in STATES:
        world = state.pose.R[0] @ point + state.pose.t[0]
        moved_there = TRUE.scale * (TRUE.R[0] @ world) + TRUE.t[0]
        pose = TRUE.pose(state.pose)
        torch.testing.assert_close(pose.R[0] @ (TRUE.scale * point) + pose.t[0], moved_there)


def test_there_and_back_is_nothing():
    for state in STATES:
        same(inverse(TRUE).state(TRUE.state(state)), state)
        same(TRUE.state(inverse(TRUE).state(state)), state)


def test_what_is_between_two_cameras_is_turned_by_nothing_and_scaled():
    one, other = STATES
    before, after = one.pose.inverse() @ other.pose, TRUE.pose(one.pose).inverse() @ TRUE.pose(other.pose)
    torch.testing.assert_close(after.R, before.R)
    torch.testing.assert_close(after.t, TRUE.scale * before.t)


def test_a_moving_camera_goes_on_alike_in_both_worlds():
    dt = torch.tensor([0.3], dtype=torch.float64)
    for state in STATES:
        same(TRUE.state(state).later(dt), TRUE.state(state.later(dt)))
        assert torch.equal(TRUE.state(state).motion.omega, state.motion.omega)


def test_the_distance_of_the_plane_scales():
    plane = wall(0.1, -0.2)
    for state in STATES:
        here, there = state.seen(plane), TRUE.state(state).seen(plane_in(TRUE, plane))
        torch.testing.assert_close(there.distance, TRUE.scale * here.distance)
        torch.testing.assert_close(there.normal, here.normal)


def test_moved_keyframes_are_the_same_events_elsewhere(maps, sheet):
    home, local = maps
    keyframes = moved(local, TRUE)
    assert len(keyframes) == len(local.keyframes)
    for keyframe, before, i in zip(keyframes, local.keyframes, range(9, len(sheet.windows), 2), strict=True):
        same(keyframe.state, sheet.states[i])
        assert keyframe.ink is before.ink
        assert keyframe.time == before.time
        assert torch.equal(keyframe.seconds, before.seconds)
    assert pixels([keyframes[0].state], home.plane, [sheet.states[9]], sheet.plane, sheet.camera) < 1e-9


def test_a_map_fits_where_it_belongs(maps, sensor):
    home, local = maps
    keyframes = fitting(local, TRUE, home, home, sensor)
    assert keyframes is not None
    for one, other in zip(keyframes, moved(local, TRUE), strict=True):
        assert torch.equal(one.state.pose.t, other.state.pose.t)
    scores = [agreement(k, home, home, sensor) for k in keyframes]
    assert sorted(scores)[len(scores) // 2] > 1.5 * FITS


def test_a_keyframe_agrees_less_where_it_is_not(maps, sensor):
    home, local = maps
    keyframe = moved(local, TRUE)[1]
    beside = keyframe.at(keyframe.state.moved(torch.tensor([[0.0] * 3 + [0.05] + [0.0] * 8], dtype=torch.float64)))
    assert 0 <= agreement(beside, home, home, sensor) < 0.6 * agreement(keyframe, home, home, sensor)


@pytest.mark.parametrize(
    "wrong",
    [
        similarity_of(shift=(0.4, 0.0, 0.0)),  # 40 px
        similarity_of(shift=(0.0, -0.4, 0.0)),
        similarity_of((0.0, 0.0, 0.52)),  # 30 degrees
        similarity_of((0.0, 0.0, -0.52)),
        similarity_of(shift=(0.0, 0.0, -0.3)),
        similarity_of(scale=1.3),
    ],
)
def test_a_map_does_not_fit_where_it_does_not_belong(maps, sensor, wrong):
    home, local = maps
    pose = wrong.pose(Pose(TRUE.R, TRUE.t))
    assert fitting(local, Similarity(pose.R, pose.t, TRUE.scale * wrong.scale), home, home, sensor) is None


def test_a_map_of_what_the_other_does_not_know_does_not_fit(maps, sensor):
    home, local = maps
    away = replace(TRUE, t=TRUE.t + torch.tensor([[6.0, 0.0, 0.0]], dtype=torch.float64))
    assert agreement(moved(local, away)[0], home, home, sensor) < 0
    assert fitting(local, away, home, home, sensor) is None


def test_keyframes_that_see_what_is_not_known_do_not_speak(maps, sensor):
    """Most of them are elsewhere, and the map fits by the few that are not."""
    home, local = maps
    few = replace(local, keyframes=local.keyframes[:3])
    away = state_of(shift=(6.0, 0.0, 0.0))
    far = [k.at(replace(k.state, pose=Pose(k.state.pose.R, k.state.pose.t + away.pose.t))) for k in local.keyframes]
    both = replace(local, keyframes=few.keyframes + far)
    keyframes = fitting(both, TRUE, home, home, sensor)
    assert keyframes is not None
    assert len(keyframes) == len(both.keyframes)
    assert fitting(replace(local, keyframes=far), TRUE, home, home, sensor) is None
