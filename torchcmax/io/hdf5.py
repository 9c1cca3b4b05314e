"""HDF5 files: the simulator's layout, and our own, which `save` writes."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.io.calibration import Lens
from torchcmax.io.errors import DataError
from torchcmax.io.recording import Events, Recording

NAMES = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}
VERSION = 1
STORED = 1 << 17  # events per compressed piece of a file
WANTS = "it wants the datasets events/t (integer us), events/x, events/y (px), events/p (0 or 1), of the same length"
FAILURES = (OSError, RuntimeError, KeyError, ValueError, TypeError)  # what h5py raises on broken files
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
BYTES_PER_EVENT, SPARE = 13, 8 << 20  # asked of the disk before each chunk: HDF5 crashes the process when it finds it full


@dataclass(frozen=True)
class Contents:
    """What a file holds beside the events themselves."""

    count: int | None
    name: str = ""
    own: bool = False
    sensor: tuple[int, int] | None = None
    lens: Lens | None = None
    truth: Trajectory | None = None
    plane: Plane | None = None


@contextmanager
def _file(path: Path) -> Iterator[Any]:
    """An HDF5 file to read; what goes wrong with it is a DataError."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except FAILURES as error:
        raise DataError(path, f"cannot be read as HDF5: {error}", "copy or download it again; it may be cut off or damaged") from error


def read_contents(path: Path) -> Contents:
    """Everything but the events, which are looked at for their kinds and lengths only."""
    with _file(path) as file:
        count = _count(path, file)
        own = file.attrs.get("format") == "torchcmax"
        if own and file.attrs["version"] > VERSION:
            raise DataError(path, f"is of version {file.attrs['version']}, newer than {VERSION}", "take a newer torchcmax")
        sizes = next((group.attrs for group in (file, file["events"]) if {"width", "height"} <= set(group.attrs)), None)
        sensor = None if sizes is None else (int(sizes["width"]), int(sizes["height"]))
        lens = _lens(path, file if own else file.get("calib"))
        truth, plane = (file.get(name) for name in (("truth", "plane") if own else ("groundtruth", "groundtruth/plane")))
        return Contents(count, str(file.attrs.get("name", "")), own, sensor, lens, _truth(truth), _plane(plane))


def _count(path: Path, file: Any) -> int:
    """Number of events; DataError where the datasets are missing, differ in length or are of the wrong kind."""
    events = file.get("events")
    found = {name: events[name] for name in NAMES if name in events} if isinstance(events, h5py.Group) else {}
    if len(found) < len(NAMES):
        missing = ", ".join(f"events/{name}" for name in NAMES if name not in found)
        raise DataError(path, f"has no {missing}; it holds {', '.join(file) or 'nothing'}", WANTS)
    if any(not isinstance(data, h5py.Dataset) or data.ndim != 1 or data.dtype.kind not in "iub" for data in found.values()):
        kinds = ", ".join(f"{name}: {getattr(data, 'dtype', 'group')} {getattr(data, 'shape', '')}" for name, data in found.items())
        raise DataError(path, f"has events of another kind: {kinds}", WANTS)
    lengths = {name: len(data) for name, data in found.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(path, f"has events of different lengths: {lengths}", WANTS)
    return lengths["t"]


def _lens(path: Path, group: Any) -> Lens | None:
    """Calibration from the attributes of a group, in our own form or the simulator's."""
    if group is None or "fx" not in group.attrs:
        return None
    found = group.attrs
    fx, fy, cx, cy = (float(found[key]) for key in ("fx", "fy", "cx", "cy"))
    distortion = found["distortion"] if "distortion" in found else [found[key] for key in DISTORTION]
    model = str(found["model"]).removeprefix("OpenCV ")
    return Lens(str(path), (fx, fy, cx, cy), tuple(float(number) for number in distortion), model)


def _truth(group: Any) -> Trajectory | None:
    """Poses from t, p, q (x, y, z, w); the simulator's t is in seconds, ours in µs."""
    if group is None:
        return None
    t = group["t"][()]
    time = t if t.dtype.kind == "i" else np.rint(t * 1e6)
    q, p = (torch.from_numpy(np.asarray(group[name], np.float64)) for name in "qp")
    return Trajectory(torch.from_numpy(time.astype(np.int64)), Pose(so3.from_quaternion(q), p))


def _plane(data: Any) -> Plane | None:
    """The plane from its four numbers."""
    if data is None:
        return None
    numbers = torch.from_numpy(np.asarray(data, np.float64)).reshape(1, 4)
    return Plane(numbers[:, :3], numbers[:, 3])


def read_events(path: Path, chunk: int) -> Iterator[Events]:
    """Events as they stand in the file, `chunk` at a time."""
    start = 0
    while True:
        with _file(path) as file:  # not held open between chunks: a yield within would blame the file for the caller's errors
            group = file["events"]
            if start >= len(group["t"]):
                return
            columns = {name: group[name][start : start + chunk] for name in NAMES}
        yield _converted(path, columns, start)
        start += chunk


def _converted(path: Path, columns: dict[str, np.ndarray], start: int) -> Events:
    """Columns of any integers as Events; polarity -1 is darker, as 0."""
    for name, least, most in (("t", -(2**63), 2**63 - 1), ("x", 0, 65535), ("y", 0, 65535), ("p", -1, 1)):
        column = columns[name]
        if column.dtype.kind != "b" and (int(column.min()) < least or int(column.max()) > most):
            i = int(((column < least) | (column > most)).argmax())
            raise DataError(path, f"events/{name} is {column[i]}, not within {least}..{most}", WANTS, f"event {start + i + 1}")
    columns["p"] = columns["p"] > 0
    return Events(*(columns[name].astype(kind, copy=False) for name, kind in NAMES.items()))


def save(recording: Recording, path: Path | str) -> None:
    """Writes a recording as our own HDF5 file, chunk by chunk, under another name until it is whole."""
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    remedy = "choose another folder, or make room on the disk"
    try:
        if not path.parent.is_dir():
            raise DataError(path, f"{path.parent} is no folder", "make the folder first, or choose another")
        with h5py.File(part, "w") as file:
            _write_rest(file, recording)
            _write_events(file.create_group("events"), recording, path.parent)
        part.replace(path)
    except (OSError, RuntimeError) as error:
        raise DataError(path, f"cannot be written: {error}", remedy) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _write_rest(file: Any, recording: Recording) -> None:
    """Attributes, camera, truth and plane."""
    camera = recording.camera
    file.attrs.update(format="torchcmax", version=VERSION, name=recording.name, width=camera.size[1], height=camera.size[0])
    file.attrs.update(model=camera.model, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, distortion=camera.distortion)
    if recording.truth is not None:
        truth = file.create_group("truth")
        truth["t"] = recording.truth.time.numpy()
        truth["p"] = recording.truth.pose.t.double().numpy()
        truth["q"] = so3.to_quaternion(recording.truth.pose.R.double()).numpy()
    if recording.plane is not None:
        file["plane"] = torch.cat([recording.plane.normal[0], recording.plane.distance]).double().numpy()


def _write_events(group: Any, recording: Recording, folder: Path) -> None:
    """Datasets that grow with every chunk."""
    packed = {"chunks": (STORED,), "compression": "gzip", "compression_opts": 1, "shuffle": True}
    columns = {name: group.create_dataset(name, (0,), kind, maxshape=(None,), **packed) for name, kind in NAMES.items()}
    count = 0
    for chunk in recording.chunks():
        if shutil.disk_usage(folder).free < BYTES_PER_EVENT * len(chunk) + SPARE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        for name, column in columns.items():
            column.resize((count + len(chunk),))
            column[count:] = getattr(chunk, name)
        count += len(chunk)
