"""TensorBoard: scalars, curves of the optimizer, pictures and the configuration of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from torch import Tensor


class Board:
    """A log folder that `tensorboard --logdir` shows.  Steps are window numbers; curves have evaluations as steps."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # a second to import, so only when a board is wanted

        self._writer = SummaryWriter(str(folder), max_queue=1000, flush_secs=20)

    def config(self, text: str) -> None:
        """The run's configuration, YAML."""
        indented = "".join(f"    {line}\n" for line in text.splitlines())
        self._writer.add_text("config", indented)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """One number for each name, at a window."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def curve(self, name: str, values: Tensor) -> None:
        """One number for each evaluation: values [T]."""
        for step, value in enumerate(values[values.isfinite()].tolist()):
            self._writer.add_scalar(name, value, step)

    def image(self, name: str, picture: np.ndarray, step: int) -> None:
        """A picture [H, W, 3] uint8 at a window."""
        self._writer.add_image(name, picture, step, dataformats="HWC")

    def close(self) -> None:
        """Everything is on disk afterwards."""
        self._writer.close()
