"""The whole estimator as a layer: windows in, their motion out, with gradients through the optimum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import Module

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.contrast import CONTRASTS, blur, normalized
from torchcmax.core.estimate import Estimate, Search, estimate, rates
from torchcmax.core.model import MODELS, Displacement, Model, PlanarKnown
from torchcmax.core.objective import REFERENCES, Look, penalty
from torchcmax.core.window import Window
from torchcmax.nn.image import images
from torchcmax.nn.loss import watched

FLATTEST = 1e-3  # smallest curvature that is divided by, as a share of the largest
STEP = 0.7  # px of displacement over the window, of central differences
Value = Callable[[Tensor, Tensor | None, Tensor | None], Tensor]  # x [B, P], weight, normal -> the objective [B]


@dataclass(frozen=True)
class Compensated:
    """omega [B, 3] rad/s | velocity [B, 3] plane distances/s | normal [B, 3], None where the model has no plane

    H_k [B, K, 3, 3] to the look's reference | estimate: all that the search tells, without gradients
    """

    omega: Tensor
    velocity: Tensor
    normal: Tensor | None
    H_k: Tensor
    estimate: Estimate


class Compensate(Module):
    """The motion that makes each window sharpest, as `core.estimate` finds it, differentiable to events' weights and the known plane.

    At the optimum the gradient of the objective f(x, p) to the motion x vanishes, whatever the inputs p are; so
    dx/dp = -(d2f/dx2)^-1 d2f/dx dp (implicit function theorem): no step of the search is remembered, and the way back costs some 2 P + 2
    evaluations by plain operations in float64, P the numbers of the model.  Where the objective hardly curves (what the events do not
    decide), its curvature is held at FLATTEST of the largest, so that gradients stay finite.

    model: rotation, translation, or planar: before a plane whose normal is given to `forward`, or is estimated too
    gradients: implicit, or detached: none, and nothing more than the search is computed
    """

    def __init__(
        self,
        camera: Camera,
        model: Literal["rotation", "translation", "planar"] = "rotation",
        look: Look | None = None,
        search: Search | None = None,
        gradients: Literal["implicit", "detached"] = "implicit",
    ) -> None:
        super().__init__()
        if model not in MODELS or gradients not in ("implicit", "detached"):
            raise ValueError(f"model wants one of {', '.join(MODELS)}, gradients implicit or detached, got {model!r} and {gradients!r}")
        self.camera, self.model, self.look, self.search = camera, model, look or Look(), search or Search()
        self.gradients = gradients

    def forward(
        self, window: Window, weight: Tensor | None = None, normal: Tensor | None = None, start: Tensor | None = None
    ) -> Compensated:
        """Windows [B, N] -> their motion in the frame of the camera at the window's first event.

        weight [B, N]: what each event counts, of at least 0, by default 1 | normal [B, 3]: the known plane, unit, towards the camera
        start [B, 3] rad/s: where the search of a rotation begins, as a network may tell; then one round at the last blur is enough
        """
        with torch.autocast(window.ray.device.type, enabled=False):
            return self._found(window, weight, normal, start)

    def _found(self, window: Window, weight: Tensor | None, normal: Tensor | None, start: Tensor | None) -> Compensated:
        like, search = window.ray, self.search
        inputs = [part for part in (weight, normal) if part is not None and part.requires_grad]
        for name, part, wanted in (("weight", weight, window.polarity.shape), ("normal", normal, (len(like), 3))):
            if part is not None and part.shape != wanted:
                raise ValueError(f"{name} wants {[*wanted]}, got {[*part.shape]}")
        counted = window if weight is None else replace(window, polarity=window.polarity.to(like) * weight.detach().to(like))
        known = PlanarKnown if self.model == "planar" and normal is not None else MODELS[self.model]
        model = known((self.camera.fx * self.camera.fy) ** 0.5, None if normal is None else normal.detach())
        if start is not None:
            if self.model != "rotation":
                raise ValueError("a start is of a rotation")
            begin = Displacement(start.detach() * window.duration[:, None], torch.zeros_like(start), torch.zeros_like(start))
            model, search = replace(model, start=model.parameters(begin)), replace(search, blur=search.blur[-1:])
        with torch.no_grad():
            found = estimate(counted, self.camera, model, self.look, search)
        x = model.parameters(found.displacement(window)).double()
        if inputs and self.gradients == "implicit":
            double = [None if part is None else part.double() for part in (weight, normal)]
            x = _Optimum.apply(x, *double, lambda x, weight, normal: self._value(window, weight, normal, model, x))
        if normal is not None:
            model = replace(model, normal=normal.to(like.device, torch.float64))
        owner = torch.arange(len(window), device=like.device)
        there = model.displacement(x, owner)
        motion = rates(there, window)
        H_k = model.homography(x, owner, REFERENCES[self.look.reference]).to(like)
        return Compensated(motion.omega.to(like), motion.velocity.to(like), there.normal.to(like) if model.has_plane else None, H_k, found)

    def _value(self, window: Window, weight: Tensor | None, normal: Tensor | None, model: Model, x: Tensor) -> Tensor:
        """The objective of the last round at x [B, P], by plain operations in float64: [B]."""
        double = window.to(window.ray.device, torch.float64)
        counts = double.polarity if self.look.polarity == "signed" else double.weight
        counts = counts if weight is None else counts * weight
        some = (counts != 0).any(1)
        ray = watched(window.to(window.ray.device, torch.float64), counts.detach()[:, None])[0]
        counts = torch.where(some[:, None], counts, 1.0)
        reference, owner = REFERENCES[self.look.reference], torch.arange(len(x), device=x.device)
        there = (model if normal is None else replace(model, normal=normal)).at_reference(x, owner, reference)
        H_k = there.homography()
        image = images(H_k, double, counts[:, None], reference, Canvas.around(self.camera, self.search.margin))[:, 0]
        contrast = CONTRASTS[self.look.contrast](blur(normalized(image, counts), self.search.blur[-1]))
        return torch.where(some, penalty(self.look, model, there, H_k, ray) - contrast.log(), 0.0)


class _Optimum(torch.autograd.Function):
    """The optimum x [B, P] of `value` (x, weight, normal), with its gradients to weight and normal.

    Bilinear votes are straight lines between kinks, in which all of the objective's curvature lies: second derivatives at a point would
    be wrong, so those here are central differences over about a pixel of first ones.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor | None, normal: Tensor | None, value: Value) -> Tensor:
        ctx.save_for_backward(x, weight, normal)
        ctx.value = value
        return x.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, normal = ctx.saved_tensors
        steps = STEP * torch.eye(x.shape[1]).to(x)
        rows = [_slope(ctx.value, x + step, weight, normal) - _slope(ctx.value, x - step, weight, normal) for step in steps]
        curvature = torch.stack(rows, 1) / (2 * STEP)
        decided = curvature.isfinite().all(-1).all(-1) & (curvature != 0).any(-1).any(-1)  # not so of a window without events
        curvature = torch.where(decided[:, None, None], curvature, torch.eye(x.shape[1]).to(x))
        L, Q = torch.linalg.eigh((curvature + curvature.mT) / 2)
        L = L.clamp_min(FLATTEST * L.abs().amax(-1, keepdim=True)).clamp_min(torch.finfo(L.dtype).tiny)
        along = -(Q @ ((Q.mT @ upstream[..., None]) / L[..., None]))[..., 0]
        length = along.norm(dim=-1, keepdim=True)
        side = STEP * along / torch.where(length > 0, length, 1.0)
        inputs = [None if part is None else part.detach().requires_grad_() for part in (weight, normal)]
        asked = [part for part in inputs if part is not None]
        with torch.enable_grad():
            change = (ctx.value(x + side, *inputs) - ctx.value(x - side, *inputs)) / (2 * STEP) * length[:, 0]
            found = iter(torch.autograd.grad(change.sum(), asked))
        return None, *(None if part is None else next(found) for part in inputs), None


def _slope(value: Value, x: Tensor, weight: Tensor | None, normal: Tensor | None) -> Tensor:
    """The first derivative of the objective to x: [B, P]."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        slope: Tensor = torch.autograd.grad(value(x, weight, normal).sum(), x)[0]
    return slope
