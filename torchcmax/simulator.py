"""Built-in recordings: a camera on a closed-form path before a textured plane or in a panorama, and the events its sensor makes."""

from __future__ import annotations

import difflib
import math
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose, Trajectory
from torchcmax.io.errors import DataError
from torchcmax.io.recording import Events, Recording
from torchcmax.io.trajectory import write_plane, write_trajectory, write_velocity
from torchcmax.texture import SCENES, texture, view

STEP = 0.5  # px: no pixel moves farther between two frames
WARM_UP = 0.03  # s before the first event, so that the sensor's filters and levels are those of a camera that has been moving
FRAMES = 64  # rendered for one chunk of events
Waves = tuple[tuple[tuple[float, float, float], ...], ...]  # per axis x, y, z: (amplitude, frequency Hz, phase rad)
STILL: Waves = ((), (), ())
SHIFT: Waves = (((0.125, 0.7, 0.3), (0.035, 1.9, 1.0)), ((0.088, 0.9, 2.6), (0.031, 2.1, 0.4)), ((0.088, 0.6, 3.5), (0.025, 1.7, 2.0)))
TURN: Waves = (((0.15, 0.8, 0.4), (0.075, 2.0, 3.0)), ((0.225, 0.6, 3.3), (0.1, 1.8, 1.2)), ((0.25, 0.9, 0.2), (0.088, 2.2, 2.2)))
LOOK_ROUND: Waves = (((0.25, 0.5, 2.9), (0.06, 1.6, 0.5)), ((1.60, 0.2, 0.2), (0.15, 1.1, 1.0)), ((0.20, 0.6, 1.2), (0.07, 1.9, 2.4)))
MOTIONS = {"6dof": (SHIFT, TURN), "translation": (SHIFT, STILL), "rotation": (STILL, TURN), "slider": (STILL, STILL)}
SLIDER = 0.3  # m/s along x
FILES = {"README.md", "calib.txt", "events.h5", "groundtruth.txt", "plane.txt", "texture.png", "velocity.txt"}
MARK = "Simulated by torchcmax.simulator."  # in the README of a folder that may be replaced


README = """# {name}

{mark} {count} events with exact ground truth.

* events.h5: events/t int64 us, sorted; events/x, events/y (column, row) raw distorted pixels; events/p 1 = brighter, 0 = darker
* calib.txt: fx fy cx cy k1 k2 p1 p2 k3, as OpenCV; pixel centres at integers
* groundtruth.txt (1 kHz): t tx ty tz qx qy qz qw, camera to world, metres; x right, y down, z forward; the world is the first camera
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
    """poster, shapes, lines: a plane; panorama: a sphere at infinity; or the path of a picture for the plane."""
    motion: str = "6dof"
    """6dof, translation, rotation, or slider (constant velocity along x); a panorama wants rotation."""
    duration: float = 1.0
    """s."""
    speed: float = 1.0
    """Times the rates of the motion, along the same path; 0 stands still."""
    tilt: tuple[float, float] = (8.0, -10.0)
    """deg, of the plane about the first image's x and y axis."""
    distance: float = 0.8
    """m, from the first camera to the plane along the optical axis."""
    width: int = 240
    """px."""
    height: int = 180
    """px."""
    focal: float = 200.0
    """px."""
    distortion: tuple[float, float, float, float, float] = (-0.35, 0.13, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 k3, as OpenCV."""
    threshold: float = 0.25
    """Change of log intensity that makes an event."""
    mismatch: float = 0.035
    """Standard deviation of the pixels' thresholds."""
    noise: float = 1.0
    """Hz per pixel: events of random polarity that mean nothing."""
    refractory: float = 0.5
    """ms after an event in which its pixel is blind."""
    bandwidth: float = 600.0
    """Hz of the photoreceptor's low-pass; 0 for none."""
    seed: int = 0
    """Of the texture, the thresholds and the noise; the motion is always the same."""

    def __post_init__(self) -> None:
        if self.scene not in SCENES and not Path(self.scene).is_file():
            raise ValueError(_unknown("scene", self.scene, SCENES, ", or the path of a picture"))
        if self.motion not in MOTIONS:
            raise ValueError(_unknown("motion", self.motion, MOTIONS))
        if self.scene == "panorama" and self.motion != "rotation":
            raise ValueError(f"a panorama is infinitely far and shows rotation only: motion wants rotation, got {self.motion!r}")
        for name in ("duration", "distance", "focal", "threshold"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} wants a positive number, got {getattr(self, name)}")
        for name in ("speed", "mismatch", "noise", "refractory", "bandwidth", "seed"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} wants a number of at least 0, got {getattr(self, name)}")
        if len(self.tilt) != 2 or not max(abs(a) for a in self.tilt) < 60:
            raise ValueError(f"tilt wants two angles between -60 and 60 deg, got {self.tilt}")
        if min(self.width, self.height) < 8 or max(self.width, self.height) > 65535:
            raise ValueError(f"a sensor wants a width and height of 8 to 65535 px, got {self.width} x {self.height}")
        _ = self.camera  # it checks the rest

    @property
    def camera(self) -> Camera:
        """With the distortion, and the principal point in the middle."""
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera((self.height, self.width), self.focal, self.focal, *centre, tuple(self.distortion))

    @property
    def plane(self) -> Plane | None:
        """In the world frame, m; the panorama has none."""
        if self.scene == "panorama":
            return None
        normal = Plane.tilted(torch.tensor([self.tilt], dtype=torch.float64).deg2rad()).normal
        return Plane(normal, -self.distance * normal[:, 2])


def _unknown(option: str, got: str, names: tuple[str, ...] | dict[str, tuple[Waves, Waves]], more: str = "") -> str:
    near = difflib.get_close_matches(got, names, 1, 0.0)[0]
    return f"{option} wants one of {', '.join(names)}{more}; got {got!r}: did you mean {near!r}?"


def _waves(options: Simulation, time: Tensor, which: int) -> tuple[Tensor, Tensor]:
    """Sum of sinusoids, zero at time zero, and its derivative: time [M] s | which 0 position, 1 rotation vector -> [M, 3], [M, 3]."""
    waves = LOOK_ROUND if options.scene == "panorama" and which else MOTIONS[options.motion][which]
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


def pose(options: Simulation, time: Tensor) -> Pose:
    """T_wc in closed form: time [M] s, float64 -> Pose [M], m."""
    return Pose(so3.exp(_waves(options, time, 1)[0]), _waves(options, time, 0)[0])


def velocity(options: Simulation, time: Tensor) -> Motion:
    """Velocity of the camera in its own frame, in closed form: time [M] s, float64 -> Motion [M], rad/s and m/s."""
    (turn, turn_rate), (_, shift_rate) = _waves(options, time, 1), _waves(options, time, 0)
    omega = (so3.right_jacobian(turn) @ turn_rate[..., None])[..., 0]
    return Motion(omega, (so3.exp(turn).mT @ shift_rate[..., None])[..., 0])


def simulate(options: Simulation) -> Recording:
    """The recording.  Its events are rendered as they are asked for, and are the same each time."""
    milliseconds = torch.arange(math.ceil(options.duration * 1000 - 1e-9) + 1)
    truth = Trajectory(milliseconds * 1000, pose(options, milliseconds.double() / 1000))
    name = f"{options.scene if options.scene in SCENES else Path(options.scene).stem}_{options.motion}"
    frames = _frame_times(options)  # now, so that what cannot be simulated is said now
    chunks = partial(_chunks, options, frames)
    return Recording(Path("simulated"), name, options.camera, chunks, None, truth, options.plane)


def _frame_times(options: Simulation) -> np.ndarray:
    """When to render: so often that no pixel moves farther than STEP, and every 2 ms at least: -> [F] int64 µs, from the warm-up on."""
    end = round(options.duration * 1e6)
    time = torch.linspace(-WARM_UP, options.duration, math.ceil((WARM_UP + options.duration) * 1000) + 1, dtype=torch.float64)
    rate = (_pixel_speed(options, time) * 1.05 / STEP).clamp(min=500).numpy()  # frames per second; between the samples it may be more
    passed = np.concatenate([[0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(time.numpy()))])
    frames = np.interp(np.linspace(0, passed[-1], math.ceil(passed[-1]) + 1), passed, time.numpy())
    return np.unique(np.append((frames * 1e6).round().astype(np.int64)[:-1], end))


def _pixel_speed(options: Simulation, time: Tensor) -> Tensor:
    """Speed of the fastest of some sensor pixels: time [M] s -> [M] px/s."""
    table = options.camera.rays()
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
                f"at {bad:.3f} s the camera looks past the plane's horizon or is behind it: "
                f"take a smaller tilt {options.tilt}, a larger distance {options.distance} m or focal length {options.focal} px"
            )
    flow = -torch.linalg.cross(motion.omega[:, None], ray[None]) - near[..., None] * motion.velocity[:, None]  # of the point, per depth
    flow = flow[..., :2] - ray[:, :2] * flow[..., 2:]
    fastest: Tensor = (to_pixels @ flow[..., None])[..., 0].norm(dim=-1).amax(-1)
    return fastest


def _inverse_depth(plane: Plane, at: Pose, ray: Tensor) -> Tensor:
    """Of the plane along rays (x, y, 1), negative behind a camera or its horizon: at [M] | ray [G, 3] -> [M, G] 1/m."""
    here = plane.seen_from(at)
    inverse = -(ray @ here.normal.mT).mT / here.distance[:, None]
    return torch.where(here.distance[:, None] > 0, inverse, -1.0)


def _chunks(options: Simulation, frames: np.ndarray) -> Iterator[Events]:
    """Render the frames and let the sensor look at them: frames [F] µs -> events of FRAMES frames at a time."""
    look = view(texture(options.scene, options.seed, options.focal), options.camera, options.plane, options.distance)
    sensor = _Sensor(options, look(pose(options, torch.from_numpy(frames[:1] * 1e-6))))
    for first in range(0, len(frames) - 1, FRAMES):
        times = frames[first : first + FRAMES + 1]
        poses = pose(options, torch.from_numpy(times * 1e-6))
        parts = [sensor.step(look(poses[k : k + 1]), int(times[k - 1]), int(times[k])) for k in range(1, len(times))]
        block = Events.join(parts)
        yield block[block.t >= 0]


@dataclass
class _Sensor:
    """Pixels of an event camera, flat [N]: what each remembers between frames.

    A pixel compares its low-passed log intensity with the level of its last event.  Noise events do not touch that level: they
    only start the refractory time.
    """

    options: Simulation
    level: np.ndarray  # log intensity after the low-pass, at the last frame
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        options, count = self.options, len(self.level)
        self.rng = np.random.default_rng([options.seed, 2])
        spread = self.rng.normal(options.threshold, options.mismatch, (2, count)).clip(options.threshold / 4)
        self.on, self.off = spread.astype(np.float32)
        phase = self.rng.uniform(-0.99, 0.99, count).astype(np.float32)
        self.memory = self.level + phase * np.where(phase > 0, self.off, self.on)
        self.light = self.level
        self.ready = np.full(count, -(2**62))  # µs from which on the pixel sees again
        self.blind = math.ceil(options.refractory * 1000)

    def step(self, light: np.ndarray, start: int, end: int) -> Events:
        """The events between two frames, in order of time: light [N] log intensity at the end | start, end µs."""
        level = self._low_passed(light, (end - start) * 1e-6)
        parts = [self._noise(start, end), *self._crossings(level, start, end)]
        self.light, self.level = light, level
        t, pixel, p = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(t, kind="stable")
        y, x = np.divmod(pixel[order], self.options.width)
        return Events(t[order], x.astype(np.uint16), y.astype(np.uint16), p[order])

    def _low_passed(self, light: np.ndarray, dt: float) -> np.ndarray:
        """First-order low-pass, exact for light that changes linearly between the frames."""
        if not self.options.bandwidth:
            return light
        tau = 1 / (2 * math.pi * self.options.bandwidth)
        decay = math.exp(-dt / tau)
        lag = (light - self.light) * np.float32(tau / dt)
        out: np.ndarray = light - lag + (self.level - self.light + lag) * np.float32(decay)
        return out

    def _noise(self, start: int, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poisson noise: t µs, pixel, polarity; what falls in a pixel's refractory time is lost."""
        count = self.rng.poisson(self.options.noise * len(self.level) * (end - start) * 1e-6)
        pixel, t = self.rng.integers(0, len(self.level), count), self.rng.integers(start, end, count)
        p = self.rng.integers(0, 2, count, dtype=np.uint8)
        pixel, first = np.unique(pixel, return_index=True)
        seen = t[first] >= self.ready[pixel]
        pixel, first = pixel[seen], first[seen]
        self.ready[pixel] = t[first] + self.blind
        return t[first], pixel, p[first]

    def _crossings(self, level: np.ndarray, start: int, end: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Threshold crossings on the straight line from the last level to this one, the pixels' first, second, .. ones in turn.

        A pixel that is blind when it crosses makes its event as soon as it sees, if it is still beyond the threshold then.
        """
        swing = np.stack([self.level, level]) - self.memory
        pixel = np.flatnonzero((swing.max(0) >= self.on) | (swing.min(0) <= -self.off))
        while len(pixel):
            memory, on, off, slope = self.memory[pixel], self.on[pixel], self.off[pixel], (level - self.level)[pixel] / (end - start)
            begin = np.maximum(self.ready[pixel], start)
            now, last = self.level[pixel] + slope * (begin - start) - memory, level[pixel] - memory
            early = (now >= on) | (now <= -off)
            brighter = (now >= on) | (~early & (last >= on))
            fire = (early | (last >= on) | (last <= -off)) & (begin <= end)
            pixel, begin, early, brighter = pixel[fire], begin[fire], early[fire], brighter[fire]
            target = np.where(brighter, on[fire], -off[fire])
            wait = (target - now[fire]) / np.where(early, 1.0, slope[fire])  # a pixel that crosses late has a slope
            t = np.where(early, begin, np.minimum(begin + wait.astype(np.int64), end))
            self.memory[pixel] += target
            self.ready[pixel] = t + self.blind
            yield t, pixel, brighter.astype(np.uint8)


def write(options: Simulation, folder: Path, progress: Callable[[float], None] | None = None) -> Path:
    """The recording as files, which appear all at once: events.h5, calib.txt, ground truth -> the folder.

    progress is told the seconds of the recording that are done.  Only a folder that holds nothing but an earlier simulation is replaced.
    """
    recording = simulate(options)
    if folder.exists() and not _ours(folder):
        raise DataError(folder, "exists and was not written by the simulator", "choose another folder, or remove this one")
    partial_folder = folder.absolute().with_name(f".{folder.absolute().name}.{os.getpid()}.partial")
    try:
        partial_folder.mkdir(parents=True)
        count = _write_events(partial_folder / "events.h5", recording, progress)
        _write_texts(partial_folder, options, recording, count)
        if folder.exists():
            shutil.rmtree(folder)
        partial_folder.rename(folder)
    except OSError as error:
        raise DataError(folder, f"cannot be written: {error}", "choose another folder, or make room on the disk") from error
    finally:
        shutil.rmtree(partial_folder, ignore_errors=True)
    return folder


def _ours(folder: Path) -> bool:
    """An empty folder, or one with an earlier simulation and nothing else."""
    try:
        names = {path.name for path in folder.iterdir()}
        return not names or (names <= FILES and "README.md" in names and MARK in (folder / "README.md").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return False


def _write_events(path: Path, recording: Recording, progress: Callable[[float], None] | None) -> int:
    """Datasets that grow with every chunk: -> number of events."""
    count = 0
    # in memory until it is whole: HDF5 crashes the process where the disk is full, a plain write says so
    with h5py.File(path, "w", driver="core", backing_store=False) as file:
        file.attrs.update(width=recording.camera.size[1], height=recording.camera.size[0])
        kinds = {"t": "i8", "x": "u2", "y": "u2", "p": "u1"}
        form = {"maxshape": (None,), "chunks": (1 << 16,), "compression": "gzip", "compression_opts": 1, "shuffle": True}
        columns = {name: file.create_dataset(f"events/{name}", (0,), kind, **form) for name, kind in kinds.items()}
        for chunk in recording.chunks():
            for name, column in columns.items():
                column.resize((count + len(chunk),))
                column[count:] = getattr(chunk, name)
            count += len(chunk)
            if progress is not None and len(chunk):
                progress(float(chunk.t[-1]) * 1e-6)
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)
    return count


def _write_texts(folder: Path, options: Simulation, recording: Recording, count: int) -> None:
    """Everything but the events."""
    assert recording.truth is not None
    write_trajectory(folder / "groundtruth.txt", recording.truth)
    time = recording.truth.time
    write_velocity(folder / "velocity.txt", time, velocity(options, time.double() * 1e-6))
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
