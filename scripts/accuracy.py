"""How exact the estimator is, on recordings kept beside the checkout: python scripts/accuracy.py --data ../shared/data

Prints the table that the README quotes. tests/core/test_estimate.py holds the same numbers against the bars.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import torch
from torch import Tensor

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.estimate import Estimate, Search, best_of, estimate, round_of
from torchcmax.core.minimize import Minimum
from torchcmax.core.model import MODELS, Model, PlanarKnown, Rotation
from torchcmax.core.objective import Look
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion
from torchcmax.core.warp import transfer
from torchcmax.core.window import Window
from torchcmax.io import Recording, open

ROTATIONS = {"boxes_rotation_13s": (0.583, -1.208, 0.065), "shapes_rotation_2s": (-0.071, 0.663, -0.128)}
"""rad/s, as several estimators agree."""
FAST = ("boxes_rotation", "dynamic_rotation", "boxes_translation", "shapes_translation")
PLANAR = ("poster_6dof_sim", "shapes_6dof_sim", "poster_translation_sim", "slider_far_sim")


def whole(folder: Path) -> tuple[Camera, Window]:
    """A recording as one window."""
    recording = open(folder)
    (window,) = recording.windows(sum(len(chunk) for chunk in recording.chunks()))
    return recording.camera, window


def from_random_starts(window: Window, camera: Camera, model: Model, count: int = 50) -> Minimum:
    """The best that a search from random displacements of up to 40 px finds in one window."""
    look, search = Look(), Search()
    view = look.at(window, Canvas.around(camera, search.margin), search.blur[-1])
    x = 80 * (torch.rand(count, model.size, generator=torch.Generator().manual_seed(0)) - 0.5)
    for part in (*(view.blurred(sigma) for sigma in search.blur[:-1]), view):
        every = round_of(look, model, part, x, search.stop)
        x = every.x
    return best_of(every, 1)


def sample(recording: Recording, count: int, events: int = 30000) -> tuple[Window, Motion, Plane]:
    """Windows spread evenly over a recording, with their true motion and plane in the frame of their first event."""
    assert recording.count is not None
    assert recording.truth is not None
    assert recording.plane is not None
    window = next(recording.windows(events, (recording.count - events) // (count - 1), count))
    motion, pose = recording.truth.motion(window.start, window.duration.double()), recording.truth.at(window.start)
    plane = recording.plane.seen_from(pose)
    truth = Motion(motion.omega, motion.velocity / plane.distance[:, None])
    return window, truth, Plane(plane.normal, torch.ones(count, dtype=torch.float64))


def end_point_error(window: Window, found: Estimate, truth: Motion, plane: Plane, focal: float) -> Tensor:
    """Median over a window's events of the distance between where the two motions warp them, px: [B]."""

    def warped(motion: Motion, plane: Plane) -> Tensor:
        pose = Motion(motion.omega.double(), motion.velocity.double()).at(window.dt.double())
        ray = transfer(window.ray.double(), pose, plane)
        return focal * ray[..., :2] / ray[..., 2:]

    estimated = plane if found.normal is None else Plane(found.normal.double(), plane.distance)
    error: Tensor = (warped(found.motion, estimated) - warped(truth, plane)).norm(dim=-1).median(-1).values
    return error


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with real/ecd and sim")
    parser.add_argument("--windows", type=int, default=20, help="windows of each simulated recording")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| window | result |\n|---|---|")
    for name, known in ROTATIONS.items():
        camera, window = whole(options.data / "real/ecd" / name)
        found = estimate(window, camera, Rotation(camera.fx))
        error = (found.motion.omega[0] - torch.tensor(known)).norm().item() * 180 / math.pi
        print(f"| {name} | {error:.2f} deg/s from the best known rotation, {int(found.evaluations[0])} evaluations |")
    for name in FAST:
        camera, window = whole(options.data / "real/ecd" / name)
        model = MODELS[name.split("_")[1]](camera.fx)
        found, best = estimate(window, camera, model), from_random_starts(window, camera, model)
        share = (found.gain - 1) / ((-best.value).exp() / found.contrast_zero - 1)
        print(f"| {name} | {100 * share.item():.3f} % of the gain that 50 random starts find |")
    for name in PLANAR:
        recording = open(options.data / "sim" / name)
        window, truth, plane = sample(recording, options.windows)
        for kind, model in (("known", PlanarKnown(recording.camera.fx, plane.normal)), ("free", MODELS["planar"](recording.camera.fx))):
            found = estimate(window, recording.camera, model)
            error = end_point_error(window, found, truth, plane, recording.camera.fx)
            middle, most, above = error.median().item(), error.quantile(0.9).item(), int((error > 0.5).sum())
            text = f"| {name}, plane {kind} | median end-point error {middle:.3f} px, 90 % below {most:.2f} px"
            text += f", {above} of {len(error)} above 0.5 px"
            if kind == "free" and found.normal is not None:
                angle = (found.normal.double() * plane.normal).sum(-1).clamp(-1, 1).arccos().rad2deg()
                text += f", normal off by {angle.median().item():.1f} deg"
            print(text + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
