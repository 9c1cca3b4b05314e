"""What is wrong with a file, where, and what to do about it."""

from __future__ import annotations

from pathlib import Path


class DataError(Exception):
    """A file that cannot be used as it is: says which, where in it, what is wrong and what to do.  The CLI exits with 1."""

    def __init__(self, path: Path | str, problem: str, remedy: str, place: str = "") -> None:
        self.path, self.place, self.problem, self.remedy = Path(path), place, problem, remedy
        where = f"{path}, {place}" if place else f"{path}"
        super().__init__(f"{where}: {problem}\n  what to do: {remedy}")


class DataWarning(UserWarning):
    """Something in a file that was mended or left out, and said so."""


class DataNote(UserWarning):
    """Something in a file that is worth knowing and changes nothing."""
