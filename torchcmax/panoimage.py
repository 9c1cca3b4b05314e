"""The picture of a panorama: edges dark on white, what was never seen grey, where the camera looked in colour, and a scale in degrees."""

from __future__ import annotations

import numpy as np
from PIL import Image
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from torchcmax.mapimage import BORDER, BRIGHT, LARGEST, UNSEEN, draw_path, with_scale
from torchcmax.slam.equirect import smooth
from torchcmax.slam.globe import Globe
from torchcmax.slam.tiles import spread

SOFT = 0.4  # px: edges are drawn as they are tracked on, a little blurred
GAP = 0.5  # of the width: a longer step of the path goes over the seam
MARGIN = 0.05  # of strength below which a pixel does not say what is full black


def picture(globe: Globe, turns: Tensor, title: str, most: int = LARGEST, cropped: bool = False) -> np.ndarray:
    """All directions, equirectangular: -> [H, W, 3] uint8; the middle looks along z of the world, straight up and down are the borders.

    turns [M, 3, 3]: orientations of the camera, whose axes are drawn as a path, first blue, last red
    cropped: only what was seen, and a border around it; turned so that it lies in one piece, if it can
    """
    strength, seen = _images(globe, most)
    height, width = seen.shape
    xy = _axes(globe, turns, height)
    if cropped and seen.any():
        shift = _opening(seen)
        strength, seen = np.roll(strength, -shift, 1), np.roll(seen, -shift, 1)
        xy = np.stack([(xy[:, 0] - shift + 0.5) % width - 0.5, xy[:, 1]], 1)
        rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
        top, left = max(0, rows[0] - BORDER), max(0, columns[0] - BORDER)
        cut = slice(top, rows[-1] + BORDER + 1), slice(left, columns[-1] + BORDER + 1)
        strength, seen, xy = strength[cut], seen[cut], xy - np.array([left, top])
    strong = strength[strength > MARGIN]
    full = float(np.quantile(strong, BRIGHT)) if len(strong) else 1.0
    grey = np.where(seen, 255 * (1 - np.clip(strength / full, 0, 1)), UNSEEN)
    page = Image.fromarray(np.repeat(grey.astype(np.uint8)[..., None], 3, -1))
    draw_path(page, xy, jump=GAP * width)
    return with_scale(page, title, 180 / height, "degrees")


def _images(globe: Globe, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Strength [H, W] and what was seen, reduced so that no side is longer than `most` px."""
    strength = globe.strength()
    seen = spread((globe.layers.most > 0).to(strength))
    height = min(globe.sphere.height, most // 2)
    if height < globe.sphere.height:
        strength, seen = (adaptive_avg_pool2d(part[None], (height, 2 * height))[0] for part in (strength, seen))
    else:
        strength = smooth(strength, SOFT, globe.sphere)
    return strength.cpu().numpy(), seen.cpu().numpy() > 0


def _axes(globe: Globe, turns: Tensor, height: int) -> np.ndarray:
    """Where the camera looked, px of an image of so many rows: [M, 2]."""
    xy: np.ndarray = globe.sphere.pixels(turns[:, :, 2].double()).cpu().numpy()
    return (xy + 0.5) * (height / globe.sphere.height) - 0.5


def _opening(seen: np.ndarray) -> int:
    """The column from which on what was seen lies in one piece: in the middle of the widest gap, round; 0 where there is none."""
    columns = np.flatnonzero(np.asarray(seen.any(0)))
    width = seen.shape[1]
    gaps = np.diff(columns, append=columns[0] + width)
    widest = int(gaps.argmax())
    inside = widest == len(columns) - 1 and columns[0] > 0 and columns[-1] < width - 1  # the seam is in it already
    return 0 if gaps[widest] == 1 or inside else int(columns[widest] + gaps[widest] // 2) % width
