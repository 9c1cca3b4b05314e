"""The GPU's twin of core/draw.py and of the blur, in Triton: warp and vote are one kernel that reads each event once."""

# mypy: disable-error-code="no-untyped-def, untyped-decorator, assignment"
# ruff: noqa: RUF005
# Triton's own functions have no types, its tuples grow, and its compiler knows no starred ones.

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from torchcmax import kernels

NEAREST = tl.constexpr(kernels.NEAREST)
TINY_32, TINY_64 = (tl.constexpr(torch.finfo(dtype).tiny ** 0.5) for dtype in (torch.float32, torch.float64))
LANES = 32  # events that a program takes at a time: one for each thread of its one warp, whose registers hold the homography and sums
ROUNDS = 8  # of these at least, so that reading the homography and adding up the threads' sums remain a small part
PROGRAMS = 4096  # for each row at most: enough to fill a GPU
TILE = (16, 64)  # px that a program blurs

INFINITY = tl.constexpr(math.inf)
TAN_EIGHTH = tl.constexpr(math.tan(math.pi / 8))
EIGHTH = tl.constexpr(math.floor(math.pi / 4 * 2**20) / 2**20)  # pi/4 in so few bits that its multiples are exact in float32
REST = tl.constexpr(math.pi / 4 - math.floor(math.pi / 4 * 2**20) / 2**20)


@triton.jit
def _atan(u):
    """Angle in rad for |u| <= tan(pi/8): an odd polynomial through Chebyshev nodes, off by 7e-9 in float32 and 5e-19 in float64."""
    if u.dtype == tl.float64:
        P = (1.0, -0.3333333333333312, 0.19999999999940893, -0.14285714279250245, 0.11111110744919658, -0.09090896809064027,
             0.07692045330902225, -0.06662951813629191, 0.05846878297330872, -0.05035102456601552, 0.03796525745386593,
             -0.017805397205419446)  # fmt: skip
    else:
        P = (0.9999999812646111, -0.33332785771924844, 0.19974082415507666, -0.13848490212269207, 0.07976291806794558)
    z, series = u * u, tl.zeros_like(u)
    for i in tl.static_range(len(P)):
        series = series * z + P[len(P) - 1 - i]
    return series * u


@triton.jit
def atan2(y, x):
    """Angle of (x, y) in rad, to 2e-7 in float32 and 5e-16 in float64; nan at (0, 0).

    Not libdevice's, which Triton's interpreter does not have: what the tests see is what runs.
    """
    back, steep = x < 0, tl.abs(y) > tl.abs(x)
    low, high = tl.where(steep, tl.abs(x), tl.abs(y)), tl.where(steep, tl.abs(y), tl.abs(x))  # not min and max, which lose a nan
    far = low > TAN_EIGHTH * high
    u = tl.where(far, low - high, low) / tl.where(far, low + high, high)
    quarters = tl.where(far, 1.0, tl.zeros_like(u))  # the angle is +-atan(u) + quarters pi/4; so far within 0..45 degrees
    quarters = tl.where(steep, 2 - quarters, quarters)
    quarters = tl.where(back, 4 - quarters, quarters)
    angle = (_atan(tl.where(steep != back, -u, u)) + quarters * REST) + quarters * EIGHTH
    return tl.where(y < 0, -angle, angle)


@triton.jit
def _homography(H_ptr, K: tl.constexpr):
    """The 9 K numbers of a row, read once."""
    H = ()
    for i in tl.static_range(9 * K):
        H = H + (tl.load(H_ptr + i),)
    return H


@triton.jit
def _events(x_ptr, y_ptr, s_ptr, weight_ptr, event, there):
    x, y = tl.load(x_ptr + event, mask=there, other=0.0), tl.load(y_ptr + event, mask=there, other=0.0)
    return x, y, tl.load(s_ptr + event, mask=there, other=0.0), tl.load(weight_ptr + event, mask=there, other=0.0)


@triton.jit
def _warped(H, x, y, s, K: tl.constexpr):
    """The ray sum_k s^k H_k (x, y, 1), by Horner."""
    X, Y, Z = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for k in tl.static_range(9 * (K - 1), -1, -9):
        X = X * s + (H[k] * x + (H[k + 1] * y + H[k + 2]))
        Y = Y * s + (H[k + 3] * x + (H[k + 4] * y + H[k + 5]))
        Z = Z * s + (H[k + 6] * x + (H[k + 7] * y + H[k + 8]))
    return X, Y, Z


@triton.jit
def _framed(X, Y, Z, focal, centre_x, centre_y, width, height, SPHERE: tl.constexpr):
    """Where rays fall in the frame, px, and which of them reach it; a place that is not finite does not."""
    if SPHERE:
        reached = tl.maximum(tl.abs(X), tl.abs(Z)) > (TINY_64 if X.dtype == tl.float64 else TINY_32)
        reached = reached & (X * X + Y * Y + Z * Z < INFINITY)  # longer ones have no slope
        x = atan2(X, tl.where(reached, Z, 1.0))
        y = atan2(Y, tl.where(reached, tl.sqrt(X * X + Z * Z), 1.0))
    else:
        reached = Z > NEAREST
        x, y = X / tl.where(reached, Z, 1.0), Y / tl.where(reached, Z, 1.0)
    x = x * tl.full((), focal, X.dtype) + tl.full((), centre_x, X.dtype) + 1
    y = y * tl.full((), focal, X.dtype) + tl.full((), centre_y, X.dtype) + 1
    reached = reached & (x > -1) & (x < width) & (y > -1) & (y < height)
    return tl.where(reached, x, 0.0), tl.where(reached, y, 0.0), reached


@triton.jit
def _corners(x, y, reached, width, height):
    """The upper left of the four pixels around each place, the place within them, and which of the four are in the frame."""
    left, top = tl.floor(x), tl.floor(y)
    west, east = reached & (left >= 0), reached & (left < width - 1)
    north, south = top >= 0, top < height - 1
    pixel = top.to(tl.int32) * width + left.to(tl.int32)
    return pixel, x - left, y - top, west & north, east & north, west & south, east & south


@triton.jit(do_not_specialize=["width", "height", "events", "programs"])
def _vote(
    frame_ptr, H_ptr, x_ptr, y_ptr, s_ptr, weight_ptr, owner_ptr, focal: tl.float64, centre_x: tl.float64, centre_y: tl.float64,
    width, height, events, programs, K: tl.constexpr, SPHERE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Program p of a row votes with the blocks p, p + programs, ... of its events."""
    row = (tl.program_id(0) // programs).to(tl.int64)
    H = _homography(H_ptr + row * 9 * K, K)
    first = tl.load(owner_ptr + row).to(tl.int64) * events
    x_ptr, y_ptr, s_ptr, weight_ptr = x_ptr + first, y_ptr + first, s_ptr + first, weight_ptr + first
    for start in range(tl.program_id(0) % programs * BLOCK, events, programs * BLOCK):
        event = start + tl.arange(0, BLOCK)
        x, y, s, weight = _events(x_ptr, y_ptr, s_ptr, weight_ptr, event, event < events)
        X, Y, Z = _warped(H, x, y, s, K)
        x, y, reached = _framed(X, Y, Z, focal, centre_x, centre_y, width, height, SPHERE)
        pixel, x, y, in_00, in_01, in_10, in_11 = _corners(x, y, reached & (weight != 0), width, height)
        corner = frame_ptr + row * height * width + pixel
        tl.atomic_add(corner, (1 - x) * (1 - y) * weight, mask=in_00, sem="relaxed")
        tl.atomic_add(corner + 1, x * (1 - y) * weight, mask=in_01, sem="relaxed")
        tl.atomic_add(corner + width, (1 - x) * y * weight, mask=in_10, sem="relaxed")
        tl.atomic_add(corner + width + 1, x * y * weight, mask=in_11, sem="relaxed")


@triton.jit
def _to_place(gradient_ptr, x, y, reached, width, height):
    """Slope of a gradient image between the four pixels around each place; 0 where nothing is reached."""
    pixel, x, y, in_00, in_01, in_10, in_11 = _corners(x, y, reached, width, height)
    g_00 = tl.load(gradient_ptr + pixel, mask=in_00, other=0.0)
    g_01 = tl.load(gradient_ptr + pixel + 1, mask=in_01, other=0.0)
    g_10 = tl.load(gradient_ptr + pixel + width, mask=in_10, other=0.0)
    g_11 = tl.load(gradient_ptr + pixel + width + 1, mask=in_11, other=0.0)
    return (1 - y) * (g_01 - g_00) + y * (g_11 - g_10), (1 - x) * (g_10 - g_00) + x * (g_11 - g_01)


@triton.jit
def _to_ray(dx, dy, X, Y, Z, SPHERE: tl.constexpr):
    """dL/dray from dL/d(x, y), these in units of the focal length; the ray is none that `_framed` drops."""
    if SPHERE:
        square = X * X + Z * Z
        around = tl.sqrt(square)
        inwards = dy / (square + Y * Y) * Y / around  # at a pole `around` is still above its guard
        return dx * Z / square - inwards * X, dy / (square + Y * Y) * around, -dx * X / square - inwards * Z
    else:
        return dx / Z, dy / Z, -(dx * X + dy * Y) / Z / Z


@triton.jit(do_not_specialize=["width", "height", "events", "programs"])
def _slope(
    partial_ptr, gradient_ptr, H_ptr, x_ptr, y_ptr, s_ptr, weight_ptr, owner_ptr, focal: tl.float64, centre_x: tl.float64,
    centre_y: tl.float64, width, height, events, programs, K: tl.constexpr, SPHERE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Program p of a row sums s^k dL/dray (x, y, 1)^T over the blocks p, p + programs, ... of its events."""
    row = (tl.program_id(0) // programs).to(tl.int64)
    number = partial_ptr.dtype.element_ty
    H = _homography(H_ptr + row * 9 * K, K)
    first = tl.load(owner_ptr + row).to(tl.int64) * events
    x_ptr, y_ptr, s_ptr, weight_ptr = x_ptr + first, y_ptr + first, s_ptr + first, weight_ptr + first
    sums = ()
    for _ in tl.static_range(9 * K):
        sums = sums + (tl.zeros([BLOCK], number),)

    for start in range(tl.program_id(0) % programs * BLOCK, events, programs * BLOCK):
        event = start + tl.arange(0, BLOCK)
        x, y, s, weight = _events(x_ptr, y_ptr, s_ptr, weight_ptr, event, event < events)
        X, Y, Z = _warped(H, x, y, s, K)
        px, py, reached = _framed(X, Y, Z, focal, centre_x, centre_y, width, height, SPHERE)
        dx, dy = _to_place(gradient_ptr + row * height * width, px, py, reached & (weight != 0), width, height)
        scale = tl.where(reached, weight, 0.0) * tl.full((), focal, number)
        X, Y, Z = tl.where(reached, X, 0.0), tl.where(reached, Y, 0.0), tl.where(reached, Z, 1.0)
        x, y, s = tl.where(reached, x, 0.0), tl.where(reached, y, 0.0), tl.where(reached, s, 0.0)
        dX, dY, dZ = _to_ray(dx * scale, dy * scale, X, Y, Z, SPHERE)
        outer = (dX * x, dX * y, dX, dY * x, dY * y, dY, dZ * x, dZ * y, dZ)
        more, power = (), tl.full([BLOCK], 1.0, number)
        for k in tl.static_range(K):
            for i in tl.static_range(9):
                more = more + (sums[9 * k + i] + power * outer[i],)
            power = power * s
        sums = more

    for i in tl.static_range(9 * K):
        tl.store(partial_ptr + tl.program_id(0).to(tl.int64) * 9 * K + i, tl.sum(sums[i], 0))


@triton.jit(do_not_specialize=["height", "radius"])
def _smooth(
    image_ptr, smooth_ptr, kernel_ptr, stride_a, stride_y, stride_x, height, width, radius,
    ALONG_X: tl.constexpr, BLOCK_Y: tl.constexpr, BLOCK_X: tl.constexpr,
):  # fmt: skip
    """A program blurs one tile of one image in one direction."""
    across, down = tl.cdiv(width, BLOCK_X), tl.cdiv(height, BLOCK_Y)
    image, tile = (tl.program_id(0) // (across * down)).to(tl.int64), tl.program_id(0) % (across * down)
    y = tile // across * BLOCK_Y + tl.arange(0, BLOCK_Y)[:, None]
    x = tile % across * BLOCK_X + tl.arange(0, BLOCK_X)[None, :]
    inside, centre = (y < height) & (x < width), image_ptr + image * stride_a + y * stride_y + x * stride_x
    if ALONG_X:
        at, length, step = x, width, stride_x
    else:
        at, length, step = y, height, stride_y
    total = tl.load(centre, mask=inside, other=0.0) * tl.load(kernel_ptr)
    for i in range(1, radius + 1):
        before = tl.load(centre - i * step, mask=inside & (at >= i), other=0.0)
        behind = tl.load(centre + i * step, mask=inside & (at < length - i), other=0.0)
        total += (before + behind) * tl.load(kernel_ptr + i)
    tl.store(smooth_ptr + image * height * width + y * width + x, total, mask=inside)


def votes(H_k: Tensor, ink: Any, canvas: Any, owner: Tensor) -> Tensor:
    """Warp events and vote them into frames one pixel wider on all sides than the canvas, without a derivative.

    H_k [A, K, 3, 3] | ink of W windows, [W, N] each | owner [A] int: the window of each homography -> [A, H + 2, W + 2]
    """
    frame = H_k.new_zeros(len(H_k), canvas.size[0] + 2, canvas.size[1] + 2)
    programs = _programs(ink)
    _launch(_vote, len(H_k) * programs, (frame, *_inputs(H_k, ink, canvas, owner), programs), **_kind(H_k, canvas))
    return frame


def slopes(H_k: Tensor, ink: Any, canvas: Any, owner: Tensor, gradient: Tensor) -> Tensor:
    """The derivative of `votes` to the homographies, the same each time; gradient [A, H + 2, W + 2] -> [A, K, 3, 3]."""
    programs = _programs(ink)
    partial = H_k.new_empty(len(H_k), programs, 9 * H_k.shape[1])
    inputs = (partial, gradient.contiguous(), *_inputs(H_k, ink, canvas, owner), programs)
    _launch(_slope, len(H_k) * programs, inputs, **_kind(H_k, canvas))
    return partial.sum(1).view(H_k.shape)


def smooth(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur, zero outside the image, cut at 3 sigma: image [A, H, W], of any strides | sigma > 0 px -> [A, H, W]."""
    count, height, width = image.shape
    kernel = _gauss(sigma, image.dtype, image.device)
    programs = count * triton.cdiv(height, TILE[0]) * triton.cdiv(width, TILE[1])
    for along_x in (False, True):
        result = image.new_empty(image.shape)
        inputs = (image, result, kernel, *image.stride(), height, width, len(kernel) - 1)
        _launch(_smooth, programs, inputs, ALONG_X=along_x, BLOCK_Y=TILE[0], BLOCK_X=TILE[1], num_warps=4)
        image = result
    return image


@lru_cache(maxsize=64)
def _gauss(sigma: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Half a Gaussian kernel from its middle, [3 sigma + 1]; kept, since a copy to the GPU waits for it."""
    half = torch.arange(max(1, round(3 * sigma)) + 1, dtype=torch.float64).square().div(-2 * sigma**2).exp()
    return (half / (2 * half.sum() - 1)).to(device, dtype)


def _inputs(H_k: Tensor, ink: Any, canvas: Any, owner: Tensor) -> tuple[Any, ...]:
    """What both kernels read; a frame is one pixel wider on all sides than the canvas."""
    tensors = (part.contiguous() for part in (H_k, ink.x, ink.y, ink.s, ink.weight, owner))
    return (*tensors, canvas.focal, *canvas.centre, canvas.size[1] + 2, canvas.size[0] + 2, ink.x.shape[-1])


def _kind(H_k: Tensor, canvas: Any) -> dict[str, Any]:
    """What a kernel is compiled for."""
    return {"K": H_k.shape[1], "SPHERE": canvas.sphere, "BLOCK": LANES, "num_warps": LANES // 32}


def _programs(ink: Any) -> int:
    """For each row, whatever the batch, so that a row is the same in each."""
    events: int = ink.x.shape[-1]
    return min(-(-events // (LANES * ROUNDS)), PROGRAMS)


def _launch(kernel: Any, programs: int, inputs: tuple[Any, ...], **options: Any) -> None:
    """Run programs on the device of the tensors, in one dimension of the grid: the others end at 65,535."""
    if programs:
        with torch.cuda.device_of(inputs[0]):
            kernel[(programs,)](*inputs, **options, enable_fp_fusion=True)
