"""Small simulated scenes with their exact truth, in the world of the first camera: what the tests of tracking and mapping stand on."""

from dataclasses import dataclass

import torch

from torchcmax.core import so3
from torchcmax.core.camera import Camera
from torchcmax.core.draw import Ink
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.core.window import Window
from torchcmax.simulator import Simulation, pose, simulate, velocity
from torchcmax.slam.map import Keyframe, Map, Texture
from torchcmax.slam.run import BORDER
from torchcmax.slam.tracker import rays_of


@dataclass(frozen=True)
class Scene:
    """Consecutive windows [1, N], the true states [1] at their middles, and the true plane, distance one from the first camera."""

    camera: Camera
    windows: list[Window]
    states: list[State]
    plane: Plane

    @property
    def focal(self) -> float:
        return self.camera.fx


def scene(options: Simulation, events: int) -> Scene:
    """All windows of so many events."""
    windows = list(simulate(options).windows(events))
    plane, first = first_camera(options, windows[0].start)
    return Scene(options.camera, windows, [true_state(options, w.middle, first, plane) for w in windows], unit(plane))


def first_camera(options: Simulation, time: torch.Tensor) -> tuple[Plane, Pose]:
    """The plane as the camera sees it at a time [1] µs, in metres, and the camera."""
    first = pose(options, time * 1e-6)
    return options.plane.seen_from(first), first


def unit(plane: Plane) -> Plane:
    return Plane(plane.normal, torch.ones_like(plane.distance))


def true_state(options: Simulation, time: torch.Tensor, first: Pose, plane: Plane) -> State:
    """At a time [1] µs, in the world of the first camera, in distances of the plane from there."""
    here, motion = first.inverse() @ pose(options, time * 1e-6), velocity(options, time * 1e-6)
    return State(Pose(here.R, here.t / plane.distance), Motion(motion.omega, motion.velocity / plane.distance))


def map_of(camera: Camera, plane: Plane, texture: Texture | None = None) -> Map:
    """An empty one, as the system makes it."""
    rays = camera.rays()
    edge = torch.cat([rays[0], rays[-1], rays[:, 0], rays[:, -1]])[::BORDER]
    return Map(plane, camera.fx, edge.float(), texture or Texture())


def keyframe_of(window: Window, state: State) -> Keyframe:
    return Keyframe(int(window.middle), state, window.duration.double(), Ink.of(window, window.weight))


def drawn(scene: Scene, which: range) -> Map:
    """The map that these windows draw from where they truly are."""
    m = map_of(scene.camera, scene.plane)
    m.draw([keyframe_of(scene.windows[i], scene.states[i]) for i in which])
    return m


def state_of(turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)) -> State:
    """One state from plain numbers."""
    turn, shift, omega, velocity = (torch.tensor([part], dtype=torch.float64) for part in (turn, shift, omega, velocity))
    return State(Pose(so3.exp(turn), shift), Motion(omega, velocity))


def wall(*tilt: float) -> Plane:
    """A plane at distance one, tilted by two angles, rad."""
    return Plane.tilted(torch.tensor([tilt or (0.0, 0.0)], dtype=torch.float64))


def angle(a: Plane, b: Plane) -> float:
    """Between two planes, degrees."""
    return float(torch.linalg.cross(a.normal, b.normal).norm().asin().rad2deg())


def pixels(found: list[State], on: Plane, true: list[State], plane: Plane, camera: Camera) -> float:
    """How far rays of the cameras meet their planes from where they should, as seen from the first camera: px, rms."""
    ray = rays_of(camera)
    ends = [
        ray @ State.join(states).placement(p.repeated(len(states))).mT for states, p in ((found, on), (true, plane))
    ]  # fmt: skip
    a, b = (end[..., :2] / end[..., 2:] * camera.fx for end in ends)
    return float((a - b).square().sum(-1).mean().sqrt())
