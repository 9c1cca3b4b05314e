"""Layouts in which datasets and tools of the field keep events in HDF5, known by the names in the file.

Their facts are from: DSEC, dsec.ifi.uzh.ch/data-format, and TUM-VIE, tonic's tum_vie.py and tum-vision/DEVO, which read it as DSEC;
M3ED, m3ed.io/data_overview/datafiles and daniilidis-group/m3ed, rosbag2hdf5.py and fasterlio_gt.py; MVSEC, daniilidis-group/mvsec,
mvsec_h5py.py and mvsec_reader.py, which wrote it; Metavision, docs.prophesee.ai, "HDF5 Event File Format"; event_utils,
TimoStoff/event_utils, event_packagers.py and rosbag_to_h5.py; tonic, neuromorphs/tonic, cached_dataset.py.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchcmax.io.calibration import SENSORS, Lens, checked_size, told_lens
from torchcmax.io.errors import DataError, DataNote, DataWarning, tell
from torchcmax.io.events import LATEST, Events
from torchcmax.io.lensfiles import in_our_words
from torchcmax.io.tables import ALIASES, LONGEST, SAMPLE, WIDEST, as_events, column_of, fields_of, in_seconds, order_of

LARGEST = 1 << 28  # bytes of a stored piece that is read as a whole
WANTS = "write events/t (integer us), events/x, events/y (px), events/p (0 or 1), or times as decimal fractions of seconds"
FILTERS = {  # by their registered numbers; no others are let near a file: one of a lossy filter ends the process on damaged data
    1: "gzip", 2: "shuffle", 3: "fletcher32", 4: "szip", 5: "nbit", 6: "scaleoffset", 307: "bzip2", 32000: "lzf", 32001: "Blosc",
    32004: "LZ4", 32008: "bitshuffle", 32015: "Zstandard", 32026: "Blosc2", 0x8ECF: "ECF",
}  # fmt: skip
STRAY = 0.01  # of the first events: as many beyond a sensor are no reason to take another
AGAIN = "copy or download it again; it may be cut off or damaged"
GROUPS = ("events", "prophesee/left", "")  # DSEC, TUM-VIE, event_utils; M3ED; the columns at the top
TABLES = ("davis/left/events", "CD/events", "data/0", "events")  # MVSEC; Metavision; tonic; v2e and others
OTHERS = {"davis/": "davis/right/events", "prophesee/": "prophesee/right/t", "data/": "data/1"}  # what is left out


@dataclass(frozen=True)
class Truth:
    """A file of ground truth: datasets of poses [M, 4, 4], T_wc or, inverse, T_cw, and of times [M] in units of so many µs."""

    file: Path
    poses: str
    times: str
    unit: float
    inverse: bool


@dataclass(frozen=True)
class Layout:
    """columns: t, x, y, p -> the dataset, and the field or column of it, None where it is all of it | seconds: unit of t, else µs

    offset: µs, added to t | index: dataset of the first event of every ms of t, where there is one | sensor: (width, height) px
    """

    columns: dict[str, tuple[str, str | int | None]]
    seconds: bool = False
    offset: int = 0
    index: str = ""
    sensor: tuple[Any, Any] | None = None
    lens: Lens | None = None
    truth: Truth | None = None


def layout_of(path: Path, file: Any) -> Layout | None:
    """The layout of a file and what it says of its sensor; None where it is none of these."""
    columns = _columns(path, file)
    if columns is None or ("ms_to_idx" not in file and all(where == (f"events/{name}", None) for name, where in columns.items())):
        return None  # or the plain layout, which hdf5.py reads
    table = columns["t"][0]
    for data in {data for data, _ in columns.values()}:
        check_stored(path, file[data], data)
    lengths = {name: len(file[data]) for name, (data, _) in columns.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(path, f"has events of different lengths: {lengths}", WANTS)
    if not lengths["t"]:
        raise DataError(path, "holds no events", "record or copy it again")
    offset, index, sensor, lens = 0, "", _attributes(file), None
    if table.startswith("davis/"):
        sensor = sensor or (346, 260)
    if table.startswith("prophesee/"):
        index, lens = "prophesee/left/ms_map_idx", _m3ed_lens(path, file)
        sensor = lens.sensor if lens else sensor or (1280, 720)
    if table == "events/t":
        index = "ms_to_idx"
        if "t_offset" in file:
            offset, sensor = _offset(path, file), sensor or _dsec_sensor(file)
    left_out = next((name for start, name in OTHERS.items() if table.startswith(start) and name in file), None)
    if left_out is not None:
        tell(DataNote(f"{path}: holds more than one recording; {table} is read, {left_out} is left out"))
    layout = Layout(columns, False, offset, _index(path, file, index), sensor, lens, _truth(path, table))
    return replace(layout, seconds=_seconds(path, file, layout))


def _columns(path: Path, file: Any) -> dict[str, tuple[str, str | int | None]] | None:
    """Where t, x, y, p stand."""
    for group in GROUPS:
        names = {name: [f"{group}/{alias}".lstrip("/") for alias in aliases] for name, aliases in ALIASES.items()}
        found = {name: next((data for data in known if _is_column(file.get(data))), None) for name, known in names.items()}
        if None not in found.values():
            return {name: (str(data), None) for name, data in found.items()}
    for table in TABLES:
        data = file.get(table)
        if not isinstance(data, h5py.Dataset) or data.shape is None:
            continue
        if data.ndim == 1 and (fields := fields_of(data.dtype)) is not None:
            return {name: (table, field) for name, field in fields.items()}
        if data.ndim == 2 and data.shape[1] == 4 and data.dtype.kind in "iufb":
            check_stored(path, data, table)
            order = "xytp" if table.startswith("davis/") else order_of(path, data[:SAMPLE], table)
            return {name: (table, column) for column, name in enumerate(order)}
    return None


def _is_column(data: Any) -> bool:
    """Whether it is a dataset of numbers, one an event."""
    return isinstance(data, h5py.Dataset) and data.shape is not None and data.ndim == 1 and data.dtype.kind in "iufb"


def check_stored(path: Path, data: Any, name: str) -> None:
    """DataError where a dataset's rows or pieces are too large, packed by a filter that is not here, or not as many as its length wants."""
    if data.dtype.itemsize > WIDEST:
        raise DataError(path, f"{name} has entries of {data.dtype.itemsize} bytes", AGAIN)
    if data.chunks and math.prod(data.chunks) * data.dtype.itemsize > LARGEST:
        raise DataError(path, f"{name} is stored in pieces of {data.chunks}", "write it again in smaller pieces; it may be damaged")
    packed = data.id.get_create_plist()
    for i in range(packed.get_nfilters()):
        code = packed.get_filter(i)[0]
        if code not in FILTERS:
            raise DataError(path, f"{name} is packed by the HDF5 filter {code}, which is none for events", AGAIN)
        if not h5py.h5z.filter_avail(code):
            with suppress(ImportError):
                import hdf5plugin  # noqa: F401  # it registers its filters
        if not h5py.h5z.filter_avail(code):
            remedy = "pip install 'torchcmax[io]'"
            if code == 0x8ECF:
                remedy = "install Metavision's ECF plugin and set HDF5_PLUGIN_PATH, or give the RAW file"
            raise DataError(path, f"{name} is packed by the HDF5 filter {FILTERS[code]}, {code}, which is not installed", remedy)
    if data.is_virtual or data.external:
        return
    if data.chunks:  # what is not stored would be read as the fill value, which is no event
        wanted = math.prod(-(-size // piece) for size, piece in zip(data.shape, data.chunks, strict=True))
        stored = data.id.get_num_chunks()
    else:
        wanted, stored = data.size * data.id.get_type().get_size(), data.id.get_storage_size()
    if stored != wanted:
        parts = "pieces" if data.chunks else "bytes"
        raise DataError(path, f"{name} of the shape {data.shape} wants {wanted} {parts}, but {stored} are stored", AGAIN)


def numbers(path: Path, file: Any, name: str, remedy: str, most: int = 16) -> np.ndarray:
    """All numbers of a dataset of at most so many."""
    data = file.get(name)
    if not isinstance(data, h5py.Dataset) or data.shape is None or data.dtype.kind not in "iuf":
        raise DataError(path, f"{name} is missing or holds no numbers", remedy)
    if data.size > most:
        raise DataError(path, f"{name} holds {data.size} numbers, more than {most}", remedy)
    check_stored(path, data, name)
    found: np.ndarray = data[()]
    return np.asarray(found)


def _offset(path: Path, file: Any) -> int:
    """DSEC's t_offset, µs."""
    found = numbers(path, file, "t_offset", AGAIN).reshape(-1)
    if len(found) != 1 or not abs(float(found[0])) < LATEST or float(found[0]) % 1:
        raise DataError(path, f"t_offset is {found.tolist()}, no whole number of us", AGAIN)
    return int(found[0])


def _dsec_sensor(file: Any) -> tuple[int, int] | None:
    """DSEC's 640 x 480, unless many of the first events are beyond: others write files of its layout."""
    x, y = (file[f"events/{name}"][:SAMPLE] for name in "xy")
    return (640, 480) if np.mean((x >= 640) | (y >= 480)) < STRAY else None


def _attributes(file: Any) -> tuple[Any, Any] | None:
    """Width and height from event_utils' sensor_resolution, (H, W) or (H, W, colours), or Metavision's geometry, 1280x720.

    Where it had no images, event_utils wrote the largest y and x of the events: one less than a known sensor's size is taken as that.
    """
    if np.size(file.attrs.get("sensor_resolution", ())) in (2, 3):
        height, width = np.asarray(file.attrs["sensor_resolution"]).reshape(-1)[:2].tolist()
        guessed = np.size(file.attrs.get("num_imgs", 1)) == 1 and not np.any(file.attrs.get("num_imgs", 1))
        return (width + 1, height + 1) if guessed and (width + 1, height + 1) in SENSORS else (width, height)
    told = file.attrs.get("geometry", "")
    words = (told.decode("ascii", "replace") if isinstance(told, bytes) else str(told)).split("x")
    return (words[0], words[1]) if len(words) == 2 else None


def _m3ed_lens(path: Path, file: Any) -> Lens | None:
    """M3ED's calib, in the words of Kalibr; what cannot be used is left out and told."""
    calib, wants = file.get("prophesee/left/calib"), "give another calibration: --camera FILE"
    if not isinstance(calib, h5py.Group) or not {"intrinsics", "distortion_coeffs", "resolution"} <= set(calib):
        return None
    try:
        told: dict[str, Any] = {
            name: numbers(path, calib, name, wants).reshape(-1).tolist() for name in ("intrinsics", "distortion_coeffs", "resolution")
        }
        told |= {name: _word(calib.get(name), usual) for name, usual in (("camera_model", "pinhole"), ("distortion_model", "radtan"))}
        found = in_our_words(str(path), {"cam0": told})
        return replace(told_lens(str(path), found, wants), sensor=checked_size(str(path), found["width"], found["height"]))
    except DataError as error:
        tell(DataWarning(f"{path}: its calibration is left out, {error.problem}; {wants}"))
        return None


def _word(data: Any, usual: str) -> str:
    """The one word of a dataset of text; where there is none, the usual."""
    found = data[()] if isinstance(data, h5py.Dataset) and data.shape == () else usual
    return found.decode("utf-8", "replace") if isinstance(found, bytes) else str(found)


def _index(path: Path, file: Any, name: str) -> str:
    """The name of an index by ms, where it is there and is one."""
    if not name or name not in file:
        return ""
    if not _is_column(file[name]) or file[name].dtype.kind not in "iu":
        raise DataError(path, f"{name} is no list of whole numbers", AGAIN)
    check_stored(path, file[name], name)
    return name


def _truth(path: Path, table: str) -> Truth | None:
    """The ground truth beside *_data.hdf5 of MVSEC, T_wc and s, or *_data.h5 of M3ED, T_cw of the first pose and µs."""
    if not path.stem.endswith("_data"):
        return None
    stem = path.stem.removesuffix("_data")
    if table.startswith("davis/"):
        found = Truth(path.with_name(f"{stem}_gt{path.suffix}"), "davis/left/pose", "davis/left/pose_ts", 1e6, False)
    elif table.startswith("prophesee/"):
        found = Truth(path.with_name(f"{stem}_pose_gt{path.suffix}"), "Cn_T_C0", "ts", 1.0, True)
    else:
        return None
    return found if found.file.is_file() else None


def _seconds(path: Path, file: Any, layout: Layout) -> bool:
    """Whether t is in seconds; DataError where it is no number, or spans too many."""
    column = _column(file, layout, "t", slice(0, SAMPLE))
    if column.dtype.kind not in "iuf":
        raise DataError(path, f"has times of another kind: {layout.columns['t'][0]} is {column.dtype}", WANTS)
    if not in_seconds(path, column):
        return False
    first, last = float(column[0]), float(_column(file, layout, "t", slice(-1, None))[0])
    if abs(last - first) > LONGEST:
        raise DataError(path, f"has times as decimal fractions from {first:g} to {last:g}, which are no seconds", WANTS)
    return True


def _column(file: Any, layout: Layout, name: str, part: slice) -> np.ndarray:
    """A stretch of one column."""
    data, field = layout.columns[name]
    return column_of(file[data][part], field)


def read_layout(path: Path, file: Any, layout: Layout, start: int, end: int) -> Events:
    """The events start to end; t in µs of the file's own clock."""
    rows = {data: file[data][start:end] for data in {data for data, _ in layout.columns.values()}}
    columns = {name: column_of(rows[data], field) for name, (data, field) in layout.columns.items()}
    return as_events(path, columns, start, layout.seconds, layout.offset)


def event_before(file: Any, layout: Layout, time: int) -> int:
    """An event with none of a time, µs, or later before it, by the file's index by ms; 0 where that does not hold."""
    index, ms = file[layout.index], (time - layout.offset) // 1000
    if ms <= 0 or not len(index):
        return 0
    event = int(index[min(ms, len(index) - 1)])
    if not 0 < event <= len(file[layout.columns["t"][0]]):
        return 0
    last = int(_column(file, layout, "t", slice(event - 1, event))[0]) + layout.offset
    return event if last < time and not layout.seconds else 0
