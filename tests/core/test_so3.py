import math

import pytest
import torch

from torchcmax.core import so3


@pytest.fixture
def rotvec(rand):
    """Rotation vectors of every size that matters: zero, tiny, around the series' edge, ordinary, almost half a turn."""
    direction = torch.nn.functional.normalize(rand(6, 3) - 0.5, dim=-1)
    length = torch.tensor([0.0, 1e-7, 0.0099, 0.0101, 1.0, math.pi - 1e-3]).to(direction)
    return length[:, None] * direction


def test_exp_is_the_matrix_exponential_of_hat(rotvec, close):
    close(so3.exp(rotvec), torch.linalg.matrix_exp(so3.hat(rotvec)))


def test_hat_is_the_cross_product(rand, close):
    a, b = rand(4, 3), rand(4, 3)
    close((so3.hat(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


def test_log_undoes_exp_up_to_half_a_turn(rotvec, dtype):
    tolerance = {torch.float32: 2e-4, torch.float64: 1e-11}[dtype]
    torch.testing.assert_close(so3.log(so3.exp(rotvec)), rotvec, rtol=0, atol=tolerance)


def test_log_of_exactly_half_a_turn_has_that_length(dtype, device):
    half = torch.tensor([[math.pi, 0, 0], [0, math.pi, 0], [0, 0, math.pi]], dtype=dtype, device=device)
    torch.testing.assert_close(
        so3.log(so3.exp(half)).norm(dim=-1), torch.full((3,), math.pi, dtype=dtype, device=device), rtol=1e-4, atol=0
    )


def test_quaternions_turn_into_matrices_and_back(rotvec, close):
    R = so3.exp(rotvec)
    q = so3.to_quaternion(R)
    assert (q[..., 3] >= 0).all()
    close(so3.from_quaternion(q), R)
    close(so3.from_quaternion(-3 * q), R)


def test_quarter_turn_about_z_by_hand(dtype, device, close):
    R = so3.exp(torch.tensor([[0, 0, math.pi / 2]], dtype=dtype, device=device))
    close(R, torch.tensor([[[0, -1, 0], [1, 0, 0], [0, 0, 1]]], dtype=dtype, device=device))
    close(so3.to_quaternion(R), torch.tensor([[0, 0, 0.5**0.5, 0.5**0.5]], dtype=dtype, device=device))


@pytest.mark.parametrize("length", [0.0, 1e-9, 9.9e-3, 1.01e-2, 2.0])
def test_exp_has_the_right_gradient_at_and_near_zero(length):
    w = length * torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.8]], dtype=torch.float64), dim=-1)
    assert torch.autograd.gradcheck(so3.exp, w.requires_grad_())


def test_exp_in_float32_has_the_gradient_of_float64_at_a_milliradian():
    w = torch.tensor([[6e-4, -5e-4, 8e-4]], dtype=torch.float64)
    exact, single = (torch.autograd.functional.jacobian(so3.exp, x) for x in (w, w.float()))
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=1e-6)


def test_right_jacobian_is_the_derivative_of_exp_seen_from_the_turned_frame(rotvec):
    w = rotvec.double()
    small = 1e-6 * torch.tensor([0.3, -0.2, 0.7]).to(w)
    turned = so3.log(so3.exp(w).mT @ so3.exp(w + small))
    torch.testing.assert_close(turned, (so3.right_jacobian(w) @ small), rtol=1e-4, atol=1e-11)
