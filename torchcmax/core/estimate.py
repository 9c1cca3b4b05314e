"""From windows of events to their motion: coarse to fine, several starts in one batch, cold or warm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

import torch
from torch import Tensor

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.minimize import Minimum, Stop, minimize
from torchcmax.core.model import Displacement, Model
from torchcmax.core.objective import REFERENCES, Look, View, metric, objective
from torchcmax.core.pose import Motion
from torchcmax.core.window import Window

WIDEST = 32.0  # px: blur beyond it leaves nothing of an image


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
        if not (self.blur and all(0 <= blur <= WIDEST for blur in self.blur) and 0 <= self.start < math.inf and 0 <= self.margin <= 4):
            found = f"blur {self.blur}, start {self.start}, margin {self.margin}"
            raise ValueError(f"a search wants blurs of 0 to {WIDEST} px, a start of at least 0 px, a margin of 0 to 4, got {found}")


@dataclass(frozen=True)
class Estimate:
    """What B windows show.  Motion and normal are in the frame of the camera at the window's first event.

    motion [B] | normal [B, 3], None if the model has no plane | H_k [B, K, 3, 3] warp to the look's reference
    contrast_zero, contrast [B] normalized, at no motion and at this one | iterations, evaluations [B] | converged [B]
    traces: for each round the contrast (less the guard) after each evaluation [B, T], nan after the row's last
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
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        chosen = {name: part[index] for name, part in parts.items() if isinstance(part, Tensor)}
        motion, traces = Motion(self.motion.omega[index], self.motion.velocity[index]), tuple(trace[index] for trace in self.traces)
        return replace(self, **chosen, motion=motion, traces=traces)

    @property
    def gain(self) -> Tensor:
        """Contrast over the contrast at zero motion: [B]."""
        return self.contrast / self.contrast_zero


def estimate(window: Window, camera: Camera, model: Model, look: Look | None = None, search: Search | None = None) -> Estimate:
    """The motion that makes each window sharpest; every window by itself, all in one batch.

    A round begins where the last one ended: the best of the starts after the first, and before the last one both
    decompositions of a free plane.
    """
    if not len(window):
        raise ValueError("estimate wants at least one window, got none")
    look, search = look or Look(), search or Search()
    canvas = Canvas.around(camera, search.margin)
    x = starts(window, model, search.start)
    iterations = evaluations = torch.zeros(len(window), dtype=torch.int64, device=x.device)
    traces = []
    for index, sigma in enumerate(search.blur):
        view = look.coarsely_at(window, canvas, sigma)
        if 0 < index == len(search.blur) - 1:
            x = last_starts(look, model, view, x)
        every = round_of(look, model, view, x, search.stop)
        iterations = iterations + every.iterations.view(len(window), -1).sum(-1)
        evaluations = evaluations + every.evaluations.view(len(window), -1).sum(-1)
        found = best_of(every, len(window))
        traces.append((-found.trace).exp())
        x = found.x
    found = replace(found, iterations=iterations, evaluations=evaluations)
    result = _report(window, model, look, look.at(window, canvas, search.blur[-1]), found)
    return replace(result, traces=tuple(traces))


def starts(window: Window, model: Model, far: float) -> Tensor:
    """Where each window's search begins: at rest, and with a displacement to four sides: -> [B * S, P] px."""
    sides = [[0, 0, 0], [far, 0, 0], [-far, 0, 0], [0, far, 0], [0, -far, 0]] if far > 0 else [[0, 0, 0]]
    x = window.ray.new_zeros(len(sides), model.size)
    x[:, :3] = x.new_tensor(sides)  # of a turn or of a shift, whichever the model has first: both move the image
    return x.repeat(len(window), 1)


def last_starts(look: Look, model: Model, view: View, x: Tensor) -> Tensor:
    """What the coarse rounds found, or rest where rest is sharper (they see fewer events); and the twin of a free plane.

    x [B, P] -> [B * C, P] with C = 2 candidates for each window, of models with a free plane, or 1.
    """
    owner, reference = torch.arange(len(x), device=x.device), REFERENCES[look.reference]
    with torch.no_grad():
        here, rest = (look.sharpness(model.homography(p, owner, reference), view, owner) for p in (x, torch.zeros_like(x)))
    x = torch.where((here > rest)[:, None], x, 0.0)
    if not model.free_plane:
        return x
    twin = model.displacement(x, owner).seen_at(reference).twin().seen_at(-reference)
    return torch.stack([x, model.parameters(twin)], 1).flatten(0, 1)


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


def _report(window: Window, model: Model, look: Look, view: View, found: Minimum) -> Estimate:
    """The last minimum of every window, in units that people read, with the contrast that all its events have."""
    owner = torch.arange(len(window), device=found.x.device)
    x = torch.where((window.duration > 0)[:, None], found.x, 0.0)  # events that come all at once show no motion
    with torch.no_grad():
        H_k, H_zero = (model.homography(p, owner, REFERENCES[look.reference]) for p in (x, torch.zeros_like(x)))
        contrast, zero = (look.sharpness(H, view, owner) for H in (H_k, H_zero))
        displacement = model.displacement(x, owner)
    return Estimate(
        motion=rates(displacement, window),
        normal=displacement.normal if model.has_plane else None,
        H_k=H_k,
        contrast_zero=zero,
        contrast=contrast,
        iterations=found.iterations,
        evaluations=found.evaluations,
        converged=found.converged & (window.duration > 0),
        traces=(),
    )
