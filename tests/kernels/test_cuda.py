"""The Triton kernels against their readable twins: on a GPU where there is one, else in Triton's interpreter."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # before Triton is imported

triton = pytest.importorskip("triton")
import triton.language as tl  # noqa: E402

from torchcmax import kernels  # noqa: E402
from torchcmax.core.camera import Canvas, Sphere  # noqa: E402
from torchcmax.core.contrast import _smooth  # noqa: E402
from torchcmax.core.draw import Ink, _framed, draw  # noqa: E402
from torchcmax.core.vote import vote_scatter  # noqa: E402
from torchcmax.core.warp import monomials, polynomial  # noqa: E402
from torchcmax.kernels import cuda  # noqa: E402

PINHOLE, SPHERE = Canvas(20.0, (15.3, 11.7), (25, 32)), Sphere(16)
BOTH = pytest.mark.parametrize("canvas", [PINHOLE, SPHERE], ids=["pinhole", "sphere"])


@pytest.fixture
def device():
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.fixture
def make(rand):
    """Signed events of three windows, the last five of each padding, and homographies of five rows with K terms."""

    def made(events=75, terms=6, rows=5):
        x, y, s, weight = rand(4, 3, events) - 0.5
        weight = torch.where(torch.arange(events, device=x.device) < events - 5, 4 * weight, 0.0)
        normal = torch.nn.functional.normalize(x.new_tensor([[0.1, 0.2, -1.0]]), dim=-1).expand(rows, 3)
        H_k = polynomial(1.2 * (rand(rows, 3) - 0.5), 0.6 * (rand(rows, 3) - 0.5), normal, terms)
        return H_k[:, :terms].contiguous(), Ink(x, y, s, weight), torch.tensor([0, 0, 1, 2, 1], device=x.device)[:rows]

    return made


def places(H_k, ink, canvas, owner):
    """In px of the frame, float64."""
    ray = torch.stack([ink.x, ink.y, torch.ones_like(ink.x)], -1).double()
    warped = H_k.double().transpose(1, 2).flatten(2) @ monomials(ray, ink.s.double(), H_k.shape[1])[owner]
    return canvas.pixels(warped.mT) + 1


def off_the_lines(H_k, ink, canvas, owner):
    """Without the events that fall so near a line of pixels in some row that rounding decides on which side."""
    xy = places(H_k, ink, canvas, owner)
    near = ((xy - xy.round()).abs() < 1e-3).any(-1)
    windows = torch.stack([near[owner == w].any(0) if (owner == w).any() else near[0] for w in range(len(ink.x))])
    return Ink(ink.x, ink.y, ink.s, ink.weight.masked_fill(windows, 0.0))


def twin(H_k, ink, canvas, owner):
    """The frames in plain torch operations and float64."""
    ray = torch.stack([ink.x, ink.y, torch.ones_like(ink.x)], -1).double()
    basis = monomials(ray, ink.s.double(), H_k.shape[1])
    return _framed(vote_scatter, H_k.double(), basis[owner], ink.weight[owner].double(), canvas)


@BOTH
@pytest.mark.parametrize("terms", [1, 6])
def test_votes_and_slopes_are_their_readable_twins(make, rand, canvas, terms, dtype):
    H_k, ink, owner = make(terms=terms)
    ink = off_the_lines(H_k, ink, canvas, owner)
    assert (ink.weight != 0).sum() > 150
    leaf = H_k.clone().requires_grad_()
    frame = twin(leaf, ink, canvas, owner)
    back = rand(*frame.shape)
    (expected,) = torch.autograd.grad((frame * back).sum(), leaf)
    size = expected.abs().max()

    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    found = cuda.slopes(H_k, ink, canvas, owner, back)
    torch.testing.assert_close(cuda.votes(H_k, ink, canvas, owner), frame.to(dtype).detach(), rtol=0, atol=tolerance)
    torch.testing.assert_close(found / size, expected / size, rtol=0, atol=tolerance)
    assert torch.equal(found, cuda.slopes(H_k, ink, canvas, owner, back))


@BOTH
def test_events_all_around_are_seen_where_they_can_be(make, rand, canvas, dtype):
    """A row that looks back: nothing in a pinhole image, the other side of a sphere, across its seam and its poles."""
    H_k, ink, owner = make(terms=1, rows=2)
    turned = torch.stack([torch.diag(H_k.new_tensor([1.0, -1.0, -1.0])), H_k.new_tensor([[1, 0, 0], [0, 0, 1.0], [0, -1, 0]])])[:, None]
    ink = off_the_lines(turned, ink, canvas, owner)
    leaf = turned.clone().requires_grad_()
    frame = twin(leaf, ink, canvas, owner)
    back = rand(*frame.shape)
    (expected,) = torch.autograd.grad((frame * back).sum(), leaf)
    tolerance = 1e-11 if dtype == torch.float64 else 5e-5
    votes, slopes = cuda.votes(turned, ink, canvas, owner), cuda.slopes(turned, ink, canvas, owner, back)
    torch.testing.assert_close(votes, frame.to(dtype).detach(), rtol=0, atol=tolerance)
    torch.testing.assert_close(slopes, expected, rtol=tolerance, atol=tolerance * max(1, float(expected.abs().max())))
    assert (votes[0].abs().sum() > 0) == canvas.sphere


def test_a_single_event_by_hand(rand, dtype):
    one = torch.ones(1, 1).to(rand(1))
    ink, owner, H_k = (
        Ink(0.1 * one, -0.2 * one, 0 * one, 3 * one),
        torch.zeros(1, dtype=torch.int64, device=one.device),
        torch.eye(3).to(one),
    )
    frame = cuda.votes(H_k.view(1, 1, 3, 3), ink, PINHOLE, owner)  # at (15.3 + 2, 11.7 - 4), one more in the frame
    expected = torch.zeros_like(frame)
    expected[0, 8:10, 18:20] = 3 * torch.tensor([[0.7 * 0.3, 0.3 * 0.3], [0.7 * 0.7, 0.3 * 0.7]])
    torch.testing.assert_close(frame, expected, rtol=0, atol=1e-5)


def test_many_events_go_round_in_few_programs(make, rand, monkeypatch):
    H_k, ink, owner = make(events=299, terms=1, rows=2)
    back = rand(2, 27, 34)
    some = cuda.votes(H_k, ink, PINHOLE, owner), cuda.slopes(H_k, ink, PINHOLE, owner, back)
    monkeypatch.setattr(cuda, "ROUNDS", 1)
    monkeypatch.setattr(cuda, "PROGRAMS", 3)
    few = cuda.votes(H_k, ink, PINHOLE, owner), cuda.slopes(H_k, ink, PINHOLE, owner, back)
    torch.testing.assert_close(some, few, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(some[0], twin(H_k, ink, PINHOLE, owner).to(H_k), rtol=0, atol=1e-4)


@BOTH
def test_a_row_is_the_same_alone_and_in_any_batch(make, rand, canvas):
    H_k, ink, owner = make(terms=2)
    back = rand(5, canvas.size[0] + 2, canvas.size[1] + 2)
    together = cuda.votes(H_k, ink, canvas, owner), cuda.slopes(H_k, ink, canvas, owner, back)
    for i in (slice(1, 2), slice(3, 4)):
        alone = cuda.votes(H_k[i], ink, canvas, owner[i]), cuda.slopes(H_k[i], ink, canvas, owner[i], back[i])
        torch.testing.assert_close(alone, (together[0][i], together[1][i]), rtol=1e-5, atol=1e-5)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, in the interpreter
@BOTH
def test_what_is_not_finite_or_far_off_draws_nothing_and_has_no_slope(make, canvas, dtype):
    H_k, ink, owner = make(events=16, terms=2, rows=1)
    broken = [torch.nan, torch.inf, -torch.inf, 0.9 * torch.finfo(dtype).max]
    x, y, s, weight = (part.clone() for part in (ink.x, ink.y, ink.s, ink.weight))
    x[0, :4] = y[0, 3:7] = s[0, 6:10] = x.new_tensor(broken)
    bad = torch.arange(16, device=x.device) < 10
    clean = cuda.votes(H_k, Ink(ink.x, ink.y, ink.s, weight.masked_fill(bad, 0)), canvas, owner)
    frame = cuda.votes(H_k, Ink(x, y, s, weight), canvas, owner)
    slopes = cuda.slopes(H_k, Ink(x, y, s, weight), canvas, owner, torch.ones_like(frame))
    assert slopes.isfinite().all()
    torch.testing.assert_close(frame, clean)
    lost = torch.full_like(H_k, torch.nan)
    assert (cuda.votes(lost, ink, canvas, owner) == 0).all()
    assert (cuda.slopes(lost, ink, canvas, owner, torch.ones_like(frame)) == 0).all()


def test_events_behind_the_camera_and_beside_the_canvas_draw_nothing(make):
    _, ink, owner = make(events=16, terms=1, rows=2)
    one = torch.eye(3).to(ink.x)
    beside = one.clone()
    beside[0, 2] = 1e7
    H_k = torch.stack([-one, beside])[:, None]
    frame = cuda.votes(H_k, ink, PINHOLE, owner)
    assert (frame == 0).all()
    assert (cuda.slopes(H_k, ink, PINHOLE, owner, torch.ones_like(frame)) == 0).all()


def test_no_rows_and_no_events_are_no_work(make):
    H_k, ink, owner = make(events=16)
    nothing = Ink(*(part[:, :0] for part in (ink.x, ink.y, ink.s, ink.weight)))
    frame = cuda.votes(H_k, nothing, PINHOLE, owner)
    assert (frame == 0).all()
    assert (cuda.slopes(H_k, nothing, PINHOLE, owner, frame) == 0).all()
    assert cuda.votes(H_k[:0], ink, PINHOLE, owner[:0]).shape == (0, 27, 34)
    assert cuda.slopes(H_k[:0], ink, PINHOLE, owner[:0], frame[:0]).shape == (0, 6, 3, 3)
    assert cuda.smooth(frame[:0], 1.0).shape == (0, 27, 34)


@BOTH
def test_draw_by_the_kernels_has_the_gradient_of_float64(device, canvas, monkeypatch):
    monkeypatch.setattr(kernels, "drawing", lambda like, pixels=0: cuda)
    g = torch.Generator().manual_seed(0)
    x, y, s, weight = (torch.rand(4, 1, 6, generator=g, dtype=torch.float64) - 0.5).to(device)
    H_k = (torch.eye(3).expand(1, 2, 3, 3) + 0.2 * torch.rand(1, 2, 3, 3, generator=g, dtype=torch.float64)).to(device).requires_grad_()
    ink, owner = Ink(x, y, s, 4 * weight), torch.zeros(1, dtype=torch.int64, device=device)
    xy = places(H_k.detach(), ink, canvas, owner)
    assert (xy - xy.round()).abs().min() > 1e-4
    back = torch.rand(canvas.size, generator=g, dtype=torch.float64).to(device)
    assert torch.autograd.gradcheck(lambda H: (draw(H, ink, canvas, owner) * back).sum(), H_k, nondet_tol=1e-12)


@pytest.mark.parametrize("sigma", [0.3, 1.3, 4.0])
def test_smooth_is_its_readable_twin_in_place_of_any_strides(rand, sigma, close):
    large = rand(2, 23, 72)
    for image in (large, large[:, 1:-1, 1:-1], large.mT, large[:1].expand(3, -1, -1)[:, ::2], large[:, :1, :1]):
        close(cuda.smooth(image, sigma), _smooth(_smooth(image, sigma, -2), sigma, -1))


@triton.jit
def angles(y_ptr, x_ptr, angle_ptr, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(angle_ptr + at, cuda.atan2(tl.load(y_ptr + at), tl.load(x_ptr + at)))


def test_atan2_is_as_exact_as_it_says(rand, dtype):
    turn, size = (2 * rand(2**16) - 1) * math.pi, (20 * rand(2**16) - 10).exp()
    axes = turn.new_tensor([[0, 1], [1, 0], [0, -1], [-1, 0], [1, 1], [-1, 1], [1, -1], [-1, -1]])
    x, y = (torch.cat([part, axis.repeat(128)]) for part, axis in zip((size * turn.cos(), size * turn.sin()), axes.T, strict=True))
    found = torch.empty_like(x)
    angles[(len(x) // 1024,)](y, x, found, BLOCK=1024)
    error = (found.double() - torch.atan2(y.double(), x.double())).abs().max()
    assert error < (2e-7 if dtype == torch.float32 else 5e-16)


def test_the_kernels_see_what_a_sphere_sees():
    for number, dtype in ((cuda.TINY_32, torch.float32), (cuda.TINY_64, torch.float64)):
        axes = torch.eye(3, dtype=dtype) * number.value
        assert not SPHERE.sees(axes).any()
        assert SPHERE.sees(1.01 * axes).tolist() == [True, False, True]


H100 = """
import re, torch, triton
from triton.backends.compiler import GPUTarget
from torchcmax.core.camera import Canvas, Sphere
from torchcmax.core.draw import Ink
from torchcmax.kernels import cuda

class H100:
    get_current_target = staticmethod(lambda: GPUTarget("cuda", 90, 32))
    get_current_device = staticmethod(lambda: 0)
    get_current_stream = staticmethod(lambda device: 0)

def compiled(kernel, programs, inputs, **options):
    code = kernel.warmup(*inputs, **options, enable_fp_fusion=True, grid=(programs,)).asm["ptx"]
    if inputs[0].dtype == torch.float32:
        assert not re.search(r"(add|sub|mul|div|fma|sqrt)[.a-z]*[.]f64", code), "a float32 kernel computes in float64"
    print(kernel.fn.__name__, code.count("red.") + code.count("atom."))

triton.runtime.driver.set_active(H100())
cuda._launch = compiled
for dtype, canvas in ((torch.float32, Canvas(20.0, (15.3, 11.7), (25, 32))), (torch.float32, Sphere(16)), (torch.float64, Sphere(16))):
    ink, H_k, owner = Ink(*torch.rand(4, 2, 48, dtype=dtype)), torch.rand(3, 6, 3, 3, dtype=dtype), torch.tensor([0, 1, 1])
    cuda.slopes(H_k, ink, canvas, owner, cuda.votes(H_k, ink, canvas, owner))
    cuda.smooth(torch.rand(3, 27, 34, dtype=dtype)[:, 1:-1, 1:-1], 1.0)
"""


def test_the_kernels_compile_for_an_h100_on_any_machine(tmp_path):
    """The interpreter knows neither the types nor the scopes of Triton's compiler, which needs no GPU."""
    pytest.importorskip("triton.backends.nvidia")
    environment = {**os.environ, "TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", H100], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["_vote", "4", "_slope", "0", "_smooth", "0", "_smooth", "0"] * 3
