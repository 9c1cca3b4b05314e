"""The picture of a map: its edges dark on white, what was never seen grey, the camera's path in colour, and a scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchcmax.slam.map import Map
from torchcmax.slam.tiles import CELL, TILE

LARGEST, NARROWEST = 4096, 360  # px of a picture's longer side; of its width
BORDER = 12  # px of paper around what was seen
BRIGHT = 0.995  # quantile of the strengths that is drawn black
UNSEEN = 235  # grey
FIRST, LAST = np.array([30, 110, 255]), np.array([230, 40, 30])  # colours of the path at its begin and end
SMOOTH = 4  # drawn so many times larger, and reduced


@dataclass(frozen=True)
class Sheet:
    """The whole map in one image.  strength [H, W] 0..1 | seen [H, W] | corner: map px (x, y) of its first px | reduced: map px per px"""

    strength: np.ndarray
    seen: np.ndarray
    corner: tuple[int, int]
    reduced: int

    def cropped(self, border: int) -> Sheet:
        """What was seen, and a border around it."""
        rows, columns = np.flatnonzero(self.seen.any(1)), np.flatnonzero(self.seen.any(0))
        if not len(rows):
            return self
        top, left = max(0, rows[0] - border), max(0, columns[0] - border)
        cut = slice(top, rows[-1] + border + 1), slice(left, columns[-1] + border + 1)
        corner = self.corner[0] + int(left) * self.reduced, self.corner[1] + int(top) * self.reduced
        return Sheet(self.strength[cut], self.seen[cut], corner, self.reduced)

    def place(self, xy: np.ndarray) -> np.ndarray:
        """Map px [M, 2] on the sheet, px."""
        return (xy + 0.5 - self.corner) / self.reduced - 0.5


def sheet(m: Map, most: int = LARGEST) -> Sheet:
    """The map tile by tile, reduced by a power of two so that no side is longer than `most` px."""
    whole = m.whole()
    reduced = 2 ** max(0, math.ceil(math.log2(max(whole.size) / most)))
    height, width = (max(1, -(-n // reduced)) for n in whole.size)
    strength, seen = np.zeros((height, width), np.float32), np.zeros((height, width), bool)
    inner = min(reduced, TILE)  # of one tile; where a whole tile is less than a px, the strongest stays
    for (row, column), tile in m.tiles.items():
        known = tile.exposure[0] + tile.exposure[2] > 0
        known = known.repeat_interleave(CELL, 0).repeat_interleave(CELL, 1).float()
        part, there = ((avg_pool2d(x[None], inner)[0] if inner > 1 else x).cpu().numpy() for x in (m.strength(tile), known))
        y, x = (row - whole.row) * TILE // reduced, (column - whole.column) * TILE // reduced
        place = slice(y, y + len(part)), slice(x, x + len(part))
        strength[place] = np.maximum(strength[place], part)
        seen[place] |= there > 0
    return Sheet(strength, seen, whole.corner, reduced).cropped(BORDER)


def picture(m: Map, positions: Tensor | None, title: str, metres: float | None = None, most: int = LARGEST) -> np.ndarray:
    """The map as seen from straight before it: -> [H, W, 3] uint8.

    positions [M, 3]: of the camera in the world, plane distances; drawn where they are before the plane, first blue, last red.
    metres: of one plane distance, for the scale.
    """
    drawn = sheet(m, most)
    ink = np.clip(drawn.strength / max(_full(drawn), 1e-6), 0, 1)
    grey = np.where(drawn.seen, 255 * (1 - ink), UNSEEN)
    page = Image.fromarray(np.repeat(grey.astype(np.uint8)[..., None], 3, -1))
    if positions is not None and len(positions) > 1:
        draw_path(page, drawn.place(before(m, positions)))
    unit = drawn.reduced / m.focal * m.plane.distance[0].item()  # plane distances per px
    return with_scale(page, title, unit if metres is None else unit * metres, "m" if metres is not None else "plane distances")


def before(m: Map, positions: Tensor) -> np.ndarray:
    """Where the camera is straight before the plane: positions [M, 3] -> map px [M, 2]."""
    there = positions.detach().cpu().double() @ m.view[0].cpu().double().mT
    xy: np.ndarray = (there[:, :2] * (m.focal / m.plane.distance[0].item())).numpy()
    return xy


def _full(drawn: Sheet) -> float:
    strong = drawn.strength[drawn.strength > 0.05]
    return float(np.quantile(strong, BRIGHT)) if len(strong) else 1.0


def draw_path(page: Image.Image, xy: np.ndarray, jump: float = math.inf) -> None:
    """A thin smooth line that goes from one colour to the other, within its own box; steps longer than `jump` px are left out."""
    xy = xy[np.isfinite(xy).all(1)]
    if len(xy) < 2:
        return
    size = np.array(page.size)
    low, high = np.floor(xy.min(0) - 8).clip(0, size).astype(int), np.ceil(xy.max(0) + 8).clip(0, size).astype(int)
    if (high <= low).any():
        return
    wide = max(1.2, max(page.size) / 900)  # px
    small = int(high[0] - low[0]), int(high[1] - low[1])
    large = small[0] * SMOOTH, small[1] * SMOOTH
    mask, colour = Image.new("L", large), Image.new("RGB", large)
    pens = ImageDraw.Draw(mask), ImageDraw.Draw(colour)
    points = ((xy - low + 0.5) * SMOOTH).round()
    for i in range(len(points) - 1):
        if abs(points[i + 1] - points[i]).max() > jump * SMOOTH:
            continue
        line = [tuple(points[i]), tuple(points[i + 1])]
        shade = tuple(int(c) for c in FIRST + (LAST - FIRST) * (i / max(1, len(points) - 2)))
        pens[0].line(line, fill=255, width=round(wide * SMOOTH))
        pens[1].line(line, fill=shade, width=round(3 * wide * SMOOTH))
    for point, end in ((points[0], FIRST), (points[-1], LAST)):
        r = 2.2 * wide * SMOOTH
        box = [*(point - r), *(point + r)]
        pens[0].ellipse(box, fill=255)
        pens[1].ellipse(box, fill=tuple(int(c) for c in end))
    page.paste(colour.resize(small, Image.Resampling.BOX), (int(low[0]), int(low[1])), mask.resize(small, Image.Resampling.BOX))


def with_scale(page: Image.Image, title: str, unit: float, name: str) -> np.ndarray:
    """The page with a line below it: a bar of a round length, and what it says."""
    text = max(13, page.width // 80)
    font = ImageFont.load_default(text)
    length = rounded(page.width * unit / 5)
    label = f"{length:g} {name}"
    bar = length / unit
    words = font.getlength(label), font.getlength(title)
    width = max(page.width, NARROWEST, math.ceil(bar + sum(words) + 4 * text))
    paper = Image.new("RGB", (width, page.height + 2 * text), (UNSEEN,) * 3)
    paper.paste(page, ((width - page.width) // 2, 0))
    pen = ImageDraw.Draw(paper)
    y = page.height + text
    for x, up, right in ((text, 0, text + bar), (text, text // 3, text), (text + bar, text // 3, text + bar)):
        pen.line([(x, y - up), (right, y + up)], fill="black", width=max(1, text // 8))
    pen.text((text + bar + text // 2, y), label, fill="black", font=font, anchor="lm")
    pen.text((width - text, y), title, fill="black", font=font, anchor="rm")
    return np.asarray(paper)


def rounded(value: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is not above a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(n * power for n in (1, 2, 5) if n * power <= value * (1 + 1e-9))
