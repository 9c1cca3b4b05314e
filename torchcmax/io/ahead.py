"""Read ahead: what comes next is made by a thread while what came last is worked on."""

from __future__ import annotations

import warnings
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

from torchcmax.io.errors import LATER

T = TypeVar("T")


def ahead(source: Generator[T, None, None]) -> Generator[T, None, None]:
    """The same things in the same order, each made by a thread while the caller works on the one before: memory for one more.

    What the source raises, and what it says by `tell`, reaches the caller where it would without the thread.  Closed early, it
    waits for the thing that is just being made, and closes the source.
    """
    told: list[Warning] = []
    end = object()
    reader = ThreadPoolExecutor(1, "ahead", initializer=LATER.set, initargs=(told,))  # idle between things, so that nothing hangs
    try:
        coming = reader.submit(next, source, end)
        while True:
            thing = coming.result()
            _tell_again(told)
            if thing is end:
                return
            coming = reader.submit(next, source, end)
            yield thing  # type: ignore[misc]
    except Exception:
        with suppress(Warning):  # one that is made an error does not take the place of what went wrong
            _tell_again(told)
        raise
    finally:
        reader.shutdown(cancel_futures=True)
        source.close()
        _tell_again(told)


def _tell_again(told: list[Warning]) -> None:
    while told:
        warnings.warn(told.pop(0), stacklevel=3)
