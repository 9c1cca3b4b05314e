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
