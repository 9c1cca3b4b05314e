import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.warp import monomials, polynomial, transfer, warp

FOCAL = 200.0


@pytest.fixture
def scene(rand):
    """Three cameras in front of three tilted planes, 50 events each."""
    motion = Motion(rand(3, 3) - 0.5, rand(3, 3) - 0.5)
    ray = torch.cat([rand(3, 50, 2) - 0.5, torch.ones_like(rand(3, 50, 1))], -1)
    return ray, motion.at(0.1 * rand(3, 50)), Plane.tilted(rand(3, 2) - 0.5)


def pixels(ray):
    return FOCAL * ray[..., :2] / ray[..., 2:]


def test_transfer_inverts_the_plane_homography(scene, close):
    ray, pose, plane = scene
    eye = torch.eye(3).to(ray)
    H = pose.R.mT @ (eye + pose.t[..., None] * plane.normal[:, None, None] / plane.distance[:, None, None, None])
    close(pixels((H @ transfer(ray, pose, plane)[..., None])[..., 0]) / FOCAL, pixels(ray) / FOCAL)


def test_transfer_is_what_a_point_of_the_plane_does(scene, close):
    """The long way: the moved camera's ray meets the plane in a point, and the reference camera looks at the point."""
    ray, pose, plane = scene
    direction = (pose.R @ ray[..., None])[..., 0]
    n, d = plane.normal[:, None], plane.distance[:, None]
    depth = -(d + (n * pose.t).sum(-1)) / (n * direction).sum(-1)
    close(pixels(transfer(ray, pose, plane)) / FOCAL, pixels(pose.t + depth[..., None] * direction) / FOCAL)


@pytest.mark.parametrize(("angle", "bound"), [(0.05, 1e-4), (0.1, 1e-4), (0.2, 1e-2), (0.4, 2e-2)])
def test_the_polynomial_is_its_closed_form_twin_over_the_whole_image(angle, bound):
    """method.md's table: at most 0.01 px at 0.2 rad."""
    g = torch.Generator().manual_seed(1)
    y, x = torch.meshgrid(torch.linspace(-0.6, 0.6, 13), torch.linspace(-0.8, 0.8, 17), indexing="ij")
    grid = torch.stack([x, y, torch.ones_like(x)], -1).reshape(1, -1, 3).double().expand(40, -1, -1)
    turn = angle * torch.nn.functional.normalize(torch.randn(40, 3, generator=g, dtype=torch.float64), dim=-1)
    shift = 0.4 * (torch.rand(40, 3, generator=g, dtype=torch.float64) - 0.5)
    plane = Plane.tilted(torch.rand(40, 2, generator=g, dtype=torch.float64) - 0.5)
    worst = 0.0
    for s in (0.25, 0.5, 1.0):
        time = torch.full(grid.shape[:2], s, dtype=torch.float64)
        exact = transfer(grid, Motion(turn, shift).at(time), plane)
        series = warp(polynomial(turn, shift, plane.normal), monomials(grid, time)).mT
        worst = max(worst, (pixels(exact) - pixels(series)).abs().max().item())
    assert worst < bound


def test_monomials_are_the_powers_of_time_times_the_ray(rand, close):
    ray, s = rand(2, 5, 3), rand(2, 5)
    basis = monomials(ray, s, 4)
    for k in range(4):
        close(basis[:, 3 * k : 3 * k + 3], (s[..., None] ** k * ray).mT)


def test_warp_is_the_sum_of_the_homographies(rand, close):
    ray, s, H_k = rand(2, 7, 3), rand(2, 7), rand(2, 4, 3, 3)
    H = sum(H_k[:, k, None] * s[..., None, None] ** k for k in range(4))
    close(warp(H_k, monomials(ray, s, 4)).mT, (H @ ray[..., None])[..., 0])


def test_no_motion_leaves_every_ray(rand, close):
    zero, ray = torch.zeros_like(rand(1, 3)), rand(1, 9, 3)
    H_k = polynomial(zero, zero, torch.tensor([[0.0, 0.0, -1.0]]).to(zero))
    close(warp(H_k, monomials(ray, rand(1, 9))).mT, ray)


def test_the_polynomial_has_the_right_gradient():
    g = torch.Generator().manual_seed(2)
    turn, shift, tilt = (torch.rand(2, n, generator=g, dtype=torch.float64).requires_grad_() for n in (3, 3, 2))
    assert torch.autograd.gradcheck(lambda a, b, c: polynomial(a, b, Plane.tilted(c).normal), (turn, shift, tilt))


def test_projection_to_the_map_is_one_transfer_with_the_composed_pose(scene, rand, close):
    ray, pose, world = scene
    frame = Pose(so3.exp(0.2 * rand(3, 3)), 0.2 * rand(3, 3))
    two = transfer(transfer(ray, pose, world.seen_from(frame)), frame[:, None], world)
    one = transfer(ray, frame[:, None] @ pose, world)
    close(pixels(one) / FOCAL, pixels(two) / FOCAL)
