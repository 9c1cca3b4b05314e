"""All that can be set about following a camera before a plane, or one that only turns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from torchcmax.core.objective import Look
from torchcmax.slam.compass import Turning
from torchcmax.slam.map import Texture
from torchcmax.slam.mapper import Keyframing, Mapping
from torchcmax.slam.relocalize import Relocalizing
from torchcmax.slam.sense import Sensing
from torchcmax.slam.tracker import ModelName, Tracking


@dataclass(frozen=True)
class Slam:
    """How a camera is tracked before a plane, and the plane mapped."""

    model: ModelName = "planar"
    """planar: six degrees of freedom; translation or rotation: what the camera is known to do."""
    start: Look = field(default_factory=lambda: Look(contrast="gradient_magnitude"))
    """How windows are looked at before there is a map."""
    tracking: Tracking = field(default_factory=Tracking)
    """How windows are tracked."""
    sensing: Sensing = field(default_factory=Sensing)
    """When a window is still, weak or lost."""
    mapping: Mapping = field(default_factory=Mapping)
    """How the map is made."""
    texture: Texture = field(default_factory=Texture)
    """How votes become the strength of edges."""
    relocalizing: Relocalizing = field(default_factory=Relocalizing)
    """How a camera is searched for in a map."""
    atlas: bool = True
    """A lost camera begins a new map, which is joined with the old one when it is found there."""


@dataclass(frozen=True)
class Panorama:
    """How a camera that only turns is tracked, and what it sees mapped on a sphere."""

    model: ClassVar[ModelName] = "rotation"
    start: Look = field(default_factory=lambda: Look(contrast="gradient_magnitude"))
    """How windows are looked at before there is a map."""
    tracking: Tracking = field(default_factory=lambda: Tracking(displacement=20.0, most=50000, seconds=0.06))
    """How windows are tracked."""
    sensing: Sensing = field(default_factory=Sensing)
    """When a window is still, weak or lost."""
    mapping: Keyframing = field(default_factory=lambda: Keyframing(first=8, settle=1, every=12))
    """How the map is made."""
    texture: Texture = field(default_factory=Texture)
    """How votes become the strength of edges."""
    relocalizing: Turning = field(default_factory=Turning)
    """How a camera is searched for in a map."""
    atlas: bool = True
    """A lost camera begins a new map, which is joined with the old one when it is found there."""
