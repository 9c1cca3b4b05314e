"""torchcmax evaluate: results against ground truth."""

from __future__ import annotations

import dataclasses
import json
import sys
from functools import cache
from pathlib import Path

from jsonargparse import Namespace
from tqdm import tqdm

from torchcmax.commands.arguments import made
from torchcmax.config import Parser, UsageError, command, usage
from torchcmax.evaluate import ALL, EvaluateOptions, Row, evaluate, read_run, write_csv
from torchcmax.folder import EVALUATION, writing
from torchcmax.io import DataError
from torchcmax.io.truth import REMEDY, read_truth
from torchcmax.page import write_page
from torchcmax.protocols import PROTOCOLS
from torchcmax.resultfiles import finished

SUMMARY = "say how far results are from ground truth"
DESCRIPTION = (
    "Say how far results are from ground truth, by named protocols, so that numbers can stand beside those of papers. A result is a folder "
    "that track, panorama or compensate wrote, a whole batch, or a trajectory of any other system as text (TUM). Prints a table; writes "
    "evaluation.json and evaluation.csv with all statistics into the result's folder, and shows them in its report.html."
)
USUAL = "usual"
SHOWN = {
    "ate_rmse_m": "ATE m", "percent_of_path": "% path", "percent_of_distance": "% distance", "rotation_rmse_deg": "rotation °",
    "rpe_translation_rmse_m": "RPE m", "rpe_rotation_rmse_deg": "RPE °", "omega_x_rmse_deg_s": "ωx °/s", "omega_y_rmse_deg_s": "ωy °/s",
    "omega_z_rmse_deg_s": "ωz °/s", "v_x_rmse_m_s": "vx m/s", "v_y_rmse_m_s": "vy m/s", "v_z_rmse_m_s": "vz m/s", "scale": "scale",
    "coverage": "coverage",
}  # fmt: skip


def build() -> Parser:
    """Its options."""
    sub = command(DESCRIPTION)
    sub.add_argument("results", type=str, nargs="+", help="folders that track, panorama, compensate or batch wrote, or trajectories")
    sub.add_argument(
        "--truth", type=str, default="", help="text as of ECD and TUM, EuRoC's csv, or a recording; default: the recording of each result"
    )
    told = "; ".join(f"{name}: {protocol.about}{' (extra eval)' if protocol.evo else ''}" for name, protocol in PROTOCOLS.items())
    sub.add_argument(
        "--protocol", type=str, default=USUAL, help=f"names with commas between them, all, or {USUAL}: what needs no extra. {told}"
    )
    sub.add_argument("--from", type=float | None, default=None, help="second of the recording's clock to begin at")
    sub.add_argument("--to", type=float | None, default=None, help="second of the recording's clock to stop before")
    sub.add_class_arguments(EvaluateOptions, skip={"begin", "end"})
    sub.add_argument("--json", action="store_true", help="print JSON instead of a table")
    sub.add_argument("--csv", type=str, default="", help="file to write the numbers of all results to")
    return sub


def run(config: Namespace) -> int:
    """torchcmax evaluate"""
    names = _protocols(config.protocol)
    config.begin, config.end = config["from"], config.to
    with usage():
        options = made(EvaluateOptions, config)
        if not all(config.results):
            raise ValueError("a result's name is empty")
    places = [place for name in config.results for place in finished(Path(name))]
    told, rows, failed = [], list[Row](), 0
    truth_of = cache(read_truth)
    for place in tqdm(places, desc="evaluate", unit=" results", disable=len(places) < 2, leave=False):
        try:
            run = read_run(place)
            if not config.truth and run.recording is None:
                raise DataError(place, "does not say where its ground truth is", REMEDY)
            where = Path(config.truth or str(run.recording))
            run = run if len(places) == 1 else dataclasses.replace(run, name=str(place))
            found = evaluate(run, *truth_of(where), where, names, options)
            rows += found.rows
            told.append({"truth": str(where), "offset_s": found.offset, "offset_found": found.found, "results": found.rows})
            if found.found and not config.json:
                print(f"offset: {found.offset:.6f} s are added to the times of {place}")
            if place.is_dir():
                found.save(place)
                write_page(place)
        except DataError as error:
            if len(places) == 1 and not rows:
                raise
            print(f"torchcmax evaluate: {error}", file=sys.stderr)
            failed += 1
    if config.json or rows:
        print(json.dumps(told, indent=1) if config.json else table(rows))
    if len(places) == 1 and places[0].is_dir() and not config.json and not failed:
        print("\n".join(f"evaluation: {places[0] / name}" for name in EVALUATION))
    if config.csv and rows:
        with writing(Path(config.csv)) as temporary:
            write_csv(temporary, rows)
    return 1 if failed else 0


def _protocols(text: str) -> tuple[str, ...]:
    """Names of protocols, or `ALL`, or () for the usual ones."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if names in ((USUAL,), ALL):
        return () if names == (USUAL,) else names
    unknown = [name for name in names if name not in PROTOCOLS]
    if unknown or not names:
        raise UsageError(f"--protocol wants {', '.join(PROTOCOLS)}, all or {USUAL}, got {unknown[0] if unknown else text!r}")
    return names


def table(rows: list[Row]) -> str:
    """Rows as aligned text: the numbers that papers quote, those that any row has."""
    columns = {name: told for name, told in SHOWN.items() if any(row.get(name) is not None for row in rows)}
    head = ["result", "protocol", *columns.values()]
    lines = [[str(row["result"]), str(row["protocol"]), *(_cell(row.get(name)) for name in columns)] for row in rows]
    wide = [max(len(line[i]) for line in [head, *lines]) for i in range(len(head))]
    return "\n".join("  ".join(_padded(line, wide)).rstrip() for line in [head, *lines])


def _padded(line: list[str], wide: list[int]) -> list[str]:
    """Words to the left, numbers to the right."""
    return [word.ljust(width) if i < 2 else word.rjust(width) for i, (word, width) in enumerate(zip(line, wide, strict=True))]


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else ""
