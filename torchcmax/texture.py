"""Procedural textures on a plane or on the sphere of directions, pre-filtered for a sensor's pixels, and how a camera sees them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw
from torch import Tensor

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose
from torchcmax.io.errors import DataError

PLANE_SCENES = ("poster", "shapes", "lines")
SCENES = (*PLANE_SCENES, "panorama")
TEXEL = 0.6  # px: a texel on the sensor, at the distance the texture is made for
FINEST = 700.0  # texels per unit tangent: bounds the memory for sensors with a long focal length, which then see it soft
BLUR = 0.6  # px: standard deviation of the optics' point spread
LEVELS = 3  # the plane at half, once and twice the distance the texture is made for
EXTENT = (5.0, 4.0)  # plane distances: width and height of a plane texture; beyond it goes on mirrored
ASPECT = 4  # of a picture, at most: a narrower one, as wide as the other textures, would fill the memory
MARGIN = 8  # texels round each face of the sphere, so that neither blur nor interpolation sees the face's end
CORNERS = 24  # of an outline
LATTICE = 64  # edge of the periodic volume of random numbers


@dataclass(frozen=True)
class PlaneTexture:
    """Log intensity on a plane, point (0, 0) in the middle.  levels [1, L, H, W], each twice as soft | texels per plane distance."""

    levels: Tensor
    texels: float

    def sample(self, xy: Tensor, footprint: Tensor) -> Tensor:
        """xy [2, N] plane distances | footprint [N] of a sensor pixel, 1 at the reference distance -> [N] log intensity."""
        height, width = self.levels.shape[-2:]
        grid = torch.stack([xy[0] * (2 * self.texels / width), xy[1] * (2 * self.texels / height)], -1)
        soft = F.grid_sample(self.levels, grid[None, None], padding_mode="reflection", align_corners=False)[0, :, 0]
        level = (footprint.log2() + 1).clamp(0, LEVELS - 1)
        return sum((soft[i] * (1 - (level - i).abs()).clamp(min=0) for i in range(LEVELS)), torch.zeros_like(level))

    def picture(self) -> Tensor:
        """A picture to look at: -> [H, W] log intensity."""
        return self.levels[0, 1]


@dataclass(frozen=True)
class SphereTexture:
    """Log intensity of every direction, on the six faces of a cube with equal angles between texels.  atlas [1, 1, 6 S, S]."""

    atlas: Tensor

    def sample(self, direction: Tensor) -> Tensor:
        """direction [3, N], of any length -> [N] log intensity."""
        size = self.atlas.shape[-1]
        face, uv = _on_cube(direction)
        texel = (uv + 1) * (size / 2 - MARGIN) + MARGIN  # from the outer border of the face
        x, y = texel[0] * (2 / size) - 1, (texel[1] + face * size) / (3 * size) - 1
        return F.grid_sample(self.atlas, torch.stack([x, y], -1)[None, None], padding_mode="border", align_corners=False)[0, 0, 0]

    def picture(self) -> Tensor:
        """A picture to look at, longitude -180..180 deg to the right and latitude down: -> [H, W] log intensity."""
        width = 2 * self.atlas.shape[-1]
        longitude = ((torch.arange(width) + 0.5) / width - 0.5) * 2 * math.pi
        latitude = ((torch.arange(width // 2) + 0.5) / (width // 2) - 0.5) * math.pi
        lat, lon = torch.meshgrid(latitude, longitude, indexing="ij")
        direction = torch.stack([lat.cos() * lon.sin(), lat.sin(), lat.cos() * lon.cos()])
        return self.sample(direction.view(3, -1)).view(lat.shape)


@lru_cache(maxsize=4)
def texture(scene: str, seed: int, focal: float) -> PlaneTexture | SphereTexture:
    """The texture of a scene for a sensor with this focal length in px."""
    rng = np.random.default_rng([seed, 1])
    texels = min(focal / TEXEL, FINEST)
    if scene == "panorama":
        return _panorama(rng, texels)
    width, height = (round(e * texels) for e in EXTENT)
    if scene in PLANE_SCENES:
        light = {"poster": _poster, "shapes": _shapes, "lines": _lines}[scene](rng, (height, width), texels)
    else:
        light = _picture_file(Path(scene), width)
    soft = BLUR * max(texels / focal, TEXEL * texels / focal)  # texels at the reference distance
    levels = torch.stack([_blur(light, max(soft * 2 ** (i - 1), 0.5)) for i in range(LEVELS)])
    return PlaneTexture(levels.log()[None], texels)


def _poster(rng: np.random.Generator, size: tuple[int, int], texels: float) -> Tensor:
    """Dead leaves, which occlude one another and come in all sizes as things in photographs do: -> [H, W] intensity."""
    height, width = size
    leaves = _leaves(rng, 7000)
    centre = rng.uniform(-0.52, 0.52, (len(leaves), 1, 2)) * EXTENT
    ids = _paint((leaves + centre) * texels + (width / 2, height / 2), size)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    point = torch.stack([x, y, torch.zeros_like(x)], -1).view(-1, 3).float() / texels
    return _coat(rng, ids, point, len(leaves)).view(size)


def _shapes(rng: np.random.Generator, size: tuple[int, int], texels: float) -> Tensor:
    """Dark shapes far apart on a light ground: -> [H, W] intensity."""
    height, width = size
    cell = 0.3  # plane distances: room of one shape
    y, x = np.mgrid[0 : EXTENT[1] : cell, 0 : EXTENT[0] : cell].reshape(2, -1)
    keep = rng.random(len(x)) < 0.85
    centre = np.stack([x, y], -1)[keep] + cell * rng.uniform(0.35, 0.65, (keep.sum(), 2))
    outline = _outlines(rng)[rng.integers(0, 40, len(centre))] * rng.uniform(0.2, 0.36, (len(centre), 1, 1)) * cell
    ids = _paint((outline + centre[:, None]) * texels, (height, width))
    tone = np.concatenate([[0.75], rng.uniform(0.18, 0.28, len(centre))])
    return torch.from_numpy(tone.astype(np.float32))[ids]


def _lines(rng: np.random.Generator, size: tuple[int, int], texels: float) -> Tensor:
    """Nearly vertical dark lines, from the lower to the upper end, on a ground with very faint clouds: -> [H, W] intensity."""
    height, width = size
    count = round(EXTENT[0] * 16)
    foot, lean = rng.uniform(0, width, count), rng.normal(0, 0.01, count) * height
    half = rng.uniform(0.003, 0.012, count) * texels
    x = np.stack([foot - half, foot + half, foot + half + lean, foot - half + lean], -1)
    y = np.broadcast_to([-1.0, -1.0, height, height], x.shape)
    ids = _paint(np.stack([x, y], -1), size)
    tone = torch.from_numpy(np.concatenate([[0.6], rng.uniform(0.15, 0.3, count)]).astype(np.float32))[ids]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    point = torch.stack([columns, rows, torch.zeros_like(rows)], -1).view(-1, 3).float() / texels
    return tone * (0.03 * _noise(rng, point, (2, 4, 8))).exp().view(size)


def _picture_file(path: Path, width: int) -> Tensor:
    """A picture from a file, as wide as the other plane textures, as tall as it comes: -> [H, W] intensity."""
    try:
        with Image.open(path) as image:
            if max(image.size) > ASPECT * min(image.size):
                problem = f"is a picture of {image.width} x {image.height} px, too narrow or too flat for a scene"
                raise DataError(path, problem, f"crop it: its longer side may be {ASPECT} times its shorter side")
            grey = image.convert("L")
    except Image.DecompressionBombError as error:
        raise DataError(path, f"is too large a picture ({error})", f"make it smaller: {width} px of width are used") from error
    except (OSError, SyntaxError, ValueError) as error:  # what Pillow raises on broken files
        raise DataError(path, f"cannot be read as a picture ({error})", "give a PNG or JPEG file as the scene") from error
    grey = grey.resize((width, round(grey.height * width / grey.width)), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.asarray(grey, np.float32).copy()) / 255 + 0.1  # black is never without light


def _panorama(rng: np.random.Generator, texels: float) -> SphereTexture:
    """Leaves and noise as functions of the direction, so there is no seam and no pole."""
    inner = 2 * round(texels * math.pi / 4)
    size = inner + 2 * MARGIN
    angle = ((torch.arange(size) + 0.5 - MARGIN) / inner - 0.5) * (math.pi / 2)
    v, u = torch.meshgrid(angle.tan(), angle.tan(), indexing="ij")
    centre = rng.normal(size=(6000, 3))
    centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
    leaves = _leaves(rng, len(centre))
    side = np.cross(centre, np.eye(3)[np.abs(centre).argmin(-1)])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    up = np.cross(centre, side)
    corner = centre[:, None] + leaves[..., :1] * side[:, None] + leaves[..., 1:] * up[:, None]
    ids, points = [], []
    for face in range(6):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        front = sign * centre[:, axis] > 0.1  # no other leaf is large enough to reach into the face
        depth = np.maximum(sign * corner[..., axis], 0.05)  # corners beside the camera go far out of the face
        place = np.stack([corner[..., (axis + 1) % 3] / depth, corner[..., (axis + 2) % 3] / depth], -1)
        texel = (np.arctan(place) / (math.pi / 2) + 0.5) * inner + MARGIN
        ids.append(_paint(np.where(front[:, None, None], texel, -1.0), (size, size)))
        cube = torch.stack([torch.full_like(u, sign), u, v], -1)
        points.append(F.normalize(cube.roll(axis, -1), dim=-1).view(-1, 3))
    light = _coat(rng, torch.cat(ids), torch.cat(points), len(leaves)).view(6, size, size)
    return SphereTexture(torch.cat([_blur(face, BLUR * max(texels, 1.0) / texels / TEXEL) for face in light]).log()[None, None])


def _on_cube(direction: Tensor) -> tuple[Tensor, Tensor]:
    """The face a direction meets, 0..5 for +x, -x, +y, .., and its place there, linear in the angle: [3, N] -> [N], [2, N] in -1..1."""
    x, y, z = direction.abs()
    axis = torch.where(x >= torch.maximum(y, z), 0, torch.where(y >= z, 1, 2))[None]  # argmax along the rows takes ten times as long
    depth = direction.gather(0, axis)
    uv = direction.gather(0, torch.cat([(axis + 1) % 3, (axis + 2) % 3])) / depth.abs()
    return (2 * axis + (depth < 0))[0], uv.atan() * (4 / math.pi)


def _outlines(rng: np.random.Generator) -> np.ndarray:
    """40 outlines about the origin, radius about 1: discs, ellipses, polygons, stars, bars -> [40, V, 2]."""
    angle = 2 * math.pi * np.arange(CORNERS) / CORNERS
    kinds = []
    for i in range(40):
        corners = (3, 4, 5, 6, 8)[i // 8]
        sector = (angle % (2 * math.pi / corners)) - math.pi / corners
        radius = math.cos(math.pi / corners) / np.cos(sector)  # a regular polygon
        if i % 8 in (0, 1):
            radius = np.ones_like(angle)
        elif i % 8 == 2:
            radius = 1 - 0.55 * (1 - np.abs(sector) * corners / math.pi)  # a star
        aspect = (1.0, 0.55, 1.0, 1.0, 0.7, 0.25, 0.85, 1.0)[i % 8]
        shape = np.stack([radius * np.cos(angle), aspect * radius * np.sin(angle)], -1)
        turn = rng.uniform(0, 2 * math.pi)
        kinds.append(shape @ [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return np.stack(kinds)


def _leaves(rng: np.random.Generator, count: int) -> np.ndarray:
    """Outlines whose number falls with the cube of their size, as in photographs, of all turns: -> [count, V, 2] plane distances or rad."""
    smallest, largest = 0.025, 0.45
    share = rng.random(count) * (1 - (smallest / largest) ** 2)
    radius = smallest / np.sqrt(1 - share)
    turn = rng.uniform(0, 2 * math.pi, count)
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    outline: np.ndarray = _outlines(rng)[rng.integers(0, 40, count)] * radius[:, None, None]
    turned: np.ndarray = outline @ rotation
    return turned


def _paint(outline: np.ndarray, size: tuple[int, int]) -> Tensor:
    """Which outline is on top, the later over the earlier: [N, V, 2] texels from the border | size (H, W) -> [H, W], 0 = none, i + 1."""
    image = Image.new("I", (size[1], size[0]))
    draw = ImageDraw.Draw(image)
    seen = ((outline.max(1) > 0) & (outline.min(1) < (size[1], size[0]))).all(-1)
    for i in np.flatnonzero(seen):
        draw.polygon((outline[i] - 0.5).ravel().tolist(), fill=int(i) + 1)
    return torch.from_numpy(np.asarray(image).astype(np.int64))


def _coat(rng: np.random.Generator, ids: Tensor, point: Tensor, count: int) -> Tensor:
    """Tone and surface of each leaf, under one large soft light: ids [...] | point [M, 3] -> [M] intensity."""
    tone = rng.normal(0, 0.27, count + 1).clip(-0.7, 0.7)
    rough = rng.choice([0.02, 0.07, 0.14], count + 1)  # smooth, grained and coarse surfaces
    table = torch.from_numpy(np.stack([tone, rough]).astype(np.float32))[:, ids.view(-1)]
    light = 0.25 * _noise(rng, point, (1.5, 3))
    return 0.35 * (table[0] + table[1] * _noise(rng, point, (8, 16, 32, 64)) + light).exp()


def _noise(rng: np.random.Generator, point: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Smooth random numbers of about unit variance, octaves of value noise: point [M, 3] | frequencies per unit -> [M]."""
    volume = torch.from_numpy(rng.standard_normal((LATTICE,) * 3).astype(np.float32))
    volume = F.pad(volume[None, None], (0, 1, 0, 1, 0, 1), mode="circular")
    total = torch.zeros(len(point))
    for k, frequency in enumerate(frequencies):
        turn = torch.from_numpy(np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32))  # hides the lattice
        place = (point @ (turn * frequency) + torch.from_numpy(rng.uniform(0, LATTICE, 3).astype(np.float32))) % LATTICE
        value = F.grid_sample(volume, (place * (2 / LATTICE) - 1)[None, None, None], align_corners=True, padding_mode="border")
        total += 1.7 * 0.75**k * value.view(-1)  # interpolation leaves a third of the variance
    return total / math.sqrt(sum(0.75 ** (2 * k) for k in range(len(frequencies))))


def _blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur: [H, W] | sigma texels -> [H, W]."""
    radius = math.ceil(3 * sigma)
    x = torch.arange(-radius, radius + 1, dtype=image.dtype)
    kernel = torch.exp(-((x / sigma) ** 2) / 2)
    kernel = kernel / kernel.sum()
    padded = F.pad(image[None, None], (radius,) * 4, mode="reflect")
    return F.conv2d(F.conv2d(padded, kernel[None, None, None]), kernel[None, None, :, None])[0, 0]


def view(light: PlaneTexture | SphereTexture, camera: Camera, plane: Plane | None, distance: float) -> Callable[[Pose], np.ndarray]:
    """The renderer: of a pose [1], m, the log intensity at every distorted pixel, [H W] float32.

    plane [1] in the world, m, None for a sphere | distance m, from the first camera along its axis to the texture's middle
    """
    ray = camera.rays().float().view(-1, 3).mT.contiguous()  # [3, N]
    if isinstance(light, SphereTexture):
        return lambda pose: np.asarray(light.sample(pose.R[0].float() @ ray))
    if plane is None:
        raise ValueError("a plane texture wants a plane")
    return partial(_plane_view, light, ray, plane, distance)


def _plane_view(light: PlaneTexture, ray: Tensor, plane: Plane, distance: float, pose: Pose) -> np.ndarray:
    """The light where rays [3, N] meet the plane: -> [N]."""
    here = plane.seen_from(pose)
    axes = plane.facing()[0, :2]  # of the texture, in the world
    start = axes @ (pose.t[0] - torch.tensor([0, 0, distance], dtype=torch.float64))
    # x = t + s R r with s = -d / (n . r): over the common denominator each coordinate is linear in the ray
    rows = torch.outer(start, here.normal[0]) - here.distance * (axes @ pose.R[0])
    x, y, slope = torch.cat([rows / distance, here.normal]).float() @ ray
    return np.asarray(light.sample(torch.stack([x, y]) / slope, -(here.distance / distance).float() / slope))
