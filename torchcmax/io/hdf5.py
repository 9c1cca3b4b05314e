"""HDF5 files: the simulator's layout, our own, which `save` writes, and those of layouts.py."""

from __future__ import annotations

import errno
import os
import shutil
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.io.calibration import Lens, told_lens
from torchcmax.io.contents import Contents
from torchcmax.io.errors import DataError
from torchcmax.io.events import Events
from torchcmax.io.layouts import AGAIN, Layout, Truth, check_stored, event_before, layout_of, numbers, read_layout
from torchcmax.io.member import LARGE
from torchcmax.io.recording import Recording
from torchcmax.io.tables import as_events
from torchcmax.io.trajectory import checked_plane, checked_trajectory

NAMES = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}
VERSION = 2  # 1 had no index
STORED = 1 << 16  # events per compressed piece of a file
WANTS = "it wants the datasets events/t (integer us), events/x, events/y (px), events/p (0 or 1), of the same length"
REWRITE = "write the ground truth again, or take it out of the file"
FAILURES = (OSError, RuntimeError, LookupError, ValueError, TypeError, OverflowError, MemoryError)  # what h5py raises on broken files
HEAP, SEARCHED = b"GCOL", 4 << 20  # how a heap of text begins; bytes in which it is looked for
MANY = LARGE // 8  # numbers of a trajectory or an index
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
KEPT = 8 << 20  # bytes of each column that stay unpacked: neighbours are mostly in the same stored piece
MOST_OPEN = 32  # files that a process keeps open to read pieces of
BYTES_PER_EVENT, SPARE = 13, 8 << 20  # asked of the disk before each chunk: HDF5 crashes the process when it finds it full


@contextmanager
def _file(path: Path) -> Iterator[Any]:
    """An HDF5 file to read; what goes wrong with it is a DataError."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except FAILURES as error:
        raise DataError(path, f"cannot be read as HDF5: {error}", AGAIN) from error


def _check_heap(path: Path) -> None:
    """DataError where a heap of text, near the beginning or the end of the file, has an entry of no size: HDF5 would read it forever."""
    with path.open("rb") as stream:
        parts = [stream.read(SEARCHED)]
        stream.seek(max(stream.seek(0, os.SEEK_END) - SEARCHED, SEARCHED))
        parts.append(stream.read(SEARCHED))
    for data in parts:
        start = data.find(HEAP)
        while start >= 0:
            at, end = start + 16, min(start + int.from_bytes(data[start + 8 : start + 16], "little"), len(data))
            if data[start + 4 : start + 8] != b"\1\0\0\0":  # its version; else these are other bytes that look alike
                end = 0
            while at + 16 <= end:
                index, size = struct.unpack_from("<H6xQ", data, at)
                step = 16 + -(-size // 8) * 8 if index else size
                if not step:
                    raise DataError(path, "cannot be read as HDF5: an entry of a heap has no size", AGAIN)
                at += step
            start = data.find(HEAP, start + 1)


def knows(path: Path, head: bytes) -> bool:
    """Whether it is an HDF5 file."""
    return bool(h5py.is_hdf5(path))


def contents(path: Path) -> Contents:
    """What the file holds; its events are looked at for their kinds and lengths, and a few for their units."""
    with _file(path) as file:
        _check_heap(path)
        own = file.attrs.get("format") == "torchcmax"
        version = _attribute(file.attrs.get("version"))
        if own and version not in (1, VERSION):
            raise DataError(path, f"is of version {version}, not {VERSION}", "read it with the torchcmax that wrote it, or a newer one")
        layout = None if own else layout_of(path, file)
        count = len(file[layout.columns["t"][0]]) if layout else _count(path, file)
        sizes = next((group.attrs for group in (file, file.get("events", file)) if {"width", "height"} <= set(group.attrs)), None)
        sensor = None if sizes is None else (_attribute(sizes["width"]), _attribute(sizes["height"]))
        lens = _lens(path, file if own else file.get("calib"))
        if layout:
            sensor, lens = sensor or layout.sensor, lens or layout.lens
        truth, plane = _truth(path, file, "truth" if own else "groundtruth"), _plane(path, file, "plane" if own else "groundtruth/plane")
        if layout and layout.truth and truth is None:
            truth = _truth_beside(layout.truth)
        events, name = partial(read_events, path, layout=layout), str(file.attrs.get("name", ""))
        indexed = bool(layout.index) if layout else own and version == VERSION
        since = partial(_since, path, layout) if indexed else None
        pieces = Pieces(path, layout)
        return Contents(events, lambda event: f"event {event + 1}", count, name, own, sensor, lens, truth, plane, since, pieces)


def _attribute(value: Any) -> Any:
    """An attribute as Python has it: numbers that stand alone, lists, text."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _count(path: Path, file: Any) -> int:
    """Number of events; DataError where the datasets are missing, differ in length or are of the wrong kind."""
    events = file.get("events")
    found = {name: events[name] for name in NAMES if name in events} if isinstance(events, h5py.Group) else {}
    if len(found) < len(NAMES):
        missing = ", ".join(f"events/{name}" for name in NAMES if name not in found)
        raise DataError(path, f"has no {missing}; it holds {', '.join(file) or 'nothing'}", WANTS)
    if all(isinstance(data, h5py.Dataset) and not data.size for data in found.values()):
        raise DataError(path, "holds no events", "record or copy it again")
    if any(not isinstance(data, h5py.Dataset) or data.ndim != 1 or data.dtype.kind not in "iub" for data in found.values()):
        kinds = ", ".join(f"{name}: {getattr(data, 'dtype', 'group')} {getattr(data, 'shape', '')}" for name, data in found.items())
        raise DataError(path, f"has events of another kind: {kinds}", WANTS)
    for name, data in found.items():
        check_stored(path, data, f"events/{name}")
    lengths = {name: len(data) for name, data in found.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(path, f"has events of different lengths: {lengths}", WANTS)
    return lengths["t"]


def _lens(path: Path, group: Any) -> Lens | None:
    """Calibration from the attributes of a group, in our own form or the simulator's."""
    if group is None or "fx" not in group.attrs:
        return None
    found = {key: _attribute(value) for key, value in group.attrs.items()}
    if "k1" in found:
        found["distortion"] = [found.get(key, 0.0) for key in DISTORTION]
    found["model"] = str(found.get("model", "plumb_bob")).removeprefix("OpenCV ")
    return told_lens(str(path), found, f"it wants the attributes fx, fy, cx, cy, model, and distortion or {', '.join(DISTORTION)}")


def _truth(path: Path, file: Any, name: str) -> Trajectory | None:
    """Poses from t, p, q (x, y, z, w) of a group; the simulator's t is in seconds, ours in µs."""
    if name not in file:
        return None
    t, p, q = (numbers(path, file, f"{name}/{column}", REWRITE, MANY) for column in "tpq")
    time = t if t.dtype.kind in "iu" else t * 1e6
    return checked_trajectory(str(path), time, p, q, lambda i: f"{name}, pose {i + 1}")


def _truth_beside(told: Truth) -> Trajectory:
    """Poses from matrices of a file of ground truth."""
    path, remedy = told.file, "copy or download it again, or move it elsewhere"
    with _file(path) as file:
        pose, time = (numbers(path, file, name, remedy, MANY).astype(np.float64) for name in (told.poses, told.times))
    if pose.ndim != 3 or pose.shape[1:] != (4, 4):
        raise DataError(path, f"{told.poses} has the shape {pose.shape}, not (M, 4, 4)", remedy)
    R, p = pose[:, :3, :3], pose[:, :3, 3]
    rigid = (abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) < 0.01) & (np.linalg.det(R) > 0)
    if not rigid.all():
        raise DataError(path, f"{told.poses} holds a matrix that is no rotation", remedy, f"pose {int((~rigid).argmax()) + 1}")
    if told.inverse:
        R = R.transpose(0, 2, 1)
        p = -(R @ p[:, :, None])[:, :, 0]
    q = so3.to_quaternion(torch.from_numpy(R.copy())).numpy()
    return checked_trajectory(str(path), time * told.unit, p, q, lambda i: f"{told.poses}, pose {i + 1}")


def _plane(path: Path, file: Any, name: str) -> Plane | None:
    """The plane from its four numbers."""
    return checked_plane(str(path), numbers(path, file, name, REWRITE).reshape(-1), name) if name in file else None


def _since(path: Path, layout: Layout | None, time: int, chunk: int) -> tuple[int, Iterator[Events]]:
    """How many events are left out, all before a time, µs, and the rest in chunks."""
    with _file(path) as file:
        event = event_before(file, layout, time) if layout else _piece_before(path, file, time)
    return event, read_events(path, chunk, layout, event)


def _piece_before(path: Path, file: Any, time: int) -> int:
    """First event of the last stored piece that begins before a time, µs; 0 where none does."""
    count, stored, remedy = len(file["events/t"]), (file["events/t"].chunks or (STORED,))[0], "convert the recording again"
    index = numbers(path, file, "index", remedy, MANY)
    if index.ndim != 1 or len(index) != -(-count // stored) or (index[1:] < index[:-1]).any():
        raise DataError(path, f"its index of {index.size} times does not fit its {count} events", remedy)
    return max(int(np.searchsorted(index, time)) - 1, 0) * stored


def read_events(path: Path, chunk: int, layout: Layout | None = None, start: int = 0) -> Iterator[Events]:
    """Events as they stand in the file, `chunk` at a time, from event `start` on."""
    while True:
        with _file(path) as file:  # not held open between chunks: a yield within would blame the file for the caller's errors
            if start >= len(file[layout.columns["t"][0] if layout else "events/t"]):
                return
            events = _read(path, file, layout, start, start + chunk)
        yield events
        start += chunk


def _read(path: Path, file: Any, layout: Layout | None, start: int, stop: int) -> Events:
    if layout:
        return read_layout(path, file, layout, start, stop)
    return as_events(path, {name: file[f"events/{name}"][start:stop] for name in NAMES}, start, seconds=False, prefix="events/")


class _Opened:
    """A file whose datasets stay open, as what is unpacked of them is forgotten when they are closed."""

    def __init__(self, path: Path) -> None:
        self.file = h5py.File(path, "r", rdcc_nbytes=KEPT)
        self.known: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self.known:
            self.known[name] = self.file[name]
        return self.known[name]


_opened: OrderedDict[tuple[int, Path], _Opened] = OrderedDict()  # by process, as HDF5 does not survive a fork; the latest last


@dataclass(frozen=True)
class Pieces:
    """The events of a file from one number to another, as they stand there.  Every process opens its own file, and keeps some open."""

    path: Path
    layout: Layout | None

    def __call__(self, start: int, stop: int) -> Events:
        try:
            return _read(self.path, self._file(), self.layout, start, stop)
        except FAILURES as error:
            remedy = "close other files, or raise the limit: ulimit -n 4096" if "Too many open files" in str(error) else AGAIN
            raise DataError(self.path, f"cannot be read as HDF5: {error}", remedy) from error

    def _file(self) -> _Opened:
        key = os.getpid(), self.path
        if key not in _opened:
            own = [other for other in _opened if other[0] == key[0]]
            if len(own) >= MOST_OPEN:
                _opened.pop(own[0]).file.close()
            _opened[key] = _Opened(self.path)
        _opened.move_to_end(key)
        return _opened[key]


def save(recording: Recording, path: Path | str, progress: Callable[[int], object] | None = None) -> None:
    """Writes a recording as our own HDF5 file, chunk by chunk, under another name until it is whole.

    progress: is told how many events are written so far
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    remedy = "choose another folder, or make room on the disk"
    try:
        if not path.parent.is_dir():
            raise DataError(path, f"{path.parent} is no folder", "make the folder first, or choose another")
        _check_room(path.parent, 64 * len(recording.truth) if recording.truth is not None else 0)
        with h5py.File(part, "w") as file:
            _write_rest(file, recording)
            _write_events(file.create_group("events"), recording, path.parent, progress)
            file["index"] = file["events/t"][::STORED]  # first time of every stored piece
        part.replace(path)
    except (OSError, RuntimeError) as error:
        raise DataError(path, f"cannot be written: {error}", remedy) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _check_room(folder: Path, size: int) -> None:
    """There is room for so many bytes."""
    if shutil.disk_usage(folder).free < size + SPARE:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


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


def _write_events(group: Any, recording: Recording, folder: Path, progress: Callable[[int], object] | None) -> None:
    """Datasets that grow with every chunk."""
    packed = {"chunks": (STORED,), "compression": "gzip", "compression_opts": 1, "shuffle": True}
    columns = {name: group.create_dataset(name, (0,), kind, maxshape=(None,), **packed) for name, kind in NAMES.items()}
    count = 0
    for chunk in recording.chunks():
        _check_room(folder, BYTES_PER_EVENT * len(chunk))
        for name, column in columns.items():
            column.resize((count + len(chunk),))
            column[count:] = getattr(chunk, name)
        count += len(chunk)
        if progress is not None:
            progress(count)
