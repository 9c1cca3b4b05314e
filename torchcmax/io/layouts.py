"""Layouts in which datasets and tools of the field keep events in HDF5, known by the names in the file."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchcmax.io.calibration import Lens, told_lens
from torchcmax.io.errors import DataError, DataNote, tell

NAMES = "txyp"
LONGEST = 1e6  # s, 11 days: times as decimal fractions that span more are not seconds
LARGEST = 1 << 28  # bytes of a stored piece that is read as a whole
WANTS = "write events/t (integer us), events/x, events/y (px), events/p (0 or 1), or times as decimal fractions of seconds"
GROUPS = ("events", "prophesee/left", "")  # DSEC, TUM-VIE, event_utils; M3ED; the columns at the top
TABLES = ("davis/left/events", "CD/events", "events")  # MVSEC; Metavision; tonic


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


def layout_of(path: Path, file: Any) -> Layout | None:
    """The layout of a file and what it says of its sensor; None where it is none of these."""
    columns = _columns(file)
    if columns is None:
        return None
    for data, _ in columns.values():
        _check_stored(path, file[data], data)
    if columns["t"][0] == "events/t" and "ms_to_idx" not in file:
        return None  # the plain layout, which hdf5.py reads
    table, field = columns["t"]
    kind = file[table].dtype[field] if isinstance(field, str) else file[table].dtype
    if kind.kind not in "iuf":
        raise DataError(path, f"has times of another kind: {table} is {file[table].dtype}", WANTS)
    offset, index, sensor, lens = 0, "", _attributes(file), None
    if table.startswith("davis/"):
        sensor = sensor or (346, 260)
        if "davis/right/events" in file:
            tell(DataNote(f"{path}: holds two cameras; the left one is read"))
    if table.startswith("prophesee/left/"):
        index, lens = "prophesee/left/ms_map_idx", _m3ed_lens(path, file)
        sensor = lens.sensor if lens else sensor
    if table == "events/t":
        index = "ms_to_idx"
        if "t_offset" in file:
            offset, sensor = int(np.asarray(file["t_offset"][()]).reshape(-1)[0]), sensor or (640, 480)
    found = Layout(columns, kind.kind == "f", offset, index if index in file else "", sensor, lens)
    _check_unit(path, file, found)
    return found


def _columns(file: Any) -> dict[str, tuple[str, str | int | None]] | None:
    """Where t, x, y, p stand."""
    for group in GROUPS:
        for form in ("{}", "{}s"):
            names = {name: f"{group}/{form.format(name)}".lstrip("/") for name in NAMES}
            if all(_is_column(file.get(name)) for name in names.values()):
                return {name: (data, None) for name, data in names.items()}
    for table in TABLES:
        data = file.get(table)
        if not isinstance(data, h5py.Dataset) or data.shape is None:
            continue
        if data.ndim == 1 and set(NAMES) <= set(data.dtype.names or ()):
            return {name: (table, name) for name in NAMES}
        if table.startswith("davis/") and data.ndim == 2 and data.shape[1] == 4:
            return {name: (table, column) for column, name in enumerate("xytp")}
    return None


def _is_column(data: Any) -> bool:
    """Whether it is a dataset of numbers, one an event."""
    return isinstance(data, h5py.Dataset) and data.shape is not None and data.ndim == 1 and data.dtype.kind in "iufb"


def _check_stored(path: Path, data: Any, name: str) -> None:
    """DataError where a dataset's pieces are too large, or packed by a filter that is not here."""
    if data.chunks and math.prod(data.chunks) * data.dtype.itemsize > LARGEST:
        raise DataError(path, f"{name} is stored in pieces of {data.chunks}", "write it again in smaller pieces; it may be damaged")
    packed = data.id.get_create_plist()
    for i in range(packed.get_nfilters()):
        code = packed.get_filter(i)[0]
        if not h5py.h5z.filter_avail(code):
            with suppress(ImportError):
                import hdf5plugin  # noqa: F401  # it registers its filters
        if not h5py.h5z.filter_avail(code):
            remedy = "pip install 'torchcmax[io]'"
            if code == 0x8ECF:
                remedy = "install Metavision's ECF plugin and set HDF5_PLUGIN_PATH, or give the RAW file"
            raise DataError(path, f"{name} is packed by the HDF5 filter {code}, which is not installed", remedy)


def _attributes(file: Any) -> tuple[Any, Any] | None:
    """Width and height from event_utils' sensor_resolution (H, W) or Metavision's geometry, 1280x720."""
    if "sensor_resolution" in file.attrs and np.size(file.attrs["sensor_resolution"]) == 2:
        height, width = np.asarray(file.attrs["sensor_resolution"]).reshape(-1).tolist()
        return width, height
    words = str(file.attrs.get("geometry", "")).split("x")
    return (words[0], words[1]) if len(words) == 2 else None


def _m3ed_lens(path: Path, file: Any) -> Lens | None:
    """M3ED's calib: intrinsics fx, fy, cx, cy, distortion_coeffs k1, k2, p1, p2, resolution."""
    calib = file.get("prophesee/left/calib")
    if calib is None or not {"intrinsics", "distortion_coeffs", "resolution"} <= set(calib):
        return None
    numbers = dict(zip(("fx", "fy", "cx", "cy"), np.asarray(calib["intrinsics"][()]).reshape(-1).tolist(), strict=False))
    bent = np.asarray(calib["distortion_coeffs"][()]).reshape(-1).tolist()
    model = calib["distortion_model"].asstr()[()] if "distortion_model" in calib else "radtan"
    if model != "radtan" or len(bent) != 4:
        raise DataError(path, f"calib has the distortion {model!r} of {len(bent)} numbers", "give another calibration: --camera FILE")
    lens = told_lens(str(path), {**numbers, "distortion": [*bent, 0.0]}, "calib/intrinsics wants fx, fy, cx, cy")
    width, height = np.asarray(calib["resolution"][()]).reshape(-1).tolist()
    return Lens(lens.file, lens.numbers, lens.distortion, lens.model, (int(width), int(height)))


def _check_unit(path: Path, file: Any, layout: Layout) -> None:
    """DataError where the columns differ in length, are empty, or decimal times are no seconds."""
    lengths = {name: len(file[data]) for name, (data, _) in layout.columns.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(path, f"has events of different lengths: {lengths}", WANTS)
    if not lengths["t"]:
        raise DataError(path, "holds no events", "record or copy it again")
    if layout.seconds:
        first, last = (float(_column(file, layout, "t", slice(i, i + 1))[0]) for i in (0, lengths["t"] - 1))
        if abs(last - first) > LONGEST:
            raise DataError(path, f"has times as decimal fractions from {first:g} to {last:g}, which are no seconds", WANTS)


def _column(file: Any, layout: Layout, name: str, part: slice) -> np.ndarray:
    """A stretch of one column."""
    data, field = layout.columns[name]
    if isinstance(field, int):
        row: np.ndarray = file[data][part, field]
        return row
    column: np.ndarray = file[data][part]
    return column if field is None else column[field]


def read_columns(path: Path, file: Any, layout: Layout, start: int, end: int) -> dict[str, np.ndarray]:
    """Columns of the events start to end, as integers; t in µs of the file's own clock."""
    found = {}
    for name in NAMES:
        column = _column(file, layout, name, slice(start, end))
        if column.dtype.kind == "f":
            column = column.astype(np.float64)
            whole = np.rint(column * 1e6 if name == "t" else column)
            wrong = ~(np.abs(whole) < 2.0**61) | ((whole != column) & (name != "t"))
            if wrong.any():
                i = int(wrong.argmax())
                raise DataError(path, f"{name} is {column[i]:g}, which it cannot be", WANTS, f"event {start + i + 1}")
            column = whole.astype(np.int64)
        found[name] = column.astype(np.int64) + layout.offset if name == "t" and layout.offset else column
    return found


def event_before(file: Any, layout: Layout, time: int) -> int:
    """An event with none of a time, µs, or later before it, by the file's index by ms; 0 where that does not hold."""
    index, ms = file[layout.index], (time - layout.offset) // 1000
    if ms <= 0 or index.ndim != 1 or not len(index):
        return 0
    event = int(index[min(ms, len(index) - 1)])
    if not 0 < event <= len(file[layout.columns["t"][0]]):
        return 0
    last = int(_column(file, layout, "t", slice(event - 1, event))[0]) + layout.offset
    return event if last < time and not layout.seconds else 0
