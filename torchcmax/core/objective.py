"""What is maximized: the log contrast of a window's image, less the guard against event collapse."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from torchcmax import kernels
from torchcmax.core.camera import NEAREST, Canvas
from torchcmax.core.contrast import CONTRASTS, blur, normalized
from torchcmax.core.draw import Ink, draw
from torchcmax.core.minimize import Minimum, Objective, Stop, minimize
from torchcmax.core.model import CLOSEST, Displacement, Model, Planar, PlanarKnown, Rotation, Translation
from torchcmax.core.warp import TERMS, monomials
from torchcmax.core.window import Window

REFERENCES = {"first": 0.0, "middle": 0.5}
ContrastName = Literal["variance", "mean_square", "high_pass", "michelson", "gradient_magnitude"]
SAMPLES = 150  # events that are enough to measure how far a step moves a window, and to watch over it
RIDGE = 1e-3  # of the metric, as a share of its mean
GRAZING = 0.05  # sine of the flattest angle at which an event can see its plane


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
        if not (self.deformation > 1 and 0 <= self.guard < math.inf and 0 <= self.tilt < math.inf):
            found = f"deformation {self.deformation}, guard {self.guard}, tilt {self.tilt}"
            raise ValueError(f"a look wants a deformation above 1 and weights of at least 0, got {found}")

    def at(self, window: Window, canvas: Canvas, sigma: float) -> View:
        """All events of the window on the canvas, blurred by sigma px."""
        weight = window.polarity if self.polarity == "signed" else window.weight
        ink = Ink.of(window, weight, REFERENCES[self.reference])
        return View(ink, canvas, sigma, ink.sample(SAMPLES))

    def sharpness(self, H_k: Tensor, view: View, owner: Tensor) -> Tensor:
        """Normalized contrast of the image of warped events: H_k [A, K, 3, 3] | owner [A] -> [A]."""
        kernel = kernels.searching(view.ink.x, view.canvas)
        if kernel is not None and not H_k.requires_grad and self.contrast in kernel.CONTRASTS:
            values: Tensor = kernel.sharpness(H_k, view, owner, self.contrast)
            return values
        image = normalized(draw(H_k, view.ink, view.canvas, owner), view.ink.weight[owner])
        return CONTRASTS[self.contrast](blur(image, view.sigma))


@dataclass(frozen=True)
class View:
    """Windows made ready for many warps, where they are drawn, the blur of the image in canvas px, and a few of the events.

    some: enough of them to measure how far a step moves a window, and to watch over it
    """

    ink: Ink
    canvas: Canvas
    sigma: float
    some: Ink

    def __getitem__(self, index: Tensor) -> View:
        """Some of the windows."""
        return View(self.ink[index], self.canvas, self.sigma, self.some[index])

    def blurred(self, sigma: float) -> View:
        """Looked at through a blur of sigma px, for less work: every sigma-th event will do, and pixels of sigma px."""
        factor = max(1.0, sigma)
        return View(self.ink.thinned(int(factor)), self.canvas.scaled(1 / factor), sigma / factor, self.some)


def deformation(there: Displacement, H_k: Tensor, ray: Tensor, reference: float) -> Tensor:
    """By how much the warp changes areas: log |det| of its Jacobian at rays [A, 3, M] at both ends of the window, -> [A, 2M].

    0 where areas stay; events can only collapse into a line or a point where it goes to minus infinity (Shiba et al. 2022).
    The Jacobian of x -> H x / (H x)_z has the determinant det H / (H x)_z^3, and det H is the square of the distance to the plane.
    """
    logs = []
    for end in (-reference, 1 - reference):
        distance = 1 + end * (there.normal * there.shift).sum(-1, keepdim=True)  # below zero the camera is behind the plane
        row = H_k[:, -1, 2]
        for k in range(H_k.shape[1] - 2, -1, -1):
            row = row * end + H_k[:, k, 2]
        depth = (row[..., None] * ray).sum(1)
        logs.append(2 * distance.clamp_min(NEAREST).log() - 3 * depth.clamp_min(NEAREST).log())
    return torch.cat(logs, 1)


def penalty(look: Look, model: Model, there: Displacement, H_k: Tensor, ray: Tensor) -> Tensor:
    """The guard, at rays [A, 3, M] of some events: nothing until areas change by more than look.deformation, -> [A].

    A free plane must face all the events, which it cannot have shown otherwise, and is pulled weakly towards the camera.
    """
    if not model.has_plane:  # a turn cannot collapse anything
        return torch.zeros_like(there.turn[:, 0])
    excess = deformation(there, H_k, ray, REFERENCES[look.reference]).abs() - math.log(look.deformation)
    cost = look.guard * excess.clamp_min(0).square().mean(-1)
    if not model.free_plane:
        return cost
    away = ((there.normal[:, :, None] * ray).sum(1).amax(-1) + GRAZING).clamp_min(0)
    tilted = 2 * (1 + there.normal[:, 2])  # the square of a small tilt
    return cost + look.guard * away.square() + look.tilt * tilted


def objective(look: Look, model: Model, view: View, owner: Tensor) -> Objective:
    """-log contrast + guard, with its gradient, for `minimize`: owner [B] says which window of the view a row belongs to.

    Parameters are meant to be float64, whatever the images are: twelve numbers cost nothing, and the search is that of the kernels.
    """
    numbers, kernel = problem(look, model, view), kernels.searching(view.ink.x, view.canvas)
    if numbers is not None and kernel is not None:
        return lambda x, rows: kernel.evaluate(numbers, x, owner[rows])
    ray = view.some.ray.double()

    def evaluate(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        x = x.detach().requires_grad_()
        with torch.enable_grad():
            there = model.at_reference(x, owner[rows], REFERENCES[look.reference])
            H_k = there.homography()
            contrast = look.sharpness(H_k.to(view.ink.x), view, owner[rows])
            value = penalty(look, model, there, H_k, ray[owner[rows]]) - contrast.to(x).log()
            (gradient,) = torch.autograd.grad(value.sum(), x)
        return value.detach().to(contrast), gradient

    return evaluate


def metric(look: Look, model: Model, some: Ink, x: Tensor, owner: Tensor) -> Tensor:
    """Squared length of a step in px of the events' own flow: mean of J^T J over `some` events, J = d pixel / d x, -> [A, P, P].

    In it one unit moves the events by 1 px rms, and rotation and translation, nearly collinear, come apart. The ridge gives a
    length to what moves nothing (the tilt of a plane before which nothing moves yet).
    """
    parameters, events = x.shape[-1], some.x.shape[-1]
    steps = torch.eye(parameters, dtype=x.dtype, device=x.device)
    nearby = torch.cat([x[:, None] + steps, x[:, None] - steps], 1).flatten(0, 1)  # central differences of one pixel
    each = owner.repeat_interleave(2 * parameters)
    flat = model.homography(nearby, each, REFERENCES[look.reference]).transpose(1, 2).flatten(2)
    basis = monomials(some.ray.mT, some.s).to(x)
    ray = (flat[..., None] * basis[each][:, None]).sum(2)  # no matrix products here, which round differently in another batch
    flow = (ray[:, :2] / ray[:, 2:].clamp_min(NEAREST) * model.focal).view(len(x), 2, parameters, -1)
    J = (flow[:, 0] - flow[:, 1]) / 2 * (some.weight[owner] != 0).to(x)[:, None].repeat(1, 1, 2)
    G = (J[:, :, None] * J[:, None]).sum(-1) / events
    mean = G.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(torch.finfo(x.dtype).eps)
    return G + RIDGE * mean[:, None, None] * steps


IN_MACHINE_CODE = (Rotation, Translation, PlanarKnown, Planar)  # in the order of kernels/motion.py


def problem(look: Look, model: Model, view: View) -> Any:
    """What the kernels of this device want for the same objective; None where there is no kernel, or something is someone's own."""
    kernel = kernels.searching(view.ink.x, view.canvas)
    if kernel is None or type(model) not in IN_MACHINE_CODE or type(look) is not Look or look.contrast not in kernel.CONTRASTS:
        return None
    sought = kernel.Look(
        model=IN_MACHINE_CODE.index(type(model)), focal=float(model.focal), reference=REFERENCES[look.reference],
        contrast=kernel.CONTRASTS.index(look.contrast), deformation=float(look.deformation), guard=float(look.guard), tilt=float(look.tilt),
        closest=CLOSEST, grazing=GRAZING, nearest=NEAREST, ridge=RIDGE,
    )  # fmt: skip
    known = model.wall(view.ink.x, torch.arange(len(view.ink.x)))
    return kernel.Problem(view, known, sought, TERMS)


def minimum(look: Look, model: Model, view: View, owner: Tensor) -> Callable[[Tensor, Stop | None], Minimum]:
    """The way to the minimum of `objective` from x [B, P], measured by `metric`: in machine code where there is some for it."""
    numbers, kernel = problem(look, model, view), kernels.searching(view.ink.x, view.canvas)
    if numbers is None or kernel is None:
        return lambda x, stop: minimize(objective(look, model, view, owner), x, metric(look, model, view.some, x, owner), stop)
    return lambda x, stop: Minimum(*kernel.search(numbers, x, owner, stop or Stop()))
