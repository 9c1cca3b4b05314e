"""Pictures of plans and runs: what was planned against what was measured, and the motor in its operating range."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchcmax.rig.axis import RPM, to_motor
from torchcmax.rig.checks import EXACT, voltage_needed
from torchcmax.rig.config import Axis, Rig
from torchcmax.rig.demand import Samples
from torchcmax.rig.motors import available_speed, continuous_torque, no_load_current
from torchcmax.rig.record import Encoder
from torchcmax.rig.thermal import TwoBody

PLANNED, MEASURED, LIMIT, GOOD, SHORT = "#888888", "#1764ab", "#c0392b", "#cfe5c9", "#f6efd9"
POINTS = 4000  # of a line: more are not seen


def motion(rig: Rig, planned: Samples | None, encoder: Encoder | None, cycles: Sequence[tuple[int, int]] = ()) -> bytes:
    """Position, velocity, current and winding's temperature of every axis over time, planned and measured: -> PNG.

    The measured temperature is that of the two-body model fed with the measured current.  cycles: first and last sample of each that was
    measured; the plan is drawn in all of them, its temperature, which is that of the last one, in that alone.
    """
    figure = Figure(figsize=(6 * len(rig.axes), 8), layout="constrained")
    panels = figure.subplots(4, len(rig.axes), sharex=True, squeeze=False)
    for k, axis in enumerate(rig.axes):
        metre = axis.kind == "linear"
        scale = 1.0 if metre else 180 / np.pi
        unit = "m" if metre else "deg"
        begins = [0.0] if encoder is None or not cycles else [float(encoder.time[first]) for first, _ in cycles]
        curves = [*_planned(planned, k, scale, begins), *_measured(rig, encoder, k, scale)]
        limits = (None, scale * axis.limits.v, axis.current_peak, axis.motor.winding_max)
        names = (f"position, {unit}", f"velocity, {unit}/s", "current, A", "winding, °C")
        for row, (name, limit) in enumerate(zip(names, limits, strict=True)):
            panel = panels[row, k]
            for label, time, *values in curves:
                colour, width = (MEASURED, 1.0) if label == "measured" else (PLANNED, 2.5)
                panel.plot(*_thinned(time, values[row]), color=colour, label=label, lw=width)
            panel.set_ylabel(name)
            panel.grid(alpha=0.3)
            if limit is not None:
                _limit(panel, limit, both=row in (1, 2))
        panels[0, k].set_title(f"axis {axis.name}")
        panels[0, k].legend(loc="best")
        panels[3, k].set_xlabel("time of the drives' clock, s")
    return _png(figure)


Curve = tuple[str, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # label, time, position, velocity, current, temperature


def _planned(planned: Samples | None, k: int, scale: float, begins: list[float]) -> list[Curve]:
    if planned is None:
        return []
    x, v, warm = scale * planned.x[:, k], scale * planned.v[:, k], planned.temperature[:, k]
    unknown = np.full_like(warm, np.nan)
    return [
        ("" if n else "planned", planned.time + begin, x, v, planned.current[:, k], warm if n == len(begins) - 1 else unknown)
        for n, begin in enumerate(begins)
    ]


def _measured(rig: Rig, encoder: Encoder | None, k: int, scale: float) -> list[Curve]:
    if encoder is None:
        return []
    axis, step = rig.axes[k], float(np.diff(encoder.time).mean())
    warm = TwoBody(axis.motor, rig.ambient).run(encoder.current[:, k], to_motor(axis, encoder.velocity[:, k]), step)[0]
    return [("measured", encoder.time, scale * encoder.place[:, k], scale * encoder.velocity[:, k], encoder.current[:, k], warm)]


def _thinned(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    step = -(-len(time) // POINTS)
    return time[::step], values[::step]


def _limit(panel: Any, limit: float, both: bool) -> None:
    """A line at a limit, unless the picture would then show little else."""
    low, high = panel.get_ylim()
    if limit <= max(4 * max(abs(low), abs(high)), 1e-9):
        for value in (limit, -limit) if both else (limit,):
            panel.axhline(value, color=LIMIT, lw=0.8, ls="--")


def operating_range(rig: Rig, k: int, samples: Samples) -> bytes:
    """Torque and speed of an axis' motor in a plan, in the range that it can have: -> PNG.

    Continuous: for ever, as warm as it may become and not above the printed torque.  Short: up to the peak current.  Both end where the
    supply drives no more through a winding as hot as it may become.  Red: what the plan's checks refuse.
    """
    axis = rig.axes[k]
    motor, hot, volts, fastest = axis.motor, axis.motor.winding_max, rig.modulation * rig.supply, _fastest(axis)
    turns, pull = _path(axis, samples, k)
    peak = motor.torque_constant * axis.current_peak
    most = 1.15 * max(peak, abs(pull).max(), motor.nominal_torque)
    torque, speed = np.linspace(-most, most, 800), np.linspace(0, fastest, 400)
    available = available_speed(motor, torque, volts, hot)
    driven = np.interp(speed, available[::-1], torque[::-1])
    lasting, lost = continuous_torque(motor, speed, rig.ambient), motor.torque_constant * no_load_current(motor, speed)
    figure = Figure(figsize=(8.5, 5.5), layout="constrained")
    panel = figure.subplots()
    for colour, name, least, highest in ((SHORT, "short", -peak - lost, peak - lost), (GOOD, "continuous", -lasting, lasting)):
        panel.fill_betweenx(speed / RPM, least * 1e3, np.minimum(highest, driven).clip(least) * 1e3, color=colour, lw=0, label=name)
    panel.plot(torque * 1e3, available_speed(motor, torque, motor.voltage) / RPM, color=PLANNED, ls=":",
               label=f"nominal, {motor.voltage:g} V, 25 °C")  # fmt: skip
    panel.plot(torque * 1e3, available / RPM, color="black", label=f"available, {volts:.3g} V, {hot:.0f} °C")
    panel.plot(np.stack([-peak - lost, peak - lost], 1) * 1e3, speed / RPM, color=LIMIT, ls="--", lw=1,
               label=[f"peak current, {axis.current_peak:g} A", None])  # fmt: skip
    panel.axhline(fastest / RPM, color=LIMIT, ls="-.", lw=1, label="fastest of motor and transmission")
    panel.scatter(pull * 1e3, turns / RPM, color=MEASURED, s=6, zorder=3, label="plan")
    refused = outside(rig, k, samples)
    panel.scatter(pull[refused] * 1e3, turns[refused] / RPM, color=LIMIT, s=16, marker="x", zorder=4)
    top = 1.1 * max(fastest, turns.max()) / RPM
    panel.set(xlabel="torque, mNm; negative: it brakes", ylabel="speed, rpm", xlim=(-most * 1e3, most * 1e3), ylim=(0, top))
    panel.set_title(f"axis {axis.name}: {motor.family} {motor.part}" + (f", {refused.sum()} samples outside" if refused.any() else ""))
    figure.legend(loc="outside lower center", ncols=4, fontsize=8)
    return _png(figure)


def outside(rig: Rig, k: int, samples: Samples) -> np.ndarray:
    """Which samples [K] want more current, voltage, or speed than there is, as the plan's checks have it."""
    axis = rig.axes[k]
    speed, amperes = to_motor(axis, samples.v[:, k]), samples.current[:, k]
    volts = voltage_needed(rig, axis, speed, amperes, samples.temperature[:, k].max())
    wanted = np.abs([amperes, volts, speed])
    there_is = np.array([axis.current_peak, rig.modulation * rig.supply, _fastest(axis)])[:, None]
    return np.asarray((wanted > there_is * (1 + EXACT)).any(0))


def _fastest(axis: Axis) -> float:
    return min(axis.motor.max_speed, axis.transmission.max_input_speed)


def _path(axis: Axis, samples: Samples, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Speed rad/s of the motor in the plan, whichever way it turns, and torque Nm: negative where it brakes."""
    speed, torque = to_motor(axis, samples.v[:, k]), samples.torque[:, k]
    return abs(speed), np.where(speed == 0, abs(torque), torque * np.sign(speed))


def repeats(rig: Rig, encoder: Encoder, cycles: list[tuple[int, int]]) -> bytes:
    """How far each cycle, first and last sample, of a run lay from the mean of all, over the time in the cycle: -> PNG."""
    length = min(last - first for first, last in cycles) + 1
    figure = Figure(figsize=(6 * len(rig.axes), 3.5), layout="constrained")
    panels = figure.subplots(1, len(rig.axes), squeeze=False)[0]
    for k, axis in enumerate(rig.axes):
        scale, unit = (1e6, "µm") if axis.kind == "linear" else (180e3 / np.pi, "mdeg")
        places = scale * np.stack([encoder.place[first : first + length, k] for first, _ in cycles])
        for number, off in enumerate(places - places.mean(0), 1):
            panels[k].plot(*_thinned(encoder.time[:length] - encoder.time[0], off), lw=0.8, label=f"{number}")
        spread = places.std(0, ddof=1).max() if len(places) > 1 else 0.0
        panels[k].set(
            xlabel="time in the cycle, s",
            ylabel=f"from the mean, {unit}",
            title=f"axis {axis.name}: standard deviation up to {spread:.3g} {unit}",
        )
        panels[k].grid(alpha=0.3)
        if len(cycles) <= 10:
            panels[k].legend(title="cycle", fontsize=8)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    packed = io.BytesIO()
    figure.savefig(packed, format="png", dpi=110, metadata={"Software": None})
    return packed.getvalue()
