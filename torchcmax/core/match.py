"""Match a window to a map: look its warped events up in the map's texture; least squares, with a prior that has memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcmax import kernels
from torchcmax.core.camera import NEAREST, Canvas
from torchcmax.core.contrast import variance
from torchcmax.core.draw import Ink, draw
from torchcmax.core.minimize import Stop, minimize
from torchcmax.core.objective import RIDGE
from torchcmax.core.plane import Plane
from torchcmax.core.state import CLOSEST, SIZE, State
from torchcmax.core.warp import TERMS

NUMBERS = SIZE + 2  # of a step: a state's, and two by which the plane's normal tilts
COARSE = 1.0  # a search on a blurred map is done when a step is shorter than so many tolerances for each px of blur
LEAST = 0.05  # strength: keeps the expected curvature finite where nothing was found
STEP = 1e-3  # px: of the central differences of the homography, which is smooth and in float64


@dataclass(frozen=True)
class Matching:
    """How a window is matched to the map."""

    objective: Literal["lookup", "variance"] = "lookup"
    """lookup: how strong an edge each event meets; variance: of window and map drawn together, as in the thesis."""
    refine: Literal["full", "motion"] = "full"
    """full: pose and motion; motion: angular velocity and velocity alone, from the pose at the window's start, as in the thesis."""
    weight: float = 0.3
    """Of one event against the prior: information of T - T^2/2; neighbouring events are not independent."""
    every: int = 2
    """Every so-manieth event is looked up, with as much more weight."""
    stop: Stop = field(default_factory=lambda: Stop(tolerance=0.02, iterations=12, longest=5.0))
    """When it is done, px of the events' motion on the map."""

    def __post_init__(self) -> None:
        for value, known in ((self.objective, ("lookup", "variance")), (self.refine, ("full", "motion"))):
            if value not in known:
                raise ValueError(f"{value!r} is none of {', '.join(known)}")
        if not (self.weight > 0 and self.every >= 1):
            raise ValueError(f"matching wants a weight above 0 and every of at least 1, got {self.weight}, {self.every}")

    def coarse(self, sigma: float) -> Matching:
        """For a map that is blurred by sigma px, from which another search goes on."""
        return replace(self, stop=replace(self.stop, tolerance=self.stop.tolerance * max(1.0, COARSE * sigma)))


@dataclass(frozen=True)
class Chart:
    """The dense part of a map around a camera.  texture [B, H, W] 0..1 on the plane seen by `view` [B, 3, 3] from the world's origin.

    corner [B, 2] px: where on the map the middle of the first pixel is | focal px per unit tangent
    Where B is 1, it serves any number of windows.
    """

    texture: Tensor
    corner: Tensor
    view: Tensor
    focal: float

    @cached_property
    def frame(self) -> Tensor:
        """The texture with a border of nothing, as the kernels want it: [B, H + 2, W + 2]."""
        return pad(self.texture, (1, 1, 1, 1))

    def __getitem__(self, rows: Tensor) -> Chart:
        """Those of some of the windows."""
        return self if len(self.texture) == 1 else Chart(self.texture[rows], self.corner[rows], self.view[rows], self.focal)

    def filled(self, images: Sequence[Tensor]) -> Tensor:
        """Images of the parts that were joined, [h, w] each, as large as the texture: [B, H, W]."""
        height, width = self.texture.shape[1:]
        return torch.stack([pad(image, (0, width - image.shape[1], 0, height - image.shape[0])) for image in images])

    @classmethod
    def join(cls, parts: Sequence[Chart]) -> Chart:
        """Several cameras' together, the smaller ones padded with nothing."""
        height, width = (max(p.texture.shape[i] for p in parts) for i in (1, 2))
        if len(parts) == 1:
            return parts[0]
        grown = [pad(p.texture, (0, width - p.texture.shape[2], 0, height - p.texture.shape[1])) for p in parts]
        return cls(torch.cat(grown), torch.cat([p.corner for p in parts]), torch.cat([p.view for p in parts]), parts[0].focal)


@dataclass(frozen=True)
class Match:
    """Where windows match the map, and how well.

    state [B], x [B, 14] px: the way to it | cost [B], its slope [B, 14] there | strength [B]: mean T of the events
    information [B, 14, 14] that the events gave, per px^2, at the start of the search | evaluations, converged [B]
    """

    state: State
    x: Tensor
    cost: Tensor
    slope: Tensor
    information: Tensor
    strength: Tensor
    evaluations: Tensor
    converged: Tensor


def loosely(pose: float, motion: float) -> Tensor:
    """A prior [14, 14] for `Task`: the pose and the motion go so many px, one sigma; of the plane's tilt nothing is said."""
    return torch.tensor([pose**-2] * 6 + [motion**-2] * 6 + [0.0] * (NUMBERS - SIZE), dtype=torch.float64).diag()


def units(state: State, plane: Plane, seconds: Tensor, focal: float) -> Tensor:
    """What moves the image by about one px, of each number of a step: [B, 14]."""
    one, away = torch.ones_like(seconds) / focal, state.seen(plane).distance / focal
    each = torch.stack([one, away, one / seconds, away / seconds], -1).repeat_interleave(3, -1)
    return torch.cat([each, one[:, None], one[:, None]], -1)


def homography(x: Tensor, predicted: State, plane: Plane, seconds: Tensor, chart: Chart) -> Tensor:
    """The warp of events to the chart's pixel (0, 0) as centre, after a step x [B, 14] px from the prediction: H_k [B, K, 3, 3]."""
    step = x * units(predicted, plane, seconds, chart.focal)
    H_k = predicted.moved(step[:, :SIZE]).homography(plane.leaning(step[:, SIZE:]), seconds, chart.view)
    shifted = H_k[:, :, :2] - (chart.corner / chart.focal)[:, None, :, None] * H_k[:, :, 2:]
    return torch.cat([shifted, H_k[:, :, 2:]], 2)


def _differences(x: Tensor, *problem: object) -> tuple[Tensor, Tensor]:
    """H_k [B, K, 3, 3] and its derivative [B, 14, K, 3, 3]."""
    sides = [homography(x + side, *problem) for side in STEP * torch.eye(NUMBERS).to(x)]  # type: ignore[arg-type]
    other = [homography(x - side, *problem) for side in STEP * torch.eye(NUMBERS).to(x)]  # type: ignore[arg-type]
    return homography(x, *problem), (torch.stack(sides, 1) - torch.stack(other, 1)) / (2 * STEP)  # type: ignore[arg-type]


def _flow(H_k: Tensor, dH: Tensor, ink: Ink, focal: float) -> tuple[Tensor, Tensor, Tensor]:
    """Points of the events [B, N, 2] px, their derivative [B, N, 2, 14], and which are in front of the camera [B, N]."""
    basis = torch.stack([ink.ray.mT.to(H_k) * ink.s.to(H_k)[..., None] ** k for k in range(H_k.shape[1])], 2)  # [B, N, K, 3]
    ray = torch.einsum("bkij,bnkj->bni", H_k, basis)
    moved = torch.einsum("bpkij,bnkj->bnip", dH, basis)
    depth = ray[..., 2].clamp_min(NEAREST)[..., None]
    xy = ray[..., :2] / depth
    return focal * xy, focal * (moved[..., :2, :] - xy[..., None] * moved[..., 2:, :]) / depth[..., None], ray[..., 2] > NEAREST


def lookup(texture: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear lookup, zero outside: texture [B or 1, H, W] | xy [B, N, 2] px -> strength [B, N], slope [B, N, 2] along x and y."""
    height, width = texture.shape[1:]
    frame = pad(texture, (1, 1, 1, 1)).to(xy).flatten(1).expand(len(xy), -1)
    point = xy + 1
    inside = (point > 0).all(-1) & (point[..., 0] < width + 1) & (point[..., 1] < height + 1)
    point = torch.where(inside[..., None], point, 0.0)
    corner = point.floor()
    fx, fy = (point - corner).unbind(-1)
    first = (corner[..., 1] * (width + 2) + corner[..., 0]).long()
    a, b, c, d = (frame.gather(1, first + step) * inside for step in (0, 1, width + 2, width + 3))
    above, down, twist = b - a, c - a, d - c - b + a
    return a + fx * above + fy * (down + fx * twist), torch.stack([above + fy * twist, down + fx * twist], -1)


def evaluate(x: Tensor, predicted: State, plane: Plane, seconds: Tensor, chart: Chart, ink: Ink) -> tuple[Tensor, Tensor, Tensor]:
    """-sum(T - T^2/2) over the events, its gradient, and sum T: x [B, 14] px -> [B], [B, 14], [B].

    It is the sum of squares (1 - T)^2 / 2, less a constant, of edges that should be there.
    """
    strength, g = _slopes(x, predicted, plane, seconds, chart, ink)
    gradient = ((strength - 1)[..., None] * g).sum(1)
    return -(strength - strength.square() / 2).sum(-1), gradient, strength.sum(-1)


def curvature(x: Tensor, predicted: State, plane: Plane, seconds: Tensor, chart: Chart, ink: Ink) -> Tensor:
    """What the second derivative of `evaluate` is expected to be: [B, 14, 14], never negative.

    On an edge's ridge T has no slope, so J^T J alone says nothing there. If events are as dense as T / (1 - T), the mean of
    (1 - T) (-T'') over them is, by parts, that of T'^2 (1 - T) / T; with the T'^2 of J^T J it makes T'^2 / T: Fisher's information.
    """
    strength, g = _slopes(x, predicted, plane, seconds, chart, ink)
    share = 1 / (strength + LEAST)
    return torch.einsum("bn,bnp,bnq->bpq", share, g, g)


def _slopes(x: Tensor, predicted: State, plane: Plane, seconds: Tensor, chart: Chart, ink: Ink) -> tuple[Tensor, Tensor]:
    """The strength that each event meets [B, N] and its derivative to x [B, N, 14]; nothing for what isn't seen."""
    H_k, dH = _differences(x, predicted, plane, seconds, chart)
    xy, J, ahead = _flow(H_k, dH, ink, chart.focal)
    weight = ((ink.weight != 0) & ahead).to(x)
    strength, slope = lookup(chart.texture, xy)
    return strength * weight, (slope[..., None] * J).sum(-2) * weight[..., None]


def gram(x: Tensor, predicted: State, plane: Plane, seconds: Tensor, chart: Chart, some: Ink) -> Tensor:
    """Squared length of a step in px of the events' flow on the texture: mean J^T J, with a ridge as core.objective.metric, [B, 14, 14]."""
    _, J, _ = _flow(*_differences(x, predicted, plane, seconds, chart), some, chart.focal)
    J = J * (some.weight != 0).to(x)[..., None, None]
    G = torch.einsum("bnip,bniq->bpq", J, J) / some.x.shape[-1]
    mean = G.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(torch.finfo(x.dtype).eps)
    return G + RIDGE * mean[:, None, None] * torch.eye(NUMBERS).to(x)


@dataclass(frozen=True)
class Task:
    """One window for each row: what `match` starts from.

    predicted State [B] | plane [B] | seconds [B] | chart | ink [B, N] events of the windows | some: a sample of them
    prior [B, 14, 14]: information about a step from the prediction, in `units` | basis [14, M]: x = basis q
    votes [B, H, W]: the map's events, to draw the windows on, where the objective is variance
    ghosts [B, G] with ground [B, H, W]: where events could be by chance, and what they would bring there; None: not asked
    """

    predicted: State
    plane: Plane
    seconds: Tensor
    chart: Chart
    ink: Ink
    some: Ink
    prior: Tensor
    basis: Tensor
    ghosts: Ink | None = None
    ground: Tensor | None = None
    votes: Tensor | None = None

    def __getitem__(self, rows: Tensor) -> Task:
        """Some of the windows."""
        chart, state, plane = self.chart[rows], self.predicted[rows], Plane(self.plane.normal[rows], self.plane.distance[rows])
        ghosts, ground, votes = (None if part is None else part[rows] for part in (self.ghosts, self.ground, self.votes))
        ink, some = self.ink[rows], self.some[rows]
        return Task(state, plane, self.seconds[rows], chart, ink, some, self.prior[rows], self.basis, ghosts, ground, votes)  # type: ignore[arg-type]

    def cost(self, x: Tensor, weight: float) -> tuple[Tensor, Tensor, Tensor]:
        """weight * (-sum(T - T^2/2) + sum F) + x^T prior x / 2, its gradient, and sum T: x [B, 14] px -> [B], [B, 14], [B].

        F is what events would bring by chance at the ghosts.
        """
        problem = self.predicted, self.plane, self.seconds
        value, slope, found = evaluate(x, *problem, self.chart, self.ink)
        if self.ghosts is not None and self.ground is not None:
            chance, g = _slopes(x, *problem, replace(self.chart, texture=self.ground), self.ghosts)
            share = self.ghosts.weight.to(x)
            value, slope = value + (chance * share).sum(-1), slope + (g * share[..., None]).sum(1)
        bent = (self.prior @ x[..., None])[..., 0]
        return weight * value + (x * bent).sum(-1) / 2, weight * slope + bent, found


def match(q: Tensor, task: Task, how: Matching) -> Match:
    """Where the windows fit the map: q [B, M] px, the start of the search -> Match [B].

    Minimizes weight * -sum(T - T^2/2) + x^T prior x / 2 by BFGS from the events' own curvature; in machine code where there is some for it.
    """
    kernel = kernels.drawing(task.ink.x)
    if how.objective == "variance":
        x, cost, slope, information, found, evaluations, converged = sharpen(q, task, how)
    elif kernel is not None and not task.ink.x.is_cuda:
        x, cost, slope, information, found, evaluations, converged = kernel.match(q, task, how, RIDGE, CLOSEST, TERMS)
    else:
        x, cost, slope, information, found, evaluations, converged = descend(q, task, how)
    step = x * units(task.predicted, task.plane, task.seconds, task.chart.focal)
    count = (task.ink.weight != 0).sum(-1).clamp_min(1)
    return Match(task.predicted.moved(step[:, :SIZE]), x, cost, slope, information, found / count, evaluations, converged)


def descend(q: Tensor, task: Task, how: Matching) -> tuple[Tensor, ...]:
    """The readable twin of the kernel's `match`: x [B, 14], cost, its slope, information, sum T, evaluations, converged."""
    problem = task.predicted, task.plane, task.seconds, task.chart
    basis, weight = task.basis.to(q), how.weight * how.every

    def cost(q: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        value, slope, _ = task[rows].cost(q @ basis.T, weight)
        return value, slope @ basis

    G = basis.T @ gram(q @ basis.T, *problem, task.some) @ basis
    information = weight * curvature(q @ basis.T, *problem, task.ink)
    found = minimize(cost, q, G, how.stop, torch.linalg.inv(basis.T @ (information + task.prior) @ basis))
    x = found.x @ basis.T
    value, slope, total = task.cost(x, weight)
    return x, value, slope, information, total, found.evaluations, found.converged


def sharpen(q: Tensor, task: Task, how: Matching) -> tuple[Tensor, ...]:
    """The thesis' way: -log variance of the window drawn on the map's events; returns what `descend` does.

    Nothing is weighed against the prediction, and it says nothing of how sure it is: the information is zero.
    """
    if task.votes is None:
        raise ValueError("the objective variance wants the votes of the map to draw on")
    problem, basis, votes = (task.predicted, task.plane, task.seconds, task.chart), task.basis.to(q), task.votes
    canvas = Canvas(task.chart.focal, (0.0, 0.0), (votes.shape[1], votes.shape[2]))

    def cost(q: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        part = task[rows]
        q = q.detach().requires_grad_()
        with torch.enable_grad():
            H_k = homography(q @ basis.T, part.predicted, part.plane, part.seconds, part.chart).to(part.ink.x)
            value = -variance(draw(H_k, part.ink, canvas, torch.arange(len(q), device=q.device)) + votes[rows]).log()
            (gradient,) = torch.autograd.grad(value.sum(), q)
        return value.detach().to(task.ink.x), gradient

    G = basis.T @ gram(q @ basis.T, *problem, task.some) @ basis
    found = minimize(cost, q, G, how.stop)
    x = found.x @ basis.T
    nothing = torch.zeros_like(task.prior)
    return x, found.value.to(x), nothing[:, 0], nothing, evaluate(x, *problem, task.ink)[2], found.evaluations, found.converged
