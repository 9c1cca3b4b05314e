"""Contrast maximization for event cameras: events in, sharp images, motions, poses and maps out."""

__version__ = "0.1.0"

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.estimate import Estimate, Search, estimate
from torchcmax.core.model import Planar, PlanarKnown, Rotation, Translation
from torchcmax.core.objective import Look
from torchcmax.core.window import Window
from torchcmax.io import DataError, Recording, open, save

__all__ = [
    "Camera",
    "Canvas",
    "DataError",
    "Estimate",
    "Look",
    "Planar",
    "PlanarKnown",
    "Recording",
    "Rotation",
    "Search",
    "Translation",
    "Window",
    "estimate",
    "open",
    "save",
]
