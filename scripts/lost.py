"""How a lost camera is found: python scripts/lost.py DATA [--kidnapped 60] [--near 60] [--ablation]

DATA: the folder with the simulated recordings. --kidnapped N: tracking begins at N moments of the second half of recordings, with nothing
known, on the map that a run on the first half made; what is believed within 0.6 s is compared with the truth. --near N: one window, and a
place 30 px and 10 degrees off. --ablation: whole recordings, with what knows and mends loss switched off, one after the other.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchcmax import kernels, open
from torchcmax.core import so3
from torchcmax.core.contrast import gradient_magnitude
from torchcmax.core.pose import Pose
from torchcmax.core.state import State
from torchcmax.io import DataNote, Recording
from torchcmax.score import Similarity, score, similarity
from torchcmax.slam.glimpse import Glimpse
from torchcmax.slam.globe import WALL
from torchcmax.slam.map import Map
from torchcmax.slam.relocalize import APART, Grid
from torchcmax.slam.run import Run, still
from torchcmax.slam.system import Slam, System
from torchcmax.track import TrackOptions, load_kernels, track

KIDNAPPED = "shapes_lost_sim poster_6dof_sim slider_far_sim shapes_6dof_sim".split()
HALF = {"shapes_lost_sim": 3.9}  # s; where a camera leaves its map, the half ends before
WITHIN = 0.6  # s after which a camera counts as not found
LAG = 600  # us that events come after what they show
WRONG = 10.0  # px
OFF = 30.0, 10.0  # px, degrees


@dataclass(frozen=True)
class Half:
    """The map of the first half of a recording, and the similarity from its world to the truth's."""

    recording: Recording
    map: Map
    laid: Similarity
    end: float

    @classmethod
    def of(cls, recording: Recording) -> Half:
        """By a run of our own."""
        assert recording.truth is not None
        end = HALF.get(recording.name, float(recording.truth.time[-1]) * 0.5e-6)
        tracks = track(recording, TrackOptions(end=end))
        for _ in tracks:
            pass
        found = tracks.trajectory()
        assert isinstance(tracks.map, Map)
        return cls(recording, tracks.map, similarity(found.pose, recording.truth.at(found.time)), end)

    def truth(self, time: int) -> State:
        """Where the camera was at a time, us, in the map's world."""
        assert self.recording.truth is not None
        there, laid = self.recording.truth.at(torch.tensor([time - LAG])), self.laid
        return still(Pose(laid.R.mT @ there.R, (there.t - laid.t) @ laid.R / laid.scale))

    def moments(self, count: int) -> list[float]:
        """s, spread over the second half."""
        assert self.recording.truth is not None
        last = float(self.recording.truth.time[-1]) * 1e-6 - WITHIN
        return [self.end + (last - self.end) * (i + 0.5) / count for i in range(count)]

    def off(self, run: Run, found: State, time: int) -> tuple[float, float]:
        """px, median over the view, and degrees from the truth."""
        true = self.truth(time)
        back = torch.linalg.inv(found.placement(self.map.plane, self.map.view)[0])
        ray = run.rays @ (back @ true.placement(self.map.plane, self.map.view)[0]).mT
        px = (ray[:, :2] / ray[:, 2:] - run.rays[:, :2]).norm(dim=-1) * self.map.focal
        return float(px.median()), float(so3.log(found.pose.R.mT @ true.pose.R).norm().rad2deg())


def kidnapped(half: Half, count: int) -> dict[str, object]:
    """How many of the moments are found."""
    seen: list[tuple[float, float, float]] = []
    for begin in half.moments(count):
        system = System([half.recording.camera], Slam(), [half.map])
        run = system.runs[0]
        with half.recording.stream(begin) as stream:
            for one in system.run([stream]):
                if run.site is run.sites[0] and run.belief is not None:
                    at = int(run.belief.time[0])
                    seen.append((*half.off(run, run.belief.state, at), at * 1e-6 - begin))
                    break
                if one.time * 1e-6 > begin + WITHIN:
                    break
    return {
        "recording": half.recording.name, "moments": count, "believed": len(seen),
        "within 2 px, 1 deg": sum(px < 2 and degrees < 1 for px, degrees, _ in seen),
        "within 4 px, 2 deg": sum(px < 4 and degrees < 2 for px, degrees, _ in seen),
        "wrong": sum(px > WRONG for px, _, _ in seen),
        "median px": middle([px for px, _, _ in seen]), "median deg": middle([degrees for _, degrees, _ in seen]),
        "median s": middle([seconds for _, _, seconds in seen]), "longest s": round(max([s for _, _, s in seen], default=0.0), 2),
    }  # fmt: skip


def near(half: Half, count: int) -> dict[str, object]:
    """How many single windows are found around a place that is off."""
    recording, random, found = half.recording, torch.Generator().manual_seed(0), []
    run = System([recording.camera], Slam(), [half.map]).runs[0]
    grid, how = Grid(half.map, Slam().relocalizing), Slam().tracking
    for begin in half.moments(count):
        with recording.stream(begin) as stream:
            window = stream.look(how.most, how.seconds)
        assert window is not None
        true = half.truth(int(window.middle))
        turn, shift = torch.randn(1, 3, generator=random).double(), torch.randn(1, 3, generator=random).double()
        shift[:, 2] = 0
        away = true.seen(half.map.plane).distance
        turn = turn / turn.norm() * torch.tensor(OFF[1]).deg2rad()
        held = away * torch.stack([-turn[:, 1], turn[:, 0], torch.zeros(1)], -1)
        expected = still(true.pose @ Pose(so3.exp(turn), held + shift / shift.norm() * OFF[0] / half.map.focal * away))
        motion = run.shown(window).motion
        began = time.perf_counter()
        places = grid.near(Glimpse.of(window, motion, WALL.normal, run.sensor, run.border), expected)
        found.append((*half.off(run, places.state[:1], int(window.middle)), time.perf_counter() - began))
    return {
        "recording": recording.name, "windows": count, "within 2 px, 1 deg": sum(px < 2 and degrees < 1 for px, degrees, _ in found),
        "within 4 px": sum(px < APART for px, _, _ in found), "median s": middle([seconds for _, _, seconds in found]),
    }  # fmt: skip


SWITCHES: dict[str, Callable[[Slam], Slam]] = {
    "default": lambda s: s,
    "noise is tracked": lambda s: replace(s, sensing=replace(s.sensing, still=False)),
    "unsure windows are drawn": lambda s: replace(s, sensing=replace(s.sensing, certain=1e9, hopeless=1e9)),
    "no near search": lambda s: replace(s, relocalizing=replace(s.relocalizing, near=False)),
    "no global search": lambda s: replace(s, relocalizing=replace(s.relocalizing, far=False)),
    "no local maps": lambda s: replace(s, atlas=False),
    "no search, no local maps": lambda s: replace(s, atlas=False, relocalizing=replace(s.relocalizing, near=False, far=False)),
    "translation only": lambda s: replace(s, model="translation"),
}
PARTS = {"shapes_lost_sim": ((0.0, 3.9), (5.0, 8.0)), "slider_far_sim": ((0.0, 6.3),), "stop_and_go_sim": ((0.0, 4.0),)}


def whole(recording: Recording, slam: Slam) -> dict[str, object]:
    """One run, from nothing to the end."""
    began, tracks = time.perf_counter(), track(recording, TrackOptions(slam))
    for _ in tracks:
        pass
    seconds = time.perf_counter() - began
    path, placements = tracks.trajectory(), tracks.placements
    assert isinstance(tracks.map, Map)
    found: dict[str, object] = {"recording": recording.name}
    for first, last in PARTS[recording.name]:
        try:
            error = score(path, recording.truth, recording.plane, round(first * 1e6), round(last * 1e6))  # type: ignore[arg-type]
            text = f"{error.percent_of_distance:.2f} %, {error.orientation_rmse_deg:.2f} deg, coverage {error.coverage:.2f}"
        except ValueError:
            text = "no pose"
        found["error" if "error" not in found else "error, last part"] = text
    lost = sum(p.status == "lost" for p in placements)
    return found | {
        "lost windows": lost, "losses": tracks.losses, "recoveries": tracks.recoveries, "maps": len(tracks.atlas),
        "keyframes": len(tracks.map.keyframes), "sharpness": round(sharpness(tracks.map), 2), "seconds": round(seconds, 1),
    }  # fmt: skip


def sharpness(m: Map) -> float:
    """Gradient magnitude of the map's strength, of what is known."""
    layers = m.assembled(m.whole())
    known = (layers.most >= m.texture.exposure).double().mean()
    return float(gradient_magnitude(m.strength(layers)[None])[0] / known) * 1e4


def middle(values: Sequence[float]) -> float:
    """The median, rounded."""
    return round(float(torch.tensor(values).median()), 2) if values else float("nan")


def table(rows: Sequence[dict[str, object]]) -> None:
    """As Markdown."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns))
    for row in rows:
        print("| " + " | ".join(str(row.get(name, "")) for name in columns) + " |", flush=True)
    print()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--kidnapped", type=int, default=0, metavar="N", help="moments of each recording")
    parser.add_argument("--near", type=int, default=0, metavar="N", help="windows of each recording")
    parser.add_argument("--ablation", action="store_true")
    parser.add_argument("--threads", type=int, default=2, help="of the CPU's kernels")
    options = parser.parse_args()
    warnings.simplefilter("ignore", DataNote)
    torch.set_num_threads(1)
    kernels.set_threads(options.threads)
    load_kernels(Slam(), "cpu")
    if options.kidnapped or options.near:
        halves = [Half.of(open(options.data / name)) for name in KIDNAPPED]
        if options.kidnapped:
            table([kidnapped(half, options.kidnapped) for half in halves])
        if options.near:
            table([near(half, options.near) for half in halves])
    if options.ablation:
        for name in PARTS:
            table([{"switched": text} | whole(open(options.data / name), switch(Slam())) for text, switch in SWITCHES.items()])
    return 0


if __name__ == "__main__":
    sys.exit(main())
