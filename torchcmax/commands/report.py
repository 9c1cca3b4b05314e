"""torchcmax report: the pages of results, made again."""

from __future__ import annotations

import sys
from pathlib import Path

from jsonargparse import Namespace

from torchcmax.batchpage import write_batch_page
from torchcmax.config import Parser, UsageError, command
from torchcmax.io import DataError
from torchcmax.page import write_page
from torchcmax.resultfiles import BATCH, batch_rows, finished, inside

SUMMARY = "make report.html of results and batches again"


def build() -> Parser:
    """Its options."""
    sub = command(
        "Make report.html again, from what is in folders that compensate, track, panorama or batch wrote. The page needs no network and "
        "no other file. For a batch, the pages of all its finished results are made again too; one that cannot be made is told, and "
        "stops nothing."
    )
    sub.add_argument("folders", type=str, nargs="+", help="folders that compensate, track, panorama or batch wrote")
    return sub


def run(config: Namespace) -> int:
    """torchcmax report"""
    folders = [Path(name) for name in config.folders if name]
    if len(folders) < len(config.folders):
        raise UsageError("a folder's name is empty")
    failed: list[DataError] = []
    for folder in folders:
        try:
            _make(folder, failed)
        except DataError as error:  # the others must be seen
            failed.append(error)
    for one in failed:
        print(f"torchcmax report: {one}", file=sys.stderr)
    return 1 if failed else 0


def _make(folder: Path, failed: list[DataError]) -> None:
    """Make the page of a result, or the pages of a batch; failed: gets what is wrong with results whose pages cannot be made."""
    if inside(folder, BATCH):
        for place in finished(folder):
            try:
                write_page(place)
            except DataError as error:
                failed.append(error)
    print(f"report: {write_batch_page(folder, batch_rows(folder)) if inside(folder, BATCH) else write_page(folder)}")
