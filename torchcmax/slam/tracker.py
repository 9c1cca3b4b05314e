"""One window after the other against the map: predict, make sharp, match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.draw import Ink
from torchcmax.core.estimate import COARSE, Search
from torchcmax.core.match import NUMBERS, Chart, Match, Matching, Task, match, units
from torchcmax.core.minimize import Stop
from torchcmax.core.model import MODELS, Displacement, Model, PlanarKnown
from torchcmax.core.objective import Look, View, minimum
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion
from torchcmax.core.state import SIZE, State
from torchcmax.core.warp import TERMS, still
from torchcmax.core.window import Window
from torchcmax.slam.globe import Globe
from torchcmax.slam.map import Area, Map

World = Map | Globe
ModelName = Literal["planar", "translation", "rotation"]
SOME = 24  # events that are enough to measure how far a step moves a window
GRID = 8  # rays along each side of the sensor at which the flow and what is known are measured
FREE = {"planar": (0, 1, 2, 3), "translation": (1, 3), "rotation": (0, 2)}  # of turn, shift, angular velocity, velocity


@dataclass(frozen=True)
class Tracking:
    """How a window is tracked."""

    displacement: float = 12.0
    """px that the image moves in a window, rms."""
    fewest: int = 1000
    """Events in a window at least, unless it would last longer than `seconds`."""
    most: int = 30000
    """Events in a window at most."""
    seconds: float = 0.04
    """A window lasts no longer."""
    acceleration: tuple[float, float] = (20.0, 8.0)
    """What the motion may change by from window to window: rad/s^2 and plane distances/s^2, one sigma."""
    look: Look = field(default_factory=Look)
    """How a window is looked at by itself."""
    search: Search = field(default_factory=lambda: Search((1.0,), stop=Stop(tolerance=0.05, iterations=25)))
    """How its motion is searched for before it is matched to the map."""
    matching: Matching = field(default_factory=Matching)
    """How it is matched to the map."""

    def __post_init__(self) -> None:
        if not (self.displacement > 0 and self.seconds > 0 and 2 <= self.fewest <= self.most and min(self.acceleration) > 0):
            raise ValueError(
                "tracking wants a displacement, seconds and accelerations above 0 and 2 <= fewest <= most, got "
                f"{self.displacement}, {self.seconds}, {self.acceleration}, {self.fewest}, {self.most}"
            )


@dataclass(frozen=True)
class Belief:
    """What is known of B cameras.  time [B] µs, of the middle of the last window | state [B] | covariance [B, 12, 12]"""

    time: Tensor
    state: State
    covariance: Tensor

    def __getitem__(self, index: slice | Tensor) -> Belief:
        return Belief(self.time[index], self.state[index], self.covariance[index])

    @classmethod
    def join(cls, parts: Sequence[Belief]) -> Belief:
        """Several cameras together."""
        states = State.join([p.state for p in parts])
        return cls(torch.cat([p.time for p in parts]), states, torch.cat([p.covariance for p in parts]))

    def at(self, time: Tensor, acceleration: tuple[float, float]) -> Belief:
        """What is known at another time [B] µs: constant velocity, with accelerations as noise."""
        dt = (time - self.time).to(self.covariance) * 1e-6
        F = self.state.stepping(dt)
        sigma = F.new_tensor([acceleration[0]] * 3 + [acceleration[1]] * 3)
        gain = torch.cat([sigma * (dt * dt / 2)[:, None], sigma * dt[:, None]], 1)
        noise = gain[:, :, None] * torch.eye(6, dtype=F.dtype, device=F.device).repeat(2, 1)
        return Belief(time, self.state.later(dt), F @ self.covariance @ F.mT + noise @ noise.mT)


def covariance_of(sigma: tuple[float, float, float, float]) -> Tensor:
    """[1, 12, 12], of turn, shift, angular velocity and velocity, one sigma."""
    return torch.tensor(sigma, dtype=torch.float64).repeat_interleave(3).square().diag()[None]


def rays_of(camera: Camera) -> Tensor:
    """A grid of rays over the sensor: [GRID * GRID, 3] float64."""
    rays = camera.rays()
    rows, columns = (torch.linspace(0, n - 1, GRID).round().long() for n in rays.shape[:2])
    return rays[rows][:, columns].reshape(-1, 3)


def before_plane(state: State, plane: Plane) -> tuple[Motion, Plane]:
    """The motion of a camera [1] in its own distances from a plane, and how it sees that."""
    there = state.seen(plane)
    return Motion(state.motion.omega, state.motion.velocity / there.distance[:, None]), there


def speed(state: State, plane: Plane, ray: Tensor, focal: float) -> float:
    """Of the image of a camera [1], rms over rays [M, 3]: px/s."""
    there = state.seen(plane)
    inverse_depth = -(ray @ there.normal[0])[:, None] / there.distance
    moved = torch.linalg.cross(state.motion.omega, ray) + state.motion.velocity * inverse_depth
    image = moved[:, :2] - ray[:, :2] * moved[:, 2:]
    return focal * float(image.square().sum(-1).mean().sqrt())


def doubt(belief: Belief, plane: Plane, ray: Tensor, focal: float) -> float:
    """How far the image may be off where a camera [1] is believed to be: px, rms over rays [M, 3], one sigma."""
    there = belief.state.seen(plane)
    unit = torch.eye(3).to(ray)
    turned = torch.linalg.cross(unit[:, None], ray[None], dim=-1)  # [3, M, 3]
    shifted = unit[:, None] * (-(ray @ there.normal[0]) / there.distance)[None, :, None]
    moved = torch.cat([turned, shifted])
    image = (moved[..., :2] - ray[:, :2] * moved[..., 2:]).flatten(1).T  # [2 M, 6]
    return focal * float(((image @ belief.covariance[0, :6, :6]) * image).sum().div(len(ray)).sqrt())


@dataclass(frozen=True)
class Front:
    """What windows show by themselves: motion [B] at their middles | contrast at rest and with it [B] | evaluations, converged [B]"""

    motion: Motion
    zero: Tensor
    contrast: Tensor
    evaluations: Tensor
    converged: Tensor

    def __getitem__(self, rows: Tensor) -> Front:
        """Some of the windows."""
        motion = Motion(self.motion.omega[rows], self.motion.velocity[rows])
        return Front(motion, self.zero[rows], self.contrast[rows], self.evaluations[rows], self.converged[rows])


def front(window: Window, canvas: Canvas, expected: State, plane: Plane, how: Tracking, name: ModelName = "planar") -> Front:
    """The motion that makes each window sharp on the blank canvas before the known plane [B], from the expected state's on."""
    there, seconds = expected.seen(plane), window.duration.double()[:, None]
    away = there.distance[:, None]
    start = Displacement(expected.motion.omega * seconds, expected.motion.velocity * seconds / away, there.normal).seen_at(-0.5)
    model: Model = (PlanarKnown if name == "planar" else MODELS[name])(canvas.focal, start.normal)
    owner = torch.arange(len(window), device=window.ray.device)
    view = how.look.at(window, canvas, how.search.blur[-1])
    x, evaluations = model.parameters(start), torch.zeros_like(owner)
    for i, sigma in enumerate(how.search.blur):
        last = i == len(how.search.blur) - 1
        coarse = replace(how.search.stop, tolerance=how.search.stop.tolerance * max(1.0, COARSE * sigma))
        seen, stop = (view, how.search.stop) if last else (view.blurred(sigma), coarse)
        found = minimum(how.look, model, seen, owner)(x, stop)
        x, evaluations = found.x, evaluations + found.evaluations
    moved = model.displacement(x, owner).seen_at(0.5)
    motion = Motion(moved.turn / seconds, moved.shift * away / seconds)
    return Front(motion, _at_rest(how.look, view, owner), (-found.value).exp(), evaluations, found.converged)


def _at_rest(look: Look, view: View, owner: Tensor) -> Tensor:
    return look.sharpness(still(view.ink.x.new_empty(len(owner), TERMS, 3, 3)), view, owner)


@dataclass(frozen=True)
class Sight:
    """What a camera sees of a map, or of that part of it: the warp H_k [K, 3, 3] of a window onto it, and the area around."""

    map: Map
    H_k: Tensor
    area: Area

    @classmethod
    def of(cls, world: World, state: State, seconds: Tensor) -> Sight | None:
        """From a state [1]; None where the camera looks along the plane, or away from it."""
        m = world.toward(state.pose)
        H_k = m.warp(state, seconds)
        box = m.box(H_k)
        return None if box is None else cls(m, H_k, m.area(box))

    def moved(self, state: State, seconds: Tensor) -> Sight:
        """The same area from a state [1] a few px on."""
        return replace(self, H_k=self.map.warp(state, seconds))


@dataclass(frozen=True)
class Step:
    """What windows gave: belief before and after them, what they show alone, where they match.

    information, prior [B, F, F]: about a step in px, of the events and of what was predicted, of the numbers `free` [F] of a state
    """

    before: Belief
    after: Belief
    front: Front
    match: Match
    information: Tensor
    prior: Tensor
    free: Tensor


def step(
    window: Window,
    canvas: Canvas,
    before: Belief,
    sights: Sequence[Sight],
    how: Tracking,
    name: ModelName = "planar",
    alone: Front | None = None,
) -> Step:
    """The windows [B] of cameras against what they see of their maps, from what is predicted for their middles: make sharp, match.

    alone: what they show by themselves, where that is there already
    """
    plane, seconds = Plane.join([s.map.plane for s in sights]), window.duration.double()
    if alone is None:
        alone = front(window, canvas, before.state, plane, how, name)
    size = units(before.state, plane, seconds, canvas.focal)
    basis = basis_of(name, how.matching.refine).to(size)
    free = numbers_of(name)
    tasks = tasks_of(window, before, sights, how, basis, free)
    q = torch.cat([torch.zeros_like(size[:, :6]), before.state.step_to(State(before.state.pose, alone.motion))[:, 6:] / size[:, 6:12]], 1)
    narrow = basis / basis.square().sum(0)  # its columns are orthogonal
    q = q @ narrow[:SIZE]
    evaluations = torch.zeros_like(alone.evaluations)
    for i, task in enumerate(tasks):
        sigma = sights[0].map.texture.blur[i]
        found = match(q, task, how.matching if i == len(tasks) - 1 else how.matching.coarse(sigma))
        q, evaluations = found.x @ narrow, evaluations + found.evaluations
    found = replace(found, evaluations=evaluations)
    information = found.information[:, :SIZE, :SIZE] / (size[:, :SIZE, None] * size[:, None, :SIZE])
    covariance = within(torch.linalg.inv(block(informed(before.covariance, free) + information, free)), free)
    if how.matching.objective == "variance":  # it does not say how sure it is; nobody asks
        covariance = torch.eye(SIZE).to(covariance).expand_as(covariance)
    after = Belief(before.time, found.state, (covariance + covariance.mT) / 2)
    return Step(before, after, alone, found, block(found.information, free), block(tasks[0].prior, free), free)


def numbers_of(name: ModelName) -> Tensor:
    """The numbers of a state that a model leaves free: [F]; it is sure of the others."""
    return torch.tensor([3 * which + axis for which in FREE[name] for axis in range(3)])


def block(matrix: Tensor, free: Tensor) -> Tensor:
    """Its rows and columns of the free numbers: [B, N, N] -> [B, F, F]."""
    return matrix[:, free[:, None], free]


def within(matrix: Tensor, free: Tensor) -> Tensor:
    """The reverse of `block`, with zeros for the numbers that are not free: [B, F, F] -> [B, 12, 12]."""
    whole = matrix.new_zeros(len(matrix), SIZE, SIZE)
    whole[:, free[:, None], free] = matrix
    return whole


def informed(covariance: Tensor, free: Tensor) -> Tensor:
    """The information that a covariance leaves about the free numbers, the others being sure: [B, 12, 12]."""
    return within(torch.linalg.inv(block(covariance, free)), free)


def basis_of(name: ModelName, refine: str) -> Tensor:
    """The directions in which a state may go: [14, M], in px.

    full: all that the model has; motion: velocities alone, the pose at the window's start stays, so that its middle goes half as far.
    """
    eye = torch.eye(NUMBERS, dtype=torch.float64)
    columns = [eye[:, 3 * part : 3 * part + 3] for part in FREE[name]]
    if refine == "full":
        return torch.cat(columns, 1)
    half = len(columns) // 2
    return torch.cat([rate + pose / 2 for pose, rate in zip(columns[:half], columns[half:], strict=True)], 1)


def tasks_of(window: Window, before: Belief, sights: Sequence[Sight], how: Tracking, basis: Tensor, free: Tensor) -> list[Task]:
    """The windows before their maps, coarse to fine."""
    plane, seconds = Plane.join([s.map.plane for s in sights]), window.duration.double()
    ink = Ink.of(window, window.weight)
    few, some = ink.thinned(how.matching.every), ink.sample(SOME)
    known = Ink.join([s.map.trusted(few[i : i + 1], s.H_k, s.area) for i, s in enumerate(sights)])
    size = units(before.state, plane, seconds, sights[0].map.focal)[:, :SIZE]
    prior = pad(informed(before.covariance, free) * (size[:, :, None] * size[:, None]), (0, 2, 0, 2))
    charts = [Chart.join(level) for level in zip(*(s.area.charts for s in sights), strict=True)]
    if how.matching.objective == "lookup":
        return [Task(before.state, plane, seconds, chart, known, some, prior, basis) for chart in charts]
    votes = charts[-1].filled([s.area.layers.votes for s in sights])
    return [Task(before.state, plane, seconds, charts[-1], few, some, prior, basis, votes=votes)]
