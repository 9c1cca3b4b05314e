"""Events as learning pipelines take them."""

from torchcmax.data.represent import event_count, time_surface, voxel_grid

__all__ = ["event_count", "time_surface", "voxel_grid"]
