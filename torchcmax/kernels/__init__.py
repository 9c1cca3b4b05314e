"""Fast twins of core/draw.py and of the search, chosen by where tensors are; without them everything works, slower."""

from __future__ import annotations

import importlib.util
import logging
import os
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

log = logging.getLogger("torchcmax")
NEAREST = 1e-3  # depth of a ray below which it counts as behind the camera
TRITON = (3, 3)  # the first that takes the kernels as they are written
MOST = {torch.float32: 1 << 24, torch.float64: 1 << 31}  # pixels: what float32 tells apart, what an int32 counts; on the CPU
SWITCH = "TORCHCMAX_KERNELS"  # environment: 0 leaves the kernels out, to compare with
_threads = 0


def threads() -> int:
    """Threads that the CPU's kernels use: those of torch unless `set_threads` said otherwise."""
    return _threads or torch.get_num_threads()


def set_threads(count: int) -> None:
    """Let the CPU's kernels use so many threads; 0: as many as torch."""
    global _threads
    if count < 0:
        raise ValueError(f"a number of threads is at least 0, got {count}")
    _threads = count


def drawing(like: Tensor, pixels: int = 0) -> ModuleType | None:
    """The module with `votes` and `slopes` for tensors like this one and frames of so many pixels, None where there is none."""
    if like.device.type == "cpu" and pixels >= MOST.get(like.dtype, 0):
        return None
    if os.environ.get(SWITCH) == "0" or like.dtype not in (torch.float32, torch.float64):
        return None
    return _cuda() if like.is_cuda else _cpu() if like.device.type == "cpu" else None


def searching(like: Tensor, canvas: Any) -> ModuleType | None:
    """The module with `search` and `sharpness` for tensors like this one and this canvas, None where there is none."""
    return drawing(like, frame(canvas)) if like.device.type == "cpu" and not canvas.sphere else None


def frame(canvas: Any) -> int:
    """Pixels of the frame around a canvas."""
    return int((canvas.size[0] + 2) * (canvas.size[1] + 2))


@lru_cache(maxsize=1)
def _cpu() -> ModuleType | None:
    if importlib.util.find_spec("numba") is None:
        log.warning("torchcmax: without numba the CPU is some twenty times slower; get it with: pip install 'torchcmax[fast]'")
        return None
    try:
        from torchcmax.kernels import cpu
    except ImportError as error:  # numba is there and does not work, for instance with a numpy that is too new for it
        log.warning("torchcmax: numba cannot be used, so the CPU is slower: %s", error)
        return None
    return cpu


@lru_cache(maxsize=1)
def _cuda() -> ModuleType | None:
    try:
        found = tuple(int(part) for part in version("triton").split(".")[:2])
    except PackageNotFoundError:
        found = (0, 0)
    if found < TRITON:
        log.warning("torchcmax: without triton %d.%d the GPU is slower; torch 2.7 and later bring it: pip install -U torch", *TRITON)
        return None
    from torchcmax.kernels import cuda

    return cuda
