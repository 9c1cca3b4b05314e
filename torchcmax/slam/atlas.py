"""Two maps of one plane become one: the similarity between them, and whether what the one drew fits the other."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median

from torch import Tensor

from torchcmax.core.camera import Canvas
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.slam.glimpse import Glimpse
from torchcmax.slam.map import Keyframe
from torchcmax.slam.seek import Searchable
from torchcmax.slam.tracker import World, before_plane

FITS = 0.4  # score that the keyframes of the one map have in the other, where it knows their view, in the median


@dataclass(frozen=True)
class Similarity:
    """From one world to another: x' = scale R x + t.  R [1, 3, 3] | t [1, 3] | scale [1]"""

    R: Tensor
    t: Tensor
    scale: Tensor

    @classmethod
    def between(cls, one: State, plane: Plane, other: State, other_plane: Plane) -> Similarity:
        """From the world of the one plane to that of the other, of the camera [1] that is seen in both at the same moment.

        Its distance from the plane is the same, which tells the scale.
        """
        scale = other.seen(other_plane).distance / one.seen(plane).distance
        R = other.pose.R @ one.pose.R.mT
        return cls(R, other.pose.t - scale[:, None] * (R @ one.pose.t[..., None])[..., 0], scale)

    def pose(self, pose: Pose) -> Pose:
        """A camera [1] of the one world in the other."""
        return Pose(self.R @ pose.R, self.scale[:, None] * (self.R @ pose.t[..., None])[..., 0] + self.t)

    def state(self, state: State) -> State:
        """A moving one."""
        return State(self.pose(state.pose), Motion(state.motion.omega, state.motion.velocity * self.scale[:, None]))


def moved(m: World, similarity: Similarity) -> list[Keyframe]:
    """The keyframes of a map in the other world."""
    return [keyframe.at(similarity.state(keyframe.state)) for keyframe in m.keyframes]


def fitting(m: World, similarity: Similarity, home: World, grid: Searchable, sensor: Canvas) -> list[Keyframe] | None:
    """The keyframes of a map in the world of another, if those that see what it knows fit it; else None."""
    keyframes = moved(m, similarity)
    scores = [score for k in keyframes if (score := agreement(k, home, grid, sensor)) >= 0]
    return keyframes if scores and median(scores) >= FITS else None


def agreement(keyframe: Keyframe, home: World, grid: Searchable, sensor: Canvas) -> float:
    """The score of a keyframe in a map, below zero where the map hardly knows what it sees."""
    motion, there = before_plane(keyframe.state, home.plane)
    glimpse = Glimpse.drawn(keyframe.ink, keyframe.seconds, motion, there.normal, sensor, home.border)
    return grid.judge(glimpse, keyframe.state)
