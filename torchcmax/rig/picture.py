"""Pictures of plans and runs: what was planned against what was measured, and the motor in its operating range."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchcmax.rig.axis import RPM
from torchcmax.rig.config import Axis, Rig
from torchcmax.rig.demand import Samples
from torchcmax.rig.motors import available_speed, continuous_torque
from torchcmax.rig.record import Encoder
from torchcmax.rig.thermal import TwoBody

PLANNED, MEASURED, LIMIT, GOOD = "#888888", "#1764ab", "#c0392b", "#dbe9d8"
POINTS = 4000  # of a line: more are not seen


def motion(rig: Rig, planned: Samples | None, encoder: Encoder | None) -> bytes:
    """Position, velocity, current and winding's temperature of every axis over time, planned and measured: -> PNG.

    The measured temperature is that of the two-body model fed with the measured current.
    """
    figure = Figure(figsize=(6 * len(rig.axes), 8), layout="constrained")
    panels = figure.subplots(4, len(rig.axes), sharex=True, squeeze=False)
    for k, axis in enumerate(rig.axes):
        metre = axis.kind == "linear"
        scale = 1.0 if metre else 180 / np.pi
        unit = "m" if metre else "deg"
        lines = _planned(planned, k, scale), _measured(rig, encoder, k, scale)
        limits = (None, scale * axis.limits.v, axis.current_peak, axis.motor.winding_max)
        names = (f"position, {unit}", f"velocity, {unit}/s", "current, A", "winding, °C")
        for row, (name, limit) in enumerate(zip(names, limits, strict=True)):
            panel = panels[row, k]
            for values, colour, label, width in ((lines[0], PLANNED, "planned", 2.5), (lines[1], MEASURED, "measured", 1.0)):
                if values is not None:
                    panel.plot(*_thinned(values[0], values[row + 1]), color=colour, label=label, lw=width)
            panel.set_ylabel(name)
            panel.grid(alpha=0.3)
            if limit is not None:
                _limit(panel, limit, both=row in (1, 2))
        panels[0, k].set_title(f"axis {axis.name}")
        panels[0, k].legend(loc="best")
        panels[3, k].set_xlabel("time of the drives' clock, s")
    return _png(figure)


def _planned(planned: Samples | None, k: int, scale: float) -> tuple[np.ndarray, ...] | None:
    if planned is None:
        return None
    return planned.time, scale * planned.x[:, k], scale * planned.v[:, k], planned.current[:, k], planned.temperature[:, k]


def _measured(rig: Rig, encoder: Encoder | None, k: int, scale: float) -> tuple[np.ndarray, ...] | None:
    if encoder is None:
        return None
    axis, step = rig.axes[k], float(np.diff(encoder.time).mean())
    speed = encoder.velocity[:, k] * 2 * np.pi * axis.transmission.ratio / axis.transmission.travel
    warm = TwoBody(axis.motor, rig.ambient).run(encoder.current[:, k], speed, step)[0]
    return encoder.time, scale * encoder.place[:, k], scale * encoder.velocity[:, k], encoder.current[:, k], warm


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

    Continuous: for ever, as warm as it may become and not above the printed torque.  Available: what the supply drives through a hot
    winding.  Short: up to the peak current.  Parts of the path outside of these are red.
    """
    axis = rig.axes[k]
    motor, hot, volts = axis.motor, axis.motor.winding_max, rig.modulation * rig.supply
    peak = motor.torque_constant * axis.current_peak
    torque = np.linspace(0, 1.15 * max(peak, abs(samples.torque[:, k]).max(), motor.nominal_torque), 400)
    fastest = min(motor.max_speed, axis.transmission.max_input_speed)
    available = np.minimum(available_speed(motor, torque, volts, hot), fastest).clip(0)
    speed = np.linspace(0, fastest, 400)
    lasting = continuous_torque(motor, speed, rig.ambient)
    figure = Figure(figsize=(7.5, 5.5), layout="constrained")
    panel = figure.subplots()
    panel.fill_betweenx(speed / RPM, 0, lasting * 1e3, color=GOOD, label="continuous")
    panel.plot(torque * 1e3, np.minimum(available_speed(motor, torque, motor.voltage), fastest).clip(0) / RPM, color=PLANNED, ls=":",
               label=f"nominal, {motor.voltage:g} V, 25 °C")  # fmt: skip
    panel.plot(torque * 1e3, available / RPM, color="black", label=f"available, {volts:.3g} V, {hot:.0f} °C")
    panel.axvline(peak * 1e3, color=LIMIT, ls="--", lw=1, label=f"peak current, {axis.current_peak:g} A")
    panel.axhline(fastest / RPM, color=LIMIT, ls="-.", lw=1, label="fastest of motor and transmission")
    turns, pull = _path(axis, samples, k)
    outside = (pull > peak) | (turns > np.interp(pull, torque, available))
    path = panel.scatter(pull * 1e3, turns / RPM, c=samples.time, s=6, cmap="viridis", zorder=3, label="plan")
    panel.scatter(pull[outside] * 1e3, turns[outside] / RPM, color=LIMIT, s=16, marker="x", zorder=4)
    figure.colorbar(path, ax=panel, label="time, s")
    panel.set(xlabel="torque, mNm", ylabel="speed, rpm", xlim=(0, torque[-1] * 1e3), ylim=(0, 1.1 * fastest / RPM))
    panel.set_title(f"axis {axis.name}: {motor.family} {motor.part}" + (f", {outside.sum()} samples outside" if outside.any() else ""))
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return _png(figure)


def _path(axis: Axis, samples: Samples, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Speed rad/s and torque Nm of the motor in the plan, both of their sizes."""
    speed = abs(samples.v[:, k]) * 2 * np.pi * axis.transmission.ratio / axis.transmission.travel
    return speed, abs(samples.torque[:, k])


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
            xlabel="time in the cycle, s", ylabel=f"from the mean, {unit}", title=f"axis {axis.name}: spread up to {spread:.3g} {unit}"
        )
        panels[k].grid(alpha=0.3)
        if len(cycles) <= 10:
            panels[k].legend(title="cycle", fontsize=8)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    packed = io.BytesIO()
    figure.savefig(packed, format="png", dpi=110, metadata={"Software": None})
    return packed.getvalue()
