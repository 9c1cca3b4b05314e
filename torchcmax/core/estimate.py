"""From windows of events to their motion: coarse to fine, several starts in one batch, cold or warm."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import torch
from torch import Tensor

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.minimize import Minimum, Stop, minimize
from torchcmax.core.model import Displacement, Model
from torchcmax.core.objective import REFERENCES, Look, View, metric, objective
from torchcmax.core.pose import Motion
from torchcmax.core.window import Window


@dataclass(frozen=True)
class Search:
    """How the sharpest image is searched for."""

    blur: tuple[float, ...] = (4.0, 2.0, 1.0)
    """Gaussian blur in px, one round each, coarse to fine; a round with blur b takes every b-th event."""
    start: float = 0.0
    """px: besides at rest, begin with this displacement right, left, down and up; 0: at rest alone."""
    margin: float = 0.25
    """Of the canvas on each side, as a share of the sensor's size."""
    stop: Stop = field(default_factory=Stop)
    """When a round ends."""

    def __post_init__(self) -> None:
        if not self.blur or min(self.blur) < 0 or self.start < 0 or self.margin < 0:
            found = f"blur {self.blur}, start {self.start}, margin {self.margin}"
            raise ValueError(f"a search wants at least one blur, and nothing negative, got {found}")


@dataclass(frozen=True)
class Estimate:
    """What B windows show.  Motion and normal are in the frame of the camera at the window's first event.

    motion [B] | normal [B, 3], None if the model has no plane | H_k [B, K, 3, 3] warp to the look's reference
    contrast_zero, contrast [B] normalized, at no motion and at this one | iterations, evaluations [B] | converged [B]
    traces: for each round the contrast after each evaluation [B, T]
    """

    motion: Motion
    normal: Tensor | None
    H_k: Tensor
    contrast_zero: Tensor
    contrast: Tensor
    iterations: Tensor
    evaluations: Tensor
    converged: Tensor
    traces: tuple[Tensor, ...]

    def __getitem__(self, index: Tensor) -> Estimate:
        """Some of the windows."""
        motion = Motion(self.motion.omega[index], self.motion.velocity[index])
        normal, traces = None if self.normal is None else self.normal[index], tuple(trace[index] for trace in self.traces)
        numbers = (self.H_k, self.contrast_zero, self.contrast, self.iterations, self.evaluations, self.converged)
        H_k, zero, contrast, iterations, evaluations, converged = (number[index] for number in numbers)
        return Estimate(motion, normal, H_k, zero, contrast, iterations, evaluations, converged, traces)

    @property
    def gain(self) -> Tensor:
        """Contrast over the contrast at zero motion: [B]."""
        return self.contrast / self.contrast_zero


def estimate(window: Window, camera: Camera, model: Model, look: Look | None = None, search: Search | None = None) -> Estimate:
    """The motion that makes each window sharpest; every window by itself, all in one batch.

    A round begins where the last one ended: the best of the starts after the first, and before the last one both
    decompositions of a free plane.
    """
    look, search = look or Look(), search or Search()
    canvas = Canvas.around(camera, search.margin)
    x = starts(window, model, search.start)
    iterations = evaluations = torch.zeros(len(window), dtype=torch.int64, device=x.device)
    traces = []
    for index, sigma in enumerate(search.blur):
        if model.free_plane and index == len(search.blur) - 1:
            x = with_twins(x, model, REFERENCES[look.reference])
        every = round_of(look, model, look.coarsely_at(window, canvas, sigma), x, search.stop)
        iterations = iterations + every.iterations.view(len(window), -1).sum(-1)
        evaluations = evaluations + every.evaluations.view(len(window), -1).sum(-1)
        found = best_of(every, len(window))
        traces.append((-found.trace).exp())
        x = found.x
    found = replace(found, iterations=iterations, evaluations=evaluations)
    return _report(window, model, look, look.at(window, canvas, search.blur[-1]), found, tuple(traces))


def starts(window: Window, model: Model, far: float) -> Tensor:
    """Where each window's search begins: at rest, and with a displacement to four sides: -> [B * S, P] px."""
    sides = [[0, 0, 0], [far, 0, 0], [-far, 0, 0], [0, far, 0], [0, -far, 0]] if far > 0 else [[0, 0, 0]]
    x = window.ray.new_zeros(len(sides), model.size)
    x[:, :3] = x.new_tensor(sides)  # of a turn or of a shift, whichever the model has first: both move the image
    return x.repeat(len(window), 1)


def with_twins(x: Tensor, model: Model, reference: float) -> Tensor:
    """Each row followed by the other decomposition of its plane: x [B, P] -> [B * 2, P]."""
    here = model.displacement(x, torch.arange(len(x), device=x.device)).seen_at(reference)
    return torch.stack([x, model.parameters(here.twin().seen_at(-reference))], 1).flatten(0, 1)


def round_of(look: Look, model: Model, view: View, x: Tensor, stop: Stop | None = None) -> Minimum:
    """One round of the search, from C candidates for each window of the view: x [B * C, P]."""
    windows = len(view.ink.weight)
    owner = torch.arange(windows, device=x.device).repeat_interleave(len(x) // windows)
    return minimize(objective(look, model, view, owner), x, metric(look, model, view.ink, x, owner), stop)


def best_of(every: Minimum, windows: int) -> Minimum:
    """The lowest of each window's candidates: B * C rows -> B rows."""
    value = every.value.view(windows, -1).nan_to_num(torch.inf)
    best = value.argmin(-1) + value.shape[1] * torch.arange(windows, device=value.device)
    return Minimum(*(getattr(every, f.name)[best] for f in fields(every)))


def rates(displacement: Displacement, window: Window) -> Motion:
    """Displacement over the window -> rad/s and plane distances/s; nothing where the window has no duration."""
    per_second = torch.where(window.duration > 0, 1 / torch.where(window.duration > 0, window.duration, 1.0), 0.0)[:, None]
    return Motion(displacement.turn * per_second, displacement.shift * per_second)


def _report(window: Window, model: Model, look: Look, view: View, found: Minimum, traces: tuple[Tensor, ...]) -> Estimate:
    """The last minimum of every window, in units that people read, with the contrast that all its events have."""
    owner = torch.arange(len(window), device=found.x.device)
    with torch.no_grad():
        H_k, H_zero = (model.homography(x, owner, REFERENCES[look.reference]) for x in (found.x, torch.zeros_like(found.x)))
        contrast, zero = (look.sharpness(H, view, owner) for H in (H_k, H_zero))
        displacement = model.displacement(found.x, owner)
    return Estimate(
        motion=rates(displacement, window),
        normal=displacement.normal if model.has_plane else None,
        H_k=H_k,
        contrast_zero=zero,
        contrast=contrast,
        iterations=found.iterations,
        evaluations=found.evaluations,
        converged=found.converged & (window.duration > 0),
        traces=traces,
    )
