"""From windows of events to their motion: coarse to fine, several starts in one batch, cold or warm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

import torch
from torch import Tensor

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.minimize import Minimum, Stop
from torchcmax.core.model import Displacement, Model
from torchcmax.core.objective import REFERENCES, Look, View, minimum
from torchcmax.core.pose import Motion
from torchcmax.core.warp import TERMS, still
from torchcmax.core.window import Window

COARSE = 4.0  # a blurred round is done when a step is shorter than so many tolerances for each px of blur
WIDEST = 32.0  # px: blur beyond it leaves nothing of an image


@dataclass(frozen=True)
class Search:
    """How the sharpest image is searched for."""

    blur: tuple[float, ...] = (4.0, 2.0, 1.0)
    """Gaussian blur in px, one round each, coarse to fine; with blur b every b-th event and pixel are taken, in the last round all."""
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

    def displacement(self, window: Window) -> Displacement:
        """The motion over each of these windows, or of others that are as long; a fronto-parallel plane where none was estimated."""
        wall = torch.zeros_like(self.motion.omega)
        wall[:, 2] = -1
        seconds = window.duration[:, None]
        return Displacement(self.motion.omega * seconds, self.motion.velocity * seconds, wall if self.normal is None else self.normal)

    @property
    def gain(self) -> Tensor:
        """Contrast over the contrast at zero motion: [B]."""
        return self.contrast / self.contrast_zero


def estimate(window: Window, camera: Camera, model: Model, look: Look | None = None, search: Search | None = None) -> Estimate:
    """The motion that makes each window sharpest; every window by itself, all in one batch.

    With `model.start` it begins there, and one round with little blur, Search((1.0,)), is enough after a window like this one.
    A round begins where the last one ended: the best of the starts after the first, and before the last one both
    decompositions of a free plane.  What is not sharper than no motion is searched for again from there.
    """
    if not len(window):
        raise ValueError("estimate wants at least one window, got none")
    look, search = look or Look(), search or Search()
    view = look.at(window, Canvas.around(camera, search.margin), search.blur[-1])
    owner = torch.arange(len(window), device=window.ray.device)
    zero = look.sharpness(still(window.ray.new_empty(len(window), TERMS, 3, 3)), view, owner)
    x, rounds = starts(window, model, search.start), []
    for sigma in search.blur[:-1]:
        stop = replace(search.stop, tolerance=search.stop.tolerance * max(1.0, COARSE * sigma))
        rounds.append(best_of(round_of(look, model, view.blurred(sigma), x, stop), len(window)))
        x = rounds[-1].x
    found = best_of(round_of(look, model, view, with_twin(model, look, x), search.stop), len(window))
    worse = (~(found.value <= -zero.log())).nonzero()[:, 0]
    if len(worse):
        part = replace(model, start=None, normal=None if model.normal is None else model.normal[worse])
        found = _mended(found, worse, round_of(look, part, view[worse], torch.zeros_like(x[worse]), search.stop))
    return _report(window, model, look, view, [*rounds, found], zero)


def starts(window: Window, model: Model, far: float) -> Tensor:
    """Where searches begin: at the model's start, else at rest and displaced to four sides: -> [B * S, P] px, float64."""
    if model.start is not None:
        if model.start.shape != (len(window), model.size):
            raise ValueError(f"a start wants [W, P] = {[len(window), model.size]}, got {[*model.start.shape]}")
        return model.start.to(window.ray.device, torch.float64)
    sides = [[0, 0, 0], [far, 0, 0], [-far, 0, 0], [0, far, 0], [0, -far, 0]] if far > 0 else [[0, 0, 0]]
    x = torch.zeros(len(sides), model.size, dtype=torch.float64, device=window.ray.device)
    x[:, :3] = x.new_tensor(sides)  # of a turn or of a shift, whichever the model has first: both move the image
    return x.repeat(len(window), 1)


def with_twin(model: Model, look: Look, x: Tensor) -> Tensor:
    """What the coarse rounds found, and of a free plane its other decomposition: x [B, P] -> [B * C, P], C = 1 or 2."""
    if not model.free_plane:
        return x
    owner, reference = torch.arange(len(x), device=x.device), REFERENCES[look.reference]
    twin = model.displacement(x, owner).seen_at(reference).twin().seen_at(-reference)
    return torch.stack([x, model.parameters(twin)], 1).flatten(0, 1)


def round_of(look: Look, model: Model, view: View, x: Tensor, stop: Stop | None = None) -> Minimum:
    """One round of the search, from C candidates for each window of the view: x [B * C, P]."""
    windows = len(view.ink.weight)
    owner = torch.arange(windows, device=x.device).repeat_interleave(len(x) // windows)
    return minimum(look, model, view, owner)(x, stop)


def best_of(every: Minimum, windows: int) -> Minimum:
    """The lowest of each window's candidates, with the work of all: B * C rows -> B rows."""
    if len(every.x) == windows:
        return every
    value = every.value.view(windows, -1).nan_to_num(torch.inf)
    best = value.argmin(-1) + value.shape[1] * torch.arange(windows, device=value.device)
    found = Minimum(*(getattr(every, f.name)[best] for f in fields(every)))
    iterations, evaluations = (n.view(windows, -1).sum(-1) for n in (every.iterations, every.evaluations))
    return replace(found, iterations=iterations, evaluations=evaluations)


def _mended(found: Minimum, rows: Tensor, again: Minimum) -> Minimum:
    """Some rows searched for once more; the work of both counts, the trace is that of the first."""
    iterations, evaluations = found.iterations.clone(), found.evaluations.clone()
    iterations[rows] += again.iterations
    evaluations[rows] += again.evaluations
    x, value, converged = (getattr(found, n).index_copy(0, rows, getattr(again, n)) for n in ("x", "value", "converged"))
    return replace(found, x=x, value=value, converged=converged, iterations=iterations, evaluations=evaluations)


def rates(displacement: Displacement, window: Window) -> Motion:
    """Displacement over the window -> rad/s and plane distances/s; nothing where the window has no duration."""
    per_second = torch.where(window.duration > 0, 1 / torch.where(window.duration > 0, window.duration, 1.0), 0.0)[:, None]
    return Motion(*((moved * per_second).to(per_second) for moved in (displacement.turn, displacement.shift)))


def _report(window: Window, model: Model, look: Look, view: View, rounds: list[Minimum], zero: Tensor) -> Estimate:
    """The last minimum of every window, in units that people read, with the contrast that all its events have."""
    found, seen = rounds[-1], window.duration > 0  # events that come all at once show no motion
    owner, reference = torch.arange(len(window), device=zero.device), REFERENCES[look.reference]
    x = torch.where(seen[:, None], found.x, 0.0)
    H_k = model.homography(x, owner, reference).to(zero)
    displacement = model.displacement(x, owner)
    return Estimate(
        motion=rates(displacement, window),
        normal=displacement.normal.to(zero) if model.has_plane else None,
        H_k=H_k,
        contrast_zero=zero,
        contrast=look.sharpness(H_k, view, owner),
        iterations=torch.stack([r.iterations for r in rounds]).sum(0),
        evaluations=torch.stack([r.evaluations for r in rounds]).sum(0),
        converged=found.converged & seen,
        traces=tuple((-r.trace).exp().to(zero) for r in rounds),
    )
