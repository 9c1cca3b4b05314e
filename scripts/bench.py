"""Benchmark tables: scripts/run python scripts/bench.py [--recording REC] [--device cpu] [--json FILE]

(a) one evaluation, ns per event, for each backend; (b) a cold window per motion model; (c) whole recordings; (d) a step of the
flow's loss, reading files, windows from a DataLoader, and the rig's simulated drives; (e) memory; (f) what the device can do at best,
measured in the same run.  Ratios within one run are to be trusted; absolute times depend on the machine and on who else works on it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from torchcmax import __version__, kernels
from torchcmax.compensate import Compensation, compensate, load_kernels
from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import blur_twin
from torchcmax.core.draw import Ink, draw_twin
from torchcmax.core.estimate import Estimate, Search, estimate
from torchcmax.core.model import MODELS, Planar
from torchcmax.core.objective import Look, View, objective
from torchcmax.core.vote import vote_scatter
from torchcmax.core.window import Window
from torchcmax.data import WindowDataset, collate
from torchcmax.folder import writing
from torchcmax.io import DataNote, Events, OpenOptions, Recording, open, save
from torchcmax.nn import FlowContrastLoss
from torchcmax.simulator import Simulation, write

Table = list[dict[str, object]]


def best(run: Callable[[], object], device: str, repeats: int = 7) -> tuple[float, float]:
    """Wall and CPU seconds of the fastest of some runs, after one that is not counted."""

    def once() -> tuple[float, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        run()
        if device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter() - wall, time.process_time() - cpu

    once()
    return min(once() for _ in range(repeats))


@contextmanager
def without_kernels() -> Iterator[None]:
    """The plain torch path."""
    before = os.environ.get(kernels.SWITCH)
    os.environ[kernels.SWITCH] = "0"
    try:
        yield
    finally:
        del os.environ[kernels.SWITCH]
        if before is not None:
            os.environ[kernels.SWITCH] = before


def joined(window: Window, count: int) -> Window:
    """The first `count` events of several windows in a row as one window."""
    dt = window.dt + (window.start - window.start[0])[:, None] * 1e-6
    ray, dt, polarity = (part.flatten(0, 1)[None, :count] for part in (window.ray, dt.to(window.dt.dtype), window.polarity))
    return Window(ray.contiguous(), dt.contiguous(), polarity.contiguous(), window.start[:1], dt[:, -1])


def evaluations(recording: Recording, window: Window, device: str, threads: list[int]) -> Table:
    """(a) Value and gradient of the eight-parameter warp on the sensor's own pixels, variance with and without blur."""
    canvas, model, look, rows = Canvas.around(recording.camera, 0.0), Planar(recording.camera.fx), Look(), []
    for part in (window, joined(window, window.weight.numel()), window[:1]):
        ink = Ink.of(part, part.weight)
        owner = torch.arange(len(part), device=device)
        x = torch.ones(len(part), model.size, device=device)
        for sigma in (0.0, 1.0):
            view = View(ink, canvas, sigma, ink.sample(150))
            for count in threads:
                with using(count):
                    times = {backend(device): best(partial(objective(look, model, view, owner), x, owner), device)[0]}
                    if count == threads[0]:
                        with without_kernels():
                            times["torch"] = best(partial(objective(look, model, view, owner), x, owner), device, 3)[0]
                            if sigma == 0:
                                times["readable twin"] = best(partial(twin, model, ink, canvas, x), device, 3)[0]
                for name, wall in times.items():
                    at = {"backend": name, "threads": count, "windows": len(part), "events": ink.weight.numel(), "blur px": sigma}
                    rows.append({**at, "ns per event": round(wall / ink.weight.numel() * 1e9, 1)})
    return rows


def twin(model: Planar, ink: Ink, canvas: Canvas, x: torch.Tensor) -> torch.Tensor:
    """The same in plain torch operations, without the guard."""
    x, owner = x.clone().requires_grad_(), torch.arange(len(x), device=x.device)
    image = draw_twin(model.homography(x, owner, 0.5), ink, canvas, owner).flatten(1)
    return torch.autograd.grad(image.var(-1).sum(), x)[0]


def backend(device: str) -> str:
    """What the kernels are made with."""
    found = kernels.drawing(torch.empty(0, device=device))
    return "torch" if found is None else "triton" if device != "cpu" else "numba"


@contextmanager
def using(threads: int) -> Iterator[None]:
    """So many threads, of torch and of the kernels."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def cold_windows(recording: Recording, window: Window, device: str) -> Table:
    """(b) One window from a cold start, to convergence; and several in one batch, per window."""
    rows: Table = []
    for name, kind in MODELS.items():
        model = kind(recording.camera.fx)
        for part in (window[:1], window):
            wall, cpu = best(partial(estimate, part, recording.camera, model), device)
            found = estimate(part, recording.camera, model)
            one = {"model": name, "backend": backend(device), "windows": len(part)}
            rows.append(one | per_window(wall, cpu, found, len(part)))
        if len(window) > 1:
            last = found.displacement(window)
            warm, one_round = replace(model, start=model.parameters(last).roll(1, 0)), Search((1.0,))
            run = partial(estimate, window, recording.camera, warm, None, one_round)
            wall, cpu = best(run, device)
            row = {"model": f"{name}, from the window before", "backend": backend(device), "windows": len(window)}
            rows.append(row | per_window(wall, cpu, run(), len(window)))
        if backend(device) != "torch":
            with without_kernels():
                wall, cpu = best(partial(estimate, window[:1], recording.camera, model), device, 1)
                found = estimate(window[:1], recording.camera, model)
            rows.append({"model": name, "backend": "torch", "windows": 1} | per_window(wall, cpu, found, 1))
    return rows


def per_window(wall: float, cpu: float, found: Estimate, windows: int) -> dict[str, object]:
    return {
        "wall ms": round(wall / windows * 1e3, 1),
        "CPU ms": round(cpu / windows * 1e3, 1),
        "evaluations": round(found.evaluations.double().mean().item(), 1),
        "gain": round(found.gain.double().mean().item(), 4),
        "converged": round(found.converged.double().mean().item(), 2),
    }


def whole_recording(recording: Recording, device: str, threads: list[int]) -> Table:
    """(c) All windows of a recording: wall and CPU time, and what reading alone takes, as a share of the wall time."""
    rows: Table = []
    began = time.perf_counter()
    windows = sum(len(window) for window in recording.windows(30000, batch=16, device=device))
    reading = time.perf_counter() - began
    for name in MODELS:
        for count in threads:
            options = Compensation(model=name, device=device)  # type: ignore[arg-type]
            with using(count):
                began, cpu = time.perf_counter(), time.process_time()
                for _, found in compensate(recording, options):
                    last = found.contrast
                last.cpu()  # waits for a GPU
                wall, cpu = time.perf_counter() - began, time.process_time() - cpu
            at = {"model": name, "threads": count, "windows": windows, "Mev/s": round(windows * 0.03 / wall, 2)}
            rows.append(at | {"CPU s": round(cpu, 2), "reading alone, share of wall": round(reading / wall, 2)})
    return rows


def memory(recording: Recording, device: str) -> Table:
    """(d) Memory that compensating adds at its peak to what an opened recording takes, each in a process of its own."""
    rows: Table = []
    for name in MODELS:
        for batch in (1, 16, 64):
            arguments = [sys.executable, __file__, "--peak", name, str(batch), "--recording", str(recording.path), "--device", device]
            done = subprocess.run(arguments, capture_output=True, text=True, check=True)
            rows.append({"model": name, "windows in a batch": batch, "MB added": float(done.stdout)})
    return rows


def peak(recording: Recording, name: str, batch: int, device: str) -> float:
    """MB of the device, or resident on the CPU."""
    load_kernels(device)
    before = used(device)
    for _ in compensate(recording, Compensation(model=name, batch=batch, limit=3 * batch, device=device)):  # type: ignore[arg-type]
        pass
    return round(used(device) - before)


def used(device: str) -> float:
    """MB at the peak so far."""
    if device != "cpu":
        return torch.cuda.max_memory_allocated(device) / 1e6
    status = Path("/proc/self/status")  # getrusage would tell the peak of the process that started this one, if that was larger
    lines = status.read_text().splitlines() if status.exists() else []
    return next((float(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM")), float("nan"))


def flow_steps(recording: Recording, window: Window, device: str) -> Table:
    """A step of training with FlowContrastLoss, forth and back, against the same loss with four scatter_add, and with a plain blur too."""
    loss, rows = FlowContrastLoss(recording.camera), list[dict[str, object]]()
    flow = torch.zeros(len(window), 2, *recording.camera.size, device=device, requires_grad=True)

    def step() -> None:
        flow.grad = None
        loss(window, flow).backward()

    def scattered(xy: Tensor, motion: Tensor, s: Tensor, weight: Tensor, size: tuple[int, int]) -> Tensor:
        return vote_scatter(torch.addcmul(xy, motion, s[..., None]), weight, size)

    fast = {name: best(step, device)[i] for i, name in enumerate(("wall", "CPU"))}
    with patch("torchcmax.nn.flow.vote_moved", scattered):
        votes = {name: best(step, device)[i] for i, name in enumerate(("wall", "CPU"))}
        with patch("torchcmax.nn.loss.blur", blur_twin):
            plain = {name: best(step, device)[i] for i, name in enumerate(("wall", "CPU"))}
    for name, seconds in fast.items():
        row: dict[str, object] = {"windows": len(window), "time": name, "ms": round(seconds * 1e3, 1)}
        for what, slow in (("scatter_add", votes[name]), ("scatter_add, plain blur", plain[name])):
            row |= {f"{what} ms": round(slow * 1e3, 1), f"{what} ratio": round(slow / seconds, 2)}
        rows.append(row)
    return rows


def reading(recording: Recording, folder: Path, count: int = 1_000_000) -> Table:
    """Mega-events a second that each form of the same events is read at, checks included, on one core."""
    once = Events.join(list(recording.chunks()))
    span = int(once.t[-1] - once.t[0]) + 1
    turns = -(-count // len(once))
    events = Events.join([replace(once, t=once.t - once.t[0] + turn * span) for turn in range(turns)])
    table = np.stack([events.t, events.x, events.y, events.p], 1).astype(np.int64)
    files = {"text, t x y p in s": "s.txt", "text, t,x,y,p in us": "us.csv", "npz": "events.npz", "DAT": "events.dat", "ours": "ours.h5"}
    np.savetxt(folder / files["text, t,x,y,p in us"], table, "%d", ",", header="t_us,x,y,p", comments="")
    seconds = (f"{t // 1_000_000}.{t % 1_000_000:06d} {x} {y} {p}\n" for t, x, y, p in table.tolist())
    (folder / files["text, t x y p in s"]).write_text("".join(seconds))
    np.savez(folder / files["npz"], t=events.t, x=events.x, y=events.y, p=events.p)
    height, width = recording.camera.size
    words = np.stack([events.t, events.x.astype(np.int64) | events.y.astype(np.int64) << 14 | events.p.astype(np.int64) << 28], 1)
    head = f"% Version 2\n% Width {width}\n% Height {height}\n".encode()
    (folder / files["DAT"]).write_bytes(head + bytes([12, 8]) + words.astype("<u4").tobytes())
    options = OpenOptions(camera="pinhole", sensor=(width, height))
    save(open(folder / files["npz"], options), folder / files["ours"])
    rows: Table = []
    for name, file in files.items():
        taken, _ = best(lambda file=file: sum(map(len, open(folder / file, options).chunks())), "cpu", 3)  # type: ignore[misc]
        rows.append({"form": name, "MB": round((folder / file).stat().st_size * 1e-6, 1), "Mev/s": round(len(events) / taken * 1e-6, 1)})
    return rows


def loading(folder: Path) -> Table:
    """Mega-events a second that a DataLoader gives in windows at random places of the file of ours that `reading` wrote."""
    rows: Table = []
    for events, batch in ((5_000, 16), (30_000, 4)):
        for workers in (0, 1, 2):
            dataset = WindowDataset(folder / "ours.h5", events, stride=events // 2)
            loader = DataLoader(dataset, batch, shuffle=True, num_workers=workers, collate_fn=collate, persistent_workers=workers > 0)
            taken, _ = best(lambda loader=loader: sum(1 for _ in loader), "cpu", 3)  # type: ignore[misc]
            speed = round(len(dataset) * events / taken * 1e-6, 2)
            rows.append({"events": events, "batch": batch, "workers": workers, "windows": len(dataset), "Mev/s": speed})
    return rows


def rigs(folder: Path) -> Table:
    """SYNCs a second of the example rigs' programs on simulated drives, in lock-step with their motors' physics; real time is `real`."""
    if find_spec("canopen") is None:
        return [{"rig": "the extra rig is not installed"}]
    from torchcmax.rig.config import load
    from torchcmax.rig.plan import plan
    from torchcmax.rig.profilefile import load_profile
    from torchcmax.rig.runner import run

    rows: Table = []
    configs = Path(__file__).parents[1] / "configs" / "rig"
    for name, profile in (("slider", "slider_pass"), ("pantilt", "pantilt_sweep")):
        rig, ticks = load(configs / f"{name}.yaml"), [0]
        program = plan(rig, load_profile(configs / f"{profile}.yaml", rig)).program
        begin = time.perf_counter()
        run(rig, program, folder / name, simulate=True, watch=lambda k, ticks=ticks: ticks.__setitem__(0, k))  # type: ignore[misc]
        speed = ticks[0] / (time.perf_counter() - begin)
        rows.append({"rig": name, "axes": len(rig.axes), "SYNC/s": round(speed), "real": round(1 / rig.bus.sync_period)})
    return rows


def limits(recording: Recording, window: Window, device: str) -> Table:
    """(e) Copying, and torch adding to four pixels of an image for each event; and how we compare, reading events twice an evaluation."""
    canvas, model = Canvas.around(recording.camera, 0.0), Planar(recording.camera.fx)
    ink, owner = Ink.of(window, window.weight), torch.arange(len(window), device=device)
    events = ink.weight.numel()
    source = torch.empty(1 << (24 if device == "cpu" else 28), device=device)
    target = torch.empty_like(source)
    copy = 2 * source.numel() * 4 / best(lambda: target.copy_(source), device)[0]
    pixels = canvas.size[0] * canvas.size[1]
    place = torch.randint(0, pixels, (len(window), 4 * ink.weight.shape[1]), device=device)
    image, ones = torch.zeros(len(window), pixels, device=device), torch.ones(place.shape, device=device)
    added = best(lambda: image.scatter_add_(1, place, ones), device)[0] / events
    x = torch.ones(len(window), model.size, device=device)
    view = View(ink, canvas, 0.0, ink.sample(150))
    ours = best(partial(objective(Look(), model, view, owner), x, owner), device)[0] / events
    moved = 2 * 16 / ours  # x, y, s, weight, once for the votes and once for the gradient
    return [
        {"limit": "copy", "GB/s": round(copy * 1e-9, 1), "our GB/s": round(moved * 1e-9, 1), "ratio": round(moved / copy, 2)},
        {"limit": "scatter_add_ to four pixels an event", "ns": round(added * 1e9, 1), "our ns": round(ours * 1e9, 1),
         "ratio": round(added / ours, 2)},
    ]  # fmt: skip


def machine(device: str) -> dict[str, object]:
    """What the numbers belong to."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        cpu = next((line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")), cpu)
    name = cpu if device == "cpu" else torch.cuda.get_device_name(device)
    versions = {"torchcmax": __version__, "torch": torch.__version__, "python": platform.python_version()}
    for package in ("numba", "triton"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return {
        "device": name,
        "cores": os.cpu_count(),
        **versions,
        "commit": commit or "unknown",
        "date": time.strftime("%Y-%m-%d"),
    }


def printed(title: str, rows: Table) -> None:
    """A table in Markdown."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    print(f"\n### {title}\n")
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns))
    for row in rows:
        print("| " + " | ".join(str(row.get(name, "")) for name in columns) + " |")


def tables_of(recordings: list[Recording], folder: Path, windows: int, device: str, threads: list[int]) -> dict[str, Table]:
    """All tables, by their titles."""
    first = next(recordings[0].windows(30000, batch=windows)).to(device, torch.float32)
    load_kernels(device)
    tables = {"One evaluation: value and gradient, 8 parameters": evaluations(recordings[0], first, device, threads)}
    for recording in recordings:
        window = next(recording.windows(30000, batch=windows)).to(device, torch.float32)
        tables[f"A cold window of 30,000 events of {recording.name}"] = cold_windows(recording, window, device)
    for recording in recordings:
        tables[f"The whole of {recording.name}"] = whole_recording(recording, device, threads)
    tables["FlowContrastLoss, a step"] = flow_steps(recordings[0], first, device)
    tables["Reading, one core"] = reading(recordings[0], folder)
    tables["Windows at random from a DataLoader"] = loading(folder)
    tables["Simulated drives, in lock-step"] = rigs(folder)
    tables["Memory"] = memory(recordings[0], device)
    tables["What the device can do"] = limits(recordings[0], first, device)
    return tables


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", nargs="+", default=[], help="default: half a second of the built-in poster")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="on the CPU")
    parser.add_argument("--windows", type=int, default=10, help="windows of 30,000 events in a batch")
    parser.add_argument("--json", type=Path, help="write the tables to this file too")
    parser.add_argument("--peak", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    warnings.simplefilter("ignore", DataNote)
    threads = options.threads if options.device == "cpu" else [1]
    torch.set_num_threads(threads[0])
    if options.peak:
        print(peak(open(options.recording[0]), options.peak[0], int(options.peak[1]), options.device))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        if not options.recording:
            write(Simulation(duration=0.5), Path(folder) / "poster")
        recordings = [open(name) for name in options.recording or [Path(folder) / "poster"]]
        about, tables = machine(options.device), tables_of(recordings, Path(folder), options.windows, options.device, threads)
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    for title, rows in tables.items():
        printed(title, rows)
    if options.json:
        with writing(options.json) as name:
            name.write_text(json.dumps({"machine": about, "tables": tables}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
