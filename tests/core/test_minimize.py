import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchcmax.core.minimize import Stop, minimize

EXACT = Stop(tolerance=1e-7, iterations=200, longest=1e9)


def quadratic(A, centre):
    """1/2 (x - c)^T A (x - c) for each problem."""

    def objective(x, rows):
        g = (A[rows] @ (x - centre[rows])[..., None])[..., 0]
        return 0.5 * (g * (x - centre[rows])).sum(-1), g

    return objective


def rosenbrock(x, rows):
    x = x.detach().requires_grad_()
    with torch.enable_grad():
        value = (1 - x[:, 0]) ** 2 + 100 * (x[:, 1] - x[:, 0] ** 2) ** 2
        (gradient,) = torch.autograd.grad(value.sum(), x)
    return value.detach(), gradient


@pytest.fixture
def problem():
    g = torch.Generator().manual_seed(0)
    M = torch.randn(6, 5, 5, generator=g, dtype=torch.float64)
    return M @ M.mT + 0.1 * torch.eye(5), torch.randn(6, 5, generator=g, dtype=torch.float64)


def test_quadratics_end_in_their_centres(problem):
    A, centre = problem
    found = minimize(quadratic(A, centre), torch.zeros_like(centre), stop=EXACT)
    torch.testing.assert_close(found.x, centre, rtol=0, atol=1e-5)
    assert found.converged.all()
    assert (found.evaluations >= found.iterations + 1).all()


def test_with_the_curvature_as_metric_a_quadratic_takes_a_handful_of_evaluations(problem):
    A, centre = problem
    found = minimize(quadratic(A, centre), torch.zeros_like(centre), A, EXACT)
    torch.testing.assert_close(found.x, centre, rtol=0, atol=1e-6)
    assert (found.evaluations <= 5).all()


def test_a_curved_valley_is_followed_to_its_end():
    start = torch.tensor([[-1.2, 1.0], [3.0, -2.0], [0.0, 5.0]], dtype=torch.float64)
    found = minimize(rosenbrock, start, stop=Stop(tolerance=1e-8, iterations=200))
    torch.testing.assert_close(found.x, torch.ones_like(start), rtol=0, atol=1e-5)


def test_a_row_goes_the_same_way_alone_and_in_a_batch(problem):
    A, centre = problem
    together = minimize(quadratic(A, centre), torch.zeros_like(centre), stop=EXACT)
    for i in range(len(A)):
        alone = minimize(quadratic(A[i : i + 1], centre[i : i + 1]), torch.zeros_like(centre[:1]), stop=EXACT)
        assert torch.equal(alone.x[0], together.x[i])
        assert alone.evaluations[0] == together.evaluations[i]
        assert alone.iterations[0] == together.iterations[i]


def test_torch_lbfgs_finds_the_same_minimum():
    """The one-row cross-check: torch.optim.LBFGS with strong Wolfe conditions."""
    ours = minimize(rosenbrock, torch.tensor([[-1.2, 1.0]], dtype=torch.float64), stop=Stop(tolerance=1e-8, iterations=200))
    x = torch.tensor([[-1.2, 1.0]], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([x], max_iter=200, line_search_fn="strong_wolfe", tolerance_grad=1e-10, tolerance_change=1e-14)

    def closure():
        value, x.grad = rosenbrock(x, torch.zeros(1, dtype=torch.int64))
        return value.sum()

    optimizer.step(closure)
    torch.testing.assert_close(ours.x, x.detach(), rtol=0, atol=1e-5)


def test_rows_that_are_done_are_not_evaluated_again(problem):
    A, centre = problem
    calls = torch.zeros(len(A), dtype=torch.int64)
    inner = quadratic(A, centre)

    def counting(x, rows):
        calls[rows] += 1
        return inner(x, rows)

    start = torch.zeros_like(centre)
    start[2] = centre[2]  # done before it begins
    found = minimize(counting, start, stop=EXACT)
    assert torch.equal(calls, found.evaluations)
    assert found.evaluations[2] == 1
    assert found.converged[2]
    assert found.iterations[2] == 0


def test_the_arguments_are_not_changed(problem):
    A, centre = problem
    start, metric = torch.zeros_like(centre), torch.eye(5, dtype=torch.float64).repeat(6, 1, 1)
    minimize(quadratic(A, centre), start, metric, EXACT)
    assert (start == 0).all()
    assert torch.equal(metric, torch.eye(5, dtype=torch.float64).repeat(6, 1, 1))


def test_the_trace_goes_down_and_ends_at_the_value(problem):
    A, centre = problem
    found = minimize(quadratic(A, centre), torch.zeros_like(centre), stop=EXACT)
    for i, trace in enumerate(found.trace):
        own = trace[: found.evaluations[i]]
        assert (own.diff() <= 1e-12).all()
        assert own[-1] == found.value[i]
        assert trace[found.evaluations[i] :].isnan().all()


def test_no_step_is_longer_than_allowed(problem):
    A, centre = problem
    points = []
    inner = quadratic(A[:1], 100 * centre[:1])

    def watching(x, rows):
        points.append(x[0].clone())
        return inner(x, rows)

    minimize(watching, torch.zeros(1, 5, dtype=torch.float64), stop=Stop(longest=3.0, iterations=10))
    path = torch.stack(points)
    assert (path - path[0]).norm(dim=-1).max() <= 10 * 3.0
    assert (path.diff(dim=0).norm(dim=-1) <= 3.0 + 1e-9).all()


def test_a_row_that_may_not_iterate_enough_says_so():
    found = minimize(rosenbrock, torch.tensor([[-1.2, 1.0]], dtype=torch.float64), stop=Stop(tolerance=1e-8, iterations=3))
    assert not found.converged[0]
    assert found.iterations[0] == 3


def test_a_row_of_nan_stands_still_and_harms_no_other(problem):
    A, centre = problem
    inner = quadratic(A, centre)

    def broken(x, rows):
        value, gradient = inner(x, rows)
        return torch.where(rows == 1, torch.nan, value), torch.where((rows == 1)[:, None], torch.nan, gradient)

    found = minimize(broken, torch.zeros_like(centre), stop=EXACT)
    assert not found.converged[1]
    assert (found.x[1] == 0).all()
    torch.testing.assert_close(found.x[2:], centre[2:], rtol=0, atol=1e-5)


def test_a_wall_of_infinity_is_backed_away_from():
    def log_barrier(x, rows):
        inside = x[:, 0] < 1
        safe = torch.where(inside, x[:, 0], 0.0)
        value = torch.where(inside, -x[:, 0] - 0.1 * (1 - safe).log(), torch.inf)
        return value, torch.where(inside, -1 + 0.1 / (1 - safe), torch.nan)[:, None]

    found = minimize(log_barrier, torch.zeros(1, 1, dtype=torch.float64), stop=Stop(tolerance=1e-6))
    torch.testing.assert_close(found.x, torch.full((1, 1), 0.9, dtype=torch.float64), rtol=0, atol=1e-4)


def test_a_wall_of_nan_is_backed_away_from_and_no_trial_leaves_the_limit():
    tried = []

    def walled(x, rows):
        tried.append(x[0, 0].item())
        return torch.where(x[:, 0] > 0.3, torch.nan, 0.5 * (x[:, 0] - 0.25) ** 2), torch.where(x > 0.3, torch.nan, x - 0.25)

    found = minimize(walled, torch.zeros(1, 1, dtype=torch.float64), stop=Stop(tolerance=1e-6, longest=6.0))
    torch.testing.assert_close(found.x, torch.full((1, 1), 0.25, dtype=torch.float64), rtol=0, atol=1e-4)
    assert max(tried) <= 6.0


@pytest.mark.parametrize("start", [1.0, 5.0, 20.0])
def test_a_hilltop_is_left_and_not_called_converged(start):
    """Flat slopes and concave all the way down the hill: 0.3 cos(x / 20), whose minimum is at 20 pi."""

    def hill(x, rows):
        return 0.3 * (x[:, 0] / 20).cos(), -0.3 / 20 * (x / 20).sin()

    found = minimize(hill, torch.full((1, 1), start, dtype=torch.float64))
    assert found.converged.all()
    torch.testing.assert_close(found.x, torch.full((1, 1), 20 * torch.pi, dtype=torch.float64), rtol=0, atol=0.05)


def test_a_wrong_curvature_is_forgotten_before_a_row_is_called_converged():
    """After a hundredfold change of curvature the first Hessian would end the search far off."""

    def bent(x, rows):
        near = x[:, 0].abs() < 1
        value = torch.where(near, 50 * x[:, 0] ** 2, 50 + 0.01 * (x[:, 0].abs() - 1)) + 0.01 * (x[:, 1] - 3) ** 2
        first = torch.where(near, 100 * x[:, 0], 0.01 * x[:, 0].sign())
        return value, torch.stack([first, 0.02 * (x[:, 1] - 3)], -1)

    found = minimize(bent, torch.tensor([[9.0, -20.0]], dtype=torch.float64), stop=Stop(iterations=200))
    torch.testing.assert_close(found.x, torch.tensor([[0.0, 3.0]], dtype=torch.float64), rtol=0, atol=0.05)


@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"longest": -1.0}, {"iterations": 0}, {"wolfe": 2.0}, {"armijo": 0.95}])
def test_options_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="stop wants"):
        Stop(**wrong)


def test_no_rows_are_no_work():
    found = minimize(rosenbrock, torch.zeros(0, 2, dtype=torch.float64))
    assert found.x.shape == (0, 2)


class Waits(TorchDispatchMode):
    """Counts the operations whose result a program must know before it can go on; on a GPU it waits for them."""

    count = 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        indices = args[1] if "index" in str(operation) and len(args) > 1 and isinstance(args[1], list | tuple) else ()
        by_mask = any(index is not None and index.dtype == torch.bool for index in indices)
        self.count += by_mask or any(name in str(operation) for name in ("nonzero", "_local_scalar_dense", "equal", "is_same_size"))
        return operation(*args, **(kwargs or {}))


def test_a_round_waits_once_for_a_gpu(problem):
    A, centre = problem
    calls = []
    inner = quadratic(A, centre)

    def counting(x, rows):
        calls.append(len(rows))
        return inner(x, rows)

    with Waits() as waits:
        minimize(counting, torch.zeros_like(centre), A, EXACT)
        spared = waits.count
        minimize(rosenbrock, torch.tensor([[-1.2, 1.0]], dtype=torch.float64), stop=Stop(iterations=3))
    assert spared == len(calls)  # whose rows go on; after the first evaluation too
    assert waits.count > spared


def test_with_the_inverse_hessian_a_quadratic_takes_one_step(problem):
    """It is evaluated where it begins and where it ends, whatever lengths are measured by."""
    A, centre = problem
    found = minimize(quadratic(A, centre), torch.zeros_like(centre), stop=EXACT, inverse=torch.linalg.inv(A))
    torch.testing.assert_close(found.x, centre, rtol=0, atol=1e-9)
    assert (found.evaluations <= 2).all()
    assert (found.iterations == 1).all()
    assert found.converged.all()


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_an_inverse_of_the_wrong_scale_is_mended_on_the_way(problem, factor):
    A, centre = problem
    inverse = factor * torch.linalg.inv(A)
    kept = inverse.clone()
    found = minimize(quadratic(A, centre), torch.zeros_like(centre), A, EXACT, inverse)
    torch.testing.assert_close(found.x, centre, rtol=0, atol=1e-5)
    assert torch.equal(inverse, kept)
    assert found.converged.all()
    assert (found.evaluations <= 12).all()


def test_an_inverse_does_not_lengthen_the_longest_step(problem):
    A, centre = problem
    points, inner = [], quadratic(A[:1], 100 * centre[:1])

    def watching(x, rows):
        points.append(x[0].clone())
        return inner(x, rows)

    start = torch.zeros(1, 5, dtype=torch.float64)
    found = minimize(watching, start, stop=Stop(longest=3.0, iterations=4), inverse=torch.linalg.inv(A[:1]))
    assert (torch.stack(points).diff(dim=0).norm(dim=-1) <= 3.0 + 1e-9).all()
    assert found.iterations[0] == 4
    assert (found.trace[0].diff() <= 0).all()
