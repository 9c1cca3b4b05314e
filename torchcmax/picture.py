"""Pictures of windows before | after, and what every picture wants: a caption, and to be packed."""

from __future__ import annotations

import io

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchcmax.core.camera import Canvas
from torchcmax.core.draw import Ink, draw
from torchcmax.core.window import Window

BRIGHT = 0.995  # quantile of the pixels hit that is drawn in full colour


def pictures(window: Window, warps: tuple[Tensor, ...], canvas: Canvas, reference: float) -> np.ndarray:
    """Each window warped in several ways side by side: brighter (ON) events red, darker (OFF) blue, one scale for all sides.

    warps: H_k [B, K, 3, 3] each -> [B, H, W * len(warps), 3] uint8
    """
    owner = torch.arange(len(window), device=window.ray.device)
    on, off = (Ink.of(window, (sign * window.polarity).clamp_min(0), reference) for sign in (1, -1))
    red, blue = (torch.cat([draw(H_k, ink, canvas, owner) for H_k in warps], -1).cpu() for ink in (on, off))
    return np.stack([coloured(a, b) for a, b in zip(red, blue, strict=True)])


def coloured(on: Tensor, off: Tensor) -> np.ndarray:
    """Two images [H, W] on white paper: -> [H, W, 3] uint8."""
    red, blue = on.numpy().ravel(), off.numpy().ravel()
    hit = np.flatnonzero(red + blue > 0)  # most of the paper stays white
    red, blue = red[hit], blue[hit]
    votes = (red + blue)[red + blue > 0.5]
    full = np.float32(max(np.quantile(votes, BRIGHT), 1)) if len(votes) else np.float32(1)
    red, blue = (np.sqrt(np.clip(part / full, 0, 1)) for part in (red, blue))  # sqrt: single events stay visible
    picture = np.full((on.numel(), 3), 255, np.uint8)
    for channel, paper in enumerate((1 - blue, np.maximum(1 - red - blue, 0), 1 - red)):
        picture[hit, channel] = 255 * paper
    return picture.reshape(*on.shape, 3)


def captioned(picture: np.ndarray, text: str) -> np.ndarray:
    """The picture [H, W, 3] with a line of text above it and a line down the middle."""
    page = Image.new("RGB", (picture.shape[1], picture.shape[0] + 22), "white")
    page.paste(Image.fromarray(picture), (0, 22))
    pen = ImageDraw.Draw(page)
    pen.text((4, 3), text, fill="black", font=ImageFont.load_default(14))
    pen.line([(picture.shape[1] // 2, 22), (picture.shape[1] // 2, page.height)], fill="gray")
    return np.asarray(page)


def png(picture: np.ndarray) -> bytes:
    """A picture [H, W, 3] uint8 as PNG; packed lightly, which takes a quarter of the time and a tenth more room."""
    packed = io.BytesIO()
    Image.fromarray(picture).save(packed, format="PNG", compress_level=1)
    return packed.getvalue()
