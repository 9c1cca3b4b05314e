"""The charts of one result: trajectory, errors, contrast and rate of events, motion, all over time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchcmax.chart import Axes, Line, Span, chart
from torchcmax.resultfiles import Poses, Result

SHADED = ("lost", "weak", "still", "start")
AXES = ("x", "y", "z")
TRUTH = ("", "", "truth (pale)")  # told once in a legend


def _clock(result: Result) -> tuple[float, str]:
    """What is subtracted from all times, s, and the name of the axis: a clock that began long before is made readable."""
    start = result.numbers["start_us"]
    first = float(start[0]) * 1e-6 if len(start) and math.isfinite(start[0]) else 0.0
    return (first, f"time, s since {first:.6f}") if abs(first) > 1e4 else (0.0, "time, s")


def _within(result: Result) -> tuple[float, float] | None:
    """From the first window to the last one, for all axes of time."""
    zero, _ = _clock(result)
    begins, ends = (part[np.isfinite(part)] for part in (result.numbers["start_us"], result.numbers["end_us"]))
    return (float(begins.min()) * 1e-6 - zero, float(ends.max()) * 1e-6 - zero) if len(begins) and len(ends) else None


def _spans(result: Result) -> list[Span]:
    """Stretches of windows with one status that is not simply well."""
    zero, _ = _clock(result)
    spans: list[Span] = []
    start, end = (result.numbers[name] * 1e-6 - zero for name in ("start_us", "end_us"))
    last = ""
    for status, a, b in zip(result.texts.get("status", []), start.tolist(), end.tolist(), strict=False):
        if status in SHADED and math.isfinite(a) and math.isfinite(b):
            begin = spans.pop().begin if status == last else a
            spans.append(Span(begin, b, status))
        last = status
    return spans


def _time_chart(result: Result, title: str, y: str, lines: Sequence[Line], height: float = 230.0) -> str:
    axes = Axes(title, _clock(result)[1], y, (1000.0, height), within=_within(result))
    return f"<figure>{chart(axes, lines, _spans(result))}</figure>"


def _with_gaps(result: Result, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Times [M] s and which pose [M] belongs to each; -1 where the camera was lost, or nothing is known for long, so that a line breaks."""
    zero, _ = _clock(result)
    time = poses.time - zero
    if len(time) < 2:
        return time, np.arange(len(time))
    lost = np.array([status == "lost" for status in result.texts.get("status", [])], bool)
    middle = (result.numbers["start_us"] + result.numbers["end_us"])[: len(lost)][lost] * 5e-7 - zero
    between = np.diff(np.searchsorted(np.sort(middle), time)) > 0
    step = np.diff(time)
    cut = np.flatnonzero(between | (step > max(0.1, 5 * float(np.median(step)))))
    return np.insert(time, cut + 1, (time[cut] + time[cut + 1]) / 2), np.insert(np.arange(len(time)), cut + 1, -1)


def _picked(values: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Rows of values [N, ...]; nan for -1."""
    found: np.ndarray = np.where((which >= 0).reshape(-1, *[1] * (values.ndim - 1)), values[which], np.nan)
    return found


def angles(rotation: np.ndarray) -> np.ndarray:
    """Yaw, pitch and roll [N, 3] degrees of R_wc [N, 3, 3] = R_y(yaw) R_x(pitch) R_z(roll), without jumps of a whole turn."""
    yaw = np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])
    pitch = -np.arcsin(np.clip(rotation[:, 1, 2], -1, 1))
    roll = np.arctan2(rotation[:, 1, 0], rotation[:, 1, 1])
    found: np.ndarray = np.rad2deg(np.stack([np.unwrap(part) for part in (yaw, pitch, roll)], -1))
    return found


def trajectory(result: Result) -> str:
    """Positions and angles over time, and the path from above and from the front."""
    if result.trajectory is None or not len(result.trajectory.time):
        return ""
    poses, truth = result.trajectory, result.truth
    time, which = _with_gaps(result, poses)
    turned, position = _picked(angles(poses.rotation), which), _picked(poses.position, which)
    spoken = ("yaw (about y)", "pitch (about x)", "roll (about z)")
    moves = [Line(name, time, position[:, k], k) for k, name in enumerate(AXES)]
    turns = [Line(name, time, turned[:, k], k) for k, name in enumerate(spoken)]
    views = {pair: [Line("estimate", position[:, pair[0]], position[:, pair[1]], 0)] for pair in ((0, 2), (0, 1))}
    if truth is not None and len(truth.time):
        true_time, true_which = _with_gaps(result, truth)
        there, own = _picked(truth.position, true_which), angles(truth.rotation)
        near = np.stack([np.interp(truth.time, poses.time, angles(poses.rotation)[:, k]) for k in range(3)], -1)
        own = _picked(near + (own - near + 180) % 360 - 180, true_which)
        moves += [Line(TRUTH[k], true_time, there[:, k], k, truth=True) for k in range(3)]
        turns += [Line(TRUTH[k], true_time, own[:, k], k, truth=True) for k in range(3)]
        for (a, b), lines in views.items():
            lines.append(Line("truth", there[:, a], there[:, b], 3, truth=True))
    parts = []
    if result.task != "panorama":
        parts.append(_time_chart(result, "Position", result.unit, moves))
    parts.append(_time_chart(result, "Orientation", "degrees", turns))
    if result.task != "panorama":
        names = {(0, 2): "Top view, x–z", (0, 1): "Front view, x–y"}
        drawn = (
            chart(Axes(names[a, b], f"{AXES[a]}, {result.unit}", f"{AXES[b]}, {result.unit}", (490.0, 400.0), True, False), lines)
            for (a, b), lines in views.items()
        )
        parts.append('<div class="pair">' + "".join(f"<figure>{one}</figure>" for one in drawn) + "</div>")
    return "\n".join(parts)


def errors(result: Result) -> str:
    """How far position and orientation are from truth, at the times that both have."""
    if result.trajectory is None or result.truth is None:
        return ""
    poses, truth = result.trajectory, result.truth
    _, i, j = np.intersect1d(np.round(poses.time * 1e6), np.round(truth.time * 1e6), return_indices=True)
    if not len(i):
        return ""
    same = Poses(poses.time[i], poses.position[i], poses.rotation[i])
    time, which = _with_gaps(result, same)
    far = np.linalg.norm(same.position - truth.position[j], axis=1)
    trace = np.einsum("nij,nij->n", same.rotation, truth.rotation[j])
    chord = np.linalg.norm(same.rotation - truth.rotation[j], axis=(1, 2))
    turn = np.rad2deg(np.where(trace > 0, 2 * np.arcsin(np.clip(chord / math.sqrt(8), 0, 1)), np.arccos(np.clip((trace - 1) / 2, -1, 1))))
    parts = [_time_chart(result, "Error of orientation", "degrees", [Line("orientation", time, _picked(turn, which), 0)], 180)]
    if result.task != "panorama":
        parts.insert(0, _time_chart(result, "Error of position", result.unit, [Line("position", time, _picked(far, which), 1)], 180))
    return "\n".join(parts)


def quality(result: Result) -> str:
    """Contrast as a gain over no motion, and the rate of events."""
    start, end = result.numbers["start_us"], result.numbers["end_us"]
    if not len(start):
        return ""
    zero, _ = _clock(result)
    time = (start + end) * 5e-7 - zero
    rate = result.numbers["events"] / np.where(end > start, end - start, np.nan)
    gain = Line("gain", time, result.numbers["gain"], 0)
    return "\n".join(
        (
            _time_chart(result, "Gain of contrast over no motion", "gain", [gain], 190),
            _time_chart(result, "Events", "Mevents/s", [Line("events", time, rate, 1)], 190),
        )
    )


def motion(result: Result) -> str:
    """Angular velocity and velocity, window by window."""
    start, end = result.numbers["start_us"], result.numbers["end_us"]
    zero, _ = _clock(result)
    time = (start + end) * 5e-7 - zero
    lost = np.array([status == "lost" for status in result.texts.get("status", [""] * len(time))], bool)
    parts = []
    for stem, title, unit, factor in (
        ("omega", "Angular velocity", "degrees/s", 180 / math.pi), ("v", "Velocity", "plane distances/s", 1.0),
    ):  # fmt: skip
        columns = [result.numbers.get(f"{stem}_{axis}", np.full(len(time), np.nan)) for axis in AXES]
        if any(np.isfinite(column).any() and np.nanmax(np.abs(column)) > 0 for column in columns if len(column)):
            lines = [Line(axis, time, np.where(lost, np.nan, columns[k] * factor), k) for k, axis in enumerate(AXES)]
            parts.append(_time_chart(result, title, unit, lines))
    return "\n".join(parts)
