"""Line charts as inline SVG: axes with round ticks, units, a legend, shaded stretches, gaps where data is missing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

MOST = 1500  # points of a drawn line
LEFT, RIGHT, TOP, BOTTOM = 64.0, 12.0, 30.0, 38.0  # px around the axes
STYLE = """
:root { --h0: #0072b2; --h1: #d55e00; --h2: #009e73; --h3: #444; --axis: #777; --grid: #e4e4e4;
 --lost: #cc79a7; --weak: #e69f00; --still: #56b4e9; --start: #bbb }
@media (prefers-color-scheme: dark) { :root { --h0: #56b4e9; --h1: #f0884a; --h2: #2fc79b; --h3: #ccc; --axis: #999; --grid: #333;
 --start: #666 } }
svg { width: 100%; height: auto; display: block; overflow: visible; font: 12px system-ui, sans-serif }
svg text { fill: currentColor } svg .tick { fill: var(--axis) } svg .name { font-weight: 600 }
svg .grid { stroke: var(--grid); fill: none } svg .frame { stroke: var(--axis); fill: none }
svg .line { fill: none; stroke-width: 1.4; stroke-linejoin: round; stroke-linecap: round }
svg .truth { fill: none; stroke-width: 5; opacity: .3; stroke-linejoin: round; stroke-linecap: round }
.h0 { stroke: var(--h0) } .h1 { stroke: var(--h1) } .h2 { stroke: var(--h2) } .h3 { stroke: var(--h3) }
.lost { fill: var(--lost); opacity: .45 } .weak { fill: var(--weak); opacity: .3 }
.still { fill: var(--still); opacity: .25 } .start { fill: var(--start); opacity: .3 }
svg .hair { stroke: var(--axis); stroke-dasharray: 3 3; visibility: hidden } svg .read { fill: var(--axis) }
"""


@dataclass(frozen=True)
class Line:
    """Numbers over numbers, both [N]; nan where there is none.  hue: 0 to 3.  Truth is drawn broad and pale, below all others."""

    name: str
    x: np.ndarray
    y: np.ndarray
    hue: int = 0
    truth: bool = False


@dataclass(frozen=True)
class Span:
    """A stretch of the x axis that is shaded.  kind: lost, weak, still or start."""

    begin: float
    end: float
    kind: str


@dataclass(frozen=True)
class Axes:
    """What stands at a chart, and how large it is.  equal: one scale for both axes | time: charts of one page share a moving hair line."""

    title: str
    x: str
    y: str
    size: tuple[float, float] = (1000.0, 230.0)  # px, width and height
    equal: bool = False
    time: bool = True
    within: tuple[float, float] | None = None  # of x; default: of the data


@dataclass(frozen=True)
class Scale:
    """From numbers in low ... high to px: low at `a`, high at `b`."""

    low: float
    high: float
    a: float
    b: float

    def __call__(self, value: np.ndarray) -> np.ndarray:
        return self.a + (value - self.low) * ((self.b - self.a) / (self.high - self.low))

    def at(self, value: float) -> float:
        return float(self(np.array(value)))


def chart(axes: Axes, lines: Sequence[Line], spans: Sequence[Span] = ()) -> str:
    """The chart as one <svg>.  All text is escaped."""
    x, y = _scales(axes, lines)
    width, height = axes.size
    kind = ' class="time"' if axes.time else ""
    data = " ".join(f'data-{name}="{value:.10g}"' for name, value in (("l", x.low), ("h", x.high), ("a", x.a), ("b", x.b)))
    data += " " + " ".join(f'data-{name}="{value:.10g}"' for name, value in (("m", y.low), ("n", y.high), ("c", y.a), ("d", y.b)))
    ordered = sorted(lines, key=lambda line: not line.truth)
    parts = [
        f'<svg{kind} viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(axes.title)}" {data}>',
        *(_span(span, x, y) for span in spans),
        _grid(axes, x, y),
        *(_path(line, x, y) for line in ordered),
        _legend(axes, lines, spans),
        f'<path class="hair" d="M0 {y.b:g}V{y.a:g}"/>' if axes.time else "",
        "</svg>",
    ]
    return "\n".join(part for part in parts if part)


def _scales(axes: Axes, lines: Sequence[Line]) -> tuple[Scale, Scale]:
    """Both axes, around all numbers that are drawn."""
    width, height = axes.size
    left, right, top, bottom = LEFT, width - RIGHT, TOP, height - BOTTOM
    x0, x1 = axes.within or _range([line.x for line in lines], 0.04 if axes.equal else 0.0)
    y0, y1 = _range([line.y for line in lines], 0.06)
    if axes.equal:
        unit = max((x1 - x0) / (right - left), (y1 - y0) / (bottom - top))
        x0, x1 = _widened(x0, x1, unit * (right - left))
        y0, y1 = _widened(y0, y1, unit * (bottom - top))
    elif not x1 > x0:
        x0, x1 = _widened(x0, x1, 1.0)
    return Scale(x0, x1, left, right), Scale(y0, y1, bottom, top)


def _range(numbers: Sequence[np.ndarray], margin: float) -> tuple[float, float]:
    """From the least to the largest finite number, with a margin; 0 ... 1 where there is none."""
    finite = np.concatenate([part[np.isfinite(part)] for part in numbers] or [np.zeros(0)])
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    more = (high - low) * margin
    if margin and more <= 1e-9 * max(abs(low), abs(high)):
        more = 0.1 * abs(high) or 1.0
    return low - more, high + more


def _widened(low: float, high: float, extent: float) -> tuple[float, float]:
    middle = 0.5 * (low + high)
    return middle - 0.5 * extent, middle + 0.5 * extent


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers within low ... high, at most about `most`: steps of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / max(most, 1)
    if not rough > 0 or not math.isfinite(rough):
        return []
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def _grid(axes: Axes, x: Scale, y: Scale) -> str:
    """Grid, numbers and names of the axes."""
    height = axes.size[1]
    down, across = ticks(y.low, y.high, int((y.a - y.b) / 36)), ticks(x.low, x.high, int((x.b - x.a) / 90))
    grid = "".join(f"M{x.a:g} {y.at(v):.1f}H{x.b:g}" for v in down) + "".join(f"M{x.at(v):.1f} {y.b:g}V{y.a:g}" for v in across)
    numbers = [f'<text x="{x.a - 6:g}" y="{y.at(v) + 4:.1f}" text-anchor="end">{said(v, down)}</text>' for v in down]
    numbers += [f'<text x="{x.at(v):.1f}" y="{y.a + 16:g}" text-anchor="middle">{said(v, across)}</text>' for v in across]
    tick = "".join(number.replace("<text", '<text class="tick"') for number in numbers)
    names = f'<text x="{(x.a + x.b) / 2:g}" y="{height - 6:g}" text-anchor="middle">{escape(axes.x)}</text>'
    middle = (y.a + y.b) / 2
    names += f'<text transform="translate(12 {middle:g}) rotate(-90)" text-anchor="middle">{escape(axes.y)}</text>'
    frame = f'<path class="frame" d="M{x.a:g} {y.b:g}V{y.a:g}H{x.b:g}"/>'
    return f'<path class="grid" d="{grid}"/>{frame}{tick}{names}'


def said(value: float, among: Sequence[float]) -> str:
    """A tick's number, with as many decimals as the step between ticks needs."""
    step = among[1] - among[0] if len(among) > 1 else abs(value) or 1.0
    if max(abs(value), abs(step)) >= 1e6 or step < 1e-5:
        return f"{value:.6g}".replace("-", "−")
    text = f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"
    return text.replace("-", "−") if float(text) else text.removeprefix("-")


def _span(span: Span, x: Scale, y: Scale) -> str:
    begin, end = (min(max(x.at(value), x.a), x.b) for value in (span.begin, span.end))
    wide = max(end - begin, 1.0)  # px: a short stretch must be seen too
    seconds = f"{span.begin:.3f} to {span.end:.3f}"
    return (
        f'<rect class="{escape(span.kind)}" x="{begin:.1f}" y="{y.b:g}" width="{wide:.1f}" height="{y.a - y.b:g}">'
        f"<title>{escape(span.kind)}: {seconds}</title></rect>"
    )


def _path(line: Line, x: Scale, y: Scale) -> str:
    """The line, broken where there is no number; a number alone is a dot."""
    keep = thinned(line.y, MOST)
    px, py = x(line.x[keep]), y(line.y[keep])
    there = np.isfinite(px) & np.isfinite(py)
    steps, pen = [], False
    for u, v, drawn in zip(px.tolist(), py.tolist(), there.tolist(), strict=True):
        if drawn:
            steps.append(f"L{u:.1f} {v:.1f}" if pen else f"M{u:.1f} {v:.1f}h0")
        pen = drawn
    shape = "truth" if line.truth else "line"
    return f'<path class="{shape} h{line.hue}" data-name="{escape(line.name)}" d="{"".join(steps)}"/>' if steps else ""


def thinned(y: np.ndarray, most: int) -> np.ndarray:
    """Which of N numbers to draw: all up to `most`, else first, least, largest and last of each stretch, and one missing for a gap."""
    count = len(y)
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, max(1, most // 5) + 1).astype(int)
    kept: set[int] = set()
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = y[begin:end]
        finite = np.flatnonzero(np.isfinite(part))
        kept |= {begin, end - 1}
        if len(finite):
            kept |= {begin + int(finite[part[finite].argmin()]), begin + int(finite[part[finite].argmax()])}
        if len(finite) < len(part):
            kept.add(begin + int(np.flatnonzero(~np.isfinite(part))[0]))
    return np.array(sorted(kept))


def _legend(axes: Axes, lines: Sequence[Line], spans: Sequence[Span]) -> str:
    """The title, then a short stroke and the name of each line, then the kinds of stretches."""
    at, parts = LEFT, [f'<text class="name" x="{LEFT:g}" y="16">{escape(axes.title)}</text>']
    at += 6.9 * len(axes.title) + 18
    for line in [line for line in lines if line.name] if len(lines) > 1 else ():
        shape = "truth" if line.truth else "line"
        parts.append(f'<path class="{shape} h{line.hue}" d="M{at:g} 12h18"/><text x="{at + 24:g}" y="16">{escape(line.name)}</text>')
        at += 24 + 6.6 * len(line.name) + 16
    for kind in dict.fromkeys(span.kind for span in spans):
        parts.append(f'<rect class="{escape(kind)}" x="{at:g}" y="6" width="14" height="12"/>')
        parts.append(f'<text x="{at + 20:g}" y="16">{escape(kind)}</text>')
        at += 20 + 6.6 * len(kind) + 16
    if axes.time:
        parts.append(f'<text class="read" x="{axes.size[0] - RIGHT:g}" y="16" text-anchor="end"></text>')
    return "".join(parts)
