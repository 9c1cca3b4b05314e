"""The page of one result, report.html: built from the folder's files alone, without anything that it would have to fetch."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image

from torchcmax import resultplots
from torchcmax.chart import STYLE
from torchcmax.folder import PAGE, writing
from torchcmax.io import DataError
from torchcmax.resultfiles import AGAIN, Result, read_result

WIDEST, LARGE = 1600, 300_000  # px and bytes of a picture that is embedded as it is
SHOWN = 3  # best windows, and worst ones
FIRST = {  # of summary.json, in the order that a reader asks; None: shown elsewhere, or not at all
    "recording": "recording", "seconds": "duration, s", "windows": "windows", "events": "events", "real_time_factor": "real-time factor",
    "mega_events_per_second": "Mevents per second of work", "wall_seconds": "time of work, s", "gain_median": "median gain",
    "contrast_median": "median contrast", "converged_share": "share converged", "evaluations_median": "median evaluations",
    "lost_seconds": "lost, s", "losses": "times lost", "recoveries": "times found again", "keyframes": "keyframes", "maps": "maps",
    "maps_joined": "maps joined", "model": "model",
    "path": None,
    "complete": None, "stopped_by": None, "config": None, "files": None, "versions": None, "pictures": None,
    "error": None, "status": None,
}  # fmt: skip
PLAIN = """
* { box-sizing: border-box } html { color-scheme: light dark }
body { margin: 0 auto; max-width: 1080px; padding: 2rem 1.5rem 4rem; font: 15px/1.5 system-ui, sans-serif;
 color: #1b1b1b; background: #fff }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; overflow-wrap: anywhere } h2 { font-size: 1.15rem; margin: 2.4rem 0 .7rem }
h3 { font-size: 1rem; margin: .1rem 0 .2rem }
.sub { color: #666; margin: 0 0 1.2rem; overflow-wrap: anywhere } .bad { color: #a3360a; font-weight: 600 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums } th { text-align: left; font-weight: 500; color: #666 }
td, th { padding: .22rem .9rem .22rem 0; border-bottom: 1px solid #e8e8e8; vertical-align: top; overflow-wrap: anywhere }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); gap: 0 2.5rem; align-items: start }
.facts table { width: 100%; margin-bottom: 1.2rem } .facts th { white-space: nowrap }
 .facts td { text-align: right } figure { margin: 0 0 1.2rem; min-width: 0 }
figcaption { color: #666; font-size: .9rem; margin-top: .3rem } img { max-width: 100%; height: auto; display: block;
 border: 1px solid #ddd }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr)); gap: 1rem } .wide { overflow-x: auto }
pre { overflow-x: auto; font-size: .82rem; background: #f6f6f6; padding: 1rem } summary { cursor: pointer; font-weight: 500 }
details { margin: .6rem 0 } a { color: #0060a0 } footer { color: #777; font-size: .85rem; margin-top: 3rem }
@media (prefers-color-scheme: dark) { body { color: #ddd; background: #161616 } td, th { border-color: #333 } pre { background: #222 }
 .sub, th, figcaption, footer { color: #9a9a9a } .bad { color: #f0884a } img { border-color: #444 } a { color: #6bb8f0 } }
@media print { body { max-width: none } }
"""
HOVER = """
const all = [...document.querySelectorAll('svg.time')], n = (s, k) => +s.dataset[k];
const points = new Map();
function value(s, p, u) {
  if (!points.has(p)) points.set(p, [...p.getAttribute('d').matchAll(/([ML])([-\\d.]+) ([-\\d.]+)/g)].map(m => [+m[2], +m[3], m[1]]));
  const all = points.get(p), k = all.findIndex(q => q[0] >= u), after = all[k], before = all[k < 0 ? all.length - 1 : k - 1];
  const far = q => q ? Math.abs(q[0] - u) : Infinity, best = far(after) < far(before) ? after : before;
  if (!(after && before && after[2] === 'L') && far(best) > 4) return '–';
  return (n(s,'m') + (best[1] - n(s,'c')) / (n(s,'d') - n(s,'c')) * (n(s,'n') - n(s,'m'))).toPrecision(4) }
function show(u) { for (const s of all) { const h = s.querySelector('.hair'), r = s.querySelector('.read');
  const on = u >= n(s,'a') && u <= n(s,'b'); h.style.visibility = on ? 'visible' : 'hidden'; r.textContent = '';
  if (!on) continue; h.setAttribute('transform', `translate(${u} 0)`);
  const t = n(s,'l') + (u - n(s,'a')) / (n(s,'b') - n(s,'a')) * (n(s,'h') - n(s,'l'));
  r.textContent = t.toFixed(3) + ' s   ' + [...s.querySelectorAll('path.line[data-name]')].map(p => value(s, p, u)).join('  ') } }
for (const s of all) { s.addEventListener('pointermove', e => { const b = s.getBoundingClientRect();
  show((e.clientX - b.left) / b.width * s.viewBox.baseVal.width) }); s.addEventListener('pointerleave', () => show(-1)) }
"""


def write_page(folder: Path) -> Path:
    """report.html of a folder that `compensate`, `track` or `panorama` wrote; -> its path."""
    page = build_page(read_result(folder))
    with writing(folder / PAGE) as name:
        name.write_text(page, encoding="utf-8")
    return folder / PAGE


def build_page(result: Result) -> str:
    """The whole page."""
    name = str(result.summary.get("recording") or result.folder.resolve().name)
    body = [
        f"<h1>{escape(name)}</h1>",
        _state(result),
        section("Summary", _facts(result)),
        section("Trajectory", resultplots.trajectory(result)),
        section("Errors over time", resultplots.errors(result)),
        section("Contrast and events", resultplots.quality(result)),
        section("Motion", resultplots.motion(result)),
        section("Panorama" if result.task == "panorama" else "Map", _maps(result)),
        section("Best and worst windows", _windows(result)),
        section("Evaluation", _evaluation(result.evaluation)),
        section("How it was made", _made(result)),
    ]
    return document(f"{result.task} of {name}", body, HOVER)


def document(title: str, body: Iterable[str], script: str = "") -> str:
    """A whole page around what is in it."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="viewport" content="width=device-width">\n'
        f'<link rel="icon" href="data:,">\n<title>{escape(title)}</title>\n<style>{PLAIN}{STYLE}</style>\n</head>\n<body>\n'
        + "\n".join(part for part in body if part)
        + (f"\n<script>{script}</script>" if script else "")
        + "\n</body>\n</html>\n"
    )


def section(title: str, body: str) -> str:
    """A heading and what is below; nothing where there is nothing."""
    return f"<section><h2>{escape(title)}</h2>\n{body}</section>" if body else ""


def number(value: Any) -> str:
    """A number as people read it, other values as text; escaped."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) or (isinstance(value, float) and value.is_integer() and abs(value) < 1e15):
        return f"{int(value):,}".replace(",", "\u202f").replace("-", "−")  # a narrow space
    if isinstance(value, float):
        return f"{value:.4g}".replace("-", "−")
    return escape(str(value))


def facts(values: dict[str, Any]) -> str:
    """A table of two columns."""
    lines = "".join(f'<tr><th scope="row">{escape(name)}</th><td>{number(value)}</td></tr>' for name, value in values.items())
    return f"<table>{lines}</table>" if lines else ""


def generic(values: dict[str, Any]) -> str:
    """Any JSON object: its plain values in one table, then one for each object within it, and for each list of objects."""
    plain = {name: value for name, value in values.items() if not isinstance(value, dict | list)}
    parts = [facts(plain)]
    for name, value in values.items():
        if isinstance(value, dict) and value:
            parts.append(f"<table><caption>{escape(name)}</caption>{facts(_flat(value)).removeprefix('<table>')}")
        elif isinstance(value, list) and value and all(isinstance(line, dict) for line in value):
            columns = list(dict.fromkeys(column for line in value for column in line))
            head = "".join(f'<th scope="col">{escape(str(column))}</th>' for column in columns)
            lines = ("".join(f"<td>{number(line.get(column))}</td>" for column in columns) for line in value[:200])
            table = "".join(f"<tr>{line}</tr>" for line in lines)
            parts.append(f'<div class="wide"><table><caption>{escape(name)}</caption><tr>{head}</tr>{table}</table></div>')
        elif isinstance(value, list) and value:
            parts.append(facts({name: ", ".join(str(part) for part in value[:50])}))
    return "\n".join(part for part in parts if part)


def _flat(values: dict[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= _flat(value, f"{before}{name}.") if isinstance(value, dict) else {before + str(name): value}
    return found


def _evaluation(found: dict[str, Any]) -> str:
    """What `evaluate` found: a column for each protocol, a line for each measure that any of them has."""
    rows = found.get("results")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        return generic(found)
    names = [name for name in dict.fromkeys(name for row in rows for name in row) if name not in ("result", "protocol")]
    head = "".join(f'<th scope="col">{escape(str(row.get("protocol", "")))}</th>' for row in rows)
    lines = "".join(
        f'<tr><th scope="row">{escape(name.replace("_", " "))}</th>{"".join(f"<td>{number(row.get(name))}</td>" for row in rows)}</tr>'
        for name in names
        if any(row.get(name) is not None for row in rows)
    )
    plain = {name: value for name, value in found.items() if not isinstance(value, dict | list)}
    return f'<div class="wide"><table><tr><th></th>{head}</tr>{lines}</table></div>{facts(plain)}'


def _state(result: Result) -> str:
    """What it is, and whether it came to its end."""
    about = f"{result.task}, torchcmax {result.summary['versions']['torchcmax']}"
    stopped = result.summary.get("stopped_by")
    if result.summary.get("complete") and not stopped:
        return f'<p class="sub">{escape(about)}, complete</p>'
    return f'<p class="sub">{escape(about)}</p><p class="bad">Not complete: {escape(str(stopped or "nobody knows why"))}</p>'


def _facts(result: Result) -> str:
    """The summary in numbers, the errors, and how many windows had which status."""
    summary = dict(result.summary)
    seconds, wall = summary.get("seconds"), summary.get("wall_seconds")
    if "real_time_factor" not in summary and isinstance(seconds, int | float) and isinstance(wall, int | float) and wall > 0:
        summary["real_time_factor"] = seconds / wall
    summary.setdefault("keyframes", result.keyframes) if result.keyframes is not None else None
    known = {told: summary[name] for name, told in FIRST.items() if told and name in summary}
    other = {name.replace("_", " "): value for name, value in summary.items() if name not in FIRST and not isinstance(value, dict | list)}
    tables = [("", known | other)]
    for name, title in (("error", "Error against truth"), ("status", "Windows by status"), ("plane", "Plane"), ("panorama", "Panorama")):
        if isinstance(summary.get(name), dict):
            values = _flat(summary[name])
            tables.append((title, {key.replace("_", " "): _listed(value) for key, value in values.items() if value is not None}))
    parts = [f"<div><h3>{escape(title)}</h3>{facts(values)}</div>" if title else facts(values) for title, values in tables if values]
    return f'<div class="facts">{parts[0]}<div>{"".join(parts[1:])}</div></div>'


def _listed(value: Any) -> Any:
    """A list as text: numbers with four digits."""
    if not isinstance(value, list):
        return value
    return ", ".join(f"{part:.4g}" if isinstance(part, float) else str(part) for part in value)


def _maps(result: Result) -> str:
    """The map as it was in the end."""
    shown = [path for path in result.maps if path.name != "panorama.png"] or result.maps
    return "".join(f"<figure>{picture(path, path.name)}<figcaption>{escape(path.name)}</figcaption></figure>" for path in shown)


def _windows(result: Result) -> str:
    """Pictures of the windows that gained most and least, of those that were drawn."""
    gain, index = result.numbers["gain"], result.numbers["index"]
    drawn = [(g, int(i)) for g, i in zip(gain.tolist(), index.tolist(), strict=True) if i in result.pictures and math.isfinite(g)]
    ordered = sorted(drawn, reverse=True)
    best = ordered[: min(SHOWN, (len(ordered) + 1) // 2)]
    worst = ordered[len(best) :][-SHOWN:][::-1]
    parts = []
    for title, some in (("Best", best), ("Worst", worst)):
        figures = "".join(
            f"<figure>{picture(result.pictures[i], f'window {i} before and after')}<figcaption>{title}: window {i}, gain {g:.3f}; "
            "at rest | compensated</figcaption></figure>"
            for g, i in some
        )
        parts.append(f'<div class="pair">{figures}</div>' if figures else "")
    return "\n".join(part for part in parts if part)


def picture(path: Path, alt: str, widest: int = WIDEST) -> str:
    """A picture within the page: as it is where it is small, else narrower and as JPEG."""
    try:
        packed, kind = path.read_bytes(), "png"
        with Image.open(io.BytesIO(packed)) as image:
            if image.width > widest or len(packed) > LARGE:
                small = image.convert("RGB")
                small.thumbnail((widest, widest), reducing_gap=2.0)
                stream = io.BytesIO()
                small.save(stream, "JPEG", quality=85)
                packed, kind = stream.getvalue(), "jpeg"
            else:
                image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(path, f"cannot be read as a picture: {error}", f"remove it, or {AGAIN}") from error
    return f'<img alt="{escape(alt)}" loading="lazy" src="data:image/{kind};base64,{base64.b64encode(packed).decode()}">'


def _made(result: Result) -> str:
    """Versions, the job of a batch, the whole configuration."""
    keep = ("name", "task", "recording", "settings", "exit", "error", "seconds", "started", "attempts", "host", "config_hash", "input")
    job = _flat({name: result.manifest[name] for name in keep if name in result.manifest})
    parts = [facts({"recording": result.summary.get("path")} | dict(result.summary["versions"]))]
    if job:
        parts.append(f"<details><summary>Job of a batch</summary>{facts(job)}</details>")
    if result.summary.get("config"):
        parts.append(f"<details><summary>Configuration</summary><pre>{escape(str(result.summary['config']))}</pre></details>")
    return "\n".join(parts)
