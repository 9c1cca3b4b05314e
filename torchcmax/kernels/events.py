"""Warp and vote in one pass over the events, compiled by numba: the twin of core/draw.py.

Events come in blocks of nearly one time, in which H(s) is a parabola: H(s) = A + u B + u^2 C with u = s - s_0, the first three
terms of the polynomial about the block's middle.  In blocks of 1/32 of a window that is 8e-6 px off at a turn of 0.4 rad, less than
float32 rounds; its gradient is exact.  In float64 blocks are so short that it is 1e-12 px off.
Images are frames, one pixel wider on all sides than the canvas, so that no vote needs a look at the border.  The lens holds
focal, centre x, y, right, bottom, stride in px of the frame, the least depth (of a sphere: distance from its axis), whether it is a
sphere, and how long a block may last.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from torchcmax.kernels.compiling import compiled

BLOCK = 512  # events in a block at most: their intermediate numbers stay in the first-level cache
SPAN = {"f4": 1 / 32, "f8": 1 / 8192}  # of a window that a block may last
EIGHTH = np.tan(np.pi / 8)
# atan(sqrt(q)) / sqrt(q) as a polynomial of q up to tan^2(pi / 8), exact to 5e-16
_SERIES = chebyshev.Chebyshev.interpolate(lambda q: np.arctan(np.sqrt(q)) / np.sqrt(q), 10, domain=[1e-12, EIGHTH**2])
ARCTAN = tuple(float(c) for c in _SERIES.convert(kind=np.polynomial.Polynomial).coef)


@compiled
def expand(H, s, near):
    """The polynomial about s, by Horner's scheme: H [K, 3, 3] -> A, B, C, near [3, 3, 3]."""
    near[:] = 0
    for k in range(len(H) - 1, -1, -1):
        for i in range(3):
            for j in range(3):
                near[2, i, j] = near[2, i, j] * s + near[1, i, j]
                near[1, i, j] = near[1, i, j] * s + near[0, i, j]
                near[0, i, j] = near[0, i, j] * s + H[k, i, j]


@compiled
def block_end(s, first, last, span, size):
    """Where the block that begins at `first` ends, at most `size` further, and the middle of its times; any order will do."""
    end = min(first + size, last)
    while True:
        part, late = s[first:end], 0
        for i in range(len(part) - 1):
            late += part[i + 1] < part[i]
        low, high = part[0], part[-1]
        if late:
            for i in range(len(part)):
                low, high = min(low, part[i]), max(high, part[i])
        if high - low <= span or end == first + 1:
            return end, s.dtype.type(0.5) * (low + high)
        end = first + (end - first) // 2


@compiled
def carry(near, s_0, x, y, s, ray):
    """Rays of the reference camera: (A + u B + u^2 C) (x, y, 1) -> ray [3, n]."""
    for r in range(3):
        a, b, c = near[0, r, 0], near[0, r, 1], near[0, r, 2]
        d, e, f = near[1, r, 0], near[1, r, 1], near[1, r, 2]
        g, h, k = near[2, r, 0], near[2, r, 1], near[2, r, 2]
        for i in range(len(x)):
            u = s[i] - s_0
            ray[r, i] = (a + u * (d + u * g)) * x[i] + (b + u * (e + u * h)) * y[i] + (c + u * (f + u * k))


@compiled
def land(ray, weight, lens, pixel, share):
    """Where rays meet the frame of a pinhole canvas: ray [3, n] -> pixel [n], share [3, n]: of the next column, row; weight."""
    focal, x, y, right, bottom, stride, near = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6]
    zero, one = lens.dtype.type(0), lens.dtype.type(1)
    for i in range(len(weight)):
        z = ray[2, i]
        ahead = z > near
        scale = focal / (z if ahead else one)
        px, py = ray[0, i] * scale + x, ray[1, i] * scale + y
        inside = ahead & (px > zero) & (px < right) & (py > zero) & (py < bottom)  # not where it is nan
        px, py = px if inside else zero, py if inside else zero
        column, row = np.floor(px), np.floor(py)
        pixel[i] = np.int32(row * stride + column)  # in floating point, as integers would be counted in 64 bits, half as fast
        share[0, i], share[1, i] = px - column, py - row
        share[2, i] = weight[i] if inside else zero


@compiled
def leave(slope, ray, n, lens):
    """The derivative of `land`: slope [3, n] along columns, rows of the frame -> along the rays' three coordinates, in place."""
    focal, near, one = lens[0], lens[6], lens.dtype.type(1)
    for i in range(n):
        z = ray[2, i]
        inverse = one / (z if z > near else one)
        along_x, along_y = slope[0, i] * focal * inverse, slope[1, i] * focal * inverse
        slope[0, i], slope[1, i] = along_x, along_y
        slope[2, i] = -(along_x * ray[0, i] + along_y * ray[1, i]) * inverse


@compiled
def angle(y, x, like):
    """atan2 without a branch, so that eight are computed at once; in the precision of the array `like`."""
    number = like.dtype.type
    one, up, right = number(1), abs(y), abs(x)
    long, short = max(up, right), min(up, right)
    ratio = short / (long if long > 0 else one)
    steep = ratio > number(EIGHTH)
    t = (ratio - one) / (ratio + one) if steep else ratio
    q = t * t
    arc = number(ARCTAN[-1])
    for k in range(len(ARCTAN) - 2, -1, -1):
        arc = arc * q + number(ARCTAN[k])
    arc = arc * t + (number(np.pi / 4) if steep else number(0))
    arc = number(np.pi / 2) - arc if up > right else arc
    arc = number(np.pi) - arc if x < 0 else arc
    return -arc if y < 0 else arc


@compiled
def land_round(ray, weight, lens, pixel, share):
    """`land` for the frame of a sphere: azimuth and elevation."""
    focal, x, y, right, bottom, stride, least = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6]
    zero = lens.dtype.type(0)
    for i in range(len(weight)):
        around = np.sqrt(ray[0, i] * ray[0, i] + ray[2, i] * ray[2, i])
        px = angle(ray[0, i], ray[2, i], lens) * focal + x
        py = angle(ray[1, i], around, lens) * focal + y
        inside = (around > least) & (px > zero) & (px < right) & (py > zero) & (py < bottom)
        px, py = px if inside else zero, py if inside else zero
        column, row = np.floor(px), np.floor(py)
        pixel[i] = np.int32(row * stride + column)
        share[0, i], share[1, i] = px - column, py - row
        share[2, i] = weight[i] if inside else zero


@compiled
def leave_round(slope, ray, n, lens):
    """The derivative of `land_round`, as `leave`."""
    focal, least, one = lens[0], lens[6], lens.dtype.type(1)
    for i in range(n):
        x, y, z = ray[0, i], ray[1, i], ray[2, i]
        square = x * x + z * z
        around = np.sqrt(square)
        seen = around > least
        square, around = square if seen else one, around if seen else one
        across = slope[0, i] * focal / square
        up = slope[1, i] * focal / (square + y * y)
        out = up * y / around
        slope[0, i], slope[1, i], slope[2, i] = across * z - out * x, up * around, -across * x - out * z


@compiled
def scatter(pixel, share, stride, frame):
    """Add each weight to the four pixels around its point: frame [(H + 2) (W + 2)]."""
    one, step = np.uint64(1), np.uint64(stride)
    for i in range(len(pixel)):
        p, fx = np.uint64(pixel[i]), share[0, i]
        low = share[2, i] * share[1, i]
        high = share[2, i] - low
        q = p + step
        frame[p] += high - high * fx
        frame[p + one] += high * fx
        frame[q] += low - low * fx
        frame[q + one] += low * fx


@compiled
def look(pixel, share, stride, frame):
    """The derivative of `scatter`: weight times slope of dL/dframe along columns and rows, in place of the shares."""
    one, step = np.uint64(1), np.uint64(stride)
    for i in range(len(pixel)):
        p = np.uint64(pixel[i])
        q = p + step
        above, below = frame[p + one] - frame[p], frame[q + one] - frame[q]
        down, twist = frame[q] - frame[p], below - above
        fx, fy, weight = share[0, i], share[1, i], share[2, i]
        share[0, i], share[1, i] = weight * (above + fy * twist), weight * (down + fx * twist)


@compiled
def follow(xy, motion, s, weight, edge, pixel, share):
    """`land` of points that move within the image: xy + s motion [n, 2] px | edge: right, bottom, stride of the frame."""
    right, bottom, stride = edge[0], edge[1], edge[2]
    zero, one = edge.dtype.type(0), edge.dtype.type(1)
    for i in range(len(weight)):  # columns first, so that the next loop computes eight at once
        share[0, i], share[1, i] = xy[i, 0] + s[i] * motion[i, 0], xy[i, 1] + s[i] * motion[i, 1]
    for i in range(len(weight)):
        px, py = share[0, i] + one, share[1, i] + one
        inside = (px > zero) & (px < right) & (py > zero) & (py < bottom)  # not where it is nan
        px, py = px if inside else zero, py if inside else zero
        column, row = np.floor(px), np.floor(py)
        pixel[i] = np.int32(row * stride + column)
        share[0, i], share[1, i] = px - column, py - row
        share[2, i] = weight[i] if inside else zero


@compiled
def vote(xy, motion, s, weight, edge, frame):
    """Add the weights [N] of points that have moved by s motion to the frame [(H + 2) (W + 2)]."""
    pixel, share = np.empty(BLOCK, np.int32), np.empty((3, BLOCK), xy.dtype)
    last = count(weight)
    for i in range(0, last, BLOCK):
        end = min(i + BLOCK, last)
        follow(xy[i:end], motion[i:end], s[i:end], weight[i:end], edge, pixel, share)
        scatter(pixel[: end - i], share, edge[2], frame)


@compiled
def read(pixel, share, stride, frame, value):
    """The derivative of `scatter` to its weights: dL/dframe at the points."""
    one, step = np.uint64(1), np.uint64(stride)
    for i in range(len(pixel)):
        p, fx, fy = np.uint64(pixel[i]), share[0, i], share[1, i]
        q = p + step
        above, below = frame[p] + fx * (frame[p + one] - frame[p]), frame[q] + fx * (frame[q + one] - frame[q])
        value[i] = above + fy * (below - above)


@compiled
def vote_slopes(xy, motion, s, weight, edge, frame, to_motion, to_weight):
    """The derivative of `vote`: frame = dL/dframe, whose border is 0 | to_motion [N, 2], to_weight [N], empty where not wanted."""
    pixel, share = np.empty(BLOCK, np.int32), np.empty((3, BLOCK), xy.dtype)
    for i in range(0, len(weight), BLOCK):
        end = min(i + BLOCK, len(weight))
        n = end - i
        follow(xy[i:end], motion[i:end], s[i:end], weight[i:end], edge, pixel, share)
        if len(to_weight):
            read(pixel[:n], share, edge[2], frame, to_weight[i:end])
        if len(to_motion):
            look(pixel[:n], share, edge[2], frame)
            for j in range(n):
                to_motion[i + j, 0], to_motion[i + j, 1] = s[i + j] * share[0, j], s[i + j] * share[1, j]


@compiled
def gather(slope, x, y, s, s_0, near):
    """The derivative of `carry`: sums over the events of slope [3, n] times (x, y, 1), times 1, u and u^2."""
    for r in range(3):
        a = b = c = d = e = f = g = h = k = x.dtype.type(0)
        for i in range(len(x)):
            v, u = slope[r, i], s[i] - s_0
            w = u * v
            z = u * w
            a, b, c = a + v * x[i], b + v * y[i], c + v
            d, e, f = d + w * x[i], e + w * y[i], f + w
            g, h, k = g + z * x[i], h + z * y[i], k + z
        near[0, r, 0], near[0, r, 1], near[0, r, 2] = a, b, c
        near[1, r, 0], near[1, r, 1], near[1, r, 2] = d, e, f
        near[2, r, 0], near[2, r, 1], near[2, r, 2] = g, h, k


@compiled
def collect(near, s, total):
    """The derivative of `expand`, added to the total [K, 3, 3]."""
    zeroth, first, second = 1.0, 0.0, 0.0  # s^k, k s^(k - 1), k (k - 1) / 2 s^(k - 2)
    for k in range(len(total)):
        for i in range(3):
            for j in range(3):
                total[k, i, j] += zeroth * near[0, i, j] + first * near[1, i, j] + second * near[2, i, j]
        zeroth, first, second = zeroth * s, first * s + zeroth, second * s + first


@compiled
def count(weight):
    """Events before the padding."""
    n = len(weight)
    while n > 0 and weight[n - 1] == 0:
        n -= 1
    return n


@compiled
def reach(pixel, least, most):
    """The least and most of some pixels and of two more."""
    for i in range(len(pixel)):
        least, most = min(least, pixel[i]), max(most, pixel[i])
    return least, most


@compiled
def draw(H, events, lens, frame):
    """Warp the events of a window and vote: H [K, 3, 3] | events: x, y, s, weight [N] | frame [(H + 2) (W + 2)], added to.

    -> the first row of the frame that has votes, and the one after the last
    """
    x, y, s, weight = events
    last, stride = count(weight), np.int64(lens[5])
    near, ray, share = np.empty((3, 3, 3), x.dtype), np.empty((3, BLOCK), x.dtype), np.empty((3, BLOCK), x.dtype)
    pixel = np.empty(BLOCK, np.int32)
    i, size, least, most = 0, BLOCK, np.int32(len(frame)), np.int32(0)
    while i < last:
        end, s_0 = block_end(s, i, last, lens[8], size)
        n = end - i
        size = min(BLOCK, 2 * n)  # the next block is about as long
        expand(H, s_0, near)
        carry(near, s_0, x[i:end], y[i:end], s[i:end], ray)
        if lens[7]:
            land_round(ray, weight[i:end], lens, pixel, share)
        else:
            land(ray, weight[i:end], lens, pixel, share)
        scatter(pixel[:n], share, stride, frame)
        least, most = reach(pixel[:n], least, most)
        i = end
    return least // stride, most // stride + 2


@compiled
def draw_slopes(H, events, lens, frame, total):
    """The derivative of `draw`: frame = dL/dframe | total [K, 3, 3] float64, added to."""
    x, y, s, weight = events
    last, stride = count(weight), np.int64(lens[5])
    near, ray, share = np.empty((3, 3, 3), x.dtype), np.empty((3, BLOCK), x.dtype), np.empty((3, BLOCK), x.dtype)
    pixel = np.empty(BLOCK, np.int32)
    i, size = 0, BLOCK
    while i < last:
        end, s_0 = block_end(s, i, last, lens[8], size)
        n = end - i
        size = min(BLOCK, 2 * n)  # the next block is about as long
        expand(H, s_0, near)
        carry(near, s_0, x[i:end], y[i:end], s[i:end], ray)
        if lens[7]:
            land_round(ray, weight[i:end], lens, pixel, share)
        else:
            land(ray, weight[i:end], lens, pixel, share)
        look(pixel[:n], share, stride, frame)
        if lens[7]:
            leave_round(share, ray, n, lens)
        else:
            leave(share, ray, n, lens)
        gather(share, x[i:end], y[i:end], s[i:end], s_0, near)
        collect(near, s_0, total)
        i = end
