"""Events as learning pipelines take them: windows in datasets, with truth and augmentations, and as images."""

from torchcmax.data.augment import Augment
from torchcmax.data.represent import event_count, time_surface, voxel_grid
from torchcmax.data.sample import Sample, collate
from torchcmax.data.windows import WindowDataset, WindowStream

__all__ = ["Augment", "Sample", "WindowDataset", "WindowStream", "collate", "event_count", "time_surface", "voxel_grid"]
