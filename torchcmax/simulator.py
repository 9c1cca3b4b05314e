"""Built-in recordings: a camera on a closed-form path before a textured plane or in a panorama, and the events its sensor makes."""

from __future__ import annotations

import difflib
import math
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.io.errors import DataError
from torchcmax.io.hdf5 import save
from torchcmax.io.recording import Events, Recording
from torchcmax.io.trajectory import read_trajectory, write_plane, write_trajectory, write_velocity
from torchcmax.path import Path as CameraPath
from torchcmax.sensor import Response, Sensor
from torchcmax.texture import SCENES, texture, view

STEP = 0.5  # px: no pixel moves farther between two frames
WARM_UP = 0.03  # s before the first event, so that the sensor's filters and levels are those of a camera that has been moving
FRAMES = 64  # rendered for one chunk of events
CHUNK = 1 << 20  # events after which a chunk ends sooner
BLOCK = 4096  # times looked at at once, so that the memory doesn't grow with the duration
Waves = tuple[tuple[tuple[float, float, float], ...], ...]  # per axis x, y, z: (amplitude, frequency Hz, phase rad)
STILL: Waves = ((), (), ())
SHIFT: Waves = (((0.125, 0.7, 0.3), (0.035, 1.9, 1.0)), ((0.088, 0.9, 2.6), (0.031, 2.1, 0.4)), ((0.088, 0.6, 3.5), (0.025, 1.7, 2.0)))
TURN: Waves = (((0.15, 0.8, 0.4), (0.075, 2.0, 3.0)), ((0.225, 0.6, 3.3), (0.1, 1.8, 1.2)), ((0.25, 0.9, 0.2), (0.088, 2.2, 2.2)))
LOOK_ROUND: Waves = (((0.25, 0.5, 2.9), (0.06, 1.6, 0.5)), ((1.60, 0.2, 0.2), (0.15, 1.1, 1.0)), ((0.20, 0.6, 1.2), (0.07, 1.9, 2.4)))
NOD: Waves = (((0.30, 0.45, 0.0), (0.05, 1.7, 0.5)), (), ((0.10, 0.35, 0.8), (0.04, 1.3, 2.0)))
MOTIONS = {
    "6dof": (SHIFT, TURN), "translation": (SHIFT, STILL), "rotation": (STILL, TURN), "slider": (STILL, STILL), "sweep": (STILL, NOD),
}  # fmt: skip
SLIDER = 0.3  # m/s along x
SWEEP = 2 * math.pi / 3  # rad/s about the vertical: two times round in 6 s
LIMITS: dict[str, tuple[float, float, str]] = {  # of an option, both allowed: what is beyond wants years, terabytes or more than µs
    "duration": (0.001, 600, " s"), "speed": (0, 100, ""), "distance": (0.01, 10_000, " m"), "width": (8, 2048, " px"),
    "height": (8, 2048, " px"), "focal": (8, 100_000, " px"), "threshold": (0.01, 10, ""), "mismatch": (0, 10, ""),
    "noise": (0, 1000, " Hz"), "refractory": (0, 1000, " ms"), "bandwidth": (1, 1_000_000, " Hz"), "seed": (0, 2**63 - 1, ""),
}  # fmt: skip
MOST_FRAMES = 20_000_000  # of one recording: hours of rendering
FILES = {"README.md", "calib.txt", "events.h5", "groundtruth.txt", "plane.txt", "texture.png", "velocity.txt"}
REMEDY = "choose another folder, or make room on the disk"
MARK = "Simulated by torchcmax.simulator."  # in the README of a folder that may be replaced
README = """# {name}

{mark} {count} events with exact ground truth.

* events.h5: events/t int64 us, sorted; events/x, events/y (column, row) raw distorted pixels; events/p 1 = brighter, 0 = darker;
  with calibration, ground truth and plane, so that it can stand alone; opened as a folder, the text files count
* calib.txt: fx fy cx cy k1 k2 p1 p2 k3, as OpenCV; pixel centres at integers
* groundtruth.txt (1 kHz): t tx ty tz qx qy qz qw, camera to world, metres; x right, y down, z forward; the world is the first camera,
  or that of the trajectory
* velocity.txt (1 kHz): t vx vy vz wx wy wz in the camera's frame, m/s and rad/s, from the closed form of the path
* plane.txt (not with a panorama): nx ny nz d with n . X + d = 0 in the world, n unit and towards the camera
* texture.png: the log intensity, reduced, to look at

Every distorted pixel is cast as a ray on the texture, blurred as by a lens, so often that none moves farther than half a pixel
between two frames.  Sensor: low-pass, per-pixel thresholds, crossing times interpolated between frames, refractory time, Poisson noise.

{lines}
"""


@dataclass(frozen=True)
class Simulation:
    """What is simulated.  The same options give the same events, byte for byte."""

    scene: str = "poster"
    """What the camera sees: poster, shapes, lines: a plane; panorama: a sphere at infinity; or the path of a picture for the plane."""
    motion: str = "6dof"
    """How the camera moves: 6dof, translation, rotation, slider (constant velocity along x), or sweep (round and round at 120 deg/s, with
    nods); a panorama wants rotation or sweep."""
    trajectory: str = ""
    """Path of a file of poses to follow instead, smoothly: lines t tx ty tz qx qy qz qw, s, m, camera to world, as a rig's ground truth has
    them. Clock, duration and world are those of the file; the plane lies before its first camera."""
    duration: float = 1.0
    """Length of the recording, s: 0.001 to 600."""
    speed: float = 1.0
    """How many times as fast as usual the camera goes along the same path: 0 (stands still) to 100."""
    tilt: tuple[float, float] = (8.0, -10.0)
    """Tilt of the plane about the first image's x and y axis, deg: each between -60 and 60."""
    distance: float = 0.8
    """Distance from the first camera to the plane along the optical axis, m: 0.01 to 10000."""
    width: int = 240
    """Width of the sensor, px: 8 to 2048."""
    height: int = 180
    """Height of the sensor, px: 8 to 2048."""
    focal: float = 200.0
    """Focal length of the lens, px: 8 to 100000."""
    distortion: tuple[float, float, float, float, float] = (-0.35, 0.13, 0.0, 0.0, 0.0)
    """Distortion of the lens, k1 k2 p1 p2 k3 as in OpenCV (no unit)."""
    threshold: float = 0.25
    """Change of log intensity that makes an event: 0.01 to 10."""
    mismatch: float = 0.035
    """Standard deviation of the pixels' thresholds about it, log intensity: 0 to 10."""
    noise: float = 1.0
    """Rate of events of random polarity that mean nothing, Hz per pixel: 0 to 1000; those in the refractory time are not seen."""
    refractory: float = 0.5
    """Time after an event in which its pixel is blind, ms: 0 to 1000."""
    bandwidth: float = 600.0
    """Cut-off frequency of the photoreceptor's low-pass, Hz: 1 to 1000000, or 0 for no low-pass."""
    seed: int = 0
    """Seed of the random texture, thresholds and noise, 0 or more; the motion is always the same."""

    def __post_init__(self) -> None:
        if self.scene not in SCENES and not os.path.isfile(self.scene):
            raise ValueError(_unknown("scene", self.scene, SCENES, ", or the path of a picture"))
        if self.motion not in MOTIONS:
            raise ValueError(_unknown("motion", self.motion, MOTIONS))
        if self.path is not None:
            if self.speed != 1:
                raise ValueError(f"a trajectory has a speed of its own: speed wants 1, got {self.speed}")
            object.__setattr__(self, "duration", float(self.path.time[-1]))
        elif self.scene == "panorama" and self.motion not in ("rotation", "sweep"):
            raise ValueError(f"a panorama is infinitely far and shows rotation only: motion wants rotation or sweep, got {self.motion!r}")
        elif self.motion == "sweep" and self.scene != "panorama":
            raise ValueError(f"a sweep goes round and wants something to see everywhere: scene wants panorama, got {self.scene!r}")
        for name, (least, most, unit) in LIMITS.items():
            if not least <= getattr(self, name) <= most and not (name == "bandwidth" and self.bandwidth == 0):
                zero = "0, or " if name == "bandwidth" else ""
                raise ValueError(f"{name} wants {zero}{least} to {most}{unit}, got {getattr(self, name)}")
        if len(self.tilt) != 2 or not all(abs(a) < 60 for a in self.tilt):
            raise ValueError(f"tilt wants two angles between -60 and 60 deg, got {self.tilt}")
        _ = self.camera  # it checks the rest
        plane = self.plane
        if plane is not None and self.path is not None and plane.seen_from(self.path.pose[:1].inverse()).distance <= 0:
            raise ValueError(
                f"{self.trajectory}: the origin of its world would lie behind the plane: take a larger distance than {self.distance} m, "
                "or another world"
            )

    @cached_property
    def path(self) -> CameraPath | None:
        """What the trajectory's file holds; None without one."""
        return CameraPath.through(read_trajectory(Path(self.trajectory))) if self.trajectory else None

    @property
    def origin(self) -> Pose:
        """The first camera [1] in the world of the recording."""
        if self.path is not None:
            return self.path.pose[:1]
        return Pose(torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))

    @property
    def camera(self) -> Camera:
        """With the distortion, and the principal point in the middle."""
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera((self.height, self.width), self.focal, self.focal, *centre, tuple(self.distortion))

    @property
    def response(self) -> Response:
        """What the sensor's pixels are like."""
        return Response(self.threshold, self.mismatch, self.noise, self.refractory, self.bandwidth)

    @property
    def plane(self) -> Plane | None:
        """In the first camera's frame, m; the panorama has none."""
        if self.scene == "panorama":
            return None
        normal = Plane.tilted(torch.tensor([self.tilt], dtype=torch.float64).deg2rad()).normal
        return Plane(normal, -self.distance * normal[:, 2])


def _unknown(option: str, got: str, names: tuple[str, ...] | dict[str, tuple[Waves, Waves]], more: str = "") -> str:
    near = difflib.get_close_matches(got, names, 1, 0.0)[0]
    return f"{option} wants one of {', '.join(names)}{more}; got {got!r}: did you mean {near!r}?"


def _waves(options: Simulation, time: Tensor, which: int) -> tuple[Tensor, Tensor]:
    """Sum of sinusoids, zero at time zero, and its derivative: time [M] s | which 0 position, 1 rotation vector -> [M, 3], [M, 3]."""
    waves = LOOK_ROUND if options.scene == "panorama" and options.motion == "rotation" and which else MOTIONS[options.motion][which]
    value = torch.zeros(len(time), 3, dtype=torch.float64)
    rate = torch.zeros_like(value)
    for axis, terms in enumerate(waves):
        for amplitude, frequency, phase in terms:
            omega = 2 * math.pi * frequency * options.speed
            value[:, axis] += amplitude * ((omega * time + phase).sin() - math.sin(phase))
            rate[:, axis] += amplitude * omega * (omega * time + phase).cos()
    if options.motion == "slider" and which == 0:
        value[:, 0], rate[:, 0] = SLIDER * options.speed * time, SLIDER * options.speed
    return value, rate


def _sweep(options: Simulation) -> Tensor:
    """Angular velocity in the world that is added to the waves: [3] rad/s."""
    return torch.tensor([0.0, SWEEP * options.speed if options.motion == "sweep" else 0.0, 0.0], dtype=torch.float64)


def pose(options: Simulation, time: Tensor) -> Pose:
    """In the first camera's frame, in closed form: time [M] s since the start, float64 -> Pose [M], m."""
    if options.path is not None:
        return options.origin.inverse() @ options.path.at(time)[0]
    turn = so3.exp(_waves(options, time, 1)[0])
    return Pose(so3.exp(_sweep(options) * time[:, None]) @ turn if options.motion == "sweep" else turn, _waves(options, time, 0)[0])


def velocity(options: Simulation, time: Tensor) -> Motion:
    """Velocity of the camera in its own frame, in closed form: time [M] s since the start, float64 -> Motion [M], rad/s and m/s."""
    if options.path is not None:
        return options.path.at(time)[1]
    (turn, turn_rate), (_, shift_rate) = _waves(options, time, 1), _waves(options, time, 0)
    omega = (so3.right_jacobian(turn) @ turn_rate[..., None])[..., 0]
    back = so3.exp(turn).mT
    return Motion(omega + back @ _sweep(options), (back @ shift_rate[..., None])[..., 0])


def simulate(options: Simulation) -> Recording:
    """The recording.  Its events are rendered as they are asked for, and are the same each time."""
    milliseconds = torch.arange(math.ceil(options.duration * 1000 - 1e-9) + 1)
    poses = [pose(options, part.double() / 1000) for part in milliseconds.split(BLOCK)]
    start, there = _start(options), options.origin @ Pose(torch.cat([p.R for p in poses]), torch.cat([p.t for p in poses]))
    truth, plane = Trajectory(start + milliseconds * 1000, there), options.plane
    motion = Path(options.trajectory).stem if options.trajectory else options.motion
    name = f"{options.scene if options.scene in SCENES else Path(options.scene).stem}_{motion}"
    frames = _frame_times(options)  # now, so that what cannot be simulated is said now
    chunks = partial(_chunks, options, frames)
    return Recording(Path("simulated"), name, options.camera, chunks, None, truth, plane and plane.seen_from(options.origin.inverse()))


def _start(options: Simulation) -> int:
    """µs of the recording's clock at which the camera starts."""
    return options.path.start if options.path is not None else 0


def _frame_times(options: Simulation) -> np.ndarray:
    """When to render: so often that no pixel moves farther than STEP, and every 2 ms at least: -> [F] int64 µs, from the warm-up on."""
    end = round(options.duration * 1e6)
    time = torch.linspace(-WARM_UP, options.duration, math.ceil((WARM_UP + options.duration) * 1000) + 1, dtype=torch.float64)
    fastest = torch.cat([_pixel_speed(options, part) for part in time.split(BLOCK)])
    rate = (fastest * 1.05 / STEP).clamp(min=500).numpy()  # frames per second; between the samples it may be more
    passed = np.concatenate([[0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(time.numpy()))])
    if rate.max() > 1e6 or passed[-1] > MOST_FRAMES:
        raise ValueError(
            f"pixels move at up to {fastest.max().item():.3g} px/s, which wants {passed[-1]:.3g} frames, {rate.max():.3g} in a second; "
            f"at most {MOST_FRAMES} can be, and 1000000 in a second: take a lower speed than {options.speed}, "
            f"a shorter duration than {options.duration} s, or a shorter focal length than {options.focal} px"
        )
    frames = np.interp(np.linspace(0, passed[-1], math.ceil(passed[-1]) + 1), passed, time.numpy())
    return np.unique(np.append((frames * 1e6).round().astype(np.int64)[:-1], end))


def _pixel_speed(options: Simulation, time: Tensor) -> Tensor:
    """Speed of the fastest of some sensor pixels: time [M] s -> [M] px/s."""
    table = _rays(options)
    y, x = (torch.linspace(1, n - 2, 9).round().long() for n in table.shape[:2])
    here = torch.meshgrid(y, x, indexing="ij")
    columns = [table[here[0], here[1] + 1] - table[here[0], here[1] - 1], table[here[0] + 1, here[1]] - table[here[0] - 1, here[1]]]
    to_pixels = torch.linalg.inv(torch.stack([c[..., :2].reshape(-1, 2) / 2 for c in columns], -1))  # [G, 2, 2], lens included
    ray, motion, near = table[here].view(-1, 3), velocity(options, time), torch.zeros(len(time), 81, dtype=torch.float64)
    if options.plane is not None:
        near = _inverse_depth(options.plane, pose(options, time), ray)
        if not (near > 0.15 / options.distance).all():
            bad = time[(near <= 0.15 / options.distance).any(-1)][0].item()
            raise ValueError(
                f"at {bad:.3f} s the camera looks past the plane's horizon or is behind it: take a smaller tilt than {options.tilt} deg, "
                f"a larger distance than {options.distance} m, a longer focal length than {options.focal} px, "
                f"a shorter duration than {options.duration} s, or another motion than {options.motion}"
            )
    flow = -torch.linalg.cross(motion.omega[:, None], ray[None]) - near[..., None] * motion.velocity[:, None]  # of the point, per depth
    flow = flow[..., :2] - ray[:, :2] * flow[..., 2:]
    fastest: Tensor = (to_pixels @ flow[..., None])[..., 0].norm(dim=-1).amax(-1)
    return fastest


def _rays(options: Simulation) -> Tensor:
    """Ray of every pixel: -> [H, W, 3].  A lens that has none is an option to change."""
    try:
        return options.camera.rays()
    except ValueError as error:
        raise ValueError(
            f"{error}; take a weaker distortion than {options.distortion}, a longer focal length than {options.focal} px, "
            f"or a smaller width and height than {options.width} x {options.height} px"
        ) from error


def _inverse_depth(plane: Plane, at: Pose, ray: Tensor) -> Tensor:
    """Of the plane along rays (x, y, 1), negative behind a camera or its horizon: at [M] | ray [G, 3] -> [M, G] 1/m."""
    here = plane.seen_from(at)
    inverse = -(ray @ here.normal.mT).mT / here.distance[:, None]
    return torch.where(here.distance[:, None] > 0, inverse, -1.0)


def _chunks(options: Simulation, frames: np.ndarray) -> Iterator[Events]:
    """Render the frames and let the sensor look at them: frames [F] µs -> events of FRAMES frames at a time."""
    look = view(texture(options.scene, options.seed, options.focal), options.camera, options.plane, options.distance)
    sensor = Sensor(options.response, options.seed, look(pose(options, torch.from_numpy(frames[:1] * 1e-6))))
    parts: list[Events] = []
    for first in range(0, len(frames) - 1, FRAMES):
        times = frames[first : first + FRAMES + 1]
        poses = pose(options, torch.from_numpy(times * 1e-6))
        for k in range(1, len(times)):
            t, pixel, p = sensor.step(look(poses[k : k + 1]), int(times[k - 1]), int(times[k]))
            y, x = np.divmod(pixel, options.width)
            parts.append(Events(t, x.astype(np.uint16), y.astype(np.uint16), p))
            if k == len(times) - 1 or sum(map(len, parts)) >= CHUNK:
                block, parts = Events.join(parts), []
                block = block[block.t >= 0]
                yield replace(block, t=block.t + _start(options))


def write(options: Simulation, folder: Path, progress: Callable[[float], None] | None = None) -> Path:
    """The recording as files, which appear all at once: events.h5, calib.txt, ground truth -> the folder.

    progress is told the seconds that are done.  Only a folder with nothing but an earlier simulation is replaced; links are followed.
    """
    target = _target(folder)  # all that can be known to go wrong is said before the work
    recording = simulate(options)
    part = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        part.mkdir(parents=True)
        count = _write_events(part / "events.h5", recording, _start(options), progress)
        _write_texts(part, options, recording, count)
        if _target(folder).exists():  # asked again: it may have been filled meanwhile
            shutil.rmtree(target)
        part.rename(target)
    except OSError as error:
        raise DataError(folder, f"cannot be written: {error}", REMEDY) from error
    except DataError as error:
        if part not in error.path.parents:
            raise
        problem = error.problem.replace(str(part), str(folder))
        raise DataError(folder / error.path.relative_to(part), problem, error.remedy, error.place) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return folder


def _target(folder: Path) -> Path:
    """Where the folder really is, links followed; DataError if it must not or cannot be written."""
    try:
        target = folder.resolve()
        exists = target.exists()
        near = next(parent for parent in (target.parent, *target.parents) if parent.exists())
    except (OSError, RuntimeError, StopIteration) as error:  # a link to itself, the root
        raise DataError(folder, f"cannot be written: {error}", REMEDY) from error
    if exists and not _ours(target):
        raise DataError(folder, "exists and was not written by the simulator", "choose another folder, or remove this one")
    if exists and target.is_mount():
        raise DataError(folder, "cannot be written: it is a mount point, which cannot be replaced", "choose a folder in it")
    for place in (near, target) if exists else (near,):
        if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
            raise DataError(folder, f"cannot be written: {place} is no folder that you may write to", REMEDY)
    return target


def _ours(folder: Path) -> bool:
    """An empty folder, or one with an earlier simulation and nothing else."""
    try:
        names = {path.name for path in folder.iterdir()}
        return not names or (names <= FILES and "README.md" in names and MARK in (folder / "README.md").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return False


def _write_events(path: Path, recording: Recording, start: int, progress: Callable[[float], None] | None) -> int:
    """events.h5, chunk by chunk: -> number of events."""
    count = 0

    def counted() -> Iterator[Events]:
        nonlocal count
        for chunk in recording.chunks():
            yield chunk
            count += len(chunk)
            if progress is not None and len(chunk):
                progress(float(chunk.t[-1] - start) * 1e-6)

    save(replace(recording, chunks=counted), path)
    return count


def _write_texts(folder: Path, options: Simulation, recording: Recording, count: int) -> None:
    """Everything but the events."""
    assert recording.truth is not None
    write_trajectory(folder / "groundtruth.txt", recording.truth)
    time = recording.truth.time
    motions = [velocity(options, part.double() * 1e-6) for part in (time - _start(options)).split(BLOCK)]
    motion = Motion(torch.cat([m.omega for m in motions]), torch.cat([m.velocity for m in motions]))
    write_velocity(folder / "velocity.txt", time, motion)
    if recording.plane is not None:
        write_plane(folder / "plane.txt", recording.plane)
    camera = recording.camera
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    (folder / "calib.txt").write_text(" ".join(map(repr, numbers)) + "\n", encoding="utf-8")
    picture = texture(options.scene, options.seed, options.focal).picture().numpy()
    low, high = np.percentile(picture, [0.5, 99.5])
    grey = Image.fromarray(((picture - low) / max(high - low, 1e-6) * 255).clip(0, 255).astype(np.uint8))
    grey.thumbnail((800, 800))
    grey.save(folder / "texture.png")
    lines = "\n".join(f"* {f.name}: {getattr(options, f.name)}" for f in fields(options))
    (folder / "README.md").write_text(README.format(name=recording.name, mark=MARK, count=count, lines=lines), encoding="utf-8")
