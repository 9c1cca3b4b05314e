"""How functions are compiled: by numba, once for this processor, kept on disk."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core import event

log = logging.getLogger("torchcmax")
FAST = {"reassoc", "contract", "arcp", "nsz"}  # sums in any order, fused multiply-add; nan and inf keep their meaning


def compiled(function: Callable[..., Any]) -> Any:
    """The function as machine code that runs without the interpreter's lock."""
    options: dict[str, Any] = {"nogil": True, "fastmath": FAST, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder where code could be kept: it is compiled in every process
        return numba.njit(**options)(function)


def forget_stale(kept: Path, sources: Path = Path(__file__).parent) -> None:
    """Drop code in `kept` that is older than any of the sources: numba looks at the file of the outermost function alone."""
    with suppress(OSError):  # another process does the same, or the folder is not ours
        newest = max((path.stat().st_mtime for path in sources.glob("*.py")), default=0.0)
        for code in kept.glob("*.nbi"):
            if code.stat().st_mtime < newest:
                code.unlink()


class _Say(event.Listener):
    """Says that something is compiled, the first time it happens in a process."""

    said = False

    def on_start(self, event: Any) -> None:
        module = sys.modules.get("torchcmax.kernels.compiling")
        if not _Say.said and module is not None and str(event.data["dispatcher"].py_func.__module__).startswith("torchcmax."):
            _Say.said = True
            log.warning("torchcmax: compiling the kernels for this processor, once; this takes up to a minute")

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Say())
