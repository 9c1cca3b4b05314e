"""The CPU's kernels as functions of tensors: drawing, contrast and the search, spread over threads."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcmax import kernels
from torchcmax.kernels import events, image
from torchcmax.kernels import match as matching
from torchcmax.kernels import place as placing
from torchcmax.kernels import search as searching
from torchcmax.kernels.compiling import forget_stale
from torchcmax.kernels.image import CONTRASTS
from torchcmax.kernels.motion import Look, chained, homography_at, lean, strain

if events.draw.stats.cache_path:
    forget_stale(Path(events.draw.stats.cache_path))
Array = np.ndarray[Any, np.dtype[Any]]
PART = 50_000  # events for which a second thread pays, where there is one window
_own = threading.local()
__all__ = ["CONTRASTS", "Look", "Problem", "evaluate", "search", "sharpness", "slopes", "votes"]


@dataclass(frozen=True)
class Problem:
    """What `search` minimizes: a view of W windows, known normals [W, 3], the look in numbers.

    terms: of the polynomial homography.
    """

    view: Any
    normal: Tensor
    look: Look
    terms: int

    @cached_property
    def scene(self) -> Callable[[int], searching.Scene]:
        """A window of the problem, with scratch that belongs to the thread that asks."""
        return _scenes(self.view, self.normal)


def _scenes(view: Any, normal: Tensor) -> Callable[[int], searching.Scene]:
    rows, some, known = _rows(view.ink), _rows(view.some), _array(normal.double())
    lens, taps = lens_of(view.canvas, view.ink.x), _taps(float(view.sigma), view.ink.x.dtype)
    return lambda window: searching.Scene(rows(window), some(window), known[window], lens, taps, *_scratch(view.canvas, taps))


def votes(H_k: Tensor, ink: Any, canvas: Any, owner: Tensor) -> Tensor:
    """Frames of warped events, before `canvas.folded`.

    H_k [A, K, 3, 3] | ink of W windows | owner [A] -> [A, H + 2, W + 2].  The sum of a window that several threads share
    depends on their number, and on nothing else.
    """
    H, rows, lens = _array(H_k.to(ink.x)), _rows(ink), lens_of(canvas, ink.x)
    parts = _parts(len(H), ink.x.shape[-1])
    frames = np.zeros((len(parts), len(H), (canvas.size[0] + 2) * (canvas.size[1] + 2)), lens.dtype)

    def work(a: int, window: int, i: int) -> None:
        events.draw(H[a], rows(window, parts[i]), lens, frames[i, a])

    _spread(work, [(a, window, i) for a, window in enumerate(owner.tolist()) for i in range(len(parts))])
    return torch.from_numpy(frames.sum(0) if len(parts) > 1 else frames[0]).view(len(H), canvas.size[0] + 2, canvas.size[1] + 2)


def slopes(H_k: Tensor, ink: Any, canvas: Any, owner: Tensor, gradient: Tensor) -> Tensor:
    """The derivative of `votes`: gradient = dL/dframe [A, H + 2, W + 2] -> dL/dH_k [A, K, 3, 3]."""
    H, rows, lens = _array(H_k.to(ink.x)), _rows(ink), lens_of(canvas, ink.x)
    parts = _parts(len(H), ink.x.shape[-1])
    shape = (len(H), canvas.size[0] + 2, canvas.size[1] + 2)
    if gradient.shape != shape:
        raise ValueError(f"slopes wants dL/dframe {[*shape]}, got {[*gradient.shape]}")
    frames, totals = _array(gradient.to(ink.x)).reshape(len(H), -1), np.zeros((len(parts), *H.shape))

    def work(a: int, window: int, i: int) -> None:
        events.draw_slopes(H[a], rows(window, parts[i]), lens, frames[a], totals[i, a])

    _spread(work, [(a, window, i) for a, window in enumerate(owner.tolist()) for i in range(len(parts))])
    return torch.from_numpy(totals.sum(0)).to(H_k)


def votes_sum(H_k: Tensor, ink: Any, canvas: Any) -> Tensor:
    """The frame of all windows together: H_k [W, K, 3, 3] | ink of W windows -> [1, H + 2, W + 2]; a part of the windows each thread."""
    H, rows, lens = _array(H_k.to(ink.x)), _rows(ink), lens_of(canvas, ink.x)
    shares = np.array_split(np.arange(len(H)), min(kernels.threads(), max(1, ink.x.numel() // PART)))
    frames = np.zeros((len(shares), (canvas.size[0] + 2) * (canvas.size[1] + 2)), lens.dtype)

    def work(i: int) -> None:
        for window in shares[i]:
            events.draw(H[window], rows(window), lens, frames[i])

    _spread(work, [(i,) for i in range(len(shares))])
    return torch.from_numpy(frames.sum(0) if len(shares) > 1 else frames[0]).view(1, canvas.size[0] + 2, canvas.size[1] + 2)


def slopes_sum(H_k: Tensor, ink: Any, canvas: Any, gradient: Tensor) -> Tensor:
    """The derivative of `votes_sum`: gradient = dL/dframe [1, H + 2, W + 2] -> dL/dH_k [W, K, 3, 3]."""
    H, rows, lens = _array(H_k.to(ink.x)), _rows(ink), lens_of(canvas, ink.x)
    frame, totals = _array(gradient.to(ink.x)).reshape(-1), np.zeros(H.shape)
    _spread(lambda window: events.draw_slopes(H[window], rows(window), lens, frame, totals[window]), [(i,) for i in range(len(H))])
    return torch.from_numpy(totals).to(H_k)


def vote_moved(xy: Tensor, motion: Tensor, s: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
    """`core.vote.vote_moved` without its derivative: xy, motion [B, N, 2] | s, weight [B, N] -> [B, H, W]."""
    points, edge = [_array(part) for part in (xy, motion, s, weight)], _edge(size, xy)
    frames = xy.new_zeros(len(xy), size[0] + 2, size[1] + 2)
    flat = frames.view(len(xy), -1).numpy()
    _spread(lambda i: events.vote(*(part[i] for part in points), edge, flat[i]), [(i,) for i in range(len(xy))])
    return frames[:, 1:-1, 1:-1].contiguous()


def vote_moved_slopes(
    xy: Tensor, motion: Tensor, s: Tensor, weight: Tensor, gradient: Tensor, wanted: tuple[bool, bool]
) -> tuple[Tensor | None, Tensor | None]:
    """The derivative of `vote_moved` to motion [B, N, 2] and weight [B, N], each where it is wanted: gradient = dL/dI [B, H, W]."""
    points, edge = [_array(part) for part in (xy, motion, s, weight)], _edge(gradient.shape[1:], xy)
    frames = _array(framed(gradient.to(xy))).reshape(len(xy), -1)
    count = xy.shape[1]
    to_motion, to_weight = xy.new_empty(len(xy), count * wanted[0], 2), xy.new_empty(len(xy), count * wanted[1])
    found = to_motion.numpy(), to_weight.numpy()

    def work(i: int) -> None:
        events.vote_slopes(*(part[i] for part in points), edge, frames[i], *(part[i] for part in found))

    _spread(work, [(i,) for i in range(len(xy))])
    return to_motion if wanted[0] else None, to_weight if wanted[1] else None


def _edge(size: Sequence[int], like: Tensor) -> Array:
    """Right, bottom and stride of the frame around an image."""
    return np.array([size[1] + 1, size[0] + 1, size[1] + 2], "f4" if like.dtype == torch.float32 else "f8")


def sharpness(H_k: Tensor, view: Any, owner: Tensor, contrast: str) -> Tensor:
    """Normalized contrast of the blurred image of warped events on a pinhole canvas: H_k [A, K, 3, 3] | owner [A] -> [A]."""
    H, code, scene_of = _array(H_k.to(view.ink.x)), image.CONTRASTS.index(contrast), _scenes(view, view.ink.x.new_zeros(len(view.ink.x), 3))
    values = np.zeros(len(H))

    def work(a: int, window: int) -> None:
        values[a] = searching.sharpness(H[a], code, scene_of(window))

    _spread(work, list(enumerate(owner.tolist())))
    return torch.from_numpy(values).to(H_k)


def evaluate(problem: Problem, x: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Value and gradient of `core.objective`: x [A, P] | owner [A] -> [A], [A, P].  Threads share a window where there are few."""
    places, scene_of = _array(x.double()), problem.scene
    parts = _parts(len(x), problem.view.ink.x.shape[-1])
    values, gradients = np.zeros(len(x)), np.zeros(places.shape)

    def work(row: int, window: int) -> None:
        values[row], gradients[row] = searching.evaluate(places[row], problem.look, scene_of(window), problem.terms)

    tasks = list(enumerate(owner.tolist()))
    if len(parts) == 1:
        _spread(work, tasks)
    else:
        for row, window in tasks:
            values[row], gradients[row] = _shared(problem, places[row], scene_of(window), parts)
    return torch.from_numpy(values).to(problem.view.ink.x), torch.from_numpy(gradients).to(x)


def _shared(problem: Problem, x: Array, scene: searching.Scene, parts: list[slice]) -> tuple[float, Array]:
    """`searching.evaluate` of one window by several threads, each with a frame of its own for its part of the events."""
    look, frames = problem.look, _more_frames(len(parts), scene.frames[0])
    exact, there = homography_at(x, look, scene.normal, problem.terms)
    H, totals = exact.astype(scene.lens.dtype), np.zeros((len(parts), *exact.shape))
    pieces = [tuple(array[part] for array in scene.events) for part in parts]
    reached: list[tuple[int, int]] = [(0, 0)] * len(parts)

    def draw(i: int) -> None:
        reached[i] = events.draw(H, pieces[i], scene.lens, frames[i])

    _spread(draw, [(i,) for i in range(len(parts))])
    band = min(first for first, _ in reached), max(last for _, last in reached)
    frames.sum(0, out=scene.frames[0].reshape(-1))
    sharp = searching.develop(look.contrast, scene.kernel, scene.frames, scene.line, band)
    searching.develop_slope(scene.kernel, scene.frames, scene.line, band)
    flat = scene.frames[0].reshape(-1)
    _spread(lambda i: events.draw_slopes(H, pieces[i], scene.lens, flat, totals[i]), [(i,) for i in range(len(parts))])
    cost = strain(there, exact, look, scene.some) + lean(there, look)
    energy = searching.energy_of(scene.events[3], look.contrast, scene.frames)
    with np.errstate(divide="ignore", invalid="ignore"):  # an empty image has no contrast
        value, to_H = cost - np.log(sharp / energy), totals.sum(0) / -sharp
    return value, chained(x, to_H, look, scene.normal, scene.some)


def search(problem: Problem, x: Tensor, owner: Tensor, stop: Any) -> list[Tensor]:
    """`core.minimize` of `core.objective`, each row in machine code: x [B, P] | owner [B] -> the fields of a Minimum."""
    start, scene_of = _array(x.double()), problem.scene
    limits = _limits(stop)
    found: list[Any] = [None] * len(x)

    def work(row: int, window: int) -> None:
        found[row] = searching.search(start[row], problem.look, scene_of(window), limits, problem.terms)

    _spread(work, list(enumerate(owner.tolist())))
    *numbers, traces = zip(*found, strict=True)
    trace = np.full((len(x), max(len(t) for t in traces)), np.nan)
    for row, values in enumerate(traces):
        trace[row, : len(values)] = values
    place, value, iterations, evaluations, converged = (torch.from_numpy(np.array(n)) for n in numbers)
    return [place.to(x), value.to(x), iterations, evaluations, converged, torch.from_numpy(trace).to(x)]


def smooth(x: Tensor, sigma: float) -> Tensor:
    """`core.contrast.blur`: image [B, H, W] | sigma px -> [B, H, W]."""
    taps = _taps(float(sigma), x.dtype)
    height, width = x.shape[1:]
    frames, result = _array(framed(x)), np.zeros((len(x), height + 2, width + 2), taps.dtype)

    def work(i: int) -> None:
        image.blur(frames[i], taps, np.zeros(width + 2 * len(taps), taps.dtype), result[i], (0, height + 2))

    _spread(work, [(i,) for i in range(len(x))])
    return torch.from_numpy(result[:, 1:-1, 1:-1]).contiguous()


def framed(x: Tensor) -> Tensor:
    """Images with a border of nothing: [B, H, W] -> [B, H + 2, W + 2]."""
    return torch.nn.functional.pad(x, (1, 1, 1, 1))


def _limits(stop: Any) -> searching.Stop:
    """In numbers of one kind each: numba compiles anew for others."""
    lengths = (float(n) for n in (stop.longest, stop.armijo, stop.wolfe))
    return searching.Stop(float(stop.tolerance), int(stop.iterations), int(stop.trials), *lengths)


def lens_of(canvas: Any, like: Tensor) -> Array:
    """How rays meet the frame, in the numbers that kernels/events.py wants."""
    (height, width), (x, y) = canvas.size, canvas.centre
    if kernels.frame(canvas) >= kernels.MOST[like.dtype]:
        raise ValueError(
            f"a canvas of {height} x {width} px has more than {kernels.MOST[like.dtype]} pixels, the most that {like.dtype} can draw"
        )
    least = torch.finfo(like.dtype).tiny ** 0.5 if canvas.sphere else kernels.NEAREST
    kind = "f4" if like.dtype == torch.float32 else "f8"
    numbers = [canvas.focal, x + 1, y + 1, width + 1, height + 1, width + 2, least, canvas.sphere, events.SPAN[kind]]
    return np.array(numbers, kind)


def _array(x: Tensor) -> Array:
    return x.detach().contiguous().numpy()


def _rows(ink: Any) -> Callable[..., tuple[Array, ...]]:
    """x, y, s, weight of a window, or of a part of it."""
    arrays = tuple(_array(part) for part in (ink.x, ink.y, ink.s, ink.weight))
    return lambda window, part=slice(None): tuple(array[window, part] for array in arrays)


@lru_cache(maxsize=64)
def _taps(sigma: float, dtype: torch.dtype) -> Array:
    taps: Array = image.taps(sigma).astype("f4" if dtype == torch.float32 else "f8")
    return taps


def _scratch(canvas: Any, taps: Array) -> tuple[Array, Array]:
    """Frames and a line that belong to this thread: new memory would cost more than the work in it."""
    key = (canvas.size, len(taps), taps.dtype)
    if getattr(_own, "key", None) != key:
        height, width = canvas.size
        _own.scratch = np.zeros((3, height + 2, width + 2), taps.dtype), np.zeros(width + 2 * len(taps), taps.dtype)
        _own.key = key  # last, in case there was no memory
    scratch: tuple[Array, Array] = _own.scratch
    return scratch


def _more_frames(count: int, like: Array) -> Array:
    """Empty frames for the parts of a window, [count, pixels]; kept for the next time."""
    frames: Array | None = getattr(_own, "frames", None)
    if frames is None or frames.shape != (count, like.size) or frames.dtype != like.dtype:
        frames = _own.frames = np.empty((count, like.size), like.dtype)
    frames[:] = 0
    return frames


def _parts(rows: int, count: int) -> list[slice]:
    """A window is cut where there are fewer windows than threads."""
    pieces = 1 if rows >= kernels.threads() else max(1, min(kernels.threads() // max(rows, 1), count // PART))
    edges = [count * i // pieces for i in range(pieces + 1)]
    return [slice(*edge) for edge in pairwise(edges)]


def _spread(work: Callable[..., None], tasks: Sequence[tuple[int, ...]]) -> None:
    """Do every task, in the order in which threads become free; this thread is one of them."""
    waiting = iter(tasks)
    stopped: list[BaseException] = []

    def drain() -> None:
        for task in waiting:  # one thread after the other takes the next: an iterator is safe
            if not stopped:
                work(*task)

    others = [_pool(os.getpid(), kernels.threads()).submit(drain) for _ in range(min(kernels.threads(), len(tasks)) - 1)]
    try:
        drain()
    except BaseException as error:
        stopped.append(error)
        if isinstance(error, SystemError) and interrupted(error):
            raise KeyboardInterrupt from None
        raise
    finally:
        for other in others:
            other.result()


def interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is what an error comes from: within compiled code numba hides it behind others."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


@lru_cache(maxsize=1)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """One for each process, as threads do not outlive a fork."""
    return ThreadPoolExecutor(threads, "torchcmax")


def match(q: Tensor, task: Any, how: Any, ridge: float, closest: float, terms: int) -> list[Tensor]:
    """`core.match.descend`, each row in machine code: q [B, M] -> x [B, 14], cost, slope, information, sum T, evaluations, converged."""
    start, basis, prior = _array(q.double()), _array(task.basis.double()), _array(task.prior.double())
    rows, some, chart = _rows(task.ink), _rows(task.some), task.chart
    ghosts = _rows(task.ink if task.ghosts is None else task.ghosts)
    limits, weight = _limits(how.stop), float(how.weight * how.every)
    like = task.ink.x
    texture = _array(chart.frame.to(like)).reshape(len(chart.texture), -1)
    ground = texture if task.ground is None else _array(framed(task.ground.to(like))).reshape(len(texture), -1)
    lens = _flat_lens(chart.focal, tuple(chart.texture.shape[1:]), like.dtype)
    places, found = _places(task, closest), [None] * len(q)

    def work(row: int) -> None:
        both = texture[row % len(texture)], ground[row % len(texture)]
        chance = ghosts(row) if task.ghosts is not None else rows(row, slice(0))
        numbers = places(row), prior[row], rows(row), chance, some(row), lens, both, limits, weight, terms, ridge
        found[row] = matching.match(start[row], basis, *numbers)

    _spread(work, [(row,) for row in range(len(q))])
    return [torch.from_numpy(np.array(part)).to(q.dtype if i < 5 else None) for i, part in enumerate(zip(*found, strict=True))]


def _places(task: Any, closest: float) -> Callable[[int], placing.Place]:
    """Where the rows of a task are, in numbers."""
    state, plane, chart = task.predicted, task.plane, task.chart
    where = state.pose.R, state.pose.t, state.motion.omega, state.motion.velocity
    tensors = *where, plane.normal, plane.across(), plane.distance, chart.view, chart.corner
    R, t, omega, velocity, normal, across, distance, view, corner = (_array(part.double()) for part in tensors)
    seconds, focal = _array(task.seconds.double()), float(chart.focal)

    def place(i: int) -> placing.Place:
        known = normal[i], across[i], float(distance[i]), closest, view[i % len(view)], corner[i % len(view)]
        return placing.Place(R[i], t[i], omega[i], velocity[i], *known, float(seconds[i]), focal)

    return place


@lru_cache(maxsize=64)
def _flat_lens(focal: float, size: tuple[int, int], dtype: torch.dtype) -> Array:
    """The lens of a texture whose first pixel's middle is the centre."""
    kind = "f4" if dtype == torch.float32 else "f8"
    height, width = size
    return np.array([focal, 1, 1, width + 1, height + 1, width + 2, kernels.NEAREST, 0, events.SPAN[kind]], kind)
