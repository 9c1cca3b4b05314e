"""open: what a path holds, and the recording in it."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Protocol

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.io import dv, hdf5, npz, prophesee, rosbag
from torchcmax.io.calibration import ECD_FORM, Lens, checked_size, guess_sensor, read_lens
from torchcmax.io.checked import Source, checked
from torchcmax.io.contents import Contents
from torchcmax.io.errors import DataError, DataWarning
from torchcmax.io.events import Events
from torchcmax.io.member import GZIP, UTF16, Member, image_size, not_a_file, open_zip, reading
from torchcmax.io.recording import Recording
from torchcmax.io.text import check_text, like_text, line_of, read_text
from torchcmax.io.trajectory import read_plane, read_trajectory

WANTED = (
    "give a file of AEDAT4, Prophesee RAW or DAT, ES, a ROS 1 bag, HDF5, npz, npy or text; or a folder, or .zip, with events.txt or "
    "events.h5 and calib.txt"
)
LENSES = ("calib.txt", "calib.yaml", "camchain*.yaml", "*-camchain.yaml", "camera_info.yaml")  # beside the events, the first that is there


class Format(Protocol):
    """A module that reads a family of files: whether a file that begins like this is one of them, and what it holds."""

    def knows(self, path: Path, head: bytes) -> bool: ...

    def contents(self, path: Path) -> Contents: ...


FORMATS: tuple[Format, ...] = (hdf5, prophesee, dv, rosbag, npz)
HEAD = 4096  # bytes by which a file is known
TRUTHS = ("_gt.hdf5", "_gt.h5")  # of MVSEC and M3ED, beside the events
TEXTS = (".txt", ".csv")
OTHERS = ("calib.txt", "groundtruth.txt", "plane.txt", "images.txt", "imu.txt", "velocity.txt")  # beside events, never events


@dataclass(frozen=True)
class OpenOptions:
    """How a recording is opened."""

    strict: bool = False
    """Refuse what would be mended: events out of order, or at equal times."""
    camera: str = ""
    """Calibration file instead of the recording's own: ours, ECD's, Kalibr's, ROS's, DSEC's or OpenCV's; or the word pinhole."""
    sensor: tuple[int, int] | None = None
    """Width, height px, instead of what the recording says."""
    chunk: int = 1 << 20
    """Events read at a time, and how many places an event out of order can be moved."""


def open(path: Path | str, options: OpenOptions | None = None) -> Recording:
    """The recording at a path: a file of any format that we know, or a folder with one, or a .zip with events.txt.

    Files are known by what is in them, not by their endings.  Events are read when they are asked for.  Only where neither the
    options, the files nor the first picture in images/ tell the sensor's size, all events are read once to find it (`guess_sensor`).
    """
    path, options = Path(path), options or OpenOptions()
    if options.chunk < 1:
        raise ValueError(f"a chunk wants at least 1 event, got {options.chunk}")
    with reading(path):
        if path.is_dir():
            return _folder(path, options)
        if not path.is_file():
            raise DataError(path, not_a_file(path, "file or folder"), "check the name; " + WANTED)
    if (head := _head(path)) == b"":
        raise DataError(path, "is empty", WANTED)
    if (form := _form(path, head)) is not None:
        return _binary(form, path, options)
    if head.startswith(b"PK") or zipfile.is_zipfile(path):
        return _text(open_zip(path), path, path.stem, options)
    if path.suffix.lower() in TEXTS or like_text(head) or head.startswith((GZIP, *UTF16)):
        return _text(path.parent, path, path.parent.resolve().name, options, path.name)
    kind = "should be an HDF5 file and is none" if path.suffix in (".h5", ".hdf5") else "is not a recording"
    raise DataError(path, f"{kind}: it begins with {head[:16]!r}", WANTED)


def _head(path: Path) -> bytes:
    with reading(path), path.open("rb") as stream:
        return stream.read(HEAD)


def _form(path: Path, head: bytes) -> Format | None:
    return next((form for form in FORMATS if form.knows(path, head)), None)


def _folder(folder: Path, options: OpenOptions) -> Recording:
    """events.h5, or events.txt, or else the only file of a format that we know, or else the only text of events."""
    if (folder / "events.h5").is_file():
        if (folder / "events.txt").is_file():
            text = f"{folder}: holds events.h5 and events.txt; events.txt is ignored, to read it give its own path"
            warnings.warn(DataWarning(text), stacklevel=3)
        return _binary(hdf5, folder / "events.h5", options, folder)
    if (folder / "events.txt").is_file():
        return _text(folder, folder / "events.txt", folder.resolve().name, options)
    entries = sorted(entry for entry in folder.iterdir() if not entry.name.endswith(TRUTHS))
    known = [(form, entry) for entry in entries if entry.is_file() and (form := _form(entry, _head(entry))) is not None]
    if len(known) == 1:
        return _binary(*known[0], options, folder)
    if known:
        raise _several(folder, [entry for _, entry in known])
    texts = [entry for entry in entries if entry.suffix.lower() in TEXTS and entry.name not in OTHERS and entry.is_file()]
    texts = [entry for entry in texts if like_text(_head(entry))]
    if len(texts) == 1:
        return _text(folder, texts[0], folder.resolve().name, options, texts[0].name)
    if texts:
        raise _several(folder, texts)
    raise DataError(folder, f"is a folder without a recording; it holds {_listed(entries) or 'nothing'}", WANTED)


def _several(folder: Path, entries: list[Path]) -> DataError:
    return DataError(folder, f"holds several recordings: {_listed(entries)}", "give the path of one")


def _listed(entries: list[Path]) -> str:
    """Some names."""
    return ", ".join(entry.name for entry in entries[:4]) + (f" and {len(entries) - 4} more" if len(entries) > 4 else "")


def _text(folder: Member, path: Path, name: str, options: OpenOptions, events: str = "events.txt") -> Recording:
    """A recording as text, in a folder or a .zip."""
    file = folder / events
    form = check_text(file)
    sensor = form.sensor or image_size(folder)
    found = Contents(partial(read_text, file, form=form), partial(line_of, file, form=form), name=name, sensor=sensor)
    return _recording(path, str(file), found, options, folder)


def _binary(form: Format, path: Path, options: OpenOptions, folder: Path | None = None) -> Recording:
    """A recording in one file."""
    found = form.contents(path)
    return _recording(path, str(path), found, options, path.parent if folder is None and not found.own else folder)


def _recording(path: Path, file: str, found: Contents, options: OpenOptions, folder: Member | None) -> Recording:
    """What a file and the files beside it make; the latter go before what stands in the former."""
    camera, guessed = _camera(folder, found, file, options)
    beside = (None, None) if folder is None else _truth(folder)
    truth, plane = beside[0] or found.truth, beside[1] or found.plane
    name = found.name or (path.parent.resolve().name if path.stem == "events" else path.stem)
    source, since = Source(file, camera.size[::-1], found.place, options.strict), found.since

    def chunks() -> Iterator[Events]:
        return checked(found.events(options.chunk), source)

    def later(time: int) -> tuple[int, Iterator[Events]]:
        if since is None:
            return 0, chunks()
        before, rest = since(time, options.chunk)
        return before, checked(rest, replace(source, place=lambda event: source.place(before + event)))

    return Recording(path, name, camera, chunks, found.count, truth, plane, guessed, later, found.pieces)


def _camera(folder: Member | None, found: Contents, file: str, options: OpenOptions) -> tuple[Camera, bool]:
    """The camera, and whether its size is guessed.

    Its lens is from the options, calib.txt or the file; its size from the options, the lens's file, the file, or the events.
    """
    lens: Lens | None = None
    if options.camera and options.camera != "pinhole":
        lens = read_lens(Path(options.camera))
    elif not options.camera:
        beside = None if folder is None else _lens_file(folder)
        lens = found.lens if beside is None else read_lens(beside)
        if lens is None:
            remedy = f"put {ECD_FORM} into a file calib.txt beside the events, give --camera FILE, or --camera pinhole [--sensor 240x180]"
            raise DataError(file, "there is no calibration for it", remedy)
    known = options.sensor or (lens and lens.sensor) or found.sensor
    sensor = checked_size(file, *known) if known else guess_sensor(file, lens, partial(found.events, options.chunk))
    return (Camera.pinhole(sensor[::-1]) if lens is None else lens.camera(sensor)), not known


def _lens_file(folder: Member) -> Member | None:
    """The calibration beside the events."""
    entries = sorted((entry for entry in folder.iterdir() if entry.is_file()), key=lambda entry: entry.name)
    for pattern in LENSES:
        if found := [entry for entry in entries if fnmatch(entry.name, pattern)]:
            return found[0]
    return None


def _truth(folder: Member) -> tuple[Trajectory | None, Plane | None]:
    """Ground truth and plane from the files beside the events, where they are."""
    poses, plane = folder / "groundtruth.txt", folder / "plane.txt"
    return read_trajectory(poses) if poses.is_file() else None, read_plane(plane) if plane.is_file() else None
