import pytest
import torch

from torchcmax.core.model import Displacement, Planar, PlanarKnown, Rotation, Translation
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion
from torchcmax.core.warp import monomials, transfer, warp

FOCAL = 200.0


def make(kind, rand):
    normal = Plane.tilted(0.6 * (rand(4, 2) - 0.5)).normal
    return kind(FOCAL, normal if kind in (Translation, PlanarKnown) else None)


KINDS = pytest.mark.parametrize("kind", [Rotation, Translation, PlanarKnown, Planar])


def pixels(ray):
    return ray[..., :2] / ray[..., 2:]


@KINDS
@pytest.mark.parametrize("reference", [0.0, 0.5, 1.0])
def test_the_homography_is_the_closed_form_warp_to_the_reference(kind, reference, rand, dtype):
    """Events go to the camera at the window's first event by `transfer`, and from there to the reference by its inverse."""
    tolerance = {torch.float32: 1e-4, torch.float64: 2e-6}[dtype]
    model, owner = make(kind, rand), torch.arange(4, device=rand(1).device)
    x = 30 * (rand(4, kind.size) - 0.5)
    ray = torch.cat([rand(4, 60, 2) - 0.5, torch.ones_like(rand(4, 60, 1))], -1)
    s = rand(4, 60)

    d = model.displacement(x, owner)
    motion, plane = Motion(d.turn, d.shift), Plane(d.normal, torch.ones_like(d.turn[:, 0]))
    first = transfer(ray, motion.at(s), plane)
    there = motion.at(torch.full_like(s[:, :1], reference))
    eye = torch.eye(3).to(ray)
    exact = (there.R.mT @ (eye + there.t[..., None] * plane.normal[:, None, None]) @ first[..., None])[..., 0]

    drawn = warp(model.homography(x, owner, reference), monomials(ray, s - reference)).mT
    torch.testing.assert_close(pixels(drawn), pixels(exact), rtol=0, atol=tolerance)


@KINDS
def test_one_unit_of_any_velocity_moves_the_middle_of_the_image_by_one_pixel(kind, rand):
    if kind.size == 3 and kind is Translation:
        model = Translation(FOCAL)
    else:
        model = make(kind, rand) if kind is not PlanarKnown else PlanarKnown(FOCAL)
    owner = torch.zeros(1, dtype=torch.int64, device=rand(1).device)
    ray, end = torch.tensor([[[0.0, 0.0, 1.0]]]).to(rand(1)), torch.ones(1, 1).to(rand(1))
    for axis in (0, 1):
        x = torch.zeros(1, kind.size).to(rand(1))
        x[0, axis] = 1
        moved = FOCAL * pixels(warp(model.homography(x, owner, 0.0), monomials(ray, end)).mT)
        assert abs(moved.norm().item() - 1) < 1e-3


@KINDS
def test_parameters_undo_displacement(kind, rand, close):
    model, owner = make(kind, rand), torch.arange(4, device=rand(1).device)
    x = 40 * (rand(4, kind.size) - 0.5)
    close(model.parameters(model.displacement(x, owner)) / FOCAL, x / FOCAL)


def test_seen_at_another_time_and_back_is_the_same_motion(rand, close):
    d = Displacement(0.5 * rand(3, 3), 0.4 * (rand(3, 3) - 0.5), Plane.tilted(rand(3, 2) - 0.5).normal)
    back = d.seen_at(0.7).seen_at(-0.7)
    for field in ("turn", "shift", "normal"):
        close(getattr(back, field), getattr(d, field))


def test_the_twin_moves_the_image_alike_and_its_twin_is_the_first(rand, close):
    d = Displacement(0.01 * (rand(3, 3) - 0.5), 0.02 * (rand(3, 3) - 0.5), Plane.tilted(rand(3, 2) - 0.5).normal)
    other = d.twin()
    for field in ("turn", "shift", "normal"):
        close(getattr(other.twin(), field), getattr(d, field))
    assert (other.normal[:, 2] <= 0).all()
    assert (other.normal - d.normal).norm(dim=-1).min() > 0.1
    ray = torch.cat([rand(3, 40, 2) - 0.5, torch.ones_like(rand(3, 40, 1))], -1)
    end = torch.full_like(ray[..., 0], 0.5)
    moved = [pixels(transfer(ray, Motion(m.turn, m.shift).at(end), Plane(m.normal, torch.ones_like(m.turn[:, 0])))) for m in (d, other)]
    step = (moved[0] - pixels(ray)).norm(dim=-1).max()
    assert (moved[0] - moved[1]).norm(dim=-1).max() < 0.02 * step  # equal to first order


def test_a_motion_without_shift_has_a_twin_without_nan(dtype):
    d = Displacement(*(torch.zeros(1, 3, dtype=dtype) for _ in range(2)), torch.tensor([[0.0, 0.0, -1.0]], dtype=dtype))
    assert all(getattr(d.twin(), field).isfinite().all() for field in ("turn", "shift", "normal"))


@KINDS
def test_the_homography_has_the_right_gradient(kind):
    g = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    model, owner = make(kind, rand), torch.arange(4)
    x = (20 * (rand(4, kind.size) - 0.5)).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: model.homography(p, owner, 0.5), x)
    assert torch.autograd.gradcheck(lambda p: model.homography(p, owner, 0.5), torch.zeros_like(x).requires_grad_())
