"""How well, how fast and how surely a turning camera is followed: python scripts/panoramas.py RECORDING ... [--found 60] [--sweep]

Each recording is tracked from nothing and by default. --found N: tracking begins at N random moments of it, with nothing known, against the
finished panorama; what is believed within 0.6 s is compared with the truth. --sweep: the built-in camera that turns round twice, and how
far it is off at the end of each turn.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings

import torch
from lost import table
from torch import Tensor

from torchcmax import kernels, open
from torchcmax.core import so3
from torchcmax.core.pose import Pose
from torchcmax.io import DataNote, Recording
from torchcmax.quality import quality
from torchcmax.score import errors, rotation, score
from torchcmax.simulator import Simulation, simulate
from torchcmax.slam.globe import Globe
from torchcmax.slam.system import Panorama, System
from torchcmax.slam.tiles import spread
from torchcmax.track import TrackOptions, Tracks, load_kernels, track

WITHIN = 0.6  # s after which a camera counts as not found
NEAR, WRONG = 0.5, 5.0  # degrees from the truth: found; of another place
LAST = 0.3  # s of a turn that are its end


def followed(recording: Recording) -> tuple[Tracks, dict[str, object]]:
    """One run, and what it was like in numbers."""
    tracks, began, lost = track(recording, TrackOptions(Panorama())), time.perf_counter(), 0.0
    for one in tracks:
        lost += float(one.window.duration[0]) * (one.status == "lost")
    seconds, path = time.perf_counter() - began, tracks.trajectory()
    recorded = (int(path.time[-1]) - int(path.time[0])) * 1e-6
    assert isinstance(tracks.map, Globe)
    layers = tracks.map.layers
    found = quality(layers.votes, spread(layers.most) > 0, tracks.map.sphere)
    numbers: dict[str, object] = {
        "recording": recording.name, "windows": len(path), "keyframes": len(tracks.map.keyframes), "lost_s": round(lost, 2),
        "seconds": round(seconds, 1), "real_time": round(recorded / seconds, 2), "event_area_sr": round(found.event_area_sr, 3),
        "gradient": round(found.gradient_magnitude, 1),
    }  # fmt: skip
    if recording.truth is not None:
        error = score(path, recording.truth, rotation_only=True)
        numbers |= {"rmse_deg": round(error.orientation_rmse_deg, 3), "max_deg": round(error.orientation_max_deg, 3)}
        numbers["coverage"] = round(error.coverage, 3)
    return tracks, numbers


def turns(tracks: Tracks, period: float) -> dict[str, object]:
    """degrees off at the end of each turn, laid on the truth by one rotation of all."""
    path, truth = tracks.trajectory(), tracks.recording.truth
    assert truth is not None
    _, off = errors(path, truth, rotation(path.pose, truth.at(path.time)))
    seconds = path.time.double() * 1e-6
    ends = [period * (i + 1) for i in range(round(float(seconds[-1]) / period))]
    return {
        f"end of turn {i + 1}, deg": round(float(off[(seconds > end - LAST) & (seconds <= end)].mean()), 3) for i, end in enumerate(ends)
    }


def found(tracks: Tracks, count: int) -> dict[str, object]:
    """How many of so many random moments are found in the finished panorama."""
    recording, globe, path = tracks.recording, tracks.map, tracks.trajectory()
    assert recording.truth is not None
    laid = rotation(path.pose, recording.truth.at(path.time))
    random, off, seconds = torch.Generator().manual_seed(0), list[float](), list[float]()
    last = float(recording.truth.time[-1]) * 1e-6 - WITHIN
    for begin in (torch.rand(count, generator=random) * last).tolist():
        system = System([recording.camera], Panorama(), [globe])
        run = system.runs[0]
        with recording.stream(begin) as stream:
            for one in system.run([stream]):
                if run.site is run.sites[0] and run.belief is not None:
                    here = laid @ run.belief.state.pose
                    off.append(apart(here, recording.truth.at(run.belief.time)))
                    seconds.append(float(run.belief.time[0]) * 1e-6 - begin)
                    break
                if one.time * 1e-6 > begin + WITHIN:
                    break
    middle = [round(float(torch.tensor(v).median()), 3) if v else float("nan") for v in (off, seconds)]
    return {
        "recording": recording.name, "moments": count, "believed": len(off), f"within {NEAR} deg": sum(o < NEAR for o in off),
        "wrong": sum(o > WRONG for o in off), "median deg": middle[0], "max deg": round(max(off, default=0.0), 3), "median s": middle[1],
    }  # fmt: skip


def apart(one: Pose, other: Pose) -> float:
    """degrees between two orientations [1]."""
    turn: Tensor = so3.log(one.R.mT @ other.R)
    return float(turn.norm().rad2deg())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="*")
    parser.add_argument("--found", type=int, default=0, metavar="N", help="random moments of each recording")
    parser.add_argument("--sweep", action="store_true")
    parser.add_argument("--threads", type=int, default=2, help="of the CPU's kernels")
    options = parser.parse_args()
    warnings.simplefilter("ignore", DataNote)
    torch.set_num_threads(1)
    kernels.set_threads(options.threads)
    load_kernels(Panorama(), "cpu")
    runs = [followed(open(name)) for name in options.recording]
    if options.sweep:
        tracks, numbers = followed(simulate(Simulation(scene="panorama", motion="sweep", duration=6.0)))
        numbers.pop("real_time")  # it renders meanwhile
        runs.append((tracks, numbers | turns(tracks, 3.0)))
    table([numbers for _, numbers in runs])
    if options.found:
        table([found(tracks, options.found) for tracks, _ in runs[: len(options.recording)]])
    return 0


if __name__ == "__main__":
    sys.exit(main())
