"""The layouts of HDF5 that are read, written small."""

import numpy as np

N = 5000
T = np.arange(N, dtype=np.int64) * 137 + 1000
X, Y, P = np.arange(N) % 300, np.arange(N) % 200, np.arange(N) % 2


def index():
    return np.searchsorted(T, np.arange(T[-1] // 1000 + 2) * 1000)


def columns(group, t="t", x="x", y="y", p="p", time=T, **stored):
    for name, data in ((t, time), (x, X.astype("u2")), (y, Y.astype("u2")), (p, P.astype("u1"))):
        group.create_dataset(name, data=data, **stored)


def plain(file):
    columns(file.create_group("events"))


def dsec(file):
    columns(file.create_group("events"), time=T.astype("u4"))
    file["ms_to_idx"], file["t_offset"] = index(), 51648500000


def tumvie(file):
    plain(file)
    file["ms_to_idx"] = index()


def mvsec(file):
    for side in ("left", "right"):
        file[f"davis/{side}/events"] = np.stack([X, Y, T / 1e6, 2.0 * P - 1], 1)


def m3ed(file):
    group = file.create_group("prophesee/left")
    columns(group, chunks=(700,), compression="lzf", maxshape=(None,))
    group["ms_map_idx"] = index()
    group["calib/intrinsics"], group["calib/resolution"] = [1000.0, 1001, 640, 360], [1280, 720]
    group["calib/distortion_coeffs"] = [-0.1, 0.01, 0.001, 0.002]
    group["calib/camera_model"], group["calib/distortion_model"] = "pinhole", "radtan"


def compound(name, **stored):
    def write(file):
        table = np.zeros(N, [("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")])
        table["x"], table["y"], table["p"], table["t"] = X, Y, P, T
        file.create_dataset(name, data=table, **stored)
        file.attrs["geometry"] = "640x480"

    return write


def event_utils(file):
    columns(file.create_group("events"), "ts", "xs", "ys", "ps", T / 1e6, chunks=(1024,), maxshape=(None,))
    file.attrs["sensor_resolution"] = (260, 346)


def v2e(file):
    file["events"] = np.stack([T, X, Y, P], 1).astype("u4")


LAYOUTS = {  # what writes it, (height, width) px where the file or the layout tells it, t_offset us
    "dsec": (dsec, (480, 640), 51648500000),
    "tumvie": (tumvie, None, 0),
    "mvsec": (mvsec, (260, 346), 0),
    "m3ed": (m3ed, (720, 1280), 0),
    "tonic": (compound("data/0", chunks=(625,), compression="lzf"), (480, 640), 0),
    "compound": (compound("events"), (480, 640), 0),
    "v2e": (v2e, None, 0),
    "metavision": (compound("CD/events", chunks=(1000,), compression="gzip"), (480, 640), 0),
    "event_utils": (event_utils, (260, 346), 0),
}
