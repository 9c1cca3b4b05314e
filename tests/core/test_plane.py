import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose


def test_no_tilt_is_the_wall_at_distance_one(dtype, device, close):
    plane = Plane.tilted(torch.zeros(1, 2, dtype=dtype, device=device))
    close(plane.normal, torch.tensor([[0, 0, -1]], dtype=dtype, device=device))
    close(plane.distance, torch.ones(1, dtype=dtype, device=device))


def test_tilt_finds_the_angles_that_tilted_was_given(rand, close):
    angles = torch.cat([2 * (rand(20, 2) - 0.5), torch.zeros_like(rand(1, 2))])
    close(Plane.tilted(angles).tilt(), angles)


def test_a_point_of_the_plane_stays_on_it_seen_from_elsewhere(rand, close):
    plane = Plane.tilted(rand(5, 2) - 0.5)
    pose = Pose(so3.exp(rand(5, 3) - 0.5), 0.3 * rand(5, 3))
    ray = torch.cat([rand(5, 2) - 0.5, torch.ones_like(rand(5, 1))], -1)
    point = ray * (-plane.distance / (plane.normal * ray).sum(-1))[:, None]
    inverse, there = pose.inverse(), plane.seen_from(pose)
    moved = (inverse.R @ point[..., None])[..., 0] + inverse.t
    close((there.normal * moved).sum(-1) + there.distance, torch.zeros_like(moved[:, 0]))


@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.5])
def test_facing_is_a_rotation(tilt, close, dtype, device):
    R = Plane.tilted(torch.full((1, 2), tilt, dtype=dtype, device=device)).facing()
    close(R @ R.mT, torch.eye(3, dtype=dtype, device=device)[None])
    close(torch.linalg.det(R), torch.ones(1, dtype=dtype, device=device))


def test_the_directions_along_a_plane_are_orthogonal_to_it_and_to_each_other(rand, close):
    plane = Plane.tilted(2 * (rand(20, 2) - 0.5))
    three = torch.cat([plane.across(), -plane.normal[:, None]], 1)
    close(three @ three.mT, torch.eye(3).to(three).expand(20, 3, 3))
    close(torch.linalg.det(three), torch.ones_like(three[:, 0, 0]))


def test_a_lean_by_hand(dtype, device, close):
    """The wall's directions are x and y; by 0.75 along x its normal is that of 3 : 4 : 5."""
    wall = Plane(torch.tensor([[0.0, 0.0, -1.0]], dtype=dtype, device=device), torch.full((1,), 2.0, dtype=dtype, device=device))
    leant = wall.leaning(torch.tensor([[0.75, 0.0]], dtype=dtype, device=device))
    close(leant.normal, torch.tensor([[0.6, 0.0, -0.8]], dtype=dtype, device=device))
    close(leant.distance, wall.distance)


def test_a_small_lean_goes_along_the_plane_by_its_angle(rand):
    plane = Plane.tilted(2 * (rand(20, 2).double() - 0.5))
    h = 1e-5
    for i, side in enumerate(h * torch.eye(2).to(plane.normal)):
        slope = (plane.leaning(side.expand(20, 2)).normal - plane.leaning(-side.expand(20, 2)).normal) / (2 * h)
        torch.testing.assert_close(slope, plane.across()[:, i], rtol=0, atol=1e-9)


def test_a_leaning_plane_keeps_its_distance_and_its_normal_its_length(rand, close):
    plane = Plane(Plane.tilted(2 * (rand(20, 2) - 0.5)).normal, 1 + rand(20))
    leant = plane.leaning(rand(20, 2) - 0.5)
    close(leant.normal.norm(dim=-1), torch.ones_like(plane.distance))
    assert torch.equal(leant.distance, plane.distance)
    close(plane.leaning(torch.zeros_like(plane.normal[:, :2])).normal, plane.normal)


def test_planes_are_joined_in_their_order_and_repeated(rand):
    plane = Plane(Plane.tilted(rand(3, 2)).normal, rand(3))
    parts = [Plane(plane.normal[i : i + 1], plane.distance[i : i + 1]) for i in range(3)]
    joined = Plane.join(parts)
    assert torch.equal(joined.normal, plane.normal)
    assert torch.equal(joined.distance, plane.distance)
    many = parts[1].repeated(4)
    assert torch.equal(many.normal, plane.normal[[1, 1, 1, 1]])
    assert torch.equal(many.distance, plane.distance[[1, 1, 1, 1]])
