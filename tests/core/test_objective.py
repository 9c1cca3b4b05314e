import pytest
import torch

from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import CONTRASTS
from torchcmax.core.model import Planar, PlanarKnown, Rotation, Translation
from torchcmax.core.objective import REFERENCES, RIDGE, ContrastName, Look, deformation, metric, objective, penalty
from torchcmax.core.warp import monomials
from torchcmax.core.window import Window

CANVAS = Canvas(30.0, (23.3, 17.7), (36, 48))
KINDS = pytest.mark.parametrize("kind", [Rotation, Translation, PlanarKnown, Planar])


@pytest.fixture
def window():
    g = torch.Generator().manual_seed(3)
    ray = torch.cat([torch.rand(2, 300, 2, generator=g, dtype=torch.float64) - 0.5, torch.ones(2, 300, 1, dtype=torch.float64)], -1)
    dt = (0.1 * torch.rand(2, 300, generator=g, dtype=torch.float64)).sort(-1).values
    dt = dt - dt[:, :1]
    polarity = torch.where(torch.rand(2, 300, generator=g) > 0.5, 1.0, -1.0).double()
    return Window(ray, dt, polarity, torch.zeros(2, dtype=torch.int64), dt[:, -1])


def test_the_options_name_every_contrast():
    assert set(ContrastName.__args__) == set(CONTRASTS)


def test_an_unknown_contrast_is_named():
    with pytest.raises(ValueError, match="'sharpness' is none of variance, mean_square"):
        Look(contrast="sharpness")


@KINDS
@pytest.mark.parametrize("reference", REFERENCES)
def test_the_gradient_is_that_of_central_differences(window, kind, reference):
    """Through blur, vote, warp and guard; float64, blurred, so that the kinks of the bilinear vote are small."""
    look, model, owner = Look(reference=reference, deformation=1.01), kind(30.0), torch.tensor([0, 1])
    f = objective(look, model, look.at(window, CANVAS, 2.0), owner)
    g = torch.Generator().manual_seed(5)
    x = 4 * (torch.rand(2, kind.size, generator=g, dtype=torch.float64) - 0.5)
    _, gradient = f(x, owner)
    h = 1e-4
    for p in range(kind.size):
        step = torch.zeros_like(x)
        step[:, p] = h
        difference = (f(x + step, owner)[0] - f(x - step, owner)[0]) / (2 * h)
        torch.testing.assert_close(gradient[:, p], difference, rtol=2e-3, atol=2e-5)


CORNERS = torch.tensor([[[0, -0.7, 0.7, -0.7, 0.7], [0, -0.5, -0.5, 0.5, 0.5], [1, 1, 1, 1, 1]]], dtype=torch.float64)


def changed(model, x, owner):
    there = model.at_reference(x, owner, 0.5)
    return deformation(there, there.homography(), CORNERS.expand(len(x), -1, -1), 0.5)


def guarded(look, model, x, owner):
    there = model.at_reference(x, owner, 0.5)
    return penalty(look, model, there, there.homography(), CORNERS.expand(len(x), -1, -1))


def test_the_guard_is_silent_for_turns_and_speaks_before_everything_collapses():
    turn = torch.tensor([[6.0, 4.0, 9.0]], dtype=torch.float64)
    owner = torch.zeros(1, dtype=torch.int64)
    calm = changed(Rotation(30.0), turn, owner)
    assert calm.abs().max() < torch.tensor(2.0).log()
    towards = torch.tensor([[0, 0, 0, 0, 0, 24.0]], dtype=torch.float64)
    wild = changed(PlanarKnown(30.0), towards, owner)
    assert wild.abs().max() > torch.tensor(2.0).log()


@pytest.mark.parametrize("kind", [Translation, PlanarKnown, Planar])
def test_the_guard_grows_all_the_way_through_the_plane(kind):
    """A camera that flies to the plane and beyond is never cheaper than one that stops before it, and never nan."""
    model, owner = kind(30.0), torch.zeros(40, dtype=torch.int64)
    x = torch.zeros(40, kind.size, dtype=torch.float64)
    x[:, {3: 2, 6: 5, 8: 5}[kind.size]] = torch.linspace(0, 120, 40, dtype=torch.float64)
    cost = guarded(Look(), model, x, owner)
    assert cost.isfinite().all()
    assert cost[0] == 0
    peak = int(cost.argmax())
    assert (cost[: peak + 1].diff() >= -1e-9).all()
    assert (cost[peak:] > 100).all()


def test_a_free_plane_must_face_the_events_that_it_shows():
    model, owner = Planar(30.0), torch.zeros(3, dtype=torch.int64)
    x = torch.zeros(3, 8, dtype=torch.float64)
    x[:, 6] = 30.0 * torch.tensor([0.3, 1.3, 1.7])  # tilts: seen by all corners; hidden from two; facing away
    cost = guarded(Look(tilt=0.0), model, x, owner)
    assert cost[0] == 0
    assert 0.1 < cost[1] < cost[2]


def test_deformation_is_the_change_of_a_small_triangle():
    model, owner = Planar(30.0), torch.zeros(1, dtype=torch.int64)
    x = torch.tensor([[2.0, -1.0, 3.0, 2.0, -3.0, 4.0, 5.0, -6.0]], dtype=torch.float64)
    H_k = model.homography(x, owner, 0.5)
    end = sum(H_k[0, k] * 0.5**k for k in range(H_k.shape[1]))
    h = 1e-5
    corners = torch.tensor([[0, 0, 1], [h, 0, 1], [0, h, 1]], dtype=torch.float64) @ end.mT
    point = corners[:, :2] / corners[:, 2:]
    a, b = point[1] - point[0], point[2] - point[0]
    area = (a[0] * b[1] - a[1] * b[0]) / h**2
    torch.testing.assert_close(changed(model, x, owner)[0, 5], area.abs().log(), rtol=0, atol=1e-4)


@KINDS
def test_the_metric_measures_how_far_a_step_moves_the_events(window, kind):
    look, model, owner = Look(), kind(30.0), torch.tensor([0, 1])
    ink = look.at(window, CANVAS, 0.0).some
    x = torch.ones(2, kind.size, dtype=torch.float64)
    G = metric(look, model, ink, x, owner)
    ridge = RIDGE * G.diagonal(dim1=1, dim2=2).mean(-1)[:, None, None] / (1 + RIDGE) * torch.eye(kind.size)
    step = 1e-3 * torch.arange(1, kind.size + 1, dtype=torch.float64).expand(2, -1)
    basis = monomials(ink.ray.mT, ink.s)

    def place(x):
        ray = model.homography(x, owner, 0.5).transpose(1, 2).flatten(2) @ basis
        return 30.0 * ray[:, :2] / ray[:, 2:]

    rms = (place(x + step) - place(x)).square().sum(1).mean(-1).sqrt()
    length = (step[:, None] @ (G - ridge) @ step[..., None])[:, 0, 0].sqrt()
    torch.testing.assert_close(length, rms, rtol=0.02, atol=0)
    assert (torch.linalg.eigvalsh(metric(look, model, ink, 0 * x, owner)) > 0).all()


def test_padding_changes_neither_the_metric_nor_the_guard(window):
    look, model, owner = Look(deformation=1.01), Planar(30.0), torch.tensor([0, 1])
    spare = Window(
        *(
            torch.cat([part, torch.zeros_like(part).repeat(1, 9, *[1] * (part.ndim - 2))], 1)
            for part in (window.ray, window.dt, window.polarity)
        ),
        window.start,
        window.duration,
    )
    x = torch.tensor([[1.0, -2, 1, 3, 1, 2, 4, -3]], dtype=torch.float64).expand(2, -1)
    results = []
    for some in (window, spare):
        view = look.at(some, CANVAS, 1.0)
        results.append((metric(look, model, view.some, x, owner), *objective(look, model, view, owner)(x, owner)))
    for padded, plain in zip(*results, strict=True):
        torch.testing.assert_close(padded, plain)


@pytest.mark.parametrize("wrong", [{"deformation": 1.0}, {"guard": -1.0}, {"tilt": float("nan")}, {"guard": float("inf")}])
def test_options_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="a look wants"):
        Look(**wrong)
