"""A map or a panorama in a file: HDF5, so that another run can track against it, or another program read it."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from torchcmax.core.draw import Ink
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.state import State
from torchcmax.io import DataError
from torchcmax.slam.globe import Globe
from torchcmax.slam.map import Keyframe, Map, Texture
from torchcmax.slam.tiles import CELL, TILE, Layers, spread

FORMATS, VERSION = {Map: "torchcmax map", Globe: "torchcmax panorama"}, 1
FAILURES = (  # what h5py and we raise on broken files
    OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError, UnicodeDecodeError, OverflowError, AttributeError,
)  # fmt: skip
PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
STORED = 1 << 16  # events per compressed piece
SPARE = 8 << 20  # bytes asked of the disk beside the map: HDF5 crashes the process when it finds it full
INK = tuple(f.name for f in fields(Ink))
LAYERS = {"votes": (TILE, TILE), "exposure": (3, TILE // CELL, TILE // CELL)}
AGAIN = "give a map.h5 that `torchcmax track` wrote, or a panorama.h5 of `torchcmax panorama`; copy it again if it may be cut off"


def save_map(path: Path | str, m: Map | Globe) -> None:
    """Writes a map or a panorama with its keyframes, under another name until it is whole; `load_map` gives the same, bit for bit."""
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    tensors = [getattr(part, name) for part in (m.tiles.values() if isinstance(m, Map) else [m.layers]) for name in LAYERS]
    tensors += [] if isinstance(m, Map) else [m.layers.votes] * 2  # texture and weight are as large
    tensors += [getattr(k.ink, name) for k in m.keyframes for name in INK]
    try:
        if shutil.disk_usage(path.parent).free < sum(t.nbytes for t in tensors) + SPARE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path.parent))
        with h5py.File(part, "w") as file:
            _write(file, m)
        part.replace(path)
    except (OSError, RuntimeError) as error:
        raise DataError(path, f"cannot be written: {error}", "choose another folder, or make room on the disk") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _write(file: Any, m: Map | Globe) -> None:
    file.attrs.update(format=FORMATS[type(m)], version=VERSION, number=m.number, focal=m.focal, texture=json.dumps(asdict(m.texture)))
    file["border"] = _numbers(m.border)
    if isinstance(m, Map):
        _write_plane(file, m)
    else:
        _write_sphere(file, m)
    if m.keyframes:
        _write_keyframes(file.create_group("keyframes"), m.keyframes)


def _write_plane(file: Any, m: Map) -> None:
    file["plane/normal"], file["plane/distance"] = _numbers(m.plane.normal), _numbers(m.plane.distance)
    tiles = file.create_group("tiles")
    tiles["place"] = np.array(list(m.tiles), np.int64).reshape(-1, 2)  # row, column
    for name, shape in LAYERS.items() if m.tiles else ():
        layer = _numbers(torch.stack([getattr(tile, name) for tile in m.tiles.values()]))
        tiles.create_dataset(name, data=layer, chunks=(1, *shape), **PACKED)


def _write_sphere(file: Any, m: Globe) -> None:
    """Equirectangular: texture [H, W] strength of the edges 0..1, for others to look at; weight [H, W] px of motion that each place was
    seen in; the layers that they are made of."""
    group = file.create_group("sphere")
    group.attrs["layout"] = "equirectangular: rows from straight up to straight down, columns round; the middle looks along z of the world"
    images = {"texture": m.strength(), "weight": spread(m.layers.most), "votes": m.layers.votes, "exposure": m.layers.exposure}
    for name, image in images.items():
        group.create_dataset(name, data=_numbers(image), chunks=True, **PACKED)


def _write_keyframes(group: Any, keyframes: list[Keyframe]) -> None:
    """A row for each keyframe; the events of all, one keyframe after the other, as `events` of each says."""
    state = State.join([k.state for k in keyframes])
    group["time"] = np.array([k.time for k in keyframes], np.int64)
    group["seconds"] = _numbers(torch.cat([k.seconds for k in keyframes]))
    group["R"], group["t"] = _numbers(state.pose.R), _numbers(state.pose.t)
    group["omega"], group["velocity"] = _numbers(state.motion.omega), _numbers(state.motion.velocity)
    group["events"] = np.array([k.ink.x.shape[1] for k in keyframes], np.int64)
    for name in INK:
        column = _numbers(torch.cat([getattr(k.ink, name)[0] for k in keyframes]))
        packed = PACKED if name == "weight" else {}  # the others are all different, and packing them takes ten times as long
        group.create_dataset(f"ink/{name}", data=column, chunks=(max(1, min(STORED, len(column))),), **packed)


def _numbers(values: Tensor) -> np.ndarray:
    numbers: np.ndarray = values.detach().cpu().numpy()
    return numbers


def load_map(path: Path | str) -> Map | Globe:
    """The map or panorama that `save_map` wrote, on the CPU."""
    path, kinds = Path(path), {name: kind for kind, name in FORMATS.items()}
    with _reading(path), h5py.File(path, "r") as file:
        form, version = file.attrs.get("format"), file.attrs.get("version")
        if form not in kinds:
            raise DataError(path, "is an HDF5 file, but no map", AGAIN)
        if version != VERSION:
            raise DataError(path, f"is a map of version {version}, not {VERSION}", "read it with the torchcmax that wrote it")
        focal, number, texture = float(file.attrs["focal"]), int(file.attrs["number"]), _texture(file.attrs["texture"])
        m: Map | Globe
        if kinds[form] is Globe:
            m = Globe(focal, _tensor(file["border"], None, 3), texture, number=number)
            height, width = m.sphere.size
            cells = 3, height // CELL, width // CELL
            votes, exposure = _tensor(file["sphere/votes"], height, width), _tensor(file["sphere/exposure"], *cells)
            if votes.dtype != torch.float32 or exposure.dtype != torch.float32 or (votes < 0).any():
                raise ValueError("sphere/votes and sphere/exposure want float32, and votes of at least 0")
            m.layers = Layers(votes, exposure)
        else:
            plane = Plane(_tensor(file["plane/normal"], 1, 3), _tensor(file["plane/distance"], 1))
            m = Map(plane, focal, _tensor(file["border"], None, 3), texture, number=number)
            m.tiles.update(_read_tiles(file["tiles"]))
        m.keyframes.extend(_read_keyframes(file["keyframes"]) if "keyframes" in file else [])
        return m


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """What goes wrong with a file in here is a DataError."""
    try:
        if not path.is_file():
            raise DataError(path, "there is no such file", AGAIN)
        yield
    except FAILURES as error:
        raise DataError(path, f"cannot be read as a map: {error}", AGAIN) from error


def _texture(text: str) -> Texture:
    """The options from JSON, where tuples are lists."""
    options: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in json.loads(text).items()}
    return Texture(**options)


def _tensor(data: Any, *shape: int | None) -> Tensor:
    """All numbers of a dataset, finite, of this shape; None: of any length."""
    if len(data.shape) != len(shape) or any(want not in (None, n) for n, want in zip(data.shape, shape, strict=True)):
        raise ValueError(f"{data.name} has the shape {data.shape}, not {tuple('any' if n is None else n for n in shape)}")
    values = torch.from_numpy(data[()])
    if not values.isfinite().all():
        raise ValueError(f"{data.name} holds a number that is not finite")
    return values


def _read_tiles(group: Any) -> Iterator[tuple[tuple[int, int], Layers]]:
    """The name of each tile and its layers, each with memory of its own."""
    places = _tensor(group["place"], None, 2).tolist()
    if places:
        layers = (_tensor(group[name], len(places), *shape) for name, shape in LAYERS.items())
        for (row, column), *tile in zip(places, *layers, strict=True):
            yield (row, column), Layers(*(layer.clone() for layer in tile))


def _read_keyframes(group: Any) -> Iterator[Keyframe]:
    times = _tensor(group["time"], None).tolist()
    count = len(times)
    pose = Pose(_tensor(group["R"], count, 3, 3), _tensor(group["t"], count, 3))
    state = State(pose, Motion(_tensor(group["omega"], count, 3), _tensor(group["velocity"], count, 3)))
    seconds, events = _tensor(group["seconds"], count), _tensor(group["events"], count).tolist()
    columns = [_tensor(group[f"ink/{name}"], sum(events)).split(events) for name in INK]
    for i, parts in enumerate(zip(*columns, strict=True)):
        yield Keyframe(times[i], state[i : i + 1], seconds[i : i + 1], Ink(*(part[None].clone() for part in parts)))
