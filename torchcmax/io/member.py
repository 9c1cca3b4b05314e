"""Files of a recording, in a folder or within a .zip, read the same way."""

from __future__ import annotations

import codecs
import lzma
import os
import shlex
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchcmax.io.errors import DataError

Member = Path | zipfile.Path  # both know `/`, open, iterdir, is_file
PNG = b"\x89PNG\r\n\x1a\n"
GZIP, UTF16 = b"\x1f\x8b", (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
SMALL, LARGE = 1 << 20, 100 << 20  # bytes: no calibration or plane has more than the first, no trajectory more than the second


def open_zip(path: Path) -> zipfile.Path:
    """The folder with events.txt within a .zip: its top, or the one folder in it.  Nothing is written to disk."""
    with reading(path):
        archive = zipfile.ZipFile(path)
        if any(info.flag_bits & 1 for info in archive.infolist()):
            raise DataError(path, "is locked with a password", "unpack it and open the folder")
        top = zipfile.Path(archive)
        folders = [top, *(entry for entry in top.iterdir() if entry.is_dir())]
    found = [folder for folder in folders if (folder / "events.txt").is_file()]
    if len(found) != 1:
        names = ", ".join(str(folder.at) or "the top" for folder in found)
        problem = f"holds several recordings, in {names}" if found else "holds no events.txt at its top or within one folder"
        raise DataError(path, problem, "unpack it and open one folder with events.txt and calib.txt")
    return found[0]


@contextmanager
def reading(file: Member) -> Iterator[None]:
    """Turns what goes wrong while a file is read into a DataError."""
    try:
        yield
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, NotImplementedError) as error:
        raise DataError(str(file), f"cannot be read: {error}", "copy or download it again, and check that you may read it") from error


def size_in_bytes(file: Member) -> int:
    """What a file measures, unpacked."""
    return file.root.getinfo(file.at).file_size if isinstance(file, zipfile.Path) else file.stat().st_size


def not_a_file(path: Path, what: str) -> str:
    """Why a path cannot be opened as a file: it is something else, or nothing."""
    return "is no regular file, but a device, a folder or a broken link" if os.path.lexists(path) else f"there is no such {what}"


def refuse_foreign(file: Member, head: bytes) -> None:
    """DataError where a file that should be text begins as plain text never does."""
    name = shlex.quote(file.name)
    if head.startswith(GZIP):
        raise DataError(str(file), "is compressed with gzip", f"unpack it first: gunzip < {name} > unpacked.txt")
    if head.startswith(UTF16) or b"\0" in head:
        remedy = f"write it as plain text; if it is UTF-16: iconv -f UTF-16 -t UTF-8 {name} > plain.txt"
        raise DataError(str(file), f"is not plain text: it begins with {head[:16]!r}", remedy)


def text_of(file: Member, most: int = SMALL) -> str:
    """A text file of at most so many bytes, without a byte order mark; DataError where it has more."""
    with reading(file), file.open("rb") as stream:
        text = stream.read(most + 1)
    if len(text) > most:
        raise DataError(str(file), f"has more than {most >> 20} MiB, too much for what it should hold", "put the right file there")
    refuse_foreign(file, text)
    return text.decode("utf-8-sig", "backslashreplace")


def text_lines(text: str) -> list[tuple[int, str]]:
    """Lines of a text with their numbers, from 1; empty ones and comments (#) are left out."""
    lines = [(number, line.strip()) for number, line in enumerate(text.split("\n"), 1)]
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def image_size(folder: Member) -> tuple[int, int] | None:
    """Width and height of the first PNG below images/, px; None where there is none."""
    images = folder / "images"
    if not images.is_dir():
        return None
    pictures = sorted((entry for entry in images.iterdir() if entry.name.lower().endswith(".png")), key=lambda entry: entry.name)
    if not pictures:
        return None
    with reading(pictures[0]), pictures[0].open("rb") as stream:
        head = stream.read(24)
    if len(head) < 24 or not head.startswith(PNG):
        return None
    width, height = struct.unpack(">II", head[16:24])
    return width, height
