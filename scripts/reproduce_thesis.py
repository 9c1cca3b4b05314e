"""The figures of the thesis draft, one function each: scripts/run python scripts/reproduce_thesis.py --out logs/thesis"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from torchcmax.core.camera import Canvas
from torchcmax.core.estimate import round_of
from torchcmax.core.minimize import Stop
from torchcmax.core.model import Displacement, Planar
from torchcmax.core.objective import Look
from torchcmax.core.pose import Motion
from torchcmax.core.window import Window
from torchcmax.folder import writing
from torchcmax.io import Recording, open
from torchcmax.panoimage import picture
from torchcmax.picture import captioned, pictures
from torchcmax.quality import quality
from torchcmax.score import score
from torchcmax.simulator import Simulation, simulate
from torchcmax.slam.globe import Globe
from torchcmax.slam.system import Panorama
from torchcmax.slam.tiles import spread
from torchcmax.track import TrackOptions, track

THESIS = Look(polarity="signed", reference="first", tilt=0.0)
"""How the draft looks at a window, eq. (2.1), (2.3). The guard is ours: without it the sharpest image is a collapsed one."""


def figure_2_3(recording: Recording, events: int, places: int) -> tuple[dict[str, object], Image.Image]:
    """A window in which a wrong (v, n) has at least the contrast of the truth: one window does not tell.

    Of `places` windows, and of the planes that the whole image could see, the one farthest from the truth is shown.
    """
    window, truth = with_truth(recording, events, places)
    model, canvas = Planar(recording.camera.fx), Canvas.around(recording.camera)
    x_true = model.parameters(truth)
    g = torch.Generator().manual_seed(0)
    starts = 8
    tilt = 1.4 * (torch.rand(len(window), starts, 2, generator=g) - 0.5) * model.focal
    tried = x_true[:, None].repeat(1, starts, 1)
    tried[:, 1:, 6:] = tilt[:, 1:]  # the first starts at the truth, the others look for a wrong plane
    stop = Stop(tolerance=1e-3, iterations=100)
    sharp = THESIS.at(window, canvas, 0.0)
    found = round_of(THESIS, model, THESIS.at(window, canvas, 1.0), tried.flatten(0, 1), stop)
    found = round_of(THESIS, model, sharp, found.x, stop)

    each = torch.arange(len(window))
    owner = each.repeat_interleave(starts)
    true_contrast = THESIS.sharpness(model.homography(x_true, each, 0.0), sharp, each)
    contrast, wrong = (-found.value).exp(), model.displacement(found.x, owner)
    angle = (wrong.normal * truth.normal[owner]).sum(-1).clamp(-1, 1).arccos().rad2deg()
    in_view = (
        wrong.normal @ recording.camera.rays()[:: recording.camera.size[0] - 1, :: recording.camera.size[1] - 1].flatten(0, 1).mT.float()
    ).amax(-1) < 0
    angle = torch.where((contrast >= true_contrast[owner]) & in_view, angle, -1.0)
    row = int(angle.argmax())
    if angle[row] < 5:
        raise SystemExit("figure 2.3: in none of these windows a wrong plane reaches the truth's contrast; take another recording")
    i = int(owner[row])
    report = {
        "figure": "2.3",
        "recording": recording.name,
        "window_start_us": int(window.start[i]),
        "events": events,
        "truth": {"contrast": true_contrast[i].item(), **spelled(truth, window, i, i)},
        "wrong": {"contrast": contrast[row].item(), **spelled(wrong, window, row, i)},
        "angle_between_the_normals_deg": angle[row].item(),
    }
    images = [x_true[i : i + 1], found.x[row : row + 1]]
    return report, side_by_side(window[i : i + 1], model, canvas, images, (true_contrast[i].item(), contrast[row].item()))


def with_truth(recording: Recording, events: int, places: int) -> tuple[Window, Displacement]:
    """Windows spread over the recording, with the true motion and plane in each one's first camera."""
    if recording.truth is None or recording.plane is None:
        raise SystemExit("figure 2.3 wants a recording with groundtruth.txt and plane.txt")
    total = recording.count or sum(len(chunk) for chunk in recording.chunks())
    window = next(recording.windows(events, max(1, (total - events) // max(1, places - 1)), places))
    pose, motion = recording.truth.at(window.start), recording.truth.motion(window.start, window.duration.double())
    plane, seconds = recording.plane.seen_from(pose), window.duration.double()[:, None]
    shift = motion.velocity / plane.distance[:, None] * seconds
    return window, Displacement((motion.omega * seconds).float(), shift.float(), plane.normal.float())


def spelled(displacement: Displacement, window: Window, row: int, i: int) -> dict[str, list[float]]:
    """Omega, v and n as the draft's captions give them: rad/s, plane distances/s."""
    motion = Motion(displacement.turn[row] / window.duration[i], displacement.shift[row] / window.duration[i])
    numbers = {"omega": motion.omega, "v": motion.velocity, "n": displacement.normal[row]}
    return {name: [round(value, 4) for value in vector.tolist()] for name, vector in numbers.items()}


def side_by_side(window: Window, model: Planar, canvas: Canvas, x: list[Tensor], contrast: tuple[float, float]) -> Image.Image:
    """Truth | wrong optimum, in colours."""
    none = torch.zeros(1, dtype=torch.int64)
    (picture,) = pictures(window, tuple(model.homography(p, none, 0.0) for p in x), canvas, 0.0)
    text = f"truth: contrast {contrast[0]:.5f} | wrong motion and plane: contrast {contrast[1]:.5f}"
    return Image.fromarray(captioned(picture, text))


def figure_2_6(recording: Recording) -> tuple[dict[str, object], Image.Image]:
    """A camera that only turns before a scene of any depth: every window on one panorama."""
    tracks = track(recording, TrackOptions(Panorama()))
    every = list(tracks)
    globe, path = tracks.map, tracks.trajectory()
    assert isinstance(globe, Globe)
    found = quality(globe.layers.votes, spread(globe.layers.most) > 0, globe.sphere)
    report: dict[str, object] = {
        "figure": "2.6", "recording": recording.name, "windows": len(every), "lost": sum(one.status == "lost" for one in every),
        "keyframes": len(globe.keyframes), **asdict(found),
    }  # fmt: skip
    if recording.truth is not None:
        report["orientation_rmse_deg"] = score(path, recording.truth, rotation_only=True).orientation_rmse_deg
    return report, Image.fromarray(picture(globe, path.pose.R, f"panorama of {recording.name}", cropped=True))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recording", help="with groundtruth.txt and plane.txt; default: a built-in slider before a poster")
    parser.add_argument("--panorama", help="of a camera that only turns; default: the built-in one that looks round")
    parser.add_argument("--out", type=Path, default=Path("logs/thesis"), help="folder for the figures")
    parser.add_argument("--events", type=int, default=10000, help="events in a window")
    parser.add_argument("--places", type=int, default=6, help="windows looked at")
    options = parser.parse_args()
    torch.set_num_threads(1)
    built_in = Simulation(scene="poster", motion="slider", duration=0.4, tilt=(0.0, 0.0))
    recording = open(options.recording) if options.recording else simulate(built_in)
    looking = Simulation(scene="panorama", motion="rotation", duration=1.0)
    keep(options.out, *figure_2_3(recording, options.events, options.places))
    keep(options.out, *figure_2_6(open(options.panorama) if options.panorama else simulate(looking)))
    return 0


def keep(folder: Path, report: dict[str, object], drawn: Image.Image) -> None:
    """A figure in its folder: the picture, and what is said of it."""
    stem = f"figure_{str(report['figure']).replace('.', '_')}"
    folder.mkdir(parents=True, exist_ok=True)
    with writing(folder / f"{stem}.png") as name:
        drawn.save(name, format="PNG")
    with writing(folder / f"{stem}.json") as name:
        name.write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report, indent=1))
    print(f"picture: {folder / f'{stem}.png'}")


if __name__ == "__main__":
    sys.exit(main())
