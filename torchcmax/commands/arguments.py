"""Options that several commands share, and what is made of them."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml
from jsonargparse import Namespace

from torchcmax import kernels
from torchcmax.config import Parser, UsageError, usage
from torchcmax.io import OpenOptions, Recording, open

T = TypeVar("T")
RECORDING_HELP = "file of a format that we know (AEDAT4, RAW, DAT, ES, bag, HDF5, npz, npy, text, csv, zip), or folder with one"


def add_opening(command: Parser) -> None:
    command.add_argument("recording", type=str, help=RECORDING_HELP)
    command.add_argument("--strict", action="store_true", help="refuse what would be mended: events out of order, or at equal times")
    command.add_argument("--sensor", type=str, default="", help="width x height in px, like 240x180, instead of what the recording says")
    command.add_class_arguments(OpenOptions, skip={"strict", "sensor", "chunk"})


def add_running(command: Parser, images: int) -> None:
    command.add_argument("--out", type=str, required=True, help="folder to write; look at it with: tensorboard --logdir DIR")
    command.add_argument("--images", type=int, default=images, help="a picture of every so many windows; 0: none")
    command.add_argument("--threads", type=int, default=0, help="of the CPU's kernels; 0: as many as this process may use")
    command.add_argument("--quiet", action="store_true", help="no progress bar")


def add_stretch(command: Parser) -> None:
    command.add_argument(
        "--from", type=float | None, default=None, help="second of the recording's clock to begin at; default: the first event"
    )
    command.add_argument(
        "--to", type=float | None, default=None, help="second of the recording's clock to stop before; default: the last event"
    )


def made(kind: type[T], config: Namespace) -> T:
    """The part of the parsed options that belongs to one dataclass."""
    names = {f.name for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    with usage():
        return kind(**{name: value for name, value in vars(config).items() if name in names})


def opening(config: Namespace) -> OpenOptions:
    """How the recording is to be opened."""
    with usage():
        if not config.recording:
            raise ValueError("the recording's name is empty")
        if not config.sensor:
            return OpenOptions(config.strict, config.camera)
        try:
            width, height = (int(number) for number in config.sensor.lower().split("x"))
        except ValueError:
            raise ValueError(f"--sensor wants width x height, like 240x180, got {config.sensor!r}") from None
        return OpenOptions(config.strict, config.camera, (width, height))


def folder(name: str) -> Path:
    if not name:
        raise UsageError("--out wants the name of a folder")
    return Path(name)


def recording_of(config: Namespace, load: Callable[[str], None]) -> Recording:
    """The recording to go through, with the kernels loaded."""
    check_device(config.device)
    for name in ("images", "threads"):
        if config[name] < 0:
            raise UsageError(f"--{name} wants a number of at least 0, got {config[name]}")
    kernels.set_threads(config.threads or available_cores())  # of this process, which is ours
    recording = open(config.recording, opening(config))
    load(config.device)
    return recording


def settings(config: Namespace, options: Any, names: tuple[str, ...] = ()) -> str:
    """The run's configuration as YAML, which --config makes the same run of."""
    settings = {name: config[name] for name in ("strict", "camera", "sensor", "images", *names)} | dataclasses.asdict(options)
    text: str = yaml.safe_dump(json.loads(json.dumps(settings)), sort_keys=False)
    return text


def available_cores() -> int:
    """That this process may use, which may be fewer than there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_device(name: str) -> None:
    """A device that isn't there is the user's error, said before any work."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise UsageError(f"--device wants cpu, cuda or cuda:N, got {name!r}")
    if name != "cpu" and int(name.partition(":")[2] or 0) >= torch.cuda.device_count():
        raise UsageError(f"--device {name}: torch sees {torch.cuda.device_count()} CUDA devices on this machine; take --device cpu")
