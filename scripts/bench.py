"""Benchmark tables: scripts/run python scripts/bench.py [--recording REC] [--device cpu] [--json FILE]

(a) one evaluation, ns per event; (b) a cold window per motion model; (c) a whole recording. Ratios within one run are to be
trusted, absolute times depend on the machine and on who else works on it.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from torchcmax import __version__
from torchcmax.compensate import Compensation, compensate
from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import CONTRASTS, blur, normalized
from torchcmax.core.draw import Ink, draw, draw_twin
from torchcmax.core.estimate import estimate
from torchcmax.core.model import MODELS, Model, Planar
from torchcmax.core.window import Window
from torchcmax.io import Recording, open
from torchcmax.report import writing
from torchcmax.simulator import Simulation, simulate

Table = list[dict[str, object]]


def best(run: Callable[[], object], device: str, repeats: int = 5) -> tuple[float, float]:
    """Wall and CPU seconds of the fastest of some runs, after one that is not counted."""

    def once() -> tuple[float, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        run()
        if device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter() - wall, time.process_time() - cpu

    once()
    return min(once() for _ in range(repeats))


def evaluations(window: Window, model: Model, canvas: Canvas, device: str) -> Table:
    """(a) Value and gradient of the eight-parameter warp, variance with and without blur: the fast path and its readable twin."""

    def value_and_gradient(how: Callable[..., torch.Tensor], ink: Ink, sigma: float) -> None:
        owner = torch.arange(len(ink.weight), device=device)
        x = torch.ones(len(owner), model.size, device=device, requires_grad=True)
        image = normalized(how(model.homography(x, owner, 0.5), ink, canvas, owner), ink.weight)
        torch.autograd.grad(CONTRASTS["variance"](blur(image, sigma)).sum(), x)

    rows: Table = []
    for batch in (1, len(window)):
        part = window[:batch]
        ink, events = Ink.of(part, part.weight), part.weight.numel()
        for name, how in (("grid_sample adjoint", draw), ("scatter_add twin", draw_twin)):
            for sigma in (0.0, 1.0):
                wall, _ = best(partial(value_and_gradient, how, ink, sigma), device)
                rows.append(
                    {"vote": name, "windows": batch, "events": events, "blur px": sigma, "ns per event": round(wall / events * 1e9, 1)}
                )
    return rows


def cold_windows(recording: Recording, window: Window, device: str) -> Table:
    """(b) One window of 30,000 events from a cold start, to convergence."""
    rows: Table = []
    for name, kind in MODELS.items():
        model = kind(recording.camera.fx)
        wall, cpu = best(partial(estimate, window[:1], recording.camera, model), device)
        found = estimate(window[:1], recording.camera, model)
        rows.append(
            {
                "model": name,
                "wall ms": round(wall * 1e3, 1),
                "CPU ms": round(cpu * 1e3, 1),
                "evaluations": int(found.evaluations[0]),
                "gain": round(found.gain[0].item(), 4),
                "converged": bool(found.converged[0]),
            }
        )
    return rows


def whole_recording(recording: Recording, device: str) -> Table:
    """(c) All windows of a recording, and how much of the time is reading."""
    rows: Table = []
    began = time.perf_counter()
    events = sum(window.weight.numel() for window in recording.windows(30000, batch=16))
    reading = time.perf_counter() - began
    for name in MODELS:
        began = time.perf_counter()
        options = Compensation(model=name, device=device)  # type: ignore[arg-type]
        windows = sum(len(window) for window, _ in compensate(recording, options))
        wall = time.perf_counter() - began
        rows.append(
            {"model": name, "windows": windows, "Mev/s": round(events / wall * 1e-6, 3), "reading, share": round(reading / wall, 3)}
        )
    return rows


def machine(device: str) -> dict[str, object]:
    """What the numbers belong to."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        cpu = next((line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")), cpu)
    name = cpu if device == "cpu" else torch.cuda.get_device_name(device)
    versions = {"torchcmax": __version__, "torch": torch.__version__, "python": platform.python_version()}
    return {
        "device": name,
        "threads": torch.get_num_threads(),
        **versions,
        "commit": commit or "unknown",
        "date": time.strftime("%Y-%m-%d"),
    }


def printed(title: str, rows: Table) -> None:
    """A table in Markdown."""
    print(f"\n### {title}\n")
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(str(value) for value in row.values()) + " |")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", help="default: half a second of the built-in poster")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1, help="of torch on the CPU")
    parser.add_argument("--windows", type=int, default=10, help="windows in the large batch")
    parser.add_argument("--json", type=Path, help="write the tables to this file too")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    recording = open(options.recording) if options.recording else simulate(Simulation(duration=0.5))
    window = next(recording.windows(30000, batch=options.windows)).to(options.device, torch.float32)
    about = machine(options.device)
    tables = {
        "One evaluation: value and gradient, 8 parameters": evaluations(
            window, Planar(recording.camera.fx), Canvas.around(recording.camera), options.device
        ),
        "A cold window of 30,000 events": cold_windows(recording, window, options.device),
        f"The whole of {recording.name}": whole_recording(recording, options.device),
    }
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    for title, rows in tables.items():
        printed(title, rows)
    if options.json:
        with writing(options.json) as name:
            name.write_text(json.dumps({"machine": about, "tables": tables}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
