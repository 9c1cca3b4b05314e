"""Contrast maximization for event cameras: events in, sharp images, motions, poses and maps out."""

__version__ = "0.1.0"
