"""What is wrong with a file, where, and what to do about it."""

from __future__ import annotations

import warnings
from contextvars import ContextVar
from pathlib import Path


class DataError(Exception):
    """A file that cannot be used as it is: says which, where in it, what is wrong and what to do.  The CLI exits with 1."""

    def __init__(self, path: Path | str, problem: str = "", remedy: str = "", place: str = "") -> None:
        self.path, self.place, self.problem, self.remedy = Path(path), place, problem, remedy
        where = f"{path}, {place}" if place else f"{path}"
        super().__init__(f"{where}: {problem}\n  what to do: {remedy}" if problem else where)  # a DataLoader hands on the whole text alone

    def __reduce__(self) -> tuple[type[DataError], tuple[Path, str, str, str]]:
        return type(self), (self.path, self.problem, self.remedy, self.place)


class DataWarning(UserWarning):
    """Something in a file that was mended or left out, and said so."""


class DataNote(UserWarning):
    """Something in a file that is worth knowing and changes nothing."""


LATER: ContextVar[list[Warning] | None] = ContextVar("LATER", default=None)


def tell(warning: Warning) -> None:
    """Warns of something in a file; a thread that reads ahead only notes it in LATER, for whoever it reads for.

    `warnings` belongs to the whole process: told from another thread, a warning would meet the filters of any moment.
    """
    later = LATER.get()
    if later is None:
        warnings.warn(warning, stacklevel=3)
    else:
        later.append(warning)
