"""Motion-compensate a recording: its windows in batches, each estimated from a cold start."""

from __future__ import annotations

import warnings
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from torchcmax.core.camera import Camera
from torchcmax.core.estimate import Estimate, Search, estimate
from torchcmax.core.model import Model, Planar, PlanarKnown, Rotation, Translation
from torchcmax.core.objective import Look
from torchcmax.core.window import Window
from torchcmax.io import DataError, DataWarning, Recording
from torchcmax.io.ahead import ahead

BATCH = {"cpu": 16, "gpu": 512}  # windows: enough to keep the cores busy, or to make little of what it costs to begin a kernel


@dataclass(frozen=True)
class Compensation:
    """What is estimated, from how many events, and where."""

    model: Literal["rotation", "translation", "planar"] = "rotation"
    """rotation: 3 numbers, any scene; translation: 3, before a plane; planar: 6 before a known plane, 8 with its normal."""
    plane: str = "auto"
    """The plane: wall (fronto-parallel), truth (the recording's plane and poses), three numbers "nx,ny,nz" of its normal in the
    camera's frame, or free (estimated, for planar only); auto: free for planar, wall for translation."""
    events: int = 30000
    """Events in a window."""
    stride: int | None = None
    """Events from the start of one window to the next; default: the windows lie end to end."""
    limit: int | None = None
    """Stop after this many windows."""
    batch: int | None = None
    """Windows computed together; each of 30,000 events takes some 3 MB of memory. Default: 16 on a CPU, 512 on a GPU."""
    device: str = "cpu"
    """cpu, cuda, or cuda:1 and so on."""
    look: Look = field(default_factory=Look)
    """How a window is looked at."""
    search: Search = field(default_factory=Search)
    """How the sharpest image is searched for."""

    def __post_init__(self) -> None:
        for name in ("events", "stride", "limit", "batch"):
            value, least = getattr(self, name), 2 if name == "events" else 1
            if value is not None and value < least:
                raise ValueError(f"{name} wants a number of at least {least}, got {value}")
        given_normal(self.plane)
        if self.model == "rotation" and self.plane != "auto":
            raise ValueError("--plane goes with --model planar or translation: a rotation shows no plane")
        if self.model == "translation" and self.plane == "free":
            raise ValueError("--plane free goes with --model planar: a translation alone hardly tells the plane from the velocity")


def given_normal(plane: str) -> tuple[float, ...] | None:
    """The unit normal that an option like "0,0.1,-1" names, turned to the camera; None for the words."""
    if plane in ("auto", "wall", "truth", "free"):
        return None
    try:
        x, y, z = (float(part) for part in plane.replace(",", " ").split())
    except ValueError:
        raise ValueError(f"--plane wants auto, free, wall, truth or three numbers nx,ny,nz, got {plane!r}") from None
    length = (x * x + y * y + z * z) ** 0.5
    if not 0 < length < float("inf"):
        raise ValueError(f"--plane wants a normal with a length, got {plane!r}")
    side = -length if z > 0 else length
    return (x / side, y / side, z / side)


def compensate(recording: Recording, options: Compensation | None = None) -> Generator[tuple[Window, Estimate], None, None]:
    """Windows and what they show, batch by batch, in the order of the recording.

    -> Window [B, N] and Estimate [B], float32 on the options' device.  The next batch is read while one is estimated; memory is
    that of two batches and of what estimating one takes.
    """
    options = options or Compensation()
    device = torch.empty(0, device=options.device).device  # which GPU "cuda" means, only the caller's thread knows
    with closing(ahead(_batches(recording, options, device))) as batches:
        for window in batches:
            at_once = window.start[window.duration <= 0]
            if len(at_once):
                text = f"{recording.path}: all events of the window at {at_once[0].item()} us have one time, so that no motion can be seen"
                warnings.warn(DataWarning(text), stacklevel=2)
            yield window, estimate(window, recording.camera, motion_model(options, recording, window), options.look, options.search)


def _batches(recording: Recording, options: Compensation, device: torch.device) -> Generator[Window, None, None]:
    """As many windows as the options want; not even read are those after them."""
    left = options.limit
    most = options.batch or BATCH["cpu" if device.type == "cpu" else "gpu"]
    batch = most if left is None else min(left, most)
    for window in recording.windows(options.events, options.stride, batch, device):
        yield window[:left]
        left = None if left is None else left - len(window)
        if left is not None and left <= 0:
            return


def load_kernels(device: str) -> None:
    """Estimate a window of nothing: what is compiled, or loaded, for this device is there afterwards, and later times are of work."""
    one = torch.ones(1, 16, device=device)
    ray = torch.stack([0 * one, 0 * one, one], -1)
    window = Window(ray, one.cumsum(-1) - 1, one, torch.zeros(1, dtype=torch.int64, device=device), 15 * one[:, 0])
    estimate(window, Camera.pinhole((16, 16)), Rotation(16.0))


def motion_model(options: Compensation, recording: Recording, window: Window) -> Model:
    """The model that the options name, with the planes it knows of these windows."""
    focal = (recording.camera.fx * recording.camera.fy) ** 0.5
    if options.model == "rotation":
        return Rotation(focal)
    if options.model == "planar" and options.plane in ("auto", "free"):
        return Planar(focal)
    kind = Translation if options.model == "translation" else PlanarKnown
    given = given_normal(options.plane)
    if given is not None:
        return kind(focal, torch.tensor(given, device=window.ray.device).expand(len(window), 3))
    return kind(focal, true_normal(recording, window.start).to(window.ray.device) if options.plane == "truth" else None)


def true_normal(recording: Recording, start: Tensor) -> Tensor:
    """The recording's plane as the camera sees it at the given times: start [B] µs -> normal [B, 3]."""
    if recording.truth is None or recording.plane is None:
        remedy = "give groundtruth.txt and plane.txt, or another --plane"
        raise DataError(recording.path, "has no ground truth and plane for --plane truth", remedy)
    try:
        pose = recording.truth.at(start.cpu())
    except ValueError as error:
        remedy = "check that groundtruth.txt and the events count time from the same moment, or take another --plane"
        raise DataError(recording.path, f"the ground truth does not cover the events: {error}", remedy) from None
    return recording.plane.seen_from(pose).normal
