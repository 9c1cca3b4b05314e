"""A window before the texture of a map: what its events look up, the slopes of that, and where it comes to rest."""

import math
from dataclasses import replace

import pytest
import torch

from torchcmax import kernels
from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import blur, variance
from torchcmax.core.draw import Ink, draw
from torchcmax.core.match import (
    LEAST,
    NUMBERS,
    Chart,
    Matching,
    Task,
    curvature,
    descend,
    evaluate,
    gram,
    homography,
    lookup,
    loosely,
    match,
    sharpen,
    units,
)
from torchcmax.core.minimize import Stop
from torchcmax.core.objective import RIDGE
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import SIZE, State
from torchcmax.core.warp import still

DOUBLE, FOCAL, HEIGHT, WIDTH = torch.float64, 90.0, 100, 120
EXACT = Matching(stop=Stop(tolerance=0.01, iterations=60, longest=5.0), every=1)  # bilinear kinks forbid more
BASIS = torch.eye(NUMBERS, SIZE, dtype=DOUBLE)


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def curves(count, seed):
    """Places on a circle, a slanted line and a wave: [count, 2] px."""
    a, which = 2 * math.pi * rand(count, seed=seed), torch.arange(count) % 3
    x = torch.stack([60 + 24 * a.cos(), 20 + 12 * a, 18 + 13.5 * a], -1)
    y = torch.stack([50 + 28 * a.sin(), 80 - 9 * a, 45 + 22 * a.cos()], -1)
    return torch.stack([part.gather(1, which[:, None])[:, 0] for part in (x, y)], -1)


def world(windows=2, count=900, seed=0):
    """Cameras that turn and move before a tilted plane with curves on it: truth, plane, seconds, chart, ink."""
    pose = Pose(so3.exp(0.1 * (rand(windows, 3, seed=seed) - 0.5)), 0.2 * (rand(windows, 3, seed=seed + 1) - 0.5))
    truth = State(pose, Motion(2 * (rand(windows, 3, seed=seed + 2) - 0.5), rand(windows, 3, seed=seed + 3) - 0.5))
    plane = Plane(Plane.tilted(torch.tensor([[0.2, -0.15]], dtype=DOUBLE)).normal, torch.tensor([1.3], dtype=DOUBLE)).repeated(windows)
    seconds = 0.04 + 0.02 * rand(windows, seed=seed + 4)
    y, x = torch.meshgrid(torch.arange(HEIGHT).double(), torch.arange(WIDTH).double(), indexing="ij")
    away = torch.cdist(torch.stack([x, y], -1).flatten(0, 1), curves(4000, seed=99)).amin(-1).view(1, HEIGHT, WIDTH)
    texture = 0.95 * (-(away**2) / 8).exp()
    corner = torch.tensor([[-61.5, -53.25]], dtype=DOUBLE).expand(windows, 2)
    chart = Chart(texture.expand(windows, -1, -1), corner, plane.facing(), FOCAL)
    s = rand(windows, count, seed=seed + 5).sort(-1).values - 0.5
    H_k = homography(torch.zeros(windows, NUMBERS, dtype=DOUBLE), truth, plane, seconds, chart)
    H = sum(H_k[:, None, k] * s[..., None, None] ** k for k in range(H_k.shape[1]))
    place = torch.stack([curves(count, seed=seed + 6 + i) for i in range(windows)]) / FOCAL
    ray = torch.linalg.solve(H, torch.cat([place, torch.ones_like(place[..., :1])], -1)[..., None])[..., 0]
    return truth, plane, seconds, chart, Ink(ray[..., 0] / ray[..., 2], ray[..., 1] / ray[..., 2], s, torch.ones_like(s))


@pytest.fixture(scope="module")
def scene():
    return world()


def problem_of(scene, off=0.0, seed=20):
    """The scene, from a prediction that is `off` px from the truth: predicted, plane, seconds, chart, ink."""
    truth, plane, seconds, chart, ink = scene
    step = 2 * off * (rand(len(seconds), SIZE, seed=seed) - 0.5) * units(truth, plane, seconds, FOCAL)[:, :SIZE]
    return truth.moved(step), plane, seconds, chart, ink


def task_of(scene, off=0.0, certain=1e-3, basis=BASIS, **more):
    predicted, plane, seconds, chart, ink = problem_of(scene, off)
    prior = (certain * torch.eye(NUMBERS, dtype=DOUBLE)).expand(len(seconds), -1, -1)
    return Task(predicted, plane, seconds, chart, ink, ink.sample(40), prior, basis, **more)


def apart(scene, task, found):
    """px between where the events are found to lie on the map and where they do: rms of each window."""
    there = homography(torch.zeros_like(found.x), scene[0], task.plane, task.seconds, task.chart)
    here = homography(found.x, task.predicted, task.plane, task.seconds, task.chart)
    return (places(here, task.ink) - places(there, task.ink)).square().sum(-1).mean(-1).sqrt()


def places(H_k, ink):
    H = sum(H_k[:, None, k] * ink.s[..., None, None] ** k for k in range(H_k.shape[1]))
    ray = (H @ ink.ray.mT[..., None])[..., 0]
    return FOCAL * ray[..., :2] / ray[..., 2:]


def central(f, x, h=1e-7):
    """df/dx [B, P] of numbers [B] at x [B, P]; so near that hardly an event crosses a kink of the bilinear lookup."""
    sides = h * torch.eye(x.shape[1], dtype=x.dtype)
    return torch.stack([(f(x + side) - f(x - side)) / (2 * h) for side in sides], -1)


def test_at_the_truth_the_events_lie_on_the_edges(scene):
    x = torch.zeros(2, NUMBERS, dtype=DOUBLE)
    count = scene[-1].x.shape[1]
    there = evaluate(x, *scene)[2] / count
    assert (there > 0.9).all()
    assert (evaluate(x + 4.0, *scene)[2] / count < 0.6 * there).all()


def test_a_step_of_a_unit_moves_the_image_by_about_a_pixel(scene):
    still_there = places(homography(torch.zeros(2, NUMBERS, dtype=DOUBLE), *scene[:4]), scene[4])
    for p in range(SIZE):
        x = torch.zeros(2, NUMBERS, dtype=DOUBLE)
        x[:, p] = 1.0
        rms = (places(homography(x, *scene[:4]), scene[4]) - still_there).square().sum(-1).mean(-1).sqrt()
        assert (rms > 0.05).all()
        assert (rms < 2).all()


def test_the_slope_of_the_match_is_that_of_central_differences(scene):
    problem, x = problem_of(scene, off=1.0), rand(2, NUMBERS, seed=30) - 0.5
    value, gradient, found = evaluate(x, *problem)
    torch.testing.assert_close(gradient, central(lambda x: evaluate(x, *problem)[0], x), rtol=1e-4, atol=1e-4)
    assert (value < 0).all()
    assert (found > -value).all()  # T is more than T - T^2/2


def test_the_curvature_is_that_of_each_event_by_itself(scene):
    """J^T J / (T + LEAST), J by central differences of what single events find."""
    predicted, plane, seconds, chart, ink = problem_of(scene, off=1.0)
    many = torch.zeros(50, dtype=torch.int64)
    alone = Ink(*(getattr(ink, n)[0, :50, None] for n in ("x", "y", "s", "weight")))
    x = rand(1, NUMBERS, seed=30) - 0.5

    def before(rows):
        there = Plane(plane.normal[rows], plane.distance[rows])
        return predicted[rows], there, seconds[rows], Chart(chart.texture[rows], chart.corner[rows], chart.view[rows], FOCAL)

    T = evaluate(x.expand(50, -1), *before(many), alone)[2]
    g = central(lambda x: evaluate(x, *before(many), alone)[2], x.expand(50, -1))
    some = Ink(*(getattr(ink, n)[:1, :50] for n in ("x", "y", "s", "weight")))
    found = curvature(x, *before(many[:1]), some)[0]
    torch.testing.assert_close(found, (g.mT / (T + LEAST)) @ g, rtol=1e-4, atol=1e-4)


def test_the_curvature_is_symmetric_and_never_negative(scene):
    for off in (0.0, 3.0):
        A = curvature(torch.zeros(2, NUMBERS, dtype=DOUBLE), *problem_of(scene, off))
        torch.testing.assert_close(A, A.mT)
        eigenvalues = torch.linalg.eigvalsh(A)
        assert (eigenvalues >= -1e-9 * eigenvalues[:, -1:]).all()


def test_the_metric_measures_how_far_a_step_moves_the_events(scene):
    problem, some, x = problem_of(scene)[:4], scene[4].sample(60), rand(2, NUMBERS, seed=30) - 0.5
    G = gram(x, *problem, some)
    ridge = RIDGE * G.diagonal(dim1=1, dim2=2).mean(-1)[:, None, None] / (1 + RIDGE) * torch.eye(NUMBERS)
    step = 1e-3 * (rand(2, NUMBERS, seed=31) - 0.5)
    rms = (places(homography(x + step, *problem), some) - places(homography(x, *problem), some)).square().sum(-1).mean(-1).sqrt()
    length = (step[:, None] @ (G - ridge) @ step[..., None])[:, 0, 0].sqrt()
    torch.testing.assert_close(length, rms, rtol=1e-3, atol=0)
    assert (torch.linalg.eigvalsh(G) > 0).all()


def haunted(scene):
    """Ghosts of different weights, and a smooth ground for them."""
    place, s = 1.2 * (rand(2, 80, 2, seed=40) - 0.5), rand(2, 80, seed=41) - 0.5
    y, x = torch.meshgrid(torch.arange(HEIGHT).double(), torch.arange(WIDTH).double(), indexing="ij")
    ground = (0.3 + 0.1 * (x / 17).sin() * (y / 13).cos()).expand(2, -1, -1)
    return {"ghosts": Ink(place[..., 0], place[..., 1], s, 0.5 + rand(2, 80, seed=42)), "ground": ground}


def test_the_slope_of_the_cost_is_that_of_central_differences(scene):
    x = rand(2, NUMBERS, seed=30) - 0.5
    for more in ({}, haunted(scene)):
        task = task_of(scene, off=1.0, certain=0.7, **more)
        _, slope, _ = task.cost(x, 1.5)
        torch.testing.assert_close(slope, central(lambda x, task=task: task.cost(x, 1.5)[0], x), rtol=1e-4, atol=2e-4)


def test_the_cost_is_that_of_its_parts(scene):
    """Events and ghosts by the weight, the prior by itself; ghosts one by one, as what they would bring in vain."""
    x, more = rand(2, NUMBERS, seed=30) - 0.5, haunted(scene)
    plain, task = task_of(scene, off=1.0, certain=0.7), task_of(scene, off=1.0, certain=0.7, **more)
    events = evaluate(x, *problem_of(scene, off=1.0))
    prior = 0.35 * x.square().sum(-1)
    torch.testing.assert_close(plain.cost(x, 1.5)[0], 1.5 * events[0] + prior)
    ghosts = more["ghosts"]
    xy = places(homography(x, task.predicted, task.plane, task.seconds, task.chart), ghosts)
    vain = (lookup(more["ground"], xy)[0] * ghosts.weight).sum(-1)
    torch.testing.assert_close(task.cost(x, 1.5)[0], 1.5 * (events[0] + vain) + prior)
    torch.testing.assert_close(task.cost(x, 1.5)[2], events[2])  # ghosts are not found


@pytest.mark.parametrize("compiled", [True, False])
def test_a_window_slides_back_onto_its_edges(scene, compiled, monkeypatch):
    if not compiled:
        monkeypatch.setenv(kernels.SWITCH, "0")
    task = task_of(scene, off=2.0)
    found = match(torch.zeros(2, SIZE, dtype=DOUBLE), task, EXACT)
    assert found.converged.all()
    assert (apart(scene, task, replace(found, x=torch.zeros_like(found.x))) > 0.8).all()
    assert (apart(scene, task, found) < 0.15).all()
    assert (found.cost < task.cost(torch.zeros_like(found.x), EXACT.weight)[0]).all()
    torch.testing.assert_close(found.slope[:, :SIZE], torch.zeros(2, SIZE, dtype=DOUBLE), rtol=0, atol=0.5)
    moved = task.predicted.moved((found.x * units(task.predicted, task.plane, task.seconds, FOCAL))[:, :SIZE])
    torch.testing.assert_close(found.state.step_to(moved), torch.zeros(2, SIZE, dtype=DOUBLE), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.strength, task.cost(found.x, 1.0)[2] / 900)


def test_a_certain_prediction_is_hardly_left(scene):
    task = task_of(scene, off=2.0, certain=1e7)
    found = match(torch.zeros(2, SIZE, dtype=DOUBLE), task, EXACT)
    assert found.x.abs().max() < 1e-3


def test_only_what_the_basis_has_moves(scene):
    basis = BASIS[:, [0, 1, 2, 6, 7, 8]]
    found = match(torch.zeros(2, 6, dtype=DOUBLE), task_of(scene, off=1.0, basis=basis), EXACT)
    assert (found.x[:, [3, 4, 5, 9, 10, 11, 12, 13]] == 0).all()
    assert (found.x[:, [0, 1, 2, 6, 7, 8]] != 0).all()


def test_the_twin_finds_for_a_window_in_a_batch_what_it_finds_for_it_alone(scene):
    task, q = task_of(scene, off=1.5, **haunted(scene)), torch.zeros(2, SIZE, dtype=DOUBLE)
    spare = Ink(*(torch.nn.functional.pad(getattr(task.ink, n), (0, 40)) for n in ("x", "y", "s", "weight")))
    how = replace(EXACT, stop=replace(EXACT.stop, iterations=4))
    together = descend(q, replace(task, ink=spare), how)
    for i in range(2):
        alone = descend(q[:1], task[torch.tensor([i])], how)
        for a, b in zip(alone, together, strict=True):
            torch.testing.assert_close(a[0], b[i], rtol=1e-6, atol=1e-6)


def padded(task):
    """Two windows whose events and charts differ in size, joined; and each by itself."""
    small = Chart(task.chart.texture[:1, :80, :70], task.chart.corner[:1], task.chart.view[:1], FOCAL)
    large, first, second = task[torch.tensor([1])].chart, slice(0, 1), slice(1, 2)
    inks = Ink(*(getattr(task.ink, n)[first, :500] for n in ("x", "y", "s", "weight"))), task.ink[second]
    alone = [replace(task[torch.tensor([i])], chart=(small, large)[i], ink=inks[i]) for i in (0, 1)]
    return replace(task, chart=Chart.join([small, large]), ink=Ink.join(inks)), alone


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])
@pytest.mark.parametrize("columns", [range(12), (0, 1, 2, 6, 7, 8), (3, 4, 5, 9, 10, 11)], ids=["planar", "rotation", "translation"])
def test_the_kernel_finds_for_windows_that_were_padded_exactly_what_it_finds_for_them_alone(scene, dtype, columns):
    pytest.importorskip("numba", reason="numba is not installed")
    task = task_of(scene, off=1.0, basis=BASIS[:, list(columns)], **haunted(scene))
    single = lambda ink: Ink(*(getattr(ink, n).to(dtype) for n in ("x", "y", "s", "weight")))  # noqa: E731
    task = replace(task, ink=single(task.ink), some=single(task.some), ghosts=single(task.ghosts), ground=task.ground[:, :80, :70])
    together, alone = padded(task)
    together = replace(together, ground=together.chart.filled(list(task.ground)))
    alone[1] = replace(alone[1], ground=together.ground[1:])
    q = torch.zeros(2, len(columns), dtype=DOUBLE)
    found = match(q, together, EXACT)
    for i, one in enumerate(alone):
        lone = match(q[:1], one, EXACT)
        for name in ("x", "cost", "slope", "information", "strength", "evaluations", "converged"):
            assert torch.equal(getattr(lone, name)[0], getattr(found, name)[i]), name


def votes_of(scene):
    """The map's events, drawn sharp on the chart: what the window is to be drawn upon."""
    place = curves(6000, seed=70)
    ink = Ink(*(part[None] for part in (place[:, 0] / FOCAL, place[:, 1] / FOCAL, 0 * place[:, 0], 1 + 0 * place[:, 0])))
    rest = still(torch.zeros(1, 6, 3, 3, dtype=DOUBLE))
    drawn = draw(rest, ink, Canvas(FOCAL, (0.0, 0.0), (HEIGHT, WIDTH)), torch.zeros(1, dtype=torch.int64))
    return blur(drawn, 1.0).expand(len(scene[2]), -1, -1)


def test_the_variance_of_window_and_map_together_sharpens_it(scene):
    how = replace(EXACT, objective="variance", stop=Stop(tolerance=0.01, iterations=40))
    task = task_of(scene, off=2.0, votes=votes_of(scene))
    found = match(torch.zeros(2, SIZE, dtype=DOUBLE), task, how)

    def minus_log_variance(x):
        H_k = homography(x, task.predicted, task.plane, task.seconds, task.chart)
        image = draw(H_k, task.ink, Canvas(FOCAL, (0.0, 0.0), (HEIGHT, WIDTH)), torch.arange(2))
        return -variance(image + task.votes).log()

    before, after = minus_log_variance(torch.zeros_like(found.x)), minus_log_variance(found.x)
    torch.testing.assert_close(found.cost, after, rtol=0, atol=1e-3)  # the last short step is not evaluated
    assert (after < before - 0.01).all()
    assert (apart(scene, task, found) < 0.5 * apart(scene, task, replace(found, x=torch.zeros_like(found.x)))).all()
    assert (found.information == 0).all()
    assert (found.slope == 0).all()


def test_without_votes_there_is_no_variance(scene):
    with pytest.raises(ValueError, match="wants the votes of the map"):
        sharpen(torch.zeros(2, SIZE, dtype=DOUBLE), task_of(scene), replace(EXACT, objective="variance"))


@pytest.mark.parametrize("wrong", [{"objective": "guess"}, {"refine": "nothing"}, {"weight": 0.0}, {"every": 0}])
def test_a_matching_without_sense_is_refused(wrong):
    with pytest.raises(ValueError, match=r"none of|matching wants"):
        Matching(**wrong)


@pytest.mark.parametrize("compiled", [True, False])
def test_one_chart_serves_all_windows(scene, compiled, monkeypatch):
    """As many of it would."""
    if not compiled:
        monkeypatch.setenv(kernels.SWITCH, "0")
    task, same = task_of(scene, off=1.5), torch.zeros(2, dtype=torch.int64)
    many = replace(task, chart=task.chart[same])
    one = replace(task, chart=task.chart[same[:1]])
    assert (len(one.chart.texture), len(many.chart.texture)) == (1, 2)
    q = torch.zeros(2, SIZE, dtype=DOUBLE)
    a, b = match(q, one, EXACT), match(q, many, EXACT)
    torch.testing.assert_close(a.x, b.x)
    torch.testing.assert_close(a.information, b.information)
    torch.testing.assert_close(a.strength, b.strength)
    assert a.strength[0] != a.strength[1]


def test_a_loose_prior_speaks_of_pose_and_motion_and_not_of_the_tilt():
    prior = loosely(5.0, 2.0)
    torch.testing.assert_close(prior.diagonal(), torch.tensor([0.04] * 6 + [0.25] * 6 + [0.0] * 2, dtype=DOUBLE))
    assert torch.equal(prior, prior.diagonal().diag())
