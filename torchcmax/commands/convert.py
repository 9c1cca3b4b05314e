"""torchcmax convert: any recording as one HDF5 file of ours."""

from __future__ import annotations

from pathlib import Path

from jsonargparse import Namespace
from tqdm import tqdm

from torchcmax.commands.arguments import add_opening, opening
from torchcmax.config import Parser, UsageError, command
from torchcmax.io import DataError, open, save

SUMMARY = "write a recording of any format as one HDF5 file"
DESCRIPTION = (
    "Write a recording of any format as one HDF5 file of ours: events compressed, in order of time, with an index by time, camera, ground "
    "truth and plane. A stretch of it is read at once, wherever it lies, and nothing beside it is needed. The file appears under its name "
    "only when it is whole."
)


def build() -> Parser:
    """Its options."""
    sub = command(DESCRIPTION)
    add_opening(sub)
    sub.add_argument("out", type=str, help="file to write, like poster.h5; a file that is there is replaced only with --force")
    sub.add_argument("--force", action="store_true", help="replace a file that is there")
    sub.add_argument("--quiet", action="store_true", help="no progress bar")
    return sub


def run(config: Namespace) -> int:
    """torchcmax convert"""
    out = Path(config.out)
    if out.suffix not in (".h5", ".hdf5"):
        raise UsageError(f"the file to write is an HDF5 file, NAME.h5, got {config.out!r}")
    recording = open(config.recording, opening(config))
    if out.exists() and out.resolve() in (recording.path.resolve(), Path(config.recording).resolve()):
        raise DataError(out, "is the recording itself", "give another name to write")
    if out.exists() and not config.force:
        raise DataError(out, "is there already", "give another name, or --force to replace it")
    with tqdm(total=recording.count, unit=" events", unit_scale=True, desc=recording.name, disable=config.quiet) as bar:
        save(recording, out, lambda events: bar.update(events - bar.n))
    print(f"recording: {out} ({out.stat().st_size / 1e6:.1f} MB)")
    return 0
