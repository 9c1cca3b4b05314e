"""torchcmax track: the camera before a plane."""

from __future__ import annotations

from jsonargparse import Namespace

from torchcmax.commands.arguments import add_opening, add_running, add_stretch, made
from torchcmax.commands.following import follow
from torchcmax.config import Parser, command, usage
from torchcmax.slam.system import Slam
from torchcmax.track import TrackOptions
from torchcmax.trackreport import TrackReport

SUMMARY = "follow the camera, and map the plane that it sees"


def build() -> Parser:
    """Its options."""
    sub = command(
        "Follow the camera before a plane, and map the plane on the way. Writes trajectory.txt (TUM: seconds, T_wc in plane distances or "
        "metres), windows.csv, keyframes.csv, map.png, map.h5, images/, summary.json and TensorBoard curves to --out."
    )
    add_opening(sub)
    add_running(sub, images=25)
    add_stretch(sub)
    sub.add_class_arguments(TrackOptions, skip={"slam", "begin", "end"})
    sub.add_class_arguments(Slam)
    return sub


def run(config: Namespace) -> int:
    """torchcmax track"""
    slam = made(Slam, config)
    with usage():
        options = TrackOptions(slam, config["from"], config.to, config.distance, config.map, config.device)
    return follow(config, options, TrackReport, ("from", "to", "distance", "map", "device"))
