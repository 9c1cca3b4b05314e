"""The compiled match of windows to a texture is the readable twin in core/match.py, in value, derivative and outcome."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.contrast import blur
from torchcmax.core.draw import Ink
from torchcmax.core.match import NUMBERS, Chart, Matching, Task, curvature, descend, evaluate, gram, match
from torchcmax.core.minimize import Stop
from torchcmax.core.objective import RIDGE
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import CLOSEST, State
from torchcmax.core.warp import TERMS
from torchcmax.slam.tracker import basis_of

pytest.importorskip("numba", reason="numba is not installed")
from torchcmax.kernels import cpu, place
from torchcmax.kernels import match as matching

FOCAL, SIZE = 60.0, (50, 64)
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])
EXACT = Matching(stop=Stop(tolerance=1e-3, iterations=60, longest=5.0))
TOLERANCE = {torch.float32: {"rtol": 1e-4, "atol": 1e-4}, torch.float64: {"rtol": 1e-6, "atol": 1e-6}}
SHARE = {torch.float32: 1e-2, torch.float64: 2e-4}  # of the largest: where events are near a pixel's border, rounding chooses the slope


def task_of(dtype=torch.float64, rows=3, count=500, chance=False, names="planar", refine="full"):
    """Windows before a blurred random texture, each a little off where its events meet edges; the last tenth is padding."""
    g = torch.Generator().manual_seed(7)
    rand = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    texture = blur((rand(rows, *SIZE) > 0.9).double(), 2.0)
    texture = 0.95 * texture / texture.amax((1, 2), keepdim=True)
    normal = torch.nn.functional.normalize(torch.tensor([[0.1, -0.15, -1.0]], dtype=torch.float64) + 0.1 * (rand(rows, 3) - 0.5), dim=-1)
    plane = Plane(normal, 0.8 + 0.4 * rand(rows))
    state = State(
        Pose(so3.exp(0.1 * (rand(rows, 3) - 0.5)), 0.1 * (rand(rows, 3) - 0.5)), Motion(2 * (rand(rows, 3) - 0.5), rand(rows, 3) - 0.5)
    )
    chart = Chart(texture, torch.tensor([[-32.3, -25.6]], dtype=torch.float64) + rand(rows, 2), plane.facing(), FOCAL)

    def points(n):
        weight = torch.ones(rows, n, dtype=torch.float64)
        weight[:, n - n // 10 :] = 0
        weight[:, 5::17] = 0
        parts = 0.9 * (rand(rows, n) - 0.5), 0.7 * (rand(rows, n) - 0.5), rand(rows, n).sort(-1).values - 0.5, weight
        return Ink(*(part.to(dtype) for part in parts))

    ink = points(count)
    prior = torch.diag_embed(5 + 20 * rand(rows, NUMBERS))
    ghosts = ground = None
    if chance:
        ghosts, ground = points(200), 0.3 * blur(rand(rows, *SIZE), 3.0)
        ghosts = Ink(ghosts.x, ghosts.y, ghosts.s, ghosts.weight * 2.5)
    seconds = 0.05 + 0.05 * rand(rows)
    return Task(state, plane, seconds, chart, ink, ink.sample(24), prior, basis_of(names, refine), ghosts, ground)


def alone(task, row):
    return task[torch.tensor([row])]


def compiled(task, row):
    """What the functions of kernels/match.py want of one row: units, place, events, lens, frame."""
    there = cpu._places(task, CLOSEST)(row)
    texture = cpu._array(task.chart.frame.to(task.ink.x))[row].reshape(-1)
    lens = cpu._flat_lens(FOCAL, SIZE, task.ink.x.dtype)
    return place.units(there), there, cpu._rows(task.ink)(row), lens, texture


def problem(task):
    return task.predicted, task.plane, task.seconds, task.chart


def steps(rows=3):
    return 1.5 * (torch.rand(rows, NUMBERS, generator=torch.Generator().manual_seed(9), dtype=torch.float64) - 0.5)


@DTYPES
def test_the_value_and_its_slope_are_the_twins(dtype):
    task, x = task_of(dtype), steps()
    value, slope, found = evaluate(x, *problem(task), task.ink)
    for row in range(3):
        u, there, events, lens, frame = compiled(task, row)
        numbers = matching.value_and_slope(x[row].numpy(), u, there, events, lens, frame, TERMS, NUMBERS, True)
        for one, other in zip(numbers, (value, slope, found), strict=True):
            torch.testing.assert_close(torch.as_tensor(one, dtype=torch.float64), other[row], **TOLERANCE[dtype])


@DTYPES
def test_the_curvature_and_the_metric_are_the_twins(dtype):
    task, x = task_of(dtype), steps()
    A, G = curvature(x, *problem(task), task.ink), gram(x, *problem(task), task.some)
    for row in range(3):
        u, there, events, lens, frame = compiled(task, row)
        found = torch.from_numpy(matching.curvature(x[row].numpy(), u, there, events, lens, frame, TERMS))
        torch.testing.assert_close(found, A[row], rtol=0, atol=SHARE[dtype] * float(A[row].abs().max()))
        metric = matching.gram(x[row].numpy(), u, there, cpu._rows(task.some)(row), TERMS, RIDGE)
        torch.testing.assert_close(torch.from_numpy(metric), G[row], rtol=0, atol=1e-6)


@DTYPES
@pytest.mark.parametrize("chance", [False, True], ids=["edges", "ghosts"])
@pytest.mark.parametrize(("name", "refine"), [("planar", "full"), ("translation", "full"), ("planar", "motion")])
def test_the_search_is_the_twins(dtype, chance, name, refine):
    """Bilinear texture has kinks, where rounding may choose another way: so the search is stopped before it settles in one."""
    task = task_of(dtype, chance=chance, names=name, refine=refine)
    q = torch.full((3, task.basis.shape[1]), 0.2, dtype=torch.float64)
    how = replace(EXACT, stop=replace(EXACT.stop, tolerance=1e-2)) if dtype == torch.float32 else EXACT
    twin, kernel = descend(q, task, how), cpu.match(q, task, how, RIDGE, CLOSEST, TERMS)
    x, cost, slope, information, found, evaluations, converged = kernel
    assert twin[6].all()
    assert converged.all()
    assert x.dtype == torch.float64
    assert (evaluations > 1).all()
    assert ((x - q @ task.basis.T).abs().amax(1) > 0.05).all()
    single, away = dtype == torch.float32, x - twin[0]
    length = (away[:, None] @ gram(twin[0], *problem(task), task.some) @ away[:, :, None])[:, 0, 0].sqrt()
    assert length.max() < (5 * how.stop.tolerance if single else 1e-5)  # px; numbers on which little depends may differ more
    torch.testing.assert_close(cost, twin[1], rtol=0, atol=5e-3 if single else 1e-6)
    torch.testing.assert_close(found, twin[4], rtol=0, atol=0.2 if single else 1e-4)
    torch.testing.assert_close(information, twin[3], rtol=0, atol=SHARE[dtype] * float(twin[3].max()))
    torch.testing.assert_close(slope, twin[2], rtol=0, atol=1.0 if single else 1e-3)
    if not single:
        assert torch.equal(evaluations, twin[5])


@DTYPES
def test_a_batch_is_each_window_alone(dtype):
    task = task_of(dtype, chance=True)
    q = torch.zeros(3, task.basis.shape[1], dtype=torch.float64)
    together = cpu.match(q, task, Matching(), RIDGE, CLOSEST, TERMS)
    for row in range(3):
        for one, many in zip(cpu.match(q[:1], alone(task, row), Matching(), RIDGE, CLOSEST, TERMS), together, strict=True):
            assert torch.equal(one[0], many[row])


def test_several_threads_give_what_one_gives():
    from torchcmax import kernels

    task = task_of(torch.float32, rows=5)
    q = torch.zeros(5, task.basis.shape[1], dtype=torch.float64)
    one = cpu.match(q, task, Matching(), RIDGE, CLOSEST, TERMS)
    kernels.set_threads(3)
    assert all(torch.equal(a, b) for a, b in zip(one, cpu.match(q, task, Matching(), RIDGE, CLOSEST, TERMS), strict=True))


def test_match_takes_the_kernel_and_says_where_the_camera_is(monkeypatch):
    task = task_of()
    q = torch.zeros(3, task.basis.shape[1], dtype=torch.float64)
    fast = match(q, task, EXACT)
    monkeypatch.setattr("torchcmax.kernels.drawing", lambda *_: None)
    slow = match(q, task, EXACT)
    torch.testing.assert_close(fast.state.pose.t, slow.state.pose.t, atol=1e-6, rtol=0)
    torch.testing.assert_close(fast.state.motion.omega, slow.state.motion.omega, atol=1e-5, rtol=0)
    torch.testing.assert_close(fast.strength, slow.strength, atol=1e-6, rtol=0)
    assert ((fast.strength > 0) & (fast.strength < 1)).all()


def test_a_window_without_events_stays_where_the_prior_is():
    task = task_of()
    empty = replace(task, ink=Ink(task.ink.x, task.ink.y, task.ink.s, torch.zeros_like(task.ink.x)))
    q = torch.ones(3, task.basis.shape[1], dtype=torch.float64)
    for x, cost, _, information, found, _, converged in (descend(q, empty, EXACT), cpu.match(q, empty, EXACT, RIDGE, CLOSEST, TERMS)):
        assert converged.all()
        assert x.abs().max() < 1e-6
        assert cost.abs().max() < 1e-9
        assert (information == 0).all()
        assert (found == 0).all()


def test_a_search_that_starts_at_the_minimum_ends_at_once():
    task = task_of()
    empty = replace(task, ink=Ink(task.ink.x, task.ink.y, task.ink.s, torch.zeros_like(task.ink.x)))
    q = torch.zeros(3, task.basis.shape[1], dtype=torch.float64)
    for x, cost, _, _, _, evaluations, converged in (descend(q, empty, EXACT), cpu.match(q, empty, EXACT, RIDGE, CLOSEST, TERMS)):
        assert converged.all()
        assert (x == 0).all()
        assert (cost == 0).all()
        assert (evaluations <= 2).all()


def test_the_inverse_of_a_matrix_with_numbers_of_many_sizes():
    g = np.random.default_rng(0)
    root = g.standard_normal((6, 6))
    size = 10.0 ** np.arange(-6, 6, 2)
    A = (root @ root.T + np.eye(6)) * np.outer(size, size)
    np.testing.assert_allclose(matching.scaled_inverse(A) @ A, np.eye(6), atol=1e-3)
    np.testing.assert_allclose(matching.scaled_inverse(A) * np.outer(size, size), np.linalg.inv(A / np.outer(size, size)), rtol=1e-9)
