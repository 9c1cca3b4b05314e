"""torchcmax simulate: a recording with exact ground truth."""

from __future__ import annotations

from jsonargparse import Namespace
from tqdm import tqdm

from torchcmax.commands.arguments import folder, made
from torchcmax.config import Parser, command, usage
from torchcmax.simulator import Simulation, write

SUMMARY = "write a simulated recording with exact ground truth"


def build() -> Parser:
    """Its options."""
    sub = command("Write a simulated recording with exact ground truth: a camera moves before a textured plane or in a panorama.")
    sub.add_argument("--out", type=str, required=True, help="folder to write: events.h5, calib.txt, groundtruth.txt, ...")
    sub.add_class_arguments(Simulation)
    return sub


def run(config: Namespace) -> int:
    """torchcmax simulate"""
    options, out = made(Simulation, config), folder(config.out)
    layout = "{l_bar}{bar}| {n:.2f}/{total:.2f} s [{elapsed}<{remaining}]"
    with tqdm(total=options.duration, desc="simulate", bar_format=layout) as bar, usage():  # a view past the horizon shows on the way
        write(options, out, lambda done: bar.update(min(done, options.duration) - bar.n))
    print(f"recording: {out}")
    return 0
