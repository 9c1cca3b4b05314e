"""Camera: sensor pixel -> ray, through a look-up table; Canvas: ray -> pixel of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from torchcmax.kernels import NEAREST

MODELS = {"plumb_bob": 5, "kannala_brandt": 4}
SMALLEST = 8  # px: a canvas does not become smaller
TABLE_ERROR = 1e-3  # px: what the look-up table may be off, measured by projecting it again


@dataclass(frozen=True)
class Camera:
    """Pinhole with lens distortion.  size (H, W) px; pixel centres at integers.

    distortion: plumb_bob (k1, k2, p1, p2, k3), as OpenCV and ROS; kannala_brandt (k1, k2, k3, k4), as OpenCV's fisheye.
    """

    size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    model: str = "plumb_bob"

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"camera model {self.model!r} is none of {', '.join(MODELS)}")
        if len(self.distortion) != MODELS[self.model]:
            raise ValueError(f"{self.model} wants {MODELS[self.model]} distortion numbers, got {len(self.distortion)}")
        numbers = torch.tensor([self.fx, self.fy, self.cx, self.cy, *self.distortion])
        if not numbers.isfinite().all() or min(self.fx, self.fy, *self.size) <= 0:
            raise ValueError(f"a camera wants finite numbers, a positive focal length and size, got {self}")

    @classmethod
    def pinhole(cls, size: tuple[int, int], focal_by_width: float = 1.2) -> Camera:
        """A stand-in where no calibration is known: focal length as a multiple of the width, centre in the middle."""
        (height, width), focal = size, focal_by_width * size[1]
        return cls(size, focal, focal, (width - 1) / 2, (height - 1) / 2)

    def _kornia(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Intrinsic matrix [3, 3] and distortion coefficients, as kornia wants them: float64 on the device of `like`."""
        k = like.new_tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=torch.float64)
        return k, like.new_tensor(self.distortion, dtype=torch.float64)

    def project(self, ray: Tensor) -> Tensor:
        """Rays to distorted sensor pixels: ray [M, 3] -> [M, 2] px."""
        k, coefficients = self._kornia(ray)
        point = (ray[..., :2] / ray[..., 2:]).double()
        pixel = point * k.diagonal()[:2] + k[:2, 2]
        if self._straight:
            return pixel.to(ray)
        from kornia.geometry import calibration, camera  # 0.5 s, so only where it is needed

        if self.model == "plumb_bob":
            return calibration.distort_points(pixel[None], k[None], coefficients[None])[0].to(ray)
        params = ray.new_tensor([self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=torch.float64)
        return camera.distort_points_kannala_brandt(point, params).to(ray)

    @property
    def _straight(self) -> bool:
        """Whether the lens bends nothing."""
        return self.model == "plumb_bob" and not any(self.distortion)

    def rays(self) -> Tensor:
        """Ray (x, y, 1) of every sensor pixel, exact to 1e-3 px: -> [H, W, 3] float64, computed once per camera."""
        return _table(self).clone()  # the kept one stays as it is, whatever the caller does


@lru_cache(maxsize=16)
def _table(camera: Camera) -> Tensor:
    height, width = camera.size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixel = torch.stack([x, y], -1).reshape(-1, 2).double()
    point = _undistort(camera, pixel)
    ray = torch.cat([point, torch.ones_like(point[:, :1])], -1)
    error = (camera.project(ray) - pixel).abs().amax(-1)
    if not (error < TABLE_ERROR).all():
        worst = int(error.nan_to_num(torch.inf).argmax())
        raise ValueError(
            f"the lens model cannot be inverted at pixel ({int(pixel[worst, 0])}, {int(pixel[worst, 1])}), "
            f"off by {error[worst].item():.3g} px: "
            f"the calibration does not belong to a sensor of {width} x {height}, or the lens sees beyond 90 degrees"
        )
    return ray.view(height, width, 3)


def _undistort(camera: Camera, pixel: Tensor) -> Tensor:
    """Distorted pixels [M, 2] to points on the plane z = 1, by kornia with enough rounds for the table's error."""
    k, coefficients = camera._kornia(pixel)
    if camera._straight:
        return (pixel - k[:2, 2]) / k.diagonal()[:2]
    from kornia.geometry import calibration
    from kornia.geometry.camera import undistort_points_kannala_brandt

    if camera.model == "kannala_brandt":
        params = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion], dtype=torch.float64)
        return undistort_points_kannala_brandt(pixel, params)
    flat = calibration.undistort_points(pixel[None], k[None], coefficients[None], num_iters=100)[0]
    return (flat - k[:2, 2]) / k.diagonal()[:2]


@dataclass(frozen=True)
class Canvas:
    """An image plane in front of a camera: focal px per unit tangent, centre (x, y) px, size (H, W)."""

    focal: float
    centre: tuple[float, float]
    size: tuple[int, int]
    sphere: ClassVar[bool] = False

    @classmethod
    def around(cls, camera: Camera, margin: float = 0.25) -> Canvas:
        """The undistorted sensor with a margin on each side, a share of the sensor's size, so that warped events stay on it.

        One canvas pixel is one sensor pixel in the middle of the image.
        """
        (height, width), focal = camera.size, (camera.fx * camera.fy) ** 0.5
        top, left = round(margin * height), round(margin * width)
        return cls(focal, (camera.cx + left, camera.cy + top), (height + 2 * top, width + 2 * left))

    def scaled(self, factor: float) -> Canvas:
        """The same view in a smaller image: factor 0.5 makes one pixel of two by two."""
        x, y = ((c + 0.5) * factor - 0.5 for c in self.centre)
        height, width = (max(SMALLEST, round(n * factor)) for n in self.size)
        return Canvas(self.focal * factor, (x, y), (height, width))

    def sees(self, ray: Tensor) -> Tensor:
        """Which rays are in front: ray [..., 3] -> bool [...]."""
        return ray[..., 2] > NEAREST

    def pixels(self, ray: Tensor) -> Tensor:
        """Rays to image points: ray [..., 3], z > 0 -> [..., 2] px."""
        return ray[..., :2] / ray[..., 2:] * self.focal + ray.new_tensor(self.centre)

    def folded(self, image: Tensor) -> Tensor:
        """What remains of votes into a frame that is one pixel wider on all sides: [A, H + 2, W + 2] -> [A, H, W]."""
        return image[:, 1:-1, 1:-1]


@dataclass(frozen=True)
class Sphere:
    """All directions around a camera, equirectangular: H rows from straight up to straight down, 2 H columns round.

    The middle of the image looks along z, x to the right and y down as in a pinhole image; columns are azimuth, rows elevation.
    """

    height: int
    sphere: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.height < SMALLEST:
            raise ValueError(f"a sphere wants at least {SMALLEST} rows, got {self.height}")

    @classmethod
    def around(cls, camera: Camera) -> Sphere:
        """Its pixels are as wide as the sensor's in the middle of the image."""
        return cls(max(SMALLEST, round(math.pi * (camera.fx * camera.fy) ** 0.5)))

    @property
    def size(self) -> tuple[int, int]:
        return self.height, 2 * self.height

    @property
    def focal(self) -> float:
        """px per radian."""
        return self.height / math.pi

    @property
    def centre(self) -> tuple[float, float]:
        """px, of the direction (0, 0, 1)."""
        return self.height - 0.5, (self.height - 1) / 2

    def scaled(self, factor: float) -> Sphere:
        """The same view in a smaller image."""
        return Sphere(max(SMALLEST, round(self.height * factor)))

    def sees(self, ray: Tensor) -> Tensor:
        """Which rays have a direction: ray [..., 3] -> bool [...].  Straight up and down has an elevation, but no azimuth."""
        least: float = torch.finfo(ray.dtype).tiny ** 0.5
        return ray[..., ::2].abs().amax(-1) > least

    def pixels(self, ray: Tensor) -> Tensor:
        """Directions to image points: ray [..., 3] -> [..., 2] px, the columns from -0.5 to W - 0.5."""
        return torch.stack(self.place(*ray.unbind(-1)), -1)

    def place(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Column and row of directions, px, as `pixels`, from their parts."""
        column, row = torch.atan2(x, z), torch.atan2(y, (x * x + z * z).sqrt())
        return column * self.focal + self.centre[0], row * self.focal + self.centre[1]

    def folded(self, image: Tensor) -> Tensor:
        """Votes beyond a seam belong to its other side, those beyond a pole half way round: [A, H + 2, W + 2] -> [A, H, W]."""
        half = self.height
        rows = image[:, :, 1:-1].clone()
        rows[:, :, -1] += image[:, :, 0]
        rows[:, :, 0] += image[:, :, -1]
        result: Tensor = rows[:, 1:-1].clone()
        result[:, 0] += rows[:, 0].roll(half, -1)
        result[:, -1] += rows[:, -1].roll(half, -1)
        return result


Screen = Canvas | Sphere
