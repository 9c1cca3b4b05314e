"""The kernels of the CPU are the readable twins in core, in value and derivative."""

import math
import multiprocessing
import time

import numpy as np
import pytest
import torch

from torchcmax import kernels
from torchcmax.core.camera import Canvas, Sphere
from torchcmax.core.contrast import CONTRASTS, _smooth, normalized
from torchcmax.core.draw import Ink, _framed, draw, draw_twin
from torchcmax.core.minimize import Stop, minimize
from torchcmax.core.model import Planar, PlanarKnown, Rotation, Translation
from torchcmax.core.objective import Look, View, metric, minimum, objective, penalty, problem
from torchcmax.core.vote import vote_scatter
from torchcmax.core.warp import polynomial
from torchcmax.core.window import Window

numba = pytest.importorskip("numba", reason="numba is not installed")
from torchcmax.kernels import cpu, events, image, motion  # noqa: E402

CANVASES = pytest.mark.parametrize("canvas", [Canvas(60.0, (20.3, 15.7), (31, 40)), Sphere(32)], ids=["pinhole", "sphere"])
TOLERANCE = {torch.float32: {"rtol": 2e-4, "atol": 2e-4}, torch.float64: {"rtol": 1e-9, "atol": 1e-9}}
OWNER = torch.tensor([0, 0, 1, 2, 1])
KINDS = (Rotation, Translation, PlanarKnown, Planar)


@pytest.fixture
def dtype(request):
    return getattr(request, "param", torch.float64)


@pytest.fixture
def random(dtype):
    generator = torch.Generator().manual_seed(0)
    return lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64).to(dtype)


def ink_of(random, windows=3, count=2000):
    """Signed events in order of time; the last tenth of each window is padding."""
    weight = torch.where(random(windows, count) > 0.5, 1.0, -1.0).to(random(1)) * (0.5 + random(windows, count))
    weight[:, count - count // 10 :] = 0
    return Ink(random(windows, count) - 0.5, 0.7 * (random(windows, count) - 0.5), random(windows, count).sort(-1).values - 0.5, weight)


def homographies(random, rows=5):
    normal = torch.nn.functional.normalize(torch.tensor([[0.1, 0.2, -1.0]]), dim=-1).to(random(1)).expand(rows, 3)
    return polynomial(0.6 * (random(rows, 3) - 0.5), 0.3 * (random(rows, 3) - 0.5), normal)


def framed_twin(H_k, ink, canvas, owner):
    basis, weight = ink.aligned
    return _framed(vote_scatter, H_k, basis[owner], weight[owner], canvas)


def agree(H_k, ink, canvas, owner, tolerance):
    """votes and slopes against the twin and its derivative by autograd."""
    H = H_k.clone().requires_grad_()
    image_twin = framed_twin(H, ink, canvas, owner)
    inside = torch.zeros_like(image_twin)
    inside[:, 1:-1, 1:-1] = torch.rand(image_twin[:, 1:-1, 1:-1].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(cpu.votes(H_k, ink, canvas, owner)[:, 1:-1, 1:-1], image_twin[:, 1:-1, 1:-1].detach(), **tolerance)
    (slopes_twin,) = torch.autograd.grad((image_twin * inside).sum(), H)
    scale = slopes_twin.abs().max()
    torch.testing.assert_close(cpu.slopes(H_k, ink, canvas, owner, inside) / scale, slopes_twin / scale, **tolerance)


@CANVASES
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], indirect=True, ids=["f32", "f64"])
def test_votes_and_slopes_are_the_twin(canvas, dtype, random):
    agree(homographies(random), ink_of(random), canvas, OWNER, TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], indirect=True, ids=["f32", "f64"])
def test_events_need_not_be_in_order_and_may_pause(dtype, random):
    ink = ink_of(random)
    shuffled = torch.randperm(ink.x.shape[-1], generator=torch.Generator().manual_seed(2))
    paused = torch.where(ink.s > 0, 0.4 + 0.2 * ink.s, -0.4 + 0.2 * ink.s)
    for s in (ink.s[:, shuffled], paused):
        agree(homographies(random), Ink(ink.x, ink.y, s, ink.weight), CANVAS, OWNER, TOLERANCE[dtype])


CANVAS = Canvas(60.0, (20.3, 15.7), (31, 40))


@pytest.mark.parametrize("terms", [1, 2, 6])
def test_any_number_of_terms(terms, random):
    ink, H_k = ink_of(random), homographies(random)[:, :terms]
    padded = torch.cat([H_k, torch.zeros(5, 6 - terms, 3, 3, dtype=H_k.dtype)], 1)
    found, twin = (CANVAS.folded(how) for how in (cpu.votes(H_k, ink, CANVAS, OWNER), framed_twin(padded, ink, CANVAS, OWNER)))
    assert torch.allclose(found, twin, rtol=0, atol=1e-12)


@CANVASES
def test_what_is_not_a_number_or_far_away_votes_nothing(canvas, random):
    ink, H_k = ink_of(random), homographies(random)
    clean = cpu.votes(H_k, ink, canvas, OWNER)
    for value in (math.nan, math.inf, -math.inf, 1e30, -1e30):
        bad = torch.full((3, 1), value).to(ink.x)
        parts = ((bad, ink.x), (bad, ink.y), (torch.zeros_like(bad), ink.s), (torch.ones_like(bad), ink.weight))
        more = Ink(*(torch.cat(part, 1) for part in parts))
        votes = cpu.votes(H_k, more, canvas, OWNER)
        assert votes.isfinite().all()
        if not canvas.sphere or not math.isfinite(value):  # far to the side is still a direction of a sphere
            assert torch.allclose(canvas.folded(votes), canvas.folded(clean))
        if math.isfinite(value):
            assert cpu.slopes(H_k, more, canvas, OWNER, torch.ones_like(votes)).isfinite().all()


def test_behind_the_camera_votes_nothing(random):
    H_k = torch.zeros(5, 1, 3, 3, dtype=torch.float64)
    H_k[:, 0] = -torch.eye(3)
    ink = ink_of(random)
    assert (cpu.votes(H_k, ink, CANVAS, OWNER)[:, 1:-1, 1:-1] == 0).all()
    assert (cpu.slopes(H_k, ink, CANVAS, OWNER, torch.ones(5, 33, 42).double()) == 0).all()


def test_a_canvas_that_float32_cannot_count_is_refused(random):
    ink = ink_of(random)
    ink = Ink(ink.x.float(), ink.y.float(), ink.s.float(), ink.weight.float())
    with pytest.raises(ValueError, match="5000 x 5000 px has more than 16777216"):
        cpu.votes(homographies(random)[:1].float(), ink, Canvas(60.0, (0.0, 0.0), (5000, 5000)), OWNER[:1])


def test_what_does_not_fit_together_is_refused_before_any_memory_is_touched(random):
    ink, H_k = ink_of(random), homographies(random)
    with pytest.raises(ValueError, match=r"wants dL/dframe \[5, 33, 42\], got \[5, 31, 40\]"):
        cpu.slopes(H_k, ink, CANVAS, OWNER, torch.ones(5, 31, 40).double())
    with pytest.raises(ValueError, match=r"ink wants x, y, s and weight \[W, N\], got"):
        Ink(ink.x, ink.y[:, 1:], ink.s, ink.weight)
    with pytest.raises(ValueError, match=r"draw wants H_k \[A, K, 3, 3\] and owner \[A\], got \[5, 6, 3, 3\] and \[4\]"):
        draw(H_k, ink, CANVAS, OWNER[:4])
    with pytest.raises(IndexError):
        cpu.votes(H_k, ink, CANVAS, OWNER + 1)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_same_for_any_number_of_threads(threads, random):
    count = 3 * cpu.PART
    ink, H_k = ink_of(random, windows=1, count=count), homographies(random, rows=1)
    owner, back = torch.zeros(1, dtype=torch.int64), random(1, 33, 42)
    alone = cpu.votes(H_k, ink, CANVAS, owner), cpu.slopes(H_k, ink, CANVAS, owner, back)
    kernels.set_threads(threads)
    try:
        once = cpu.votes(H_k, ink, CANVAS, owner), cpu.slopes(H_k, ink, CANVAS, owner, back)
        again = cpu.votes(H_k, ink, CANVAS, owner), cpu.slopes(H_k, ink, CANVAS, owner, back)
    finally:
        kernels.set_threads(0)
    for a, b, c in zip(once, again, alone, strict=True):
        assert torch.equal(a, b)
        torch.testing.assert_close(a, c, rtol=1e-11, atol=1e-9)


def test_angles_are_those_of_the_library():
    like = np.zeros(1)
    turn = np.linspace(-math.pi, math.pi, 1001)
    for radius in (1e-9, 1.0, 1e9):
        found = [events.angle(radius * y, radius * x, like) for y, x in zip(np.sin(turn), np.cos(turn), strict=True)]
        np.testing.assert_allclose(found, np.arctan2(np.sin(turn), np.cos(turn)), rtol=0, atol=2e-15)


def frame_of(random, height=20, width=30):
    frame = np.zeros((height + 2, width + 2))
    frame[1:-1, 1:-1] = random(height, width).numpy() - 0.3
    return frame


@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.0, 2.0, 4.0, 9.0])
def test_the_blur_is_the_twin(sigma, random):
    frame, result, taps = frame_of(random), np.zeros((22, 32)), image.taps(sigma)
    image.blur(frame, taps, np.zeros(32 + 2 * len(taps)), result, (0, 22))
    plain = torch.from_numpy(frame[1:-1, 1:-1])[None]
    twin = _smooth(_smooth(plain, sigma, -2), sigma, -1) if sigma else plain
    np.testing.assert_allclose(result[1:-1, 1:-1], twin[0], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", CONTRASTS)
def test_contrasts_and_their_slopes_are_the_twins(name, random):
    frame, slope, spare = frame_of(random), np.ones((22, 32)), np.ones((22, 32))
    plain = torch.from_numpy(frame[1:-1, 1:-1].copy())[None].requires_grad_()
    value = CONTRASTS[name](plain)
    (twin,) = torch.autograd.grad(value, plain)
    found = image.contrast(image.CONTRASTS.index(name), frame, slope, spare)
    assert found == pytest.approx(value.item(), rel=1e-12)
    np.testing.assert_allclose(slope[1:-1, 1:-1], twin[0], rtol=1e-10, atol=1e-15)
    assert not slope[0].any()
    assert not slope[:, 0].any()


def test_the_contrasts_stand_in_the_same_order():
    assert list(CONTRASTS) == list(image.CONTRASTS)


def test_an_empty_image_has_no_contrast():
    frame = np.zeros((22, 32))
    for code in range(len(image.CONTRASTS)):
        assert image.contrast(code, frame, np.zeros((22, 32)), np.zeros((22, 32))) == 0


@pytest.fixture
def scene(random):
    """Two windows of dots that drift, on a canvas of their own: Window, Canvas."""
    dots, count = 0.6 * (random(2, 40, 2) - 0.5), 3000
    s = random(2, count).sort(-1).values
    which = (random(2, count) * 40).long()
    place = dots.gather(1, which[..., None].expand(-1, -1, 2)) + s[..., None] * torch.tensor([[[0.05, -0.03]], [[-0.04, 0.06]]])
    ray = torch.cat([place, torch.ones_like(place[..., :1])], -1)
    window = Window(ray, s - s[:, :1], torch.ones_like(s), torch.zeros(2, dtype=torch.int64), s[:, -1] - s[:, 0])
    return window, Canvas(60.0, (29.5, 24.5), (50, 60))


def twin_minimum(look, model, view, owner):
    return lambda x, stop: minimize(objective(look, model, view, owner), x, metric(look, model, view.some, x, owner), stop)


@pytest.fixture
def plain(monkeypatch):
    """Switches the kernels off from here on."""
    return lambda: monkeypatch.setenv(kernels.SWITCH, "0")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("reference", ["middle", "first"])
def test_motion_homography_guard_and_metric_are_the_twins(kind, reference, scene, random):
    window, canvas = scene
    look, wall = Look(reference=reference), torch.nn.functional.normalize(random(2, 3) * torch.tensor([0.3, 0.3, -1.0]), dim=-1)
    model = kind(60.0, wall)
    view, owner = look.at(window, canvas, 1.0), torch.arange(2)
    share = {"middle": 0.5, "first": 0.0}[reference]
    numbers = problem(look, model, view).look
    for size in (0.0, 5.0, 60.0):  # the guard speaks at the last
        x = size * (random(2, kind.size) - 0.5)
        there_twin = model.at_reference(x, owner, share)
        H_twin = there_twin.homography()
        cost_twin, G_twin = penalty(look, model, there_twin, H_twin, view.some.ray), metric(look, model, view.some, x, owner)
        for row in range(2):
            there, H = np.empty((3, 3)), np.empty((6, 3, 3))
            some = tuple(getattr(view.some, n)[row].numpy() for n in ("x", "y", "s", "weight"))
            motion.motion(x[row].numpy(), numbers, wall[row].numpy(), there)
            motion.homography(there, H)
            np.testing.assert_allclose(there[0], there_twin.turn[row], atol=1e-14)
            np.testing.assert_allclose(H, H_twin[row], rtol=1e-10, atol=1e-12)
            assert motion.strain(there, H, numbers, some) + motion.lean(there, numbers) == pytest.approx(
                cost_twin[row].item(), rel=1e-9, abs=1e-12
            )
            G = motion.metric(x[row].numpy(), numbers, wall[row].numpy(), some, 6)
            np.testing.assert_allclose(G, G_twin[row], rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("contrast", CONTRASTS)
def test_the_search_is_the_twin_step_by_step(kind, contrast, scene, plain):
    window, canvas = scene
    look, model, owner = Look(contrast=contrast), kind(60.0), torch.tensor([0, 1, 1])
    view, x = look.at(window, canvas, 1.0), torch.zeros(3, kind.size, dtype=torch.float64)
    x[2, 0] = 2.0
    stop = Stop(tolerance=1e-4, iterations=6)
    found = minimum(look, model, view, owner)(x, stop)
    plain()
    twin = minimum(look, model, view, owner)(x, stop)
    assert found.value[0] < found.trace[0, 0]
    assert torch.equal(found.evaluations, twin.evaluations)
    assert torch.equal(found.iterations, twin.iterations)
    assert torch.equal(found.converged, twin.converged)
    torch.testing.assert_close(found.trace, twin.trace, rtol=1e-7, atol=1e-9, equal_nan=True)
    torch.testing.assert_close(found.x, twin.x, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_value_and_gradient_are_the_twins(kind, threads, scene, random, plain, monkeypatch):
    monkeypatch.setattr(cpu, "PART", 1000)  # so that two threads share a window
    window, canvas = scene
    look, model, owner = Look(), kind(60.0), torch.tensor([1])
    view, x = look.at(window, canvas, 1.0), 4 * (random(1, kind.size) - 0.5)
    kernels.set_threads(threads)
    try:
        value, gradient = objective(look, model, view, owner)(x, torch.tensor([0]))
    finally:
        kernels.set_threads(0)
    plain()
    value_twin, gradient_twin = objective(look, model, view, owner)(x, torch.tensor([0]))
    torch.testing.assert_close(value, value_twin, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(gradient, gradient_twin, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("polarity", ["dropped", "signed"])
def test_sharpness_is_the_twin(polarity, scene, random, plain):
    window, canvas = scene
    look = Look(polarity=polarity)
    view, H_k, owner = look.at(window, canvas, 1.0), homographies(random, 3), torch.tensor([0, 1, 1])
    found = look.sharpness(H_k, view, owner)
    plain()
    torch.testing.assert_close(found, look.sharpness(H_k, view, owner), rtol=1e-10, atol=0)


def test_a_model_of_the_users_own_is_searched_for_in_the_readable_way(scene):
    class Sideways(Rotation):
        def displacement(self, x, owner):
            return Rotation.displacement(self, x * torch.tensor([1.0, 1.0, 0.0]).to(x), owner)

    window, canvas = scene
    look = Look()
    found = minimum(look, Sideways(60.0), look.at(window, canvas, 1.0), torch.arange(2))(torch.zeros(2, 3).double(), None)
    assert (found.x[:, 2] == 0).all()
    assert (found.value < found.trace[:, 0]).all()


def test_ten_thousand_times_the_same_without_growing(random):
    """The soak of the issue: memory is measured after a first thousand, which fill the allocator's pools."""
    ink, H_k, owner = ink_of(random, count=200), homographies(random, 1), torch.zeros(1, dtype=torch.int64)
    view, back = View(ink, CANVAS, 1.0, ink.sample(50)), random(1, 33, 42)
    look, model, x = Look(), Rotation(60.0), torch.ones(1, 3, dtype=torch.float64)
    find = minimum(look, model, view, owner)

    def once():
        value, gradient = objective(look, model, view, owner)(x, owner)
        found = find(x, Stop(iterations=2)).x
        drawn = cpu.votes(H_k, ink, CANVAS, owner), cpu.slopes(H_k, ink, CANVAS, owner, back)
        return *drawn, cpu.sharpness(H_k, view, owner, "variance"), value, gradient, found

    first = once()
    before = 0
    for i in range(10_000):
        for a, b in zip(first, once(), strict=True):
            assert torch.equal(a, b)
        if i == 1000:
            before = resident()
    assert resident() - before < 2 << 20


def resident():
    """Bytes of memory of this process."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


def _votes_in_a_child(queue):
    kernels.set_threads(2)
    generator = torch.Generator().manual_seed(0)
    random = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    queue.put(cpu.votes(homographies(random), ink_of(random), CANVAS, OWNER).sum().item())


def test_threads_work_after_a_fork(random):
    kernels.set_threads(2)
    try:
        here = cpu.votes(homographies(random), ink_of(random), CANVAS, OWNER).sum().item()  # the pool has threads now
        context = multiprocessing.get_context("fork")
        queue = context.Queue()
        child = context.Process(target=_votes_in_a_child, args=(queue,))
        child.start()
        assert queue.get(timeout=60) == pytest.approx(here)
        child.join(60)
    finally:
        kernels.set_threads(0)


def test_draw_twin_and_normalized_are_what_sharpness_means(scene, random):
    window, canvas = scene
    ink, owner = Ink.of(window, window.weight), torch.arange(2)
    H_k = homographies(random, 2)
    image_twin = normalized(draw_twin(H_k, ink, canvas, owner), ink.weight)
    view = View(ink, canvas, 0.0, ink.sample(50))
    for name, contrast in CONTRASTS.items():
        torch.testing.assert_close(cpu.sharpness(H_k, view, owner, name), contrast(image_twin), rtol=1e-10, atol=0)


def test_ctrl_c_stops_all_threads_and_stays_ctrl_c():
    """numba tells an interrupt within compiled code as a SystemError caused by it."""
    done = []

    def work(i):
        done.append(i)
        if i == 0:
            raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    kernels.set_threads(2)
    try:
        with pytest.raises(KeyboardInterrupt):
            cpu._spread(lambda i: work(i) if i == 0 else time.sleep(0.005), [(i,) for i in range(1000)])
    finally:
        kernels.set_threads(0)
    assert done == [0]


def test_scratch_is_not_taken_for_larger_than_it_is_after_memory_ran_out(monkeypatch):
    small, large, taps = Canvas(60.0, (20.0, 15.0), (30, 40)), Canvas(60.0, (20.0, 15.0), (90, 120)), image.taps(1.0)
    cpu._scratch(small, taps)
    with monkeypatch.context() as patch:
        patch.setattr(np, "zeros", lambda *shape: (_ for _ in ()).throw(MemoryError()))
        with pytest.raises(MemoryError):
            cpu._scratch(large, taps)
    assert cpu._scratch(large, taps)[0].shape == (3, 92, 122)


def test_the_trace_has_room_for_every_evaluation(scene):
    """Where the curvature is forgotten an iteration takes more trials than its limit; whole numbers do for the options."""
    window, canvas = scene
    view = Look().at(window, canvas, 1.0)
    for stop in (Stop(tolerance=3, iterations=40, trials=3), Stop(tolerance=1e-7, iterations=10**10, trials=12, longest=6)):
        found = minimum(Look(guard=10), Rotation(60), view, torch.arange(2))(torch.zeros(2, 3).double(), stop)
        assert (found.trace.isfinite().sum(1) == found.evaluations).all()
        assert (found.trace.diff(dim=1).nan_to_num(0) <= 1e-12).all()


def test_what_is_the_users_own_is_left_to_torch(scene, monkeypatch):
    window, canvas = scene

    class Sharper(Look):
        pass

    monkeypatch.setitem(CONTRASTS, "own", CONTRASTS["variance"])
    view = Look().at(window, canvas, 1.0)
    own = Look()
    object.__setattr__(own, "contrast", "own")
    assert problem(Look(), Rotation(60.0), view) is not None
    assert problem(Sharper(), Rotation(60.0), view) is None
    assert problem(own, Rotation(60.0), view) is None
    assert problem(Look(), Rotation(60.0), View(view.ink, Sphere(32), 1.0, view.some)) is None
    H_k = Rotation(60.0).homography(torch.zeros(2, 3).double(), torch.arange(2), 0.5)
    torch.testing.assert_close(own.sharpness(H_k, view, torch.arange(2)), Look().sharpness(H_k, view, torch.arange(2)), rtol=1e-9, atol=0)
