"""torchcmax report: the pages of results, made again."""

from __future__ import annotations

from pathlib import Path

from jsonargparse import Namespace

from torchcmax.batchpage import write_batch_page
from torchcmax.config import Parser, command
from torchcmax.io import DataError
from torchcmax.page import write_page
from torchcmax.resultfiles import AGAIN, inside, read_json

SUMMARY = "make report.html of results and batches again"
ALL = "batch.json"


def build() -> Parser:
    """Its options."""
    sub = command(
        "Make report.html again, from what is in folders that compensate, track, panorama or batch wrote. The page needs no network and "
        "no other file. For a batch, the pages of all its finished results are made again too."
    )
    sub.add_argument("folders", type=str, nargs="+", help="folders that compensate, track, panorama or batch wrote")
    return sub


def run(config: Namespace) -> int:
    """torchcmax report"""
    for name in config.folders:
        folder = Path(name)
        print(f"report: {_batch(folder) if name and inside(folder, ALL) else write_page(folder)}")
    return 0


def _batch(folder: Path) -> Path:
    """The page of a batch, after those of its results."""
    rows = read_json(folder, ALL).get("results")
    if not isinstance(rows, list) or not all(isinstance(row, dict) and isinstance(row.get("settings", {}), dict) for row in rows):
        raise DataError(folder / ALL, "has no list of results", AGAIN)
    for row in rows:
        place = inside(folder, str(row.get("folder", "")))
        if row.get("exit") == 0 and place is not None and place.resolve() != folder.resolve():
            write_page(place)
    return write_batch_page(folder, rows)
