"""What is maximized: the log contrast of a window's image, less the guard against event collapse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import CONTRASTS, blur, normalized
from torchcmax.core.draw import NEAREST, Ink, draw
from torchcmax.core.minimize import Objective
from torchcmax.core.model import Model
from torchcmax.core.window import Window

REFERENCES = {"first": 0.0, "middle": 0.5}
ContrastName = Literal["variance", "mean_square", "high_pass", "michelson", "gradient_magnitude"]
SAMPLES = 150  # events that are enough to measure how far a step moves a window


@dataclass(frozen=True)
class Look:
    """How a window is looked at."""

    contrast: ContrastName = "variance"
    """The measure of sharpness."""
    polarity: Literal["dropped", "signed"] = "dropped"
    """dropped: every event votes 1; signed: +1 or -1, eq. (2.1)."""
    reference: Literal["middle", "first"] = "middle"
    """The time that events are warped to. With first, blur rewards collapse."""
    deformation: float = 2.0
    """Factor by which the warp may change an area before the guard against event collapse speaks."""
    guard: float = 10.0
    """Weight of that guard, in log contrast per (log area)^2."""
    tilt: float = 1e-3
    """Weight that holds a plane which the window hardly shows, in log contrast per rad^2 of tilt."""

    def __post_init__(self) -> None:
        for value, names in ((self.contrast, CONTRASTS), (self.polarity, ("dropped", "signed")), (self.reference, REFERENCES)):
            if value not in names:
                raise ValueError(f"{value!r} is none of {', '.join(names)}")

    def at(self, window: Window, canvas: Canvas, sigma: float) -> View:
        """All events of the window on the canvas, blurred by sigma px."""
        weight = window.polarity if self.polarity == "signed" else window.weight
        return View(Ink.of(window, weight, REFERENCES[self.reference]), canvas, sigma)

    def coarsely_at(self, window: Window, canvas: Canvas, sigma: float) -> View:
        """The same for less work: under a blur of sigma px every sigma-th event will do, and pixels of sigma / 2."""
        factor = min(1.0, 2 / sigma) if sigma else 1.0
        return self.at(window.thinned(max(1, int(sigma))), canvas.scaled(factor), sigma * factor)

    def sharpness(self, H_k: Tensor, view: View, owner: Tensor) -> Tensor:
        """Normalized contrast of the image of warped events: H_k [A, K, 3, 3] | owner [A] -> [A]."""
        image = normalized(draw(H_k, view.ink, view.canvas, owner), view.ink.weight[owner])
        return CONTRASTS[self.contrast](blur(image, view.sigma))


@dataclass(frozen=True)
class View:
    """Windows made ready for many warps, where they are drawn, and the blur of the image in canvas px."""

    ink: Ink
    canvas: Canvas
    sigma: float


def deformation(H_k: Tensor, canvas: Canvas, reference: float) -> Tensor:
    """By how much the warp changes areas: log |det| of its Jacobian in five places at both ends of the window, -> [A, 10].

    0 where areas stay; events can only collapse into a line or a point where it goes to minus infinity (Shiba et al. 2022).
    """
    x, y = canvas.centre
    left, right, up, down = (v / canvas.focal for v in (-x / 2, (canvas.size[1] - x) / 2, -y / 2, (canvas.size[0] - y) / 2))
    places = [[0, 0, 1], [left, up, 1], [right, up, 1], [left, down, 1], [right, down, 1]]
    ray = H_k.new_tensor(places).mT
    logs = []
    for end in (-reference, 1 - reference):
        powers = H_k.new_tensor([end**k for k in range(H_k.shape[1])])
        H = (H_k * powers[:, None, None]).sum(1)
        depth = (H[:, 2:] @ ray)[:, 0].clamp_min(NEAREST)
        determinant = torch.linalg.det(H).abs().clamp_min(NEAREST**3)[:, None]
        logs.append(determinant.log() - 3 * depth.log())  # of x -> H x / (H x)_z
    return torch.cat(logs, 1)


def penalty(look: Look, model: Model, x: Tensor, H_k: Tensor, canvas: Canvas) -> Tensor:
    """The guard: nothing until areas change by more than look.deformation; and a weak pull of a free plane to face the camera."""
    if not model.has_plane:  # a turn cannot collapse anything
        return torch.zeros_like(x[:, 0])
    excess = deformation(H_k, canvas, REFERENCES[look.reference]).abs() - torch.tensor(look.deformation).log().item()
    cost = look.guard * excess.clamp_min(0).square().mean(-1)
    return cost + look.tilt * (x[:, 6:] / model.focal).square().sum(-1) if model.free_plane else cost


def objective(look: Look, model: Model, view: View, owner: Tensor) -> Objective:
    """-log contrast + guard, with its gradient, for `minimize`: owner [B] says which window of the view a row belongs to."""

    def evaluate(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        x = x.detach().requires_grad_()
        with torch.enable_grad():
            H_k = model.homography(x, owner[rows], REFERENCES[look.reference])
            contrast = look.sharpness(H_k, view, owner[rows])
            value = penalty(look, model, x, H_k, view.canvas) - contrast.log()
            (gradient,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), gradient

    return evaluate


def metric(look: Look, model: Model, ink: Ink, x: Tensor, owner: Tensor, ridge: float = 1e-3) -> Tensor:
    """Squared length of a step in px of the events' own flow: mean of J^T J over some events, J = d pixel / d x, -> [A, P, P].

    In it one unit moves the events by 1 px rms, and rotation and translation, nearly collinear, come apart. The ridge, a
    share of the mean, gives a length to what moves nothing (the tilt of a plane before which nothing moves yet).
    """
    parameters, every = x.shape[-1], max(1, ink.basis.shape[-1] // SAMPLES)
    basis, weight = ink.basis[..., ::every][owner], ink.weight[..., ::every][owner].abs()
    steps = torch.eye(parameters).to(x)
    nearby = torch.cat([x[:, None] + steps, x[:, None] - steps], 1).flatten(0, 1)  # central differences of one pixel
    H_k = model.homography(nearby, owner.repeat_interleave(2 * parameters), REFERENCES[look.reference])
    flat, basis = H_k.transpose(1, 2).flatten(2), basis.repeat_interleave(2 * parameters, 0)
    ray = (flat[..., None] * basis[:, None]).sum(2)  # no matrix products here, which round differently in another batch
    flow = (ray[:, :2] / ray[:, 2:].clamp_min(NEAREST) * model.focal).view(len(x), 2, parameters, -1)
    J = (flow[:, 0] - flow[:, 1]) / 2 * weight[:, None].repeat(1, 1, 2)
    G = (J[:, :, None] * J[:, None]).sum(-1) / weight.sum(-1).clamp_min(1)[:, None, None]
    mean = G.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(torch.finfo(x.dtype).eps)
    return G + ridge * mean[:, None, None] * torch.eye(parameters).to(x)
