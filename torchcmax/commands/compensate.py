"""torchcmax compensate: the motion of every window."""

from __future__ import annotations

import math

from jsonargparse import Namespace
from tqdm import tqdm

from torchcmax.commands.arguments import add_opening, add_running, folder, made, recording_of, settings
from torchcmax.compensate import Compensation, compensate, load_kernels
from torchcmax.config import Parser, command
from torchcmax.io import Recording
from torchcmax.report import Report

SUMMARY = "estimate the motion of every window, and show it"


def build() -> Parser:
    """Its options."""
    sub = command(
        "Estimate the motion of every window of a recording and draw its events before and after compensation. Writes windows.csv "
        "(motion at each window's first event, rad/s and plane distances/s), images/, summary.json and TensorBoard curves to --out."
    )
    add_opening(sub)
    add_running(sub, images=10)
    sub.add_class_arguments(Compensation)
    return sub


def run(config: Namespace) -> int:
    """torchcmax compensate"""
    options, out = made(Compensation, config), folder(config.out)
    recording = recording_of(config, load_kernels)
    with (
        Report(out, recording, options, settings(config, options), config.images) as report,
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


def expected(recording: Recording, options: Compensation) -> int | None:
    """How many windows there will be, if that is known."""
    if recording.count is None:
        return options.limit
    windows = max(0, (recording.count - options.events) // (options.stride or options.events) + 1)
    return windows if options.limit is None else min(windows, options.limit)
