"""The page of a batch, report.html: a table over its results, what failed first, each with a link to its own page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from torchcmax.folder import PAGE, writing
from torchcmax.io import DataError
from torchcmax.job import numbers
from torchcmax.page import document, number, picture, section
from torchcmax.resultfiles import MAPS, inside

THUMB = 160  # px
COLUMNS = {  # of summary.json, flat
    "windows": "windows", "seconds": "duration, s", "real_time_factor": "real-time factor", "gain_median": "median gain",
    "error.percent_of_distance": "position RMSE, % of distance", "error.position_rmse_m": "position RMSE, m",
    "error.orientation_rmse_deg": "orientation RMSE, °", "error.coverage": "coverage", "lost_seconds": "lost, s", "keyframes": "keyframes",
}  # fmt: skip
SORTING = """
for (const table of document.querySelectorAll('table.sort')) for (const head of table.querySelectorAll('th[scope=col]')) {
  const button = document.createElement('button'); button.append(...head.childNodes); head.append(button);
  button.addEventListener('click', () => { const k = head.cellIndex, up = head.getAttribute('aria-sort') !== 'ascending';
    for (const other of table.querySelectorAll('th[scope=col]')) other.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
    const key = row => row.cells[k].dataset.v ?? row.cells[k].textContent, body = table.tBodies[0];
    const order = (a, b) => { const x = key(a), y = key(b); if (!x || !y) return !x - !y;
      return (up ? 1 : -1) * (isNaN(x) || isNaN(y) ? x.localeCompare(y) : x - y) };
    body.append(...[...body.rows].sort(order)) }) }
"""
MORE = """<style>body { max-width: none } .sort th { vertical-align: bottom } .sort td, .sort th { overflow-wrap: normal }
.sort td.n { text-align: right; white-space: nowrap }
.sort button { all: unset; cursor: pointer } .sort button:focus-visible { outline: 2px solid } th[aria-sort=ascending] button::after
{ content: " ↑" } th[aria-sort=descending] button::after { content: " ↓" } .sort img { width: 110px; max-width: none; border: 0 }
.failed { border-left: 3px solid #d55e00; padding-left: 1rem; margin: 0 0 1rem; overflow-wrap: anywhere }
.failed pre { white-space: pre-wrap }
</style>"""
Row = dict[str, Any]


def write_batch_page(folder: Path, rows: list[Row]) -> Path:
    """report.html of a batch; rows: the manifests of its results, in order."""
    failed = [row for row in rows if row.get("exit") != 0]
    finished = [row for row in rows if row.get("exit") == 0]
    tasks = ", ".join(dict.fromkeys(str(row.get("task", "")) for row in rows))
    seconds = sum(float(row.get("seconds") or 0) for row in rows)
    told = f"{tasks}: {len(finished)} finished, {len(failed)} failed, {number(round(seconds, 1))} s of work"
    body = [
        MORE,
        f"<h1>{escape(folder.resolve().name)}</h1>",
        f'<p class="sub">{escape(told)}</p>',
        section("Failed", "\n".join(_failure(folder, row) for row in failed)),
        section("Results", _table(folder, finished)),
    ]
    page = document(f"batch {folder.resolve().name}", body, SORTING)
    with writing(folder / PAGE) as name:
        name.write_text(page, encoding="utf-8")
    return folder / PAGE


def _failure(folder: Path, row: Row) -> str:
    """Which, with which settings, and why."""
    settings = ", ".join(f"{key}={value}" for key, value in row.get("settings", {}).items())
    name = f"{row.get('name')} ({settings})" if settings else f"{row.get('name')}"
    where = str(row.get("folder", ""))
    log = f'<a href="{quote(where)}/log.txt">log</a>' if inside(folder, f"{where}/log.txt") else ""
    told = f"{escape(str(row.get('recording')))}, exit {number(row.get('exit'))}, after {number(row.get('seconds'))} s {log}"
    return f'<div class="failed"><strong>{escape(name)}</strong><br>{told}<pre>{escape(str(row.get("error") or ""))}</pre></div>'


def _table(folder: Path, rows: Sequence[Row]) -> str:
    """A line for each result; only columns that some result has."""
    if not rows:
        return ""
    found = [_own(folder, row) for row in rows]
    swept = list(dict.fromkeys(key for row in rows for key in row.get("settings", {})))
    columns = [name for name in COLUMNS if any(name in values for values in found)]
    heads = ["", "recording", *swept, *(COLUMNS[name] for name in columns), "work, s"]
    lines = []
    for row, values in zip(rows, found, strict=True):
        cells = [f"<td>{_thumbnail(folder, row)}</td>", f"<td>{_link(folder, row)}</td>"]
        cells += [_cell(row.get("settings", {}).get(key)) for key in swept]
        cells += [_cell(values.get(name)) for name in columns]
        lines.append(f"<tr>{''.join(cells)}{_cell(row.get('seconds'))}</tr>")
    head = "".join(f'<th scope="col">{escape(name)}</th>' if name else "<td></td>" for name in heads)
    return f'<div class="wide"><table class="sort"><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _own(folder: Path, row: Row) -> dict[str, float]:
    """The numbers of a result's summary, with the factor that `compensate` leaves to the reader."""
    place = inside(folder, str(row.get("folder", "")))
    values = numbers(place) if place is not None else {}
    if "real_time_factor" not in values and values.get("wall_seconds"):
        values["real_time_factor"] = values.get("seconds", 0.0) / values["wall_seconds"]
    return values


def _cell(value: Any) -> str:
    """A number to be sorted by its value, or a word."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return f'<td class="n" data-v="{value!r}">{number(value)}</td>'
    return f"<td>{'' if value is None else number(value)}</td>"


def _link(folder: Path, row: Row) -> str:
    where, name = str(row.get("folder", "")), escape(str(row.get("name")))
    return f'<a href="{quote(where)}/{PAGE}">{name}</a>' if inside(folder, f"{where}/{PAGE}") else name


def _thumbnail(folder: Path, row: Row) -> str:
    """The map, or else the first window that was drawn."""
    where = inside(folder, str(row.get("folder", "")))
    if where is None:
        return ""
    images = inside(where, "images")
    windows = [] if images is None else [f"images/{path.name}" for path in sorted(images.glob("window_*.png"))[:1]]
    for name in (*MAPS, *windows):
        path = inside(where, name)
        if path is not None:
            try:
                return picture(path, f"{name} of {row.get('name')}", THUMB)
            except DataError:  # the result's own page says what is wrong with it; the others must be seen
                return ""
    return ""
