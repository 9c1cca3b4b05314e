"""The command line: torchcmax simulate | info | compensate | track | panorama.  Exits 0 when
all went well, 1 on bad data, 2 on wrong usage."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar

import torch
import yaml
from jsonargparse import Namespace
from tqdm import tqdm

from torchcmax import __version__, kernels
from torchcmax.compensate import Compensation, compensate, load_kernels
from torchcmax.config import USAGE_ERROR, Parser, UsageError, command, parser, usage
from torchcmax.io import DataError, DataNote, DataWarning, OpenOptions, Recording, open, summary
from torchcmax.panoreport import PanoramaReport
from torchcmax.report import Report
from torchcmax.simulator import Simulation, write
from torchcmax.slam.system import Panorama, Slam
from torchcmax.track import TrackOptions, Tracks, track
from torchcmax.track import load_kernels as load_tracking
from torchcmax.trackreport import TrackReport

T = TypeVar("T")
DATA_ERROR, INTERRUPTED = 1, 130
DESCRIPTION = """Motion from event cameras by contrast maximization: warp the events of a window with a candidate motion, vote them
into an image; the right motion is the one that makes the image sharpest."""
RECORDING_HELP = "folder with events.txt or events.h5 and calib.txt, the same as a .zip, or an HDF5 file"


def build() -> Parser:
    """The whole command line."""
    main = parser("torchcmax", DESCRIPTION)
    main.add_argument("--version", action="version", version=__version__)
    commands = main.add_subcommands(required=True, dest="command")

    simulate = command("Write a simulated recording with exact ground truth: a camera moves before a textured plane or in a panorama.")
    simulate.add_argument("--out", type=str, required=True, help="folder to write: events.h5, calib.txt, groundtruth.txt, ...")
    simulate.add_class_arguments(Simulation)
    commands.add_subcommand("simulate", simulate, help="write a simulated recording with exact ground truth")

    info = command("Say what is in a recording: sensor, calibration, duration, counts, rate over time, gaps, problems found.")
    info.add_argument("--json", action="store_true", help="print JSON instead of text")
    _add_opening(info)
    commands.add_subcommand("info", info, help="say what is in a recording, and what is wrong with it")

    compensating = command(
        "Estimate the motion of every window of a recording and draw its events before and after compensation. Writes windows.csv "
        "(motion at each window's first event, rad/s and plane distances/s), images/, summary.json and TensorBoard curves to --out."
    )
    _add_opening(compensating)
    _add_running(compensating, images=10)
    compensating.add_class_arguments(Compensation)
    commands.add_subcommand("compensate", compensating, help="estimate the motion of every window, and show it")

    tracking = command(
        "Follow the camera before a plane, and map the plane on the way. Writes trajectory.txt (TUM: seconds, T_wc in plane distances or "
        "metres), windows.csv, keyframes.csv, map.png, map.h5, images/, summary.json and TensorBoard curves to --out."
    )
    _add_opening(tracking)
    _add_running(tracking, images=25)
    _add_stretch(tracking)
    tracking.add_class_arguments(TrackOptions, skip={"slam", "begin", "end"})
    tracking.add_class_arguments(Slam)
    commands.add_subcommand("track", tracking, help="follow the camera, and map the plane that it sees")

    turning = command(
        "Follow a camera that only turns, before any scene, and map what it sees on a sphere. Writes trajectory.txt (TUM: seconds, T_wc, "
        "positions zero), windows.csv, keyframes.csv, panorama.png (equirectangular), panorama_cropped.png, panorama.h5, images/, "
        "summary.json and TensorBoard curves to --out."
    )
    _add_opening(turning)
    _add_running(turning, images=25)
    _add_stretch(turning)
    turning.add_class_arguments(TrackOptions, skip={"slam", "begin", "end", "distance"})
    turning.add_class_arguments(Panorama)
    commands.add_subcommand("panorama", turning, help="follow a camera that only turns, and map all that it sees")
    return main


def _add_opening(command: Parser) -> None:
    command.add_argument("recording", type=str, help=RECORDING_HELP)
    command.add_argument("--strict", action="store_true", help="refuse what would be mended: events out of order, or at equal times")
    command.add_argument("--sensor", type=str, default="", help="width x height in px, like 240x180, instead of what the recording says")
    command.add_class_arguments(OpenOptions, skip={"strict", "sensor", "chunk"})


def _add_running(command: Parser, images: int) -> None:
    command.add_argument("--out", type=str, required=True, help="folder to write; look at it with: tensorboard --logdir DIR")
    command.add_argument("--images", type=int, default=images, help="a picture of every so many windows; 0: none")
    command.add_argument("--threads", type=int, default=0, help="of the CPU's kernels; 0: as many as this process may use")
    command.add_argument("--quiet", action="store_true", help="no progress bar")


def _add_stretch(command: Parser) -> None:
    command.add_argument(
        "--from", type=float | None, default=None, help="second of the recording's clock to begin at; default: the first event"
    )
    command.add_argument(
        "--to", type=float | None, default=None, help="second of the recording's clock to stop before; default: the last event"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run one command; the exit status is returned."""
    torch.set_num_threads(1)  # what is left to torch is too little work for two: they would spin
    warnings.showwarning = _say
    top = build()
    config = top.parsed(arguments)
    name = config.command
    commands = {"simulate": run_simulate, "info": run_info, "compensate": run_compensate, "track": run_track, "panorama": run_panorama}
    try:
        return commands[name](config[name])
    except UsageError as error:
        print(f"torchcmax {name}: {error}", file=sys.stderr)
        return USAGE_ERROR
    except DataError as error:
        print(f"torchcmax {name}: {error}", file=sys.stderr)
        return DATA_ERROR
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        kept = "; what was finished is kept" if name in ("compensate", "track", "panorama") else ""
        print(f"\ntorchcmax {name}: stopped{kept}", file=sys.stderr)
        return INTERRUPTED


def _say(message: Warning | str, category: type[Warning], filename: str, lineno: int, file: Any = None, line: str | None = None) -> None:
    if issubclass(category, (DataWarning, DataNote)):  # others are for developers
        print(f"{'note' if issubclass(category, DataNote) else 'warning'}: {message}", file=sys.stderr)


def _dataclass(kind: type[T], config: Namespace) -> T:
    """The part of the parsed options that belongs to one dataclass."""
    names = {f.name for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    with usage():
        return kind(**{name: value for name, value in vars(config).items() if name in names})


def _opening(config: Namespace) -> OpenOptions:
    """How the recording is to be opened."""
    with usage():
        if not config.recording:
            raise ValueError("the recording's name is empty")
        if not config.sensor:
            return OpenOptions(config.strict, config.camera)
        try:
            width, height = (int(number) for number in config.sensor.lower().split("x"))
        except ValueError:
            raise ValueError(f"--sensor wants width x height, like 240x180, got {config.sensor!r}") from None
        return OpenOptions(config.strict, config.camera, (width, height))


def run_simulate(config: Namespace) -> int:
    """torchcmax simulate"""
    options, out = _dataclass(Simulation, config), _folder(config.out)
    layout = "{l_bar}{bar}| {n:.2f}/{total:.2f} s [{elapsed}<{remaining}]"
    with tqdm(total=options.duration, desc="simulate", bar_format=layout) as bar, usage():  # a view past the horizon shows on the way
        write(options, out, lambda done: bar.update(min(done, options.duration) - bar.n))
    print(f"recording: {out}")
    return 0


def _folder(name: str) -> Path:
    if not name:
        raise UsageError("--out wants the name of a folder")
    return Path(name)


def run_info(config: Namespace) -> int:
    """torchcmax info"""
    found = summary(open(config.recording, _opening(config)))
    print(json.dumps(dataclasses.asdict(found), indent=1) if config.json else found)
    return 0


def run_compensate(config: Namespace) -> int:
    """torchcmax compensate"""
    options, out = _dataclass(Compensation, config), _folder(config.out)
    recording = _running(config, load_kernels)
    with (
        Report(out, recording, options, _settings(config, options), config.images) as report,
        tqdm(total=expected(recording, options), unit="window", desc=recording.name, disable=config.quiet) as bar,
    ):
        for window, estimate in compensate(recording, options):
            report.add(window, estimate)
            bar.update(len(window))
    found = report.summary()
    print(
        f"{found['windows']} windows, median gain {found['gain_median'] or math.nan:.4f}, {found['mega_events_per_second']:.2f} Mev/s\n"
        f"motions: {report.folder / 'windows.csv'}\npictures: {report.folder / 'images'} ({found['pictures']})\n"
        f"curves: tensorboard --logdir {report.folder}"
    )
    return 0


def _running(config: Namespace, load: Callable[[str], None]) -> Recording:
    """The recording to go through, with the kernels loaded."""
    check_device(config.device)
    for name in ("images", "threads"):
        if config[name] < 0:
            raise UsageError(f"--{name} wants a number of at least 0, got {config[name]}")
    kernels.set_threads(config.threads or available_cores())  # of this process, which is ours
    recording = open(config.recording, _opening(config))
    load(config.device)
    return recording


def _settings(config: Namespace, options: Any, names: tuple[str, ...] = ()) -> str:
    """The run's configuration as YAML, which --config makes the same run of."""
    settings = {name: config[name] for name in ("strict", "camera", "sensor", "images", *names)} | dataclasses.asdict(options)
    text: str = yaml.safe_dump(json.loads(json.dumps(settings)), sort_keys=False)
    return text


def run_track(config: Namespace) -> int:
    """torchcmax track"""
    slam = _dataclass(Slam, config)
    with usage():
        options = TrackOptions(slam, config["from"], config.to, config.distance, config.map, config.device)
    return _follow(config, options, TrackReport, ("from", "to", "distance", "map", "device"))


def run_panorama(config: Namespace) -> int:
    """torchcmax panorama"""
    slam = _dataclass(Panorama, config)
    with usage():
        options = TrackOptions(slam, config["from"], config.to, None, config.map, config.device)
    return _follow(config, options, PanoramaReport, ("from", "to", "map", "device"))


def _follow(config: Namespace, options: TrackOptions, kind: type[TrackReport], names: tuple[str, ...]) -> int:
    """Through the whole recording; names: of the options beside those of the tracking that make the same run again."""
    out = _folder(config.out)
    recording = _running(config, partial(load_tracking, options.slam))
    tracks = track(recording, options)
    text = _settings(config, options.slam, names)
    with tracks.stream, kind(out, tracks, text, config.images) as report, Progress(tracks, report, config.quiet) as bar:
        for one in tracks:
            report.add(one)
            bar.update()
    shown = [out / name for name in report.names if name in report.files and Path(name).suffix in (".txt", ".png")]
    print("\n".join([told(report), *(f"{path.stem}: {path}" for path in shown), f"curves: tensorboard --logdir {out}"]))
    return 0


def told(report: TrackReport) -> str:
    """The run in a few words."""
    found, error = report.summary(), report.error
    lost = f"{found['lost_seconds']:g} s lost" + (
        f" ({found['losses']} times, found again {found['recoveries']})" if found["losses"] else ""
    )
    words = f"{found['windows']} windows, {found['keyframes']} keyframes, {lost}, {report.factor:.2f}x real time"
    if error is None:
        return words
    parts = [] if error["percent_of_distance"] is None else [f"{error['percent_of_distance']:.3f} % of the plane's distance"]
    parts += [f"{error['orientation_rmse_deg']:.3f} degrees", f"coverage {error['coverage']:.3f}"]
    return f"{words}\nerror: {', '.join(parts)}"


class Progress:
    """A bar of the recording's seconds, and how many of them a second of work takes."""

    def __init__(self, tracks: Tracks, report: TrackReport, quiet: bool) -> None:
        self._tracks, self._report = tracks, report
        self._bar = tqdm(desc=tracks.recording.name, disable=quiet, bar_format="{desc}: {n:.2f} s [{elapsed}{postfix}]")

    def update(self) -> None:
        """Another window is done."""
        stream, seconds = self._tracks.stream, self._report.seconds
        if stream.share:
            self._bar.bar_format = "{l_bar}{bar}| {n:.2f}/{total:.2f} s [{elapsed}<{remaining}{postfix}]"
            self._bar.total = seconds / (stream.share * self._report.events / stream.consumed)  # some were taken and are still to come
        self._bar.set_postfix_str(f"{self._report.factor:.2f}x real time", refresh=False)
        self._bar.update(seconds - self._bar.n)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


def available_cores() -> int:
    """That this process may use, which may be fewer than there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_device(name: str) -> None:
    """A device that isn't there is the user's error, said before any work."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise UsageError(f"--device wants cpu, cuda or cuda:N, got {name!r}")
    if name != "cpu" and int(name.partition(":")[2] or 0) >= torch.cuda.device_count():
        raise UsageError(f"--device {name}: torch sees {torch.cuda.device_count()} CUDA devices on this machine; take --device cpu")


def expected(recording: Recording, options: Compensation) -> int | None:
    """How many windows there will be, if that is known."""
    if recording.count is None:
        return options.limit
    windows = max(0, (recording.count - options.events) // (options.stride or options.events) + 1)
    return windows if options.limit is None else min(windows, options.limit)


if __name__ == "__main__":
    sys.exit(main())
