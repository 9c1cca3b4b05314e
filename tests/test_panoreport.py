"""`torchcmax panorama`: what it writes, what it refuses; panorama.h5, its pictures, and how good it says that it is."""

import csv
import json
import math

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from torchcmax.cli import main
from torchcmax.core import so3
from torchcmax.core.camera import Sphere
from torchcmax.core.contrast import blur
from torchcmax.folder import TURNED
from torchcmax.io import DataError, open
from torchcmax.mapfile import load_map, save_map
from torchcmax.mapimage import UNSEEN
from torchcmax.panoimage import picture
from torchcmax.quality import quality
from torchcmax.simulator import Simulation, write
from torchcmax.slam.globe import Globe
from torchcmax.slam.system import Panorama
from torchcmax.track import TrackOptions, track

SMALL = {"scene": "panorama", "motion": "rotation", "width": 120, "height": 90, "focal": 100.0}


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write(Simulation(duration=0.6, **SMALL), tmp_path_factory.mktemp("street") / "street")


@pytest.fixture(scope="module")
def done(street, tmp_path_factory):
    """The folder of a whole run."""
    out = tmp_path_factory.mktemp("panorama") / "out"
    assert main(["panorama", str(street), "--out", str(out), "--quiet", "--images", "5"]) == 0
    return out


def test_a_run_leaves_what_it_promises(done, street):
    names = {path.name for path in done.iterdir()}
    assert {*TURNED, "windows.csv", "summary.json", "images"} <= names
    assert not {"map.png", "map.h5"} & names
    found = json.loads((done / "summary.json").read_text())
    assert found["complete"]
    assert found["model"] == "rotation"
    assert found["lost_seconds"] == 0
    assert "plane" not in found
    assert found["error"]["orientation_rmse_deg"] < 0.4
    assert found["error"]["coverage"] == 1
    assert 0.03 < found["panorama"]["seen_share"] < 0.6
    assert found["panorama"]["event_area_sr"] > 0.01
    assert found["panorama"]["gradient_magnitude"] > 0.1
    assert set(found["files"]) == {*TURNED, "windows.csv"}
    numbers = np.loadtxt(done / "trajectory.txt")
    assert not numbers[:, 1:4].any()
    with (done / "windows.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == found["windows"] == len(numbers)
    assert {line["n_x"] for line in lines} == {""}
    assert {line["v_x"] for line in lines} <= {"0", "-0"}
    width, height = Image.open(done / "panorama.png").size
    assert width >= found["panorama"]["width"]
    assert Image.open(done / "panorama_cropped.png").size[1] < height


def test_a_saved_panorama_is_tracked_against_from_elsewhere(done, street, tmp_path):
    before = (done / "panorama.h5").read_bytes()
    out = tmp_path / "again"
    arguments = ["--map", str(done / "panorama.h5"), "--from", "0.25", "--out", str(out), "--quiet", "--images", "0"]
    assert main(["panorama", str(street), *arguments]) == 0
    assert (done / "panorama.h5").read_bytes() == before
    assert not (out / "panorama.h5").exists()
    recording = open(street)
    here = np.loadtxt(out / "trajectory.txt")
    there = np.loadtxt(done / "trajectory.txt")
    assert here[0, 0] < 0.45
    near = np.abs(here[:, :1] - there[None, :, 0]).argmin(1)
    assert recording.truth is not None
    R = [so3.from_quaternion(torch.tensor(rows[:, 4:])) for rows in (here, there[near])]
    truth = [recording.truth.at(torch.tensor((rows[:, 0] * 1e6).round()).long()).R for rows in (here, there[near])]
    moved = so3.log((R[0] @ truth[0].mT).mT @ (R[1] @ truth[1].mT)).norm(dim=-1).rad2deg()
    assert moved.max() < 0.6


def test_maps_of_planes_and_panoramas_are_not_taken_for_each_other(done, street, demo, tmp_path, capsys):
    assert main(["track", str(street), "--map", str(done / "panorama.h5"), "--out", str(tmp_path / "a"), "--quiet"]) == 1
    assert "is a panorama" in (said := capsys.readouterr().err)
    assert "torchcmax panorama --map" in said
    with h5py.File(tmp_path / "map.h5", "w") as file:
        file.attrs["format"] = "torchcmax something"
    assert main(["panorama", str(street), "--map", str(tmp_path / "map.h5"), "--out", str(tmp_path / "b"), "--quiet"]) == 1
    assert "no map" in capsys.readouterr().err


def test_what_is_not_ours_is_not_replaced(street, tmp_path, capsys):
    (tmp_path / "panorama.png").write_text("mine")
    assert main(["panorama", str(street), "--out", str(tmp_path), "--quiet"]) == 1
    assert "panorama.png, which no run of ours wrote" in capsys.readouterr().err
    assert (tmp_path / "panorama.png").read_text() == "mine"


def test_a_second_run_takes_the_place_of_the_first(street, tmp_path):
    for end in ("0.2", "0.3"):
        assert main(["panorama", str(street), "--to", end, "--out", str(tmp_path), "--quiet", "--images", "0"]) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["seconds"] > 0.25
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 1


def test_a_run_that_is_broken_off_keeps_what_is_done(street, tmp_path, monkeypatch):
    from torchcmax.panoreport import PanoramaReport

    add = PanoramaReport.add

    def broken(self, one):
        if one.index == 9:
            raise KeyboardInterrupt
        add(self, one)

    monkeypatch.setattr(PanoramaReport, "add", broken)
    assert main(["panorama", str(street), "--out", str(tmp_path), "--quiet", "--images", "0"]) == 130
    found = json.loads((tmp_path / "summary.json").read_text())
    assert not found["complete"]
    assert found["windows"] == 9
    assert (tmp_path / "panorama.png").exists()
    assert len(np.loadtxt(tmp_path / "trajectory.txt")) == 9


def test_options_are_explained_and_misspelt_ones_answered(capsys):
    with pytest.raises(SystemExit) as end:
        main(["panorama", "--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("--map", "--from", "--relocalizing.steps", "--mapping.overlap", "--tracking.displacement"))
    assert "--distance" not in said
    with pytest.raises(SystemExit) as end:
        main(["panorama", "x", "--out", "y", "--mapping.overlp", "0.5"])
    assert end.value.code == 2
    assert "--mapping.overlap" in capsys.readouterr().err


@pytest.fixture(scope="module")
def globe(street):
    tracks = track(open(street), TrackOptions(Panorama(), end=0.3))
    for _ in tracks:
        pass
    return tracks.map


def test_a_panorama_in_a_file_is_the_same_bit_for_bit(globe, tmp_path):
    save_map(tmp_path / "panorama.h5", globe)
    again = load_map(tmp_path / "panorama.h5")
    assert isinstance(again, Globe)
    assert (again.focal, again.number, again.texture) == (globe.focal, globe.number, globe.texture)
    assert torch.equal(again.layers.votes, globe.layers.votes)
    assert torch.equal(again.layers.exposure, globe.layers.exposure)
    assert torch.equal(again.border, globe.border)
    for one, other in zip(again.keyframes, globe.keyframes, strict=True):
        assert torch.equal(one.state.pose.R, other.state.pose.R)
        assert torch.equal(one.ink.x, other.ink.x)
        assert (one.time, one.seconds.item()) == (other.time, other.seconds.item())
    with h5py.File(tmp_path / "panorama.h5") as file:
        texture, weight = file["sphere/texture"][()], file["sphere/weight"][()]
    assert texture.shape == weight.shape == globe.sphere.size
    assert 0 <= texture.min() < 0.1 < texture.max() <= 1


def test_a_broken_panorama_is_told_as_such(globe, tmp_path):
    path = tmp_path / "panorama.h5"
    save_map(path, globe)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"panorama\.h5"):
        load_map(path)
    path.write_bytes(whole)
    with h5py.File(path, "a") as file:
        del file["sphere/votes"]
        file["sphere/votes"] = np.zeros((4, 8), np.float32)
    with pytest.raises(DataError, match=r"sphere/votes has the shape"):
        load_map(path)


def marked(*places):
    """A globe of which squares of a cell at (row, column) were seen."""
    globe = Globe(40.0, torch.tensor([[-0.5, -0.4, 1.0], [0.5, 0.4, 1.0]]))
    for row, column in places:
        globe.layers.exposure[0, row, column] = 30.0
    return globe


def test_what_was_never_seen_is_grey_and_an_empty_globe_has_a_picture():
    page = picture(marked(), torch.zeros(0, 3, 3), "nothing")
    assert (page[:100, :, :] == UNSEEN).all()
    page = picture(marked((10, 10)), torch.zeros(0, 3, 3), "one")
    assert (page[40:44, 40 + (page.shape[1] - 256) // 2 :][:, :4] == 255).all()


def test_what_was_seen_over_the_seam_is_cropped_in_one_piece():
    globe = marked(*((15, column) for column in (0, 1, 2, 61, 62, 63)))
    assert globe.sphere.size == (128, 256)
    axis = so3.exp(torch.tensor([[0.0, math.pi - 0.05, 0.0], [0.0, math.pi + 0.05, 0.0]], dtype=torch.float64))
    page = picture(globe, axis, "over the seam", cropped=True)
    inner = page[:-40]
    white = (inner == 255).all(-1).any(0).nonzero()[0]
    assert white[-1] - white[0] == 23  # six cells
    coloured = (inner.max(-1).astype(int) - inner.min(-1)) > 40
    assert coloured.any()
    assert np.ptp(coloured.any(0).nonzero()[0]) < 40  # the path is short


def test_the_path_is_not_drawn_across_the_picture_where_it_leaves_on_one_side():
    axis = so3.exp(torch.tensor([[0.0, math.pi - 0.2, 0.0], [0.0, math.pi - 0.1, 0.0], [0.0, math.pi + 0.1, 0.0]], dtype=torch.float64))
    page = picture(marked((15, 3)), axis, "seam")
    coloured = (page.max(-1).astype(int) - page.min(-1)) > 40
    columns = coloured.any(0).nonzero()[0] - (page.shape[1] - 256) // 2
    assert ((columns < 20) | (columns > 230)).all()


def test_a_sharp_panorama_has_less_area_and_more_gradient_than_a_blurred_one():
    sphere = Sphere(64)
    votes = torch.zeros(sphere.size)
    votes[30:34, ::8] = 5.0
    seen = torch.ones(sphere.size, dtype=torch.bool)
    sharp, soft = (quality(image, seen, sphere) for image in (votes, blur(votes[None], 1.5)[0]))
    assert sharp.event_area < 0.8 * soft.event_area
    assert sharp.gradient_magnitude > 1.5 * soft.gradient_magnitude
    assert sharp.seen_share == pytest.approx(1)
    one = torch.zeros(sphere.size)
    one[32, 5] = 1e3
    assert quality(one, seen, sphere).event_area == pytest.approx(1, abs=2e-3)
    assert quality(one, seen, sphere).event_area_sr == pytest.approx((math.pi / 64) ** 2, rel=0.01)
    with pytest.raises(ValueError, match="quality wants votes and seen"):
        quality(votes[:5], seen, sphere)
