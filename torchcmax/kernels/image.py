"""Blur, contrast and the contrast's gradient to the image, compiled for the CPU: the twin of core/contrast.py.

Images are frames [H + 2, W + 2]: the canvas with an empty border of one pixel.
"""

from __future__ import annotations

import numpy as np

from torchcmax.kernels.compiling import compiled

CONTRASTS = ("variance", "mean_square", "high_pass", "michelson", "gradient_magnitude")


def taps(sigma):
    """Half of the Gaussian kernel, cut at 3 sigma: -> [radius + 1]; the middle alone for sigma 0."""
    if sigma <= 0:
        return np.ones(1)
    kernel = np.exp(-(np.arange(max(1, round(3 * sigma)) + 1) ** 2) / (2 * sigma * sigma))
    return kernel / (2 * kernel.sum() - 1)


@compiled
def border(frame):
    """Drop what lies outside of the canvas."""
    frame[0] = 0
    frame[-1] = 0
    frame[:, 0] = 0
    frame[:, -1] = 0


@compiled
def scaled(kernel, row, result):
    """result = kernel row."""
    for i in range(len(result)):
        result[i] = kernel * row[i]


@compiled
def add_pair(kernel, pair, result):
    """result += kernel (one + other)."""
    one, other = pair
    for i in range(len(result)):
        result[i] += kernel * (one[i] + other[i])


@compiled
def add_pairs(kernel, pairs, result):
    """result += three such sums at once, so that each number of the result is loaded and stored once for all."""
    (a, b), (c, d), (e, f) = pairs
    first, second, third = kernel[0], kernel[1], kernel[2]
    for i in range(len(result)):
        result[i] += first * (a[i] + b[i]) + second * (c[i] + d[i]) + third * (e[i] + f[i])


@compiled
def rows(frame, y, i):
    """The rows i above and below y; the empty border beyond the frame."""
    return frame[max(y - i, 0)], frame[min(y + i, len(frame) - 1)]


@compiled
def shifts(line, start, length, i):
    """The line i further left and right."""
    return line[start - i : start - i + length], line[start + i : start + i + length]


@compiled
def blur(frame, kernel, line, result, wanted):
    """Smooth in both directions, row by row; nothing lies outside: line [W + 2 + 2 radius], scratch.

    Of the result only the wanted rows, from the first to the one before the last, are written, and not the border.
    """
    height, width, radius = frame.shape[0], frame.shape[1], len(kernel) - 1
    start, inner = radius + 1, width - 2
    line[:] = 0
    middle = line[radius : radius + width]
    for y in range(max(wanted[0], 1), min(wanted[1], height - 1)):
        scaled(kernel[0], frame[y], middle)
        i = 1
        while i + 2 <= radius:
            add_pairs(kernel[i:], (rows(frame, y, i), rows(frame, y, i + 1), rows(frame, y, i + 2)), middle)
            i += 3
        while i <= radius:
            add_pair(kernel[i], rows(frame, y, i), middle)
            i += 1
        out = result[y, 1 : width - 1]
        scaled(kernel[0], line[start : start + inner], out)
        i = 1
        while i + 2 <= radius:
            pairs = shifts(line, start, inner, i), shifts(line, start, inner, i + 1), shifts(line, start, inner, i + 2)
            add_pairs(kernel[i:], pairs, out)
            i += 3
        while i <= radius:
            add_pair(kernel[i], shifts(line, start, inner, i), out)
            i += 1


@compiled
def contrast(code, frame, slope, spare):
    """The contrast at this place of CONTRASTS, and its derivative to the frame; slope and spare [H + 2, W + 2] are written.

    All three have an empty border.
    """
    border(slope)
    if code == 0:
        return variance(frame, slope)
    if code == 1:
        return centred_square(frame, 0.0, slope)
    if code == 2:
        border(spare)
        return high_pass(frame, slope, spare)
    if code == 3:
        return michelson(frame, slope)
    return gradient_magnitude(frame, slope)


@compiled
def pixels(frame):
    """Of the canvas."""
    return (frame.shape[0] - 2) * (frame.shape[1] - 2)


@compiled
def variance(frame, slope):
    total = 0.0
    for y in range(1, frame.shape[0] - 1):
        row, part = frame[y], frame.dtype.type(0)
        for x in range(len(row)):
            part += row[x]
        total += part
    return centred_square(frame, total / pixels(frame), slope)


@compiled
def centred_square(frame, centre, slope):
    """Mean squared distance from the centre."""
    total, centre, scale = 0.0, frame.dtype.type(centre), frame.dtype.type(2 / pixels(frame))
    for y in range(1, frame.shape[0] - 1):
        row, out, part = frame[y, 1:-1], slope[y, 1:-1], frame.dtype.type(0)
        for x in range(len(row)):
            distance = row[x] - centre
            part += distance * distance
            out[x] = scale * distance
        total += part
    return total / pixels(frame)


@compiled
def laplacian(frame, factor, result):
    """The five-point Laplacian times the factor -> result, and the sum of its squares."""
    total, factor, four = 0.0, frame.dtype.type(factor), frame.dtype.type(4)
    for y in range(1, frame.shape[0] - 1):
        up, row, down, out, part = frame[y - 1], frame[y], frame[y + 1], result[y], frame.dtype.type(0)
        for x in range(1, len(row) - 1):
            out[x] = factor * (four * row[x] - up[x] - down[x] - row[x - 1] - row[x + 1])
            part += out[x] * out[x]
        total += part
    return total


@compiled
def high_pass(frame, slope, spare):
    energy = laplacian(frame, 1.0, spare)
    laplacian(spare, 1 / (10 * pixels(frame)), slope)
    return energy / (20 * pixels(frame))


@compiled
def michelson(frame, slope):
    one = three = four = 0.0
    for y in range(1, frame.shape[0] - 1):
        for x in range(1, frame.shape[1] - 1):
            size = abs(frame[y, x])
            one, three, four = one + size, three + size**3, four + size**4
    if three == 0:
        slope[:] = 0
        return 0.0
    bright, dark = four / three, one / pixels(frame)
    factor = 2 / (bright + dark) ** 2
    for y in range(1, frame.shape[0] - 1):
        for x in range(1, frame.shape[1] - 1):
            size = abs(frame[y, x])
            along = factor * (dark * (4 * size - 3 * bright) * size * size / three - bright / pixels(frame))
            slope[y, x] = along * np.sign(frame[y, x])
    return (bright - dark) / (bright + dark)


@compiled
def gradient_magnitude(frame, slope):
    """Differences to the right and lower neighbours; each belongs to both of its pixels."""
    total, scale = 0.0, frame.dtype.type(1 / (2 * pixels(frame)))
    slope[:] = 0
    for y in range(1, frame.shape[0] - 1):
        row, down, out, below, part = frame[y], frame[y + 1], slope[y], slope[y + 1], frame.dtype.type(0)
        for x in range(1, len(row) - 1):
            fall = row[x] - down[x]
            part += fall * fall
            out[x] += scale * fall
            below[x] -= scale * fall
        for x in range(1, len(row) - 1):
            fall = row[x] - row[x + 1]
            part += fall * fall
            out[x] += scale * fall
        for x in range(2, len(row) - 1):
            out[x] -= scale * (row[x - 1] - row[x])
        total += part
    border(slope)
    return total / (4 * pixels(frame))
