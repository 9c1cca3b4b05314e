"""HDF5 files that cannot be used are named, with the place in them and what to do."""

import h5py
import numpy as np
import pytest
from samples import CALIB, noise, read, refused

from torchcmax.io import save


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.pop("events"), "has no events/t, events/x, events/y, events/p; it holds nothing"),
        (lambda f: f["events"].pop("p"), "has no events/p; it holds events"),
        (lambda f: f["events"].pop("x") and f.create_dataset("events/x", data=[1, 2]), "different lengths"),
        (lambda f: f["events"].pop("t") and f.create_dataset("events/t", data=[0.1, 0.2, 0.3]), "another kind: t: float64"),
        (lambda f: f["events"].pop("x") and f.create_dataset("events/x", data=[[1], [2], [3]]), "another kind"),
        (lambda f: f["events"].pop("x") and f.create_dataset("events/x", data=[1, -2, 3]), "events/x is -2"),
        (lambda f: f["events"].pop("p") and f.create_dataset("events/p", data=[1, 0, 7]), "events/p is 7"),
        (lambda f: f.attrs.update(format="torchcmax", version=99), "newer"),
        (lambda f: f.attrs.update(format="torchcmax", version="new"), "is of version new"),
        (lambda f: f.create_group("groundtruth"), "groundtruth/t is missing or holds no numbers"),
        (lambda f: f.create_dataset("groundtruth", data=3), "groundtruth/t is missing or holds no numbers"),
        (lambda f: with_truth(f, t=[0.0, np.nan]), "groundtruth, pose 2: a number out of all range"),
        (lambda f: with_truth(f, t=[0.0, 1e13]), "groundtruth, pose 2: a number out of all range"),
        (lambda f: with_truth(f, t=["a", "b"]), "groundtruth/t is missing or holds no numbers"),
        (lambda f: with_truth(f, t=[1, 1]), "groundtruth, pose 2: time does not increase"),
        (lambda f: with_truth(f, t=[0.0, 1.0, 2.0]), "poses of shapes t (3,), p (2, 3), q (2, 4)"),
        (lambda f: with_truth(f, t=[0.0], p=[[0, 0, 0]], q=[[0, 0, 0, 1]]), "holds 1 poses"),
        (lambda f: with_truth(f, p=[[0, 0, 0], [0, np.inf, 0]]), "groundtruth, pose 2: a number out of all range"),
        (lambda f: with_truth(f, q=[[0, 0, 0, 1], [0, 0, 0, 0]]), "groundtruth, pose 2: qx qy qz qw is no unit quaternion"),
        (lambda f: with_truth(f, plane=[0, 0, np.nan, 1]), "groundtruth/plane: [0.0, 0.0, nan, 1.0] is no unit normal"),
        (lambda f: with_truth(f, plane=[0, 0, -1]), "groundtruth/plane: [0, 0, -1] is no unit normal"),
        (lambda f: f["events"].pop("t") and f.create_dataset("events/t", data=[-(2**62), 0, 2**62]), "events/t is -4611686018427387904"),
        (lambda f: f.create_group("calib").attrs.update(fx=1, fy=2, cx=3), "cy is missing"),
        (lambda f: f.create_group("calib").attrs.update(fx="long", fy=2, cx=3, cy=3), "fx is 'long', not a number"),
    ],
)
def test_bad_hdf5(tmp_path, change, words):
    (tmp_path / "calib.txt").write_text(CALIB)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name, data in (("t", [1, 2, 3]), ("x", [1, 2, 3]), ("y", [1, 2, 3]), ("p", [1, 0, 1])):
            file[f"events/{name}"] = np.array(data)
        change(file)
    assert refused(tmp_path / "e.h5", words).path == tmp_path / "e.h5"


@pytest.mark.parametrize(("width", "words"), [("wide", "width is 'wide', not a number"), (-240, "width is -240"), (2.5, "width is 2.5")])
def test_a_wrong_size_in_hdf5_is_named_and_can_be_overridden(tmp_path, width, words):
    (tmp_path / "calib.txt").write_text(CALIB)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file.attrs.update(width=width, height=180)
        for name in "txyp":
            file[f"events/{name}"] = [1]
    assert refused(tmp_path / "e.h5", words, "--sensor 240x180", sensor=None).path == tmp_path / "e.h5"
    assert len(read(tmp_path / "e.h5", sensor=(240, 180))) == 1


def with_truth(file, plane=None, **columns):
    """Two good poses, but for what is given."""
    good = {"t": [0.0, 1.0], "p": [[0, 0, 0], [1, 0, 0]], "q": [[0, 0, 0, 1], [0, 0, 0, 1]]}
    for name, data in (good | columns).items():
        file[f"groundtruth/{name}"] = data
    if plane is not None:
        file["groundtruth/plane"] = plane


@pytest.mark.parametrize("empty", [np.zeros(0, "i8"), np.zeros(0), h5py.Empty("i8")])
def test_hdf5_without_events(tmp_path, empty):
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", data=empty)
    refused(tmp_path / "e.h5", "holds no events")


def test_hdf5_cut_off_or_damaged(tmp_path):
    save(noise(), tmp_path / "a.h5")
    whole = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    refused(tmp_path / "cut.h5", "cannot be read as HDF5")
    middle = len(whole) // 2
    (tmp_path / "bad.h5").write_bytes(whole[:middle] + bytes(b ^ 0x55 for b in whole[middle : middle + 9000]) + whole[middle + 9000 :])
    refused(tmp_path / "bad.h5", "cannot be read as HDF5")
