"""TensorBoard: scalars, curves of the optimizer, pictures and the configuration of a run."""

from __future__ import annotations

import itertools
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor


class Board:
    """A log folder that `tensorboard --logdir` shows.  Steps are window numbers; curves have evaluations as steps.

    Events go to TensorBoard's own writer of records as they are: a SummaryWriter would unpack and pack every picture again, and write
    in a thread of its own, where an error, as of a full disk, ends in a traceback and nobody hears of it.  Here it is an OSError.
    """

    count = itertools.count()  # of boards that this process began

    def __init__(self, folder: Path) -> None:
        from tensorboard.compat.proto import event_pb2  # type: ignore[import-untyped]  # 0.1 s, so only when a board is wanted
        from tensorboard.summary.writer.record_writer import RecordWriter  # type: ignore[import-untyped]

        name = f"events.out.tfevents.{int(time.time()):010d}.{platform.node()}.{os.getpid()}.{next(self.count)}"
        folder.mkdir(parents=True, exist_ok=True)
        self._event, self._file = event_pb2.Event, (folder / name).open("wb")
        self._records = RecordWriter(self._file)
        self._write(file_version="brain.Event:2")

    def _write(self, **content: Any) -> None:
        self._records.write(self._event(wall_time=time.time(), **content).SerializeToString())

    def config(self, text: str) -> None:
        """The run's configuration, YAML."""
        indented = "".join(f"    {line}\n" for line in text.splitlines())
        tensor = {"dtype": "DT_STRING", "string_val": [indented.encode()], "tensor_shape": {"dim": [{"size": 1}]}}
        plugin = {"plugin_data": {"plugin_name": "text"}}
        self._write(summary={"value": [{"tag": "config/text_summary", "metadata": plugin, "tensor": tensor}]})

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """One number for each name, at a window."""
        self._write(summary={"value": [{"tag": name, "simple_value": value} for name, value in values.items()]}, step=step)

    def hparams(self, settings: Mapping[str, str], results: Mapping[str, float]) -> None:
        """A line in the table of hyperparameters: what was set, and what came out."""
        from torch.utils.tensorboard.summary import hparams  # 0.5 s, so only over a sweep

        for part in hparams(dict(settings), dict.fromkeys(results, 0.0)):
            self._write(summary=part)
        self.scalars(results, 0)

    def curve(self, name: str, values: Tensor) -> None:
        """One number for each evaluation: values [T]."""
        for step, value in enumerate(values[values.isfinite()].tolist()):
            self.scalars({name: value}, step)

    def image(self, name: str, picture: bytes, size: tuple[int, int], step: int) -> None:
        """A coloured picture, PNG, of size (H, W), at a window."""
        image = {"height": size[0], "width": size[1], "colorspace": 3, "encoded_image_string": picture}
        self._write(summary={"value": [{"tag": name, "image": image}]}, step=step)

    def flush(self) -> None:
        """What was written can be seen."""
        self._file.flush()

    def close(self) -> None:
        """Everything is on disk afterwards."""
        self._file.close()
