"""Match a window to the texture of a map, compiled for the CPU: the twin of core/match.py."""

from __future__ import annotations

import numpy as np

from torchcmax.kernels.compiling import compiled
from torchcmax.kernels.events import BLOCK, block_end, carry, collect, count, expand, gather, land, leave
from torchcmax.kernels.place import SIZE, at_time, chain, derivatives, placed, units
from torchcmax.kernels.search import aimed, inverted, learn, length_in, narrowed

LEAST = 0.05  # strength: as core.match


@compiled
def lookup(pixel, share, stride, frame, strength):
    """Texture at points of the frame: strength [n]; its slopes along columns and rows take the place of the shares."""
    one, step = np.uint64(1), np.uint64(stride)
    for i in range(len(pixel)):
        p = np.uint64(pixel[i])
        q = p + step
        above, below = frame[p + one] - frame[p], frame[q + one] - frame[q]
        down, twist = frame[q] - frame[p], below - above
        fx, fy, weight = share[0, i], share[1, i], share[2, i]
        strength[i] = weight * (frame[p] + fx * above + fy * (down + fx * twist))
        share[0, i], share[1, i] = weight * (above + fy * twist), weight * (down + fx * twist)


@compiled
def meet(near, s_0, x, y, s, weight, lens, frame, ray, share, pixel, strength):
    """What the events of a block find: strength [n], and in share [3, n] its slope along the coordinates of their rays."""
    carry(near, s_0, x, y, s, ray)
    land(ray, weight, lens, pixel, share)
    lookup(pixel[: len(x)], share, np.int64(lens[5]), frame, strength)
    leave(share, ray, len(x), lens)


@compiled
def crossed(slope, share, x, y, sums):
    """Sums over events of share slope_a slope_b times (x x, x y, x, y y, y, 1), a <= b: sums [6, 6]."""
    row = 0
    for a in range(3):
        for b in range(a, 3):
            xx = xy = x1 = yy = y1 = one = x.dtype.type(0)
            for i in range(len(x)):
                u = share[i] * slope[a, i] * slope[b, i]
                v, w = u * x[i], u * y[i]
                xx, xy, x1 = xx + v * x[i], xy + v * y[i], x1 + v
                yy, y1, one = yy + w * y[i], y1 + w, one + u
            sums[row, 0], sums[row, 1], sums[row, 2] = xx, xy, x1
            sums[row, 3], sums[row, 4], sums[row, 5] = yy, y1, one
            row += 1


@compiled
def spread_out(sums, Q):
    """The symmetric [9, 9] matrix of which `crossed` gave the parts; row 3 a + i belongs to H[a, i]."""
    place = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    for a in range(3):
        for b in range(3):
            for i in range(3):
                for j in range(3):
                    Q[3 * a + i, 3 * b + j] = sums[place[a, b], place[i, j]]


@compiled
def add_curvature(D, Q, half, A):
    """A += D Q D^T, below the diagonal: D [14, 9] | half [14, 9] scratch."""
    for p in range(SIZE):
        for j in range(9):
            total = 0.0
            for i in range(9):
                total += D[p, i] * Q[i, j]
            half[p, j] = total
    for p in range(SIZE):
        for q in range(p + 1):
            total = 0.0
            for j in range(9):
                total += half[p, j] * D[q, j]
            A[p, q] += total


@compiled
def value_and_slope(x, u, place, events, lens, frame, terms, most, edge):
    """-sum(T - T^2 / 2) over the events, or sum F where they are none, its derivative to x [14] px, and sum T: core.match.evaluate."""
    ex, ey, es, weight = events
    last, one = count(weight), lens.dtype.type(1)
    if last == 0:
        return 0.0, np.zeros(SIZE), 0.0
    exact = np.empty((terms, 3, 3))
    placed(x, u, place, exact)
    H, to_H = exact.astype(lens.dtype), np.zeros((terms, 3, 3))
    near, ray, share = np.empty((3, 3, 3), lens.dtype), np.empty((3, BLOCK), lens.dtype), np.empty((3, BLOCK), lens.dtype)
    pixel, strength = np.empty(BLOCK, np.int32), np.empty(BLOCK, lens.dtype)
    i, size, value, found = 0, BLOCK, 0.0, 0.0
    while i < last:
        end, s_0 = block_end(es, i, last, lens[8], size)
        n = end - i
        size = min(BLOCK, 2 * n)
        expand(H, s_0, near)
        meet(near, s_0, ex[i:end], ey[i:end], es[i:end], weight[i:end], lens, frame, ray, share, pixel, strength)
        part, all_of = lens.dtype.type(0), lens.dtype.type(0)
        for j in range(n):
            all_of += strength[j]
            part += strength[j] * strength[j]
        if edge:
            for j in range(n):
                rest = strength[j] - one
                share[0, j], share[1, j], share[2, j] = share[0, j] * rest, share[1, j] * rest, share[2, j] * rest
            value, found = value + 0.5 * part - all_of, found + all_of
        else:
            value += all_of
        gather(share, ex[i:end], ey[i:end], es[i:end], s_0, near)
        collect(near, s_0, to_H)
        i = end
    return value, chain(x, u, place, to_H, most), found


@compiled
def curvature(x, u, place, events, lens, frame, terms):
    """What the second derivative of -sum(T - T^2 / 2) is expected to be: [14, 14], core.match.curvature."""
    ex, ey, es, weight = events
    last, one, least = count(weight), lens.dtype.type(1), lens.dtype.type(LEAST)
    exact, dH = np.empty((terms, 3, 3)), derivatives(x, u, place, terms)
    placed(x, u, place, exact)
    H = exact.astype(lens.dtype)
    near, ray, share = np.empty((3, 3, 3), lens.dtype), np.empty((3, BLOCK), lens.dtype), np.empty((3, BLOCK), lens.dtype)
    pixel, strength = np.empty(BLOCK, np.int32), np.empty(BLOCK, lens.dtype)
    sums, Q, D, half, A = np.empty((6, 6)), np.empty((9, 9)), np.empty((SIZE, 9)), np.empty((SIZE, 9)), np.zeros((SIZE, SIZE))
    i, size = 0, BLOCK
    while i < last:
        end, s_0 = block_end(es, i, last, lens[8], size)
        n = end - i
        size = min(BLOCK, 2 * n)
        expand(H, s_0, near)
        meet(near, s_0, ex[i:end], ey[i:end], es[i:end], weight[i:end], lens, frame, ray, share, pixel, strength)
        for j in range(n):
            strength[j] = one / (strength[j] + least)
        crossed(share, strength, ex[i:end], ey[i:end], sums)
        spread_out(sums, Q)
        at_time(dH, float(s_0), D)
        add_curvature(D, Q, half, A)
        i = end
    for p in range(SIZE):
        for q in range(p):
            A[q, p] = A[p, q]
    return A


@compiled
def gram(x, u, place, some, terms, ridge):
    """Squared length of a step in px of the events' flow on the texture: [14, 14], as core.objective.metric."""
    ex, ey, es, weight = some
    H, dH = np.empty((terms, 3, 3)), derivatives(x, u, place, terms)
    placed(x, u, place, H)
    D, J, G = np.empty((SIZE, 9)), np.empty((2, SIZE)), np.zeros((SIZE, SIZE))
    for i in range(len(ex)):
        at_time(dH, float(es[i]), D)
        r = np.array([float(ex[i]), float(ey[i]), 1.0])
        ray = np.zeros(3)
        for k in range(terms - 1, -1, -1):
            for a in range(3):
                ray[a] = ray[a] * es[i] + H[k, a, 0] * r[0] + H[k, a, 1] * r[1] + H[k, a, 2]
        depth = max(ray[2], 1e-3)
        for p in range(SIZE):
            away = D[p, 6] * r[0] + D[p, 7] * r[1] + D[p, 8]
            for a in range(2):
                moved = D[p, 3 * a] * r[0] + D[p, 3 * a + 1] * r[1] + D[p, 3 * a + 2]
                J[a, p] = place.focal * (moved - ray[a] / depth * away) / depth * (weight[i] != 0)
        for p in range(SIZE):
            for q in range(SIZE):
                G[p, q] += (J[0, p] * J[0, q] + J[1, p] * J[1, q]) / len(ex)
    mean = max(np.trace(G) / SIZE, np.finfo(ex.dtype).eps)
    for p in range(SIZE):
        G[p, p] += ridge * mean
    return G


@compiled
def times(A, x):
    """A x, for a matrix and a vector."""
    result = np.zeros(len(A))
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            result[i] += A[i, j] * x[j]
    return result


@compiled
def within(basis, A):
    """B^T A B: of a quadratic form, what remains for the numbers that are free."""
    half, result = np.zeros(basis.shape), np.zeros((basis.shape[1], basis.shape[1]))
    for p in range(basis.shape[1]):
        half[:, p] = times(A, basis[:, p])
        for q in range(p + 1):
            result[p, q] = result[q, p] = (basis[:, q] * half[:, p]).sum()
    return result


@compiled
def scaled_inverse(A):
    """Inverse of a positive definite matrix whose numbers differ in size."""
    size = np.empty(len(A))
    for p in range(len(A)):
        size[p] = np.sqrt(max(A[p, p], 1e-300))
    inverse = inverted(A / np.outer(size, size))
    return inverse / np.outer(size, size)


@compiled
def cost_at(x, u, place, prior, weight, events, ghosts, lens, frames, terms, most):
    """weight * (-sum(T - T^2 / 2) + sum F) + x prior x / 2, its derivative, and sum T."""
    value, slope, found = value_and_slope(x, u, place, events, lens, frames[0], terms, most, True)
    more, push, _ = value_and_slope(x, u, place, ghosts, lens, frames[1], terms, most, False)
    value, slope = value + more, slope + push
    bent = times(prior, x)
    return weight * value + 0.5 * (x * bent).sum(), weight * slope + bent, found


@compiled
def match(q, basis, place, prior, events, ghosts, some, lens, frames, stop, weight, terms, ridge):
    """BFGS from x = basis q, [14] px, with the events' own curvature as the first: core.match.match.

    basis [14, M] | prior [14, 14]: information about x around 0
    -> x, cost, its slope to x, information of the events where they began, sum T, evaluations, converged
    """
    u, eps, most = units(place), np.finfo(lens.dtype).eps, SIZE
    while most > 0 and not np.any(basis[most - 1]):
        most -= 1
    G = within(basis, gram(times(basis, q), u, place, some, terms, ridge))
    A = curvature(times(basis, q), u, place, events, lens, frames[0], terms)
    plain = scaled_inverse(within(basis, weight * A + prior))
    inverse = plain.copy()
    value, slope, found = cost_at(times(basis, q), u, place, prior, weight, events, ghosts, lens, frames, terms, most)
    gradient = times(basis.T, slope)
    iterations, trials, evaluations, converged, fresh = 0, 0, 1, False, True
    step, limit, length = aimed(inverse, gradient, G, True, stop)
    low, high = 0.0, np.inf
    while not converged and iterations < stop.iterations and trials < stop.trials:
        near = q + length * step
        value_new, slope_new, found_new = cost_at(times(basis, near), u, place, prior, weight, events, ghosts, lens, frames, terms, most)
        evaluations += 1
        gradient_new, down = times(basis.T, slope_new), (gradient * step).sum()
        too_long = not value_new <= value + stop.armijo * length * down + 4 * eps * abs(value)
        if too_long or ((gradient_new * step).sum() < stop.wolfe * down and length < limit):
            guess = -down * length * length / (2 * (value_new - value - down * length))
            low, high, trials = (low, length, trials + 1) if too_long else (length, high, trials + 1)
            length = narrowed(length, low, high, limit, guess)
            if high * length_in(step, G) < stop.tolerance:
                converged = fresh
                if not fresh:  # perhaps the curvature was wrong: once more with the first
                    inverse, fresh, trials, low, high = plain.copy(), True, 0, 0.0, np.inf
                    step, limit, length = aimed(inverse, gradient, G, True, stop)
        else:
            fresh = not learn(inverse, near - q, gradient_new - gradient, False) and fresh
            q, value, gradient, found = near, value_new, gradient_new, found_new
            iterations, trials, low, high = iterations + 1, 0, 0.0, np.inf
            step, limit, length = aimed(inverse, gradient, G, True, stop)
            converged = length * length_in(step, G) < stop.tolerance
            if converged:  # the last step is as good as sure, and not evaluated
                q = q + length * step
    x = times(basis, q)
    value, slope, found = cost_at(x, u, place, prior, weight, events, ghosts, lens, frames, terms, SIZE)
    return x, value, slope, weight * A, found, evaluations, converged
