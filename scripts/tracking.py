"""How well and how fast recordings are tracked, from nothing and by default: python scripts/tracking.py RECORDING ... [--starts 12]

Prints the tables that docs/benchmarks.md holds. A first run compiles kernels before the clock starts; reading, map and joint
optimization are in the times. Options behind -- are those of `torchcmax track`, for ablations.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
import warnings
from dataclasses import replace
from typing import Any

import torch

from torchcmax import kernels, open
from torchcmax.io import DataError, DataNote, OpenOptions, Recording
from torchcmax.score import score
from torchcmax.slam.system import Slam
from torchcmax.track import TrackOptions, load_kernels, track

COLUMNS = "recording from windows keyframes lost_s position_% orientation_deg coverage plane_deg seconds real_time Mev/s".split()


def changed(options: Any, path: list[str], value: Any) -> Any:
    """The options with one of them replaced, however deep: path like ["mapping", "overlap"]."""
    name, *rest = path
    return replace(options, **{name: changed(getattr(options, name), rest, value) if rest else value})


def row(recording: Recording, slam: Slam, begin: float | None) -> dict[str, object]:
    """One run in numbers."""
    tracks, began, events, lost = track(recording, TrackOptions(slam, begin=begin)), time.perf_counter(), 0, 0.0
    for one in tracks:
        events += one.window.ray.shape[1]
        lost += float(one.window.duration[0]) * (one.status == "lost")
    seconds, path = time.perf_counter() - began, tracks.trajectory()
    recorded = (int(path.time[-1]) - int(path.time[0])) * 1e-6
    found: dict[str, object] = {
        "recording": recording.name, "from": "" if begin is None else f"{begin:.2f}", "windows": len(path),
        "keyframes": len(tracks.map.keyframes), "lost_s": round(lost, 2), "seconds": round(seconds, 1),
        "real_time": round(recorded / seconds, 2), "Mev/s": round(events / seconds * 1e-6, 2),
    }  # fmt: skip
    if recording.truth is not None:
        error = score(path, recording.truth, recording.plane, start_us=None if begin is None else round(begin * 1e6))
        found |= {"orientation_deg": round(error.orientation_rmse_deg, 2), "coverage": round(error.coverage, 3)}
        found["position_%"] = "" if error.percent_of_distance is None else round(error.percent_of_distance, 2)
    if recording.truth is not None and recording.plane is not None:
        true = recording.plane.seen_from(recording.truth.at(path.time[:1])).normal
        mine = tracks.map.plane.seen_from(path.pose[:1]).normal
        found["plane_deg"] = round(float((true * mine).sum().clamp(-1, 1).arccos().rad2deg()), 2)
    return found


def moments(recording: Recording, count: int) -> list[float | None]:
    """From the first event, and from other moments spread over the recording but for its last 2 s."""
    if count < 2 or recording.truth is None:
        return [None]
    first, last = (int(recording.truth.time[i]) * 1e-6 for i in (0, -1))
    return [None, *(first + (last - 2 - first) * i / (count - 1) for i in range(1, count))]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="+")
    parser.add_argument("--starts", type=int, default=1, help="moments to start from, spread over each recording")
    parser.add_argument("--at", type=float, nargs="+", metavar="SECOND", help="of the recording's clock to start from, instead")
    parser.add_argument("--threads", type=int, default=0, help="of the CPU's kernels; 0: as torch")
    parser.add_argument("--camera", default="", help="calibration where there is none, or the word pinhole")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="options of tracking, like mapping.overlap=0.7")
    options = parser.parse_args()
    warnings.simplefilter("ignore", DataNote)
    torch.set_num_threads(1)
    kernels.set_threads(options.threads)
    slam = Slam()
    for setting in options.set:
        name, _, value = setting.partition("=")
        number = float(value)
        slam = changed(slam, name.split("."), int(number) if number.is_integer() and "." not in value else number)
    load_kernels(slam, "cpu")
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for name in options.recording:
        recording = open(name, OpenOptions(camera=options.camera))
        for begin in options.at or moments(recording, options.starts):
            try:
                found = row(recording, slam, begin)
            except DataError as error:
                found = {"recording": recording.name, "from": begin, "windows": str(error)}
            print("| " + " | ".join(str(found.get(column, "")) for column in COLUMNS) + " |", flush=True)
    print(f"\npeak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
