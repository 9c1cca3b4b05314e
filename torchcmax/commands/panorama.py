"""torchcmax panorama: a camera that only turns."""

from __future__ import annotations

from jsonargparse import Namespace

from torchcmax.commands.arguments import add_opening, add_running, add_stretch, made
from torchcmax.commands.following import follow
from torchcmax.config import Parser, command, usage
from torchcmax.panoreport import PanoramaReport
from torchcmax.slam.system import Panorama
from torchcmax.track import TrackOptions

SUMMARY = "follow a camera that only turns, and map all that it sees"


def build() -> Parser:
    """Its options."""
    sub = command(
        "Follow a camera that only turns, before any scene, and map what it sees on a sphere. Writes trajectory.txt (TUM: seconds, T_wc, "
        "positions zero), windows.csv, keyframes.csv, panorama.png (equirectangular), panorama_cropped.png, panorama.h5, images/, "
        "summary.json and TensorBoard curves to --out."
    )
    add_opening(sub)
    add_running(sub, images=25)
    add_stretch(sub)
    sub.add_class_arguments(TrackOptions, skip={"slam", "begin", "end", "distance"})
    sub.add_class_arguments(Panorama)
    return sub


def run(config: Namespace) -> int:
    """torchcmax panorama"""
    slam = made(Panorama, config)
    with usage():
        options = TrackOptions(slam, config["from"], config.to, None, config.map, config.device)
    return follow(config, options, PanoramaReport, ("from", "to", "map", "device"))
