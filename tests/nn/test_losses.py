"""Warp, image of warped events and losses: gradients, padding, compilation, and what they are lower for."""

import math
import shutil

import pytest
import torch
from torch.autograd import gradcheck

from torchcmax.core import so3
from torchcmax.core.camera import Camera
from torchcmax.core.contrast import CONTRASTS
from torchcmax.core.estimate import estimate
from torchcmax.core.model import Rotation
from torchcmax.core.objective import Look
from torchcmax.core.window import Window
from torchcmax.nn import Compensate, ContrastLoss, FlowContrastLoss, ImageOfWarpedEvents, Warp
from torchcmax.nn.compensate import _Optimum

CAMERA = Camera.pinhole((24, 32))
OMEGA, VELOCITY, NORMAL = (0.5, -0.8, 1.5), (0.4, 0.2, -0.1), (0.1, -0.2, -math.sqrt(0.95))


def turning(batch=2, events=400, dtype=torch.float64, omega=OMEGA, seconds=0.1, seed=0):
    """Events of some bright points, seen by a camera that turns at omega, in the frame of the first event."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(batch, 12, 2, generator=generator, dtype=torch.float64) - 0.5
    which = torch.randint(12, (batch, events), generator=generator)
    dt = torch.rand(batch, events, generator=generator, dtype=torch.float64).sort(1).values * seconds
    dt[:, 0], dt[:, -1] = 0, seconds
    ray = torch.cat([points.gather(1, which[..., None].expand(-1, -1, 2)) * 0.8, torch.ones(batch, events, 1, dtype=torch.float64)], -1)
    R = so3.exp(torch.tensor(omega, dtype=torch.float64) * dt[..., None])
    seen = (R.mT @ ray[..., None])[..., 0]
    polarity = torch.randint(2, (batch, events), generator=generator) * 2.0 - 1
    return Window((seen / seen[..., 2:]).to(dtype), dt.to(dtype), polarity.to(dtype), torch.zeros(batch, dtype=torch.int64),
                  torch.full((batch,), seconds, dtype=dtype))  # fmt: skip


def vector(numbers, batch=2, dtype=torch.float64):
    return torch.tensor([numbers] * batch, dtype=dtype)


def padded(window, more):
    """The same windows with events that count nothing behind them."""

    def longer(part, value):
        return torch.cat([part, torch.full_like(part[:, :1], value).expand(-1, more, *part.shape[2:])], 1)

    return Window(longer(window.ray, 1.0), longer(window.dt, 0.0), longer(window.polarity, 0.0), window.start, window.duration)


LOSSES = {
    "one": {},
    "rest": {"against": "rest", "references": (0.0, 0.5, 1.0)},
    "plain": {"against": "nothing", "blur": 0.0},
    "signed": {"polarity": "signed"},
    "split": {"polarity": "split", "references": (0.3,)},
} | {name: {"contrast": name} for name in CONTRASTS}


@pytest.mark.parametrize("name", LOSSES)
def test_the_true_motion_is_better_than_none_and_than_its_contrary(name):
    loss, window = ContrastLoss(CAMERA, **LOSSES[name]), turning()
    if name == "signed":
        window = Window(window.ray, window.dt, window.polarity.abs(), window.start, window.duration)
    right, none, wrong = (float(loss(window, vector(OMEGA) * k)) for k in (1, 0, -1))
    assert right < none < wrong
    if LOSSES[name].get("against") == "rest":
        assert abs(none) < 1e-9


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("planar", [False, True])
def test_gradients_of_the_contrast_loss(name, planar):
    """To motion, plane and weights: central differences of 1e-6 lie within one stretch between kinks."""
    loss, window = ContrastLoss(CAMERA, **LOSSES[name]), turning(events=60)
    weight = torch.rand(2, 60, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).add(0.5).requires_grad_()
    motion = [vector(OMEGA).requires_grad_()]
    if planar:
        motion += [vector(VELOCITY).requires_grad_(), vector(NORMAL).requires_grad_()]
        assert gradcheck(lambda w, v, n: loss(window, w, v, n), motion, fast_mode=True)
        assert gradcheck(lambda w, v, n, weight: loss(window, w, v, n, weight), [*motion, weight], fast_mode=True)
    else:
        assert gradcheck(lambda w: loss(window, w), motion, fast_mode=True)
        assert gradcheck(lambda w, weight: loss(window, w, weight=weight), [*motion, weight], fast_mode=True)


def test_gradients_of_warp_and_image():
    window, warp = turning(events=30), Warp(CAMERA)
    motion = [vector(numbers).requires_grad_() for numbers in (OMEGA, VELOCITY, NORMAL)]
    assert gradcheck(lambda *m: warp(window, *m)[0], motion)
    weight = torch.rand(2, 30, dtype=torch.float64).requires_grad_()
    for polarity in ("dropped", "signed", "split"):
        image = ImageOfWarpedEvents(CAMERA, polarity)
        assert gradcheck(lambda *m: image(window, *m[:3], m[3]).square().sum((2, 3)), [*motion, weight], fast_mode=True)  # noqa: B023
        assert gradcheck(lambda *m: image(window, *m).square().sum((2, 3)), motion, fast_mode=True)  # noqa: B023


@pytest.mark.parametrize("options", [{}, {"against": "rest", "polarity": "split"}, {"contrast": "gradient_magnitude", "blur": 0.0}])
def test_gradients_of_the_flow_loss(options):
    window, loss = turning(events=60), FlowContrastLoss(CAMERA, **options)
    flow = torch.randn(2, 2, 24, 32, dtype=torch.float64, generator=torch.Generator().manual_seed(2)).requires_grad_()
    weight = torch.rand(2, 60, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).add(0.5).requires_grad_()
    assert gradcheck(lambda f, w: loss(window, f, w), [flow, weight], fast_mode=True)


def test_the_image_is_that_of_the_core_and_both_ways_agree():
    from torchcmax.core.draw import Ink, draw_twin
    from torchcmax.core.model import Displacement

    window = turning()
    image = ImageOfWarpedEvents(CAMERA)
    H_k = Displacement(vector(OMEGA) * 0.1, vector(VELOCITY) * 0.1, vector(NORMAL)).seen_at(0.5).homography()
    expected = draw_twin(H_k, Ink.of(window, window.weight), image.canvas, torch.arange(2))
    motion = [vector(numbers) for numbers in (OMEGA, VELOCITY, NORMAL)]
    torch.testing.assert_close(image(window, *motion)[:, 0], expected)
    torch.testing.assert_close(image(window, *motion, torch.ones_like(window.dt, requires_grad=True))[:, 0], expected)
    split = ImageOfWarpedEvents(CAMERA, "split")(window, *motion)
    torch.testing.assert_close(split.sum(1), expected)
    signed = ImageOfWarpedEvents(CAMERA, "signed")(window, *motion)[:, 0]
    torch.testing.assert_close(split[:, 0] - split[:, 1], signed)


def test_padding_changes_nothing():
    window = turning()
    longer = padded(window, 37)
    weight = torch.rand(2, 400, dtype=torch.float64)
    more = torch.cat([weight, torch.full((2, 37), 9.0, dtype=torch.float64)], 1)
    flow = torch.randn(2, 2, 24, 32, dtype=torch.float64)
    for options in LOSSES.values():
        loss, motion = ContrastLoss(CAMERA, **options), (vector(OMEGA), vector(VELOCITY), vector(NORMAL))
        torch.testing.assert_close(loss(longer, motion[0]), loss(window, motion[0]))
        torch.testing.assert_close(loss(longer, motion[0], weight=more), loss(window, motion[0], weight=weight))
    torch.testing.assert_close(FlowContrastLoss(CAMERA)(longer, flow, more), FlowContrastLoss(CAMERA)(window, flow, weight))


def test_a_window_without_events_costs_nothing_and_has_no_gradient():
    window = turning()
    window.polarity[1] = 0
    omega = vector(OMEGA).requires_grad_()
    loss = ContrastLoss(CAMERA, reduction="none")(window, omega, vector(VELOCITY))
    assert loss[1] == 0
    loss.sum().backward()
    assert omega.grad.isfinite().all()
    assert (omega.grad[1] == 0).all()
    torch.testing.assert_close(ContrastLoss(CAMERA)(window, omega, vector(VELOCITY)), loss[0])


@pytest.mark.parametrize("velocity", [(0.4, 0.2, -0.1), (0.0, 0.0, 5.0)])
def test_padding_and_weights_of_zero_change_nothing_before_a_plane(velocity):
    """Nor what the guard watches: a camera that comes very near."""
    window = turning()
    v, n, omega = vector(velocity), vector(NORMAL), vector(OMEGA)
    loss = ContrastLoss(CAMERA, reduction="none")
    expected = loss(window, omega, v, n)
    for more in (200, 1000, 20_000):
        torch.testing.assert_close(loss(padded(window, more), omega, v, n), expected)
    weight = torch.ones_like(window.dt)
    weight[:, ::3] = 0
    muted = Window(window.ray, window.dt, window.polarity * weight, window.start, window.duration)
    torch.testing.assert_close(loss(window, omega, v, n, weight), loss(muted, omega, v, n))


def test_what_is_not_known_of_a_window_without_events_leaves_no_trace():
    window, unknown = turning(), torch.tensor([[0.0], [torch.nan]], dtype=torch.float64)
    weight = torch.ones_like(window.dt)
    weight[1] = 0
    omega, v, n = ((vector(x) + unknown).requires_grad_() for x in (OMEGA, VELOCITY, NORMAL))
    ContrastLoss(CAMERA)(window, omega, v, n, weight).backward()
    flow = (torch.zeros(2, 2, 24, 32, dtype=torch.float64) + unknown[:, :, None, None]).requires_grad_()
    FlowContrastLoss(CAMERA)(window, flow, weight).backward()
    for part in (omega, v, n, flow):
        assert part.grad.isfinite().all()
        assert (part.grad[1] == 0).all()
    assert (omega.grad[0] != 0).any()


@pytest.mark.parametrize("model", ["rotation", "translation", "planar"])
@pytest.mark.parametrize("empty", [[1], [0, 1]])
def test_windows_without_events_do_not_disturb_the_others_of_a_batch(model, empty):
    window = turning(dtype=torch.float32)
    weight = torch.ones_like(window.dt)
    weight[empty] = 0
    weight.requires_grad_()
    found = Compensate(CAMERA, model)(window, weight)
    (found.omega.square().sum() + found.velocity.square().sum()).backward()
    assert weight.grad.isfinite().all()
    assert (weight.grad[empty] == 0).all()
    assert all((weight.grad[i] != 0).any() for i in range(2) if i not in empty)
    with pytest.raises(ValueError, match="weight wants"):
        Compensate(CAMERA, model)(window, weight[0])


def test_the_loss_compares_between_windows_and_sizes():
    """Twice the events on twice the pixels: as sharp."""
    loss = ContrastLoss(CAMERA, reduction="none", contrast="mean_square", blur=0.0)
    one, both = turning(batch=1), turning(batch=1)
    both = Window(*(torch.cat([getattr(both, name)] * 2, 1) for name in ("ray", "dt", "polarity")), both.start, both.duration)
    half = loss(both, vector(OMEGA, 1), weight=torch.full_like(both.dt, 0.5))
    torch.testing.assert_close(loss(one, vector(OMEGA, 1)), half + math.log(2))  # the same image of twice the votes, each half


@pytest.mark.slow
def test_compiled_losses_equal_eager_ones():
    """In one graph; the first by the default backend, which takes long, the others by the one that only captures and differentiates."""
    window = turning(dtype=torch.float32)
    omega, *plane = (vector(n, dtype=torch.float32).requires_grad_() for n in (OMEGA, VELOCITY, NORMAL))
    flow = torch.randn(2, 2, 24, 32, generator=torch.Generator().manual_seed(0)).requires_grad_()
    cases = [
        (ContrastLoss(CAMERA), [omega], "inductor" if shutil.which("g++") else "aot_eager"),
        (ContrastLoss(CAMERA, references=(0.0, 0.5, 1.0), against="rest"), [omega, *plane], "aot_eager"),
        (ContrastLoss(CAMERA, "gradient_magnitude", polarity="split"), [omega], "aot_eager"),
        (FlowContrastLoss(CAMERA), [flow], "aot_eager"),
    ]
    for loss, inputs, backend in cases:
        eager = loss(window, *inputs)
        expected = torch.autograd.grad(eager, inputs)
        compiled = torch.compile(loss, fullgraph=True, backend=backend)(window, *inputs)
        torch.testing.assert_close(compiled, eager, rtol=1e-4, atol=1e-5)
        for found, wanted in zip(torch.autograd.grad(compiled, inputs), expected, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-4)


def test_autocast_leaves_votes_in_float32():
    window = turning(dtype=torch.float32)
    layer = torch.nn.Linear(4, 3)
    with torch.autocast("cpu", torch.bfloat16):
        omega = layer(torch.ones(2, 4))
        assert omega.dtype == torch.bfloat16
        loss, image = ContrastLoss(CAMERA)(window, omega), ImageOfWarpedEvents(CAMERA)(window, omega)
        flow = FlowContrastLoss(CAMERA)(window, torch.zeros(2, 2, 24, 32, dtype=torch.bfloat16))
    assert {loss.dtype, image.dtype, flow.dtype} == {torch.float32}
    loss.backward()
    assert layer.weight.grad.isfinite().all()


def test_modules_have_no_state_and_can_be_copied_and_pickled():
    import copy
    import pickle

    for module in (Warp(CAMERA), ImageOfWarpedEvents(CAMERA), ContrastLoss(CAMERA), FlowContrastLoss(CAMERA), Compensate(CAMERA)):
        assert module.state_dict() == {}
        module.load_state_dict({})
        assert type(copy.deepcopy(module)) is type(pickle.loads(pickle.dumps(module)))


def test_a_free_flow_that_collapses_events_costs_more_than_the_true_one():
    """All events towards one point are sharper than as they came, and are what the guard and the references are against."""
    window = turning(batch=1, dtype=torch.float32, omega=(0.0, 1.0, 0.0))
    y, x = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    sink = torch.stack([16 - x, 12 - y])[None]
    true = torch.zeros(1, 2, 24, 32)
    true[:, 0] = -0.1 * (CAMERA.fx * CAMERA.fy) ** 0.5
    bare = FlowContrastLoss(CAMERA, references=(1.0,), guard=0.0, smoothness=0.0)
    assert bare(window, sink) < bare(window, torch.zeros_like(true))
    loss = FlowContrastLoss(CAMERA)
    assert loss(window, true) < loss(window, torch.zeros_like(true)) < loss(window, sink)


@pytest.mark.parametrize(
    ("module", "options"),
    [
        (ContrastLoss, {"contrast": "sharp"}),
        (ContrastLoss, {"references": ()}),
        (ContrastLoss, {"deformation": 1.0}),
        (FlowContrastLoss, {"smoothness": -1.0}),
        (FlowContrastLoss, {"against": "all"}),
        (ImageOfWarpedEvents, {"polarity": "both"}),
        (Compensate, {"model": "spin"}),
        (Compensate, {"gradients": "all"}),
    ],
)
def test_unknown_words_are_refused(module, options):
    with pytest.raises(ValueError, match="want"):
        module(CAMERA, **options)


def test_wrong_shapes_are_refused():
    window = turning()
    for wrong in ({"omega": torch.zeros(3, 3)}, {"omega": vector(OMEGA), "weight": torch.ones(2, 7)}):
        with pytest.raises(ValueError, match="wants"):
            ContrastLoss(CAMERA)(window, **wrong)
    with pytest.raises(ValueError, match="flow wants"):
        FlowContrastLoss(CAMERA)(window, torch.zeros(2, 2, 5, 5))


def test_compensate_finds_what_the_estimator_finds():
    window = turning(dtype=torch.float32)
    found = Compensate(CAMERA)(window)
    expected = estimate(window, CAMERA, Rotation((CAMERA.fx * CAMERA.fy) ** 0.5))
    torch.testing.assert_close(found.omega, expected.motion.omega)
    assert found.normal is None
    torch.testing.assert_close(found.omega, vector(OMEGA, dtype=torch.float32), rtol=0.1, atol=0.1)
    warm = Compensate(CAMERA)(window, start=vector(OMEGA, dtype=torch.float32))
    assert (warm.estimate.evaluations < found.estimate.evaluations).all()


def test_gradients_through_the_optimum_of_an_objective_without_kinks():
    """f = x' A x / 2 - b' x, with A of the weights and b of both inputs: the optimum is A^-1 b, and central differences are exact."""
    chance = torch.Generator().manual_seed(0)
    basis = torch.rand(3, 5, 4, generator=chance, dtype=torch.float64)
    mixed = torch.rand(5, 3, 4, generator=chance, dtype=torch.float64)

    def parts(weight, normal):
        factor = torch.einsum("knp,bn->bkp", basis, weight)
        A = factor.mT @ factor + torch.eye(4, dtype=torch.float64)
        return A, torch.einsum("nkp,bn,bk->bp", mixed, weight, normal)

    def value(x, weight, normal):
        A, b = parts(weight, normal)
        return (x[:, None] @ A @ x[..., None])[:, 0, 0] / 2 - (b * x).sum(-1)

    def optimum(weight, normal):
        A, b = parts(weight.detach(), normal.detach())
        return _Optimum.apply(torch.linalg.solve(A, b), weight, normal, value)

    weight, normal = (torch.rand(2, n, generator=chance, dtype=torch.float64, requires_grad=True) for n in (5, 3))
    assert torch.autograd.gradcheck(optimum, (weight, normal))


def test_gradients_through_the_optimum_are_those_of_the_search_begun_again():
    """More weight to events that turn otherwise pulls the optimum towards them."""
    from torchcmax.core.estimate import Search
    from torchcmax.core.minimize import Stop

    both = [turning(batch=1, omega=omega, seed=seed) for seed, omega in enumerate(((0.5, -0.8, 1.5), (0.9, -0.5, 1.2)))]
    window = Window(
        *(torch.cat([getattr(w, name) for w in both], 1) for name in ("ray", "dt", "polarity")), both[0].start, both[0].duration
    )
    some = torch.zeros(1, 800, dtype=torch.float64)
    some[:, 400:] = 1
    layer = Compensate(CAMERA, look=Look(), search=Search(blur=(4.0, 3.0), stop=Stop(tolerance=1e-4)))
    weight = torch.ones(1, 800, dtype=torch.float64, requires_grad=True)
    omega = layer(window, weight).omega
    found = torch.stack([torch.autograd.grad(omega[0, k], weight, retain_graph=True)[0].mul(some).sum() for k in range(3)])
    step = 0.3  # smaller ones measure the kinks of bilinear votes: from 0.02 to 0.6 what they find differs by a third
    again = (layer(window, 1 + step * some).omega - layer(window, 1 - step * some).omega)[0] / (2 * step)
    assert (found - again).norm() < 0.25 * again.norm()
    towards = torch.tensor([0.4, 0.3, -0.3], dtype=torch.float64)
    assert ((found * towards) > 0).all()
    assert Compensate(CAMERA, gradients="detached")(window, weight).omega.requires_grad is False


def test_gradients_through_the_optimum_to_the_plane():
    window = turning(dtype=torch.float64)
    normal = vector(NORMAL).requires_grad_()
    found = Compensate(CAMERA, "planar")(window, normal=normal)
    found.omega.square().sum().backward()
    assert normal.grad.isfinite().all()
    assert (normal.grad != 0).any()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cpu_and_cuda_agree(dtype):
    tolerance = {"rtol": 1e-8, "atol": 1e-10} if dtype == torch.float64 else {"rtol": 2e-3, "atol": 2e-4}
    found: dict[str, list[torch.Tensor]] = {}
    for device in ("cpu", "cuda"):
        window = turning(dtype=dtype).to(device, dtype)
        omega = vector(OMEGA, dtype=dtype).to(device).requires_grad_()
        flow = (torch.rand(2, 2, 24, 32, generator=torch.Generator().manual_seed(1)).to(device, dtype) - 0.5).requires_grad_()
        losses = ContrastLoss(CAMERA)(window, omega), FlowContrastLoss(CAMERA)(window, flow)
        sum(losses).backward()
        found[device] = [*losses, omega.grad, flow.grad, Compensate(CAMERA)(window).omega]
    for a, b in zip(found["cpu"], found["cuda"], strict=True):
        torch.testing.assert_close(a, b.cpu(), **tolerance)
