"""One test for each equation of the thesis draft, by hand or against an independent way to the same number.

Numbers follow the draft as the design's method page quotes it. Of the appendix the page names A.2, A.3, A.6-A.9, A.11, A.13
and A.14; A.1, A.4, A.5, A.10 and A.12 are the remaining links of its chain from the contrast down to the parameters.
"""

import math

import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import high_pass, variance
from torchcmax.core.draw import Ink, draw
from torchcmax.core.model import Planar, Rotation
from torchcmax.core.objective import Look, objective
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.core.vote import vote
from torchcmax.core.warp import monomials, polynomial, transfer, warp
from torchcmax.core.window import Window

DOUBLE = torch.float64
jacobian = torch.autograd.functional.jacobian


def equal(a, b, tolerance=1e-9):
    torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def pixels(ray):
    return ray[..., :2] / ray[..., 2:]


@pytest.fixture
def ray():
    return torch.cat([rand(2, 20, 2) - 0.5, torch.ones(2, 20, 1, dtype=DOUBLE)], -1)


@pytest.fixture
def scene(ray):
    """Rays, angular velocity, velocity, plane normal and time: x' = (I + v t n^T)^-1 R x."""
    return ray[0, 0], rand(3, seed=1) - 0.5, rand(3, seed=2) - 0.5, Plane.tilted(rand(1, 2, seed=3) - 0.5).normal[0], 0.3


def spelled(x, omega, v, n, t):
    """The warp with a matrix inverse, as the draft writes it."""
    return inverse(v, n, t) @ so3.exp(t * omega) @ x


def inverse(v, n, t):
    return torch.linalg.inv(torch.eye(3, dtype=DOUBLE) + t * v[:, None] * n[None])


def warped(x, omega, v, n, t):
    """The package's warp of one ray: `transfer`, whose scale is that of the draft."""
    pose = Motion(omega[None], v[None]).at(torch.tensor([[t]], dtype=DOUBLE))
    return transfer(x[None, None], pose, Plane(n[None], torch.ones(1, dtype=DOUBLE)))[0, 0]


def test_eq_2_1_the_image_sums_signed_events_at_their_warped_places():
    ray = torch.tensor([[[0.1, 0.2, 1.0], [0.1, 0.2, 1.0], [-0.3, 0.0, 1.0]]], dtype=DOUBLE)
    window = Window(
        ray,
        torch.tensor([[0.0, 0.1, 0.2]]).double(),
        torch.tensor([[1.0, -1.0, 1.0]]).double(),
        torch.zeros(1).long(),
        torch.tensor([0.2]).double(),
    )
    still = polynomial(*(torch.zeros(1, 3, dtype=DOUBLE) for _ in range(2)), torch.tensor([[0.0, 0.0, -1.0]], dtype=DOUBLE))
    image = draw(still, Ink.of(window, window.polarity), Canvas(10.0, (5.0, 5.0), (11, 11)), torch.zeros(1).long())
    expected = torch.zeros(1, 11, 11, dtype=DOUBLE)
    expected[0, 5, 2] = 1  # the other two cancel
    equal(image, expected)


def test_eq_2_2_the_high_pass_takes_out_what_is_flat():
    y, x = torch.meshgrid(torch.arange(40), torch.arange(40), indexing="ij")
    flat, checkers = torch.ones(1, 40, 40, dtype=DOUBLE), ((x + y) % 2 * 2.0 - 1)[None].double()
    equal(high_pass(checkers)[0], torch.tensor(((38 * 38) * 64 + 4 * 38 * 49 + 4 * 36) / 1600 / 20, dtype=DOUBLE))
    assert high_pass(flat) < 0.02 * high_pass(checkers)


def test_eq_2_3_variance():
    image = rand(2, 5, 7)
    mean = image.sum((1, 2)) / 35
    equal(variance(image), ((image - mean[:, None, None]) ** 2).sum((1, 2)) / 35)


def test_eq_2_4_pure_rotation_turns_the_ray(ray):
    omega, s = rand(2, 3), rand(2, 20)
    turned = (so3.exp(omega[:, None] * s[..., None]) @ ray[..., None])[..., 0]
    wall = Plane.tilted(torch.zeros(2, 2, dtype=DOUBLE))
    equal(transfer(ray, Motion(omega, torch.zeros_like(omega)).at(s), wall), turned)
    H_k = Rotation(1.0).homography(0.1 * omega, torch.arange(2), 0.0)
    equal(pixels(warp(H_k, monomials(ray, s)).mT), pixels(transfer(ray, Motion(0.1 * omega, 0 * omega).at(s), wall)), 1e-8)


def test_eq_2_5_a_wall_moves_by_focal_length_times_velocity_over_distance(ray):
    wall = Plane.tilted(torch.zeros(2, 2, dtype=DOUBLE))
    sideways = Motion(torch.zeros(2, 3, dtype=DOUBLE), torch.tensor([[0.2, -0.1, 0.0]], dtype=DOUBLE).expand(2, 3))
    moved = pixels(transfer(ray, sideways.at(torch.full((2, 20), 0.5, dtype=DOUBLE)), wall)) - pixels(ray)
    equal(moved, torch.tensor([0.1, -0.05], dtype=DOUBLE).expand(2, 20, 2))


def test_eq_2_6_the_warp_inverts_the_plane_homography(scene):
    equal(warped(*scene), spelled(*scene))


def test_eq_2_7_the_position_is_velocity_times_time():
    v, t = rand(2, 3), rand(2, 4)
    equal(Motion(0 * v, v).at(t).t, v[:, None] * t[..., None])


def test_eq_2_8_the_orientation_is_the_exponential_of_angular_velocity_times_time():
    w, t = rand(2, 3), rand(2, 4)
    equal(Motion(w, 0 * w).at(t).R, torch.linalg.matrix_exp(so3.hat(w)[:, None] * t[..., None, None]))


def test_eq_2_9_hat():
    equal(so3.hat(torch.tensor([1.0, 2.0, 3.0])), torch.tensor([[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]))


def test_eq_2_10_the_plane_of_the_world_is_another_one_in_the_camera():
    world, pose = Plane.tilted(rand(3, 2)), Pose(so3.exp(rand(3, 3)), 0.2 * rand(3, 3))
    point = -world.normal * world.distance[:, None]  # the foot of the perpendicular lies on the plane
    seen = world.seen_from(pose)
    inverse = pose.inverse()
    there = (inverse.R @ point[..., None])[..., 0] + inverse.t
    equal((seen.normal * there).sum(-1), -seen.distance)


def test_eq_2_11_projection_to_the_map_is_one_warp_with_the_composed_pose(ray):
    world, frame = Plane.tilted(rand(2, 2) - 0.5), Pose(so3.exp(0.2 * rand(2, 3)), 0.2 * rand(2, 3, seed=4))
    pose = Motion(rand(2, 3) - 0.5, rand(2, 3, seed=5) - 0.5).at(0.1 * rand(2, 20))
    two = transfer(transfer(ray, pose, world.seen_from(frame)), frame[:, None], world)
    equal(pixels(transfer(ray, frame[:, None] @ pose, world)), pixels(two))


def test_eq_2_12_the_turn_to_the_plane_is_about_the_axis_between_the_normals():
    plane = Plane.tilted(torch.tensor([[0.3, -0.4]], dtype=DOUBLE))
    axis = so3.log(plane.facing())[0]
    wall = torch.tensor([0.0, 0.0, -1.0], dtype=DOUBLE)
    equal(torch.linalg.cross(axis / axis.norm(), torch.linalg.cross(plane.normal[0], wall) / math.sin(0.5)), torch.zeros(3, dtype=DOUBLE))
    equal(axis.norm(), torch.tensor(0.5, dtype=DOUBLE))


def test_eq_2_13_facing_turns_the_normal_to_the_camera():
    plane = Plane.tilted(rand(4, 2) - 0.5)
    equal((plane.facing() @ plane.normal[..., None])[..., 0], torch.tensor([0.0, 0.0, -1.0], dtype=DOUBLE).expand(4, 3))


def test_eq_2_14_on_the_map_all_rays_to_one_point_of_the_plane_meet():
    world = Plane.tilted(torch.tensor([[0.2, 0.1]], dtype=DOUBLE))
    point = torch.tensor([[0.3, -0.2, 0.0]], dtype=DOUBLE)
    point[:, 2] = -(1 + (world.normal[:, :2] * point[:, :2]).sum(-1)) / world.normal[:, 2]
    seen = []
    for seed in range(5):
        pose = Pose(so3.exp(0.3 * (rand(1, 3, seed=seed) - 0.5)), 0.3 * (rand(1, 3, seed=seed + 9) - 0.5))
        inverse = pose.inverse()
        ray = (inverse.R @ point[..., None])[..., 0] + inverse.t
        on_map = world.facing() @ transfer((ray / ray[:, 2:])[:, None], pose[:, None], world)[..., None]
        seen.append(pixels(on_map[..., 0]))
    for other in seen[1:]:
        equal(other, seen[0])


def test_eq_2_15_and_2_16_the_next_window_begins_where_this_one_ends():
    pose, motion, dt = Pose(so3.exp(rand(2, 3)), rand(2, 3, seed=1)), Motion(rand(2, 3, seed=2), rand(2, 3, seed=3)), rand(2, seed=4)
    after = motion.following(pose, dt)
    equal(after.t, (pose.R @ (motion.velocity * dt[:, None])[..., None])[..., 0] + pose.t)
    equal(after.R, pose.R @ so3.exp(motion.omega * dt[:, None]))


def test_eq_2_14_the_placement_of_a_state_is_the_warp_to_the_map_and_its_turn(ray):
    """The map's pixel is that of the turned ray to the point of the plane; all in one matrix."""
    world, pose = Plane.tilted(rand(2, 2) - 0.5), Pose(so3.exp(0.3 * rand(2, 3)), 0.3 * rand(2, 3, seed=4))
    placed = ray @ State(pose, Motion(rand(2, 3), rand(2, 3))).placement(world, world.facing()).mT
    equal(pixels(placed), pixels(transfer(ray, pose[:, None], world) @ world.facing().mT))


def test_eq_2_15_and_2_16_the_state_of_a_camera_goes_on_as_they_say():
    """And the velocity, which is constant in the world, turns with the camera's frame."""
    pose, motion, dt = Pose(so3.exp(rand(2, 3)), rand(2, 3, seed=1)), Motion(rand(2, 3, seed=2), rand(2, 3, seed=3)), rand(2, seed=4)
    after, expected = State(pose, motion).later(dt), motion.following(pose, dt)
    equal(after.pose.R, expected.R)
    equal(after.pose.t, expected.t)
    equal((after.pose.R @ after.motion.velocity[..., None]), pose.R @ motion.velocity[..., None])
    equal(after.motion.omega, motion.omega)


def test_eq_a_1_the_gradient_of_variance_is_twice_the_deviation_from_the_mean():
    image = rand(1, 6, 5)
    equal(jacobian(variance, image)[0], 2 * (image - image.mean()) / 30)


def test_eq_a_2_moving_one_event_changes_the_contrast_by_its_four_pixels_alone():
    """The package's gradient against small moves of one event at a time, and these against the four pixels around it."""
    xy, weight, h = (1 + 6 * rand(1, 9, 2)).floor() + 0.2 + 0.6 * rand(1, 9, 2, seed=1), torch.ones(1, 9, dtype=DOUBLE), 1e-6
    gradient = jacobian(lambda p: variance(vote(p, weight, (9, 9))), xy)[0, 0]
    image = vote(xy, weight, (9, 9))[0]
    for i in range(9):
        for axis in (0, 1):
            moved = xy.clone()
            moved[0, i, axis] += h
            change = vote(moved, weight, (9, 9))[0] - image
            assert (change.abs() > h / 100).sum() == 4
            equal((2 * (image - image.mean()) / 81 * change).sum() / h, gradient[i, axis], 1e-6)


@pytest.mark.parametrize("axis", [0, 1])
def test_eq_a_3_and_a_14_the_slope_of_a_vote_is_a_gather_of_differences(axis):
    """dL/dx' = w [(g01 - g00)(1 - fy) + (g11 - g10) fy], and y likewise."""
    g, w, fx, fy = rand(4, 4), 0.7, 0.3, 0.6
    xy = torch.tensor([[[1 + fx, 2 + fy]]], dtype=DOUBLE, requires_grad=True)
    image = vote(xy, torch.tensor([[w]], dtype=DOUBLE), (4, 4))
    (gradient,) = torch.autograd.grad((image[0] * g).sum(), xy)
    g00, g01, g10, g11 = g[2, 1], g[2, 2], g[3, 1], g[3, 2]
    by_hand = (w * ((g01 - g00) * (1 - fy) + (g11 - g10) * fy), w * ((g10 - g00) * (1 - fx) + (g11 - g01) * fx))
    equal(gradient[0, 0, axis], by_hand[axis])


def test_eq_a_4_the_derivative_of_the_division_by_depth():
    x = rand(3) + 0.5
    X, Y, Z = x
    by_hand = torch.tensor([[1 / Z, 0, -X / Z**2], [0, 1 / Z, -Y / Z**2]], dtype=DOUBLE)
    equal(jacobian(Canvas(1.0, (0.0, 0.0), (9, 9)).pixels, x), by_hand)


def test_eq_a_5_the_canvas_multiplies_by_its_focal_length():
    canvas, x = Canvas(123.0, (4.0, 5.0), (10, 10)), rand(3) + 0.5
    equal(jacobian(canvas.pixels, x), 123.0 * jacobian(pixels, x))


def test_eq_a_6_the_warp_without_a_matrix_inverse(scene):
    """Sherman-Morrison: (I + v t n^T)^-1 = I - v t n^T / (1 + t n.v)."""
    x, omega, v, n, t = scene
    by_hand = torch.eye(3, dtype=DOUBLE) - t * v[:, None] * n[None] / (1 + t * n @ v)
    equal(by_hand, inverse(v, n, t))
    equal(warped(*scene), by_hand @ so3.exp(t * omega) @ x)


def test_eq_a_7_rodrigues():
    w = torch.tensor([0.3, -0.2, 0.5], dtype=DOUBLE)
    a, K = w.norm(), so3.hat(w / w.norm())
    equal(so3.exp(w), torch.eye(3, dtype=DOUBLE) + a.sin() * K + (1 - a.cos()) * K @ K)


def test_eq_a_8_the_derivative_of_the_rotated_ray_holds_to_first_order_only(scene):
    """-[R x]^ t is right at omega = 0; elsewhere the Jacobian of the exponential comes in."""
    x, omega, _, _, t = scene
    zero = torch.zeros(3, dtype=DOUBLE)
    exact = jacobian(lambda w: so3.exp(t * w) @ x, omega)
    first = -t * so3.hat(so3.exp(t * omega) @ x)
    equal(jacobian(lambda w: so3.exp(t * w) @ x, zero), -t * so3.hat(x))
    assert (exact - first).abs().max() > 1e-4
    equal(exact, -t * so3.exp(t * omega) @ so3.hat(x) @ so3.right_jacobian(t * omega))


def test_eq_a_9_the_derivative_to_the_velocity(scene):
    """-t (n . x') (I + v t n^T)^-1."""
    x, omega, v, n, t = scene
    P = inverse(v, n, t)
    equal(jacobian(lambda u: warped(x, omega, u, n, t), v), -t * (n @ warped(x, omega, v, n, t)) * P)


def test_eq_a_10_the_derivative_to_the_angular_velocity(scene):
    x, omega, v, n, t = scene
    P = inverse(v, n, t)
    by_hand = -t * P @ so3.exp(t * omega) @ so3.hat(x) @ so3.right_jacobian(t * omega)
    equal(jacobian(lambda w: warped(x, w, v, n, t), omega), by_hand)


def test_eq_a_11_corrected_the_derivative_to_the_normal_is_an_outer_product(scene):
    """-t (P v) ((I + v t n^T)^-1 R x)^T with P = (I + v t n^T)^-1; the draft prints it otherwise."""
    x, omega, v, n, t = scene
    P = inverse(v, n, t)
    by_hand = -t * (P @ v)[:, None] * (P @ so3.exp(t * omega) @ x)[None]
    equal(jacobian(lambda m: warped(x, omega, v, m, t), n), by_hand)


def test_eq_a_12_the_distance_of_the_plane_scales_the_velocity_and_nothing_else(ray):
    plane, pose = Plane.tilted(rand(2, 2) - 0.5), Motion(rand(2, 3), rand(2, 3, seed=1)).at(0.2 * rand(2, 20))
    far = transfer(ray, Pose(pose.R, 3.0 * pose.t), Plane(plane.normal, 3.0 * plane.distance))
    equal(pixels(far), pixels(transfer(ray, pose, plane)))


def test_eq_a_13_tilts_have_full_rank_where_the_angles_of_the_draft_have_not():
    def angles(u):  # the draft's (phi, psi): n = (cos psi sin phi, sin psi sin phi, -cos phi)
        return torch.stack([u[1].cos() * u[0].sin(), u[1].sin() * u[0].sin(), -u[0].cos()])

    zero = torch.zeros(2, dtype=DOUBLE)
    assert torch.linalg.matrix_rank(jacobian(angles, zero)) == 1
    assert torch.linalg.matrix_rank(jacobian(lambda u: Plane.tilted(u[None]).normal[0], zero)) == 2


def test_the_whole_chain_is_the_product_of_its_links(ray):
    """Contrast -> image -> votes -> rays -> eight parameters, against autograd through the spelled-out warp."""
    dt = 0.1 * rand(2, 20).sort(-1).values
    dt = dt - dt[:, :1]
    window = Window(ray, dt, torch.ones(2, 20, dtype=DOUBLE), torch.zeros(2).long(), dt[:, -1])
    canvas, model, look = Canvas(30.0, (20.3, 18.7), (40, 42)), Planar(30.0), Look(reference="first", guard=0.0, tilt=0.0)
    x = 2 * (rand(2, 8, seed=6) - 0.5)
    _, gradient = objective(look, model, look.at(window, canvas, 0.0), torch.arange(2))(x, torch.arange(2))

    def spelled_out(x):
        d = model.displacement(x, torch.arange(2))
        s = window.phase
        place = torch.stack(
            [torch.stack([warped(ray[b, i], d.turn[b], d.shift[b], d.normal[b], s[b, i]) for i in range(20)]) for b in range(2)]
        )
        image = vote(canvas.pixels(place), window.weight, canvas.size)
        return -variance(image).log().sum()

    equal(gradient, jacobian(spelled_out, x), 1e-5)
