"""Consecutive windows before one plane, optimized together: the motions and the plane that make their common image sharp."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.camera import NEAREST, Canvas
from torchcmax.core.contrast import CONTRASTS, blur, normalized
from torchcmax.core.draw import Ink, draw_sum
from torchcmax.core.match import units
from torchcmax.core.minimize import Stop, minimize
from torchcmax.core.objective import ContrastName
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import CLOSEST, State

FINE = 1e-4  # ridge of the metric of a chain, as a share of its mean
SAMPLES = 60  # events of a window that are enough to measure how far a step moves it
LARGEST = 2048  # px: no common image is wider or higher


@dataclass(frozen=True)
class Joint:
    """How windows are optimized together."""

    contrast: ContrastName = "gradient_magnitude"
    """The measure of sharpness."""
    sigma: float = 1.0
    """px of blur of the common image."""
    stop: Stop = field(default_factory=lambda: Stop(tolerance=0.005, iterations=100))
    """When it is done, px rms of the events."""
    deformation: float = 1.5
    """Factor by which an area may change, against the start, before the guard against collapse speaks."""
    guard: float = 10.0
    """Weight of that guard, in log contrast per (log area)^2."""
    acceleration: tuple[float, float] = (20.0, 8.0)
    """What the motion may change by from window to window: rad/s^2 and plane distances/s^2, one sigma."""
    steady: float = 0.03
    """Weight of such changes, in log contrast per square of a sigma: it decides where the windows do not."""

    def __post_init__(self) -> None:
        if self.contrast not in CONTRASTS:
            raise ValueError(f"{self.contrast!r} is none of {', '.join(CONTRASTS)}")
        if not (self.sigma >= 0 and self.deformation > 1 and min(self.guard, self.steady) >= 0 and min(self.acceleration) > 0):
            raise ValueError(f"joint wants sigma, guard and steady of at least 0, a deformation above 1, accelerations above 0, got {self}")


@dataclass(frozen=True)
class Frames:
    """Windows that share a plane.  state [F]: their middles | seconds [F] | ink [F, N] | plane [1]

    free: whether their angular velocities and velocities are sought, or stay as they are
    """

    state: State
    seconds: Tensor
    ink: Ink
    plane: Plane
    free: tuple[bool, bool] = (True, True)

    def __len__(self) -> int:
        return len(self.seconds)


Way = Callable[[Tensor], State]
"""Numbers x [M] px -> the states of all frames [F]."""
Whiten = Callable[[Tensor], tuple[Tensor, Tensor]]
"""y -> x, tilt: one unit of y moves the events by about 1 px rms along each axis of the image."""


def rates(frames: Frames, focal: float) -> Tensor:
    """What one px is of the angular velocity and the velocity of each frame, nothing where they are not sought: [F, 6]."""
    sought = torch.tensor(frames.free, device=frames.seconds.device).repeat_interleave(3)
    return units(frames.state, frames.plane, frames.seconds, focal)[:, 6:12] * sought


def chained(frames: Frames, focal: float, middle: int) -> Way:
    """Angular velocity and velocity of each frame, x [F * 6]; the poses follow from them, from the middle frame on.

    One window begins where the last one ends.
    """
    scale = rates(frames, focal)

    def states(x: Tensor) -> State:
        step = x.view(-1, 6) * scale
        motion = Motion(frames.state.motion.omega + step[:, :3], frames.state.motion.velocity + step[:, 3:])
        ahead, back = halves(motion, frames.seconds)
        path = products(Pose(ahead.R[:-1], ahead.t[:-1]) @ Pose(back.R[1:], back.t[1:]))
        start = frames.state.pose[middle : middle + 1] @ path[middle : middle + 1].inverse()
        return State(Pose(start.R.expand_as(path.R), start.t.expand_as(path.t)) @ path, motion)

    return states


def halves(motion: Motion, seconds: Tensor) -> tuple[Pose, Pose]:
    """From the middle of each window to its end, and from its start to its middle."""
    half = seconds[:, None] / 2
    return motion.at(half)[:, 0], motion.at(-half)[:, 0].inverse()


def products(steps: Pose) -> Pose:
    """Poses after no step, the first, the first two, ...: steps [F - 1] -> [F].  Each round doubles how many are multiplied."""
    eye = torch.eye(3, dtype=steps.R.dtype, device=steps.R.device)
    R, t = torch.cat([eye[None], steps.R]), torch.cat([steps.t.new_zeros(1, 3), steps.t])
    reach = 1
    while reach < len(R):
        grown = Pose(R[:-reach], t[:-reach]) @ Pose(R[reach:], t[reach:])
        R, t = torch.cat([R[:reach], grown.R]), torch.cat([t[:reach], grown.t])
        reach *= 2
    return Pose(R, t)


def onto(states: State, plane: Plane, seconds: Tensor, eye: Pose) -> Tensor:
    """Events to the rays of one camera [1] that looks at the plane: H_k [F, K, 3, 3].

    A ray y of the world's origin meets the plane at y d / (-n . y), so the camera's ray is R^T (d I + t n^T) y.
    """
    normal, distance = plane.normal[0], plane.distance[0]
    seen = eye.R[0].mT @ (distance * torch.eye(3).to(normal) + eye.t[0][:, None] * normal)
    return seen @ states.homography(plane.repeated(len(seconds)), seconds)


def canvas_of(H_k: Tensor, ink: Ink, focal: float, margin: float = 0.15) -> Canvas:
    """An image plane that holds all warped events, with a margin as a share of its size."""
    ray = ink.warped(H_k)[ink.weight != 0]
    ray = ray[ray[:, 2] > NEAREST]
    xy = ray[:, :2] / ray[:, 2:] * focal
    low, high = (xy.nan_to_num(0.0).quantile(q, dim=0) for q in (0.005, 0.995))
    spare = margin * (high - low) + 8
    size = (high - low + 2 * spare).clamp(32, LARGEST)
    centre = size / 2 - (low + high) / 2
    return Canvas(focal, (float(centre[0]), float(centre[1])), (int(size[1]), int(size[0])))


@dataclass(frozen=True)
class Common:
    """The common image of frames as a function of y: whitened numbers of the frames, then two of the plane."""

    frames: Frames
    way: Way
    eye: Pose
    canvas: Canvas
    how: Joint
    whiten: Whiten
    first: Tensor

    def at(self, y: Tensor) -> tuple[State, Plane]:
        """y -> states [F], plane [1]."""
        x, tilt = self.whiten(y)
        return self.way(x), tilted(self.frames.plane, tilt)

    def cost(self, y: Tensor) -> Tensor:
        """-log contrast + guard + changes of the motion."""
        states, plane = self.at(y)
        H_k = onto(states, plane, self.frames.seconds, self.eye)
        ink = self.frames.ink
        image = normalized(draw_sum(H_k.to(ink.x), ink, self.canvas), ink.weight.reshape(1, -1))  # so that canvases compare
        contrast = CONTRASTS[self.how.contrast](blur(image, self.how.sigma))[0]
        return self.strain(H_k, states, plane) + self.jerk(states.motion) - contrast.to(y).log()

    def jerk(self, motion: Motion) -> Tensor:
        """How much the motion changes from window to window, as a share of what it may; 0 for a single window."""
        between = (self.frames.seconds[1:] + self.frames.seconds[:-1])[:, None] / 2
        pairs = zip((motion.omega, motion.velocity), self.how.acceleration, strict=True)
        changes = [(part.diff(dim=0) / (sigma * between)).square().sum() for part, sigma in pairs]
        return self.how.steady * (changes[0] + changes[1]) / max(1, 6 * len(between))

    def strain(self, H_k: Tensor, states: State, plane: Plane) -> Tensor:
        """The guard against collapse: how areas change against the start."""
        excess = (areas(H_k) - self.first).abs() - math.log(self.how.deformation)
        many = plane.normal[0].expand(len(self.frames), 3)
        near = CLOSEST + 0.1 - (plane.distance[0] + (states.pose.t * many).sum(-1))
        return self.how.guard * (excess.clamp_min(0).square().mean() + near.clamp_min(0).square().mean())


def areas(H_k: Tensor) -> Tensor:
    """log |det| of the warp's Jacobian at the middle of the image, at both ends of each window: [F, 2]."""
    logs = []
    for s in (-0.5, 0.5):
        H = sum(H_k[:, k] * s**k for k in range(H_k.shape[1]))
        assert isinstance(H, Tensor)
        logs.append(torch.linalg.det(H).abs().clamp_min(1e-12).log() - 3 * H[:, 2, 2].clamp_min(NEAREST).log())
    return torch.stack(logs, 1)


def whitened_chain(frames: Frames, focal: float, eye: Pose, middle: int) -> Whiten:
    """The whole metric, as each window moves all those after it: y [F * 6 + 2] -> x, tilt."""
    count, some = len(frames), frames.ink.sample(SAMPLES)
    state = chained(frames, focal, middle)(frames.seconds.new_zeros(6 * count))
    follows = following(replace(frames, state=state), rates(frames, focal), middle)  # [F, 12, F * 6]

    def pixels(step: Tensor, tilt: Tensor) -> Tensor:
        ray = some.warped(onto(state.moved(step), tilted(frames.plane, tilt), frames.seconds, eye))
        return (ray[..., :2] / ray[..., 2:].clamp_min(NEAREST) * focal).flatten(1)

    rest, flat, sides = torch.zeros_like(follows[:, :, 0]), frames.seconds.new_zeros(2), 1e-5 * torch.eye(12).to(follows)
    own = torch.stack([(pixels(rest + e, flat) - pixels(rest - e, flat)) / 2e-5 for e in sides], -1)  # [F, 2 M, 12]
    lean = torch.stack([(pixels(rest, e[:2]) - pixels(rest, -e[:2])) / 2e-5 for e in sides[:2]], -1)
    J = torch.cat([own @ follows, lean], -1).flatten(0, 1)
    G = J.mT @ J / len(J)
    ridge = FINE * G.diagonal().mean() * torch.eye(len(G)).to(G)
    factor = torch.linalg.cholesky(G + ridge).mT

    def whiten(y: Tensor) -> tuple[Tensor, Tensor]:
        z = torch.linalg.solve_triangular(factor, y[:, None], upper=True)[:, 0]
        return z[:-2], z[-2:]

    return whiten


def following(frames: Frames, scale: Tensor, middle: int) -> Tensor:
    """How the state of each frame of a chain follows the numbers of all: d (step in its own camera's frame) / d x, [F, 12, F * 6].

    scale [F, 6]: of the numbers, as in `chained`
    """
    count, motion = len(frames), frames.state.motion
    ends = halves(motion, frames.seconds)
    parts = torch.zeros(2, count, 6, 6).to(scale)
    for p in range(6):
        side = torch.zeros(6).to(scale)
        side[p] = 1e-4
        near = [halves(Motion(motion.omega + s * side[:3], motion.velocity + s * side[3:]), frames.seconds) for s in (1, -1)]
        for which in (0, 1):
            between = [ends[which].inverse() @ n[which] for n in near]
            parts[which, :, :3, p] = (so3.log(between[0].R) - so3.log(between[1].R)) / 2e-4
            parts[which, :, 3:, p] = (between[0].t - between[1].t) / 2e-4
    steps = torch.zeros(count, 6, count, 6).to(scale)  # of the way from one middle to the next, in the frame of the next
    index = torch.arange(count)
    steps[index, :, index] = parts[1]
    steps[index[1:], :, index[:-1]] = carried(ends[1][1:].inverse()) @ parts[0, :-1]
    steps[0] = 0
    pose = frames.state.pose
    far = carried(Pose(pose.R[:, None], pose.t[:, None]).inverse() @ Pose(pose.R[None], pose.t[None]))  # [F, F, 6, 6]
    before = (index[None] <= index[:, None]).to(scale)[:, :, None, None]
    path = torch.einsum("jiab,ibkc->jakc", far * before, steps)
    path = path - torch.einsum("jab,bkc->jakc", far[:, middle], path[middle])
    own = torch.zeros(count, 6, count, 6).to(scale)
    own[index, :, index] = torch.eye(6).to(scale).expand(count, 6, 6)
    return (torch.cat([path, own], 1) * scale).flatten(2)


def carried(pose: Pose) -> Tensor:
    """A small step (turn, shift) in one camera's frame, as seen in another's: pose [..., ] of the first in the second -> [..., 6, 6]."""
    top = torch.cat([pose.R, torch.zeros_like(pose.R)], -1)
    return torch.cat([top, torch.cat([so3.hat(pose.t) @ pose.R, pose.R], -1)], -2)


def tilted(plane: Plane, tilt: Tensor) -> Plane:
    """The plane [1] tilted by two more angles, rad, at the same distance."""
    return Plane(Plane.tilted((plane.tilt()[0] + tilt)[None]).normal, plane.distance)


@dataclass(frozen=True)
class Solved:
    """Frames after their optimization | before, contrast: of the common image, less guard and changes of the motion | evaluations"""

    frames: Frames
    before: float
    contrast: float
    evaluations: int


def optimize(common: Common, count: int) -> Solved:
    """Quasi-Newton on the whitened numbers, from where the frames are; one unit of them is about 1 px rms."""
    frames = common.frames
    y = torch.zeros(1, count, dtype=torch.float64, device=frames.seconds.device)

    def objective(y: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
        y = y[0].detach().requires_grad_()
        with torch.enable_grad():
            cost = common.cost(y)
            (gradient,) = torch.autograd.grad(cost, y)
        return cost.detach()[None], gradient[None]

    found = minimize(objective, y, stop=common.how.stop)
    states, plane = common.at(found.x[0])
    first, last = float(found.trace[0, 0]), float(found.value)
    return Solved(replace(frames, state=states, plane=plane), math.exp(-first), math.exp(-last), int(found.evaluations))


def optimize_chain(frames: Frames, focal: float, how: Joint, middle: int) -> Solved:
    """Motions and plane of consecutive windows, seen from the middle one: 6 F + 2 numbers."""
    way, eye = chained(frames, focal, middle), frames.state.pose[middle : middle + 1]
    with torch.no_grad():
        states = way(frames.seconds.new_zeros(6 * len(frames)))
        H_k = onto(states, frames.plane, frames.seconds, eye)
        canvas = canvas_of(H_k, frames.ink.sample(SAMPLES), focal)
        whiten = whitened_chain(frames, focal, eye, middle)
    return optimize(Common(frames, way, eye, canvas, how, whiten, areas(H_k)), 6 * len(frames) + 2)
