"""panorama.h5: what is saved comes back, others can read it, and what is no panorama is said to be none."""

import json
import math
from dataclasses import fields

import h5py
import numpy as np
import pytest
import torch

from torchcmax.core.camera import Camera
from torchcmax.core.draw import Ink
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.so3 import exp
from torchcmax.core.state import State
from torchcmax.io import DataError
from torchcmax.mapfile import load_map, save_map
from torchcmax.slam.globe import Globe
from torchcmax.slam.map import Keyframe, Texture
from torchcmax.slam.tiles import CELL, spread

CAMERA = Camera.pinhole((60, 80))
SIZE = (304, 608)  # of its sphere: pi times the focal length of 96 px, in whole pairs of cells


def drawn(keyframes=3, seed=0):
    """A globe that windows of 500, 501, ... random events drew, the second one over the seam, the third one at the pole."""
    random = torch.Generator().manual_seed(seed)
    globe = Globe(CAMERA.fx, CAMERA.rays().float().reshape(-1, 3), Texture(exposure=21.0, blur=(3.0, 1.0)), number=7)
    turns = torch.tensor([[0.0, 0.3, 0.2], [0.1, math.pi, 0.0], [1.5, 0.0, 0.3]], dtype=torch.float64)
    for i in range(keyframes):
        rays = CAMERA.rays().reshape(-1, 3).float()[torch.randint(60 * 80, (500 + i,), generator=random)]
        s = torch.rand(500 + i, generator=random).sort().values - 0.5
        ink = Ink(rays[None, :, 0], rays[None, :, 1], s[None], torch.rand(1, 500 + i, generator=random))
        nowhere = torch.zeros(1, 3, dtype=torch.float64)
        omega = torch.tensor([[0.3, -0.2, 0.1]], dtype=torch.float64) * (i + 1) * 10
        state = State(Pose(exp(turns[i : i + 1]), nowhere), Motion(omega, nowhere))
        globe.draw([Keyframe(1_700_000_000_000_000 + 40_000 * i, state, torch.full((1,), 0.04 + 0.01 * i, dtype=torch.float64), ink)])
    return globe


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("panorama") / "panorama.h5"
    save_map(path, drawn())
    return path


def same(a, b):
    return torch.equal(a, b) and a.dtype == b.dtype


def test_a_panorama_comes_back_bit_for_bit(file):
    globe, back = drawn(), load_map(file)
    assert isinstance(back, Globe)
    assert (back.number, back.focal, back.texture) == (7, globe.focal, globe.texture)
    assert same(back.border, globe.border)
    assert globe.layers.votes.any()
    assert globe.layers.exposure.any()
    assert same(back.layers.votes, globe.layers.votes)
    assert same(back.layers.exposure, globe.layers.exposure)
    assert len(back.keyframes) == 3
    for one, other in zip(back.keyframes, globe.keyframes, strict=True):
        assert one.time == other.time
        pairs = [(one.seconds, other.seconds)]
        pairs += [(getattr(one.ink, f.name), getattr(other.ink, f.name)) for f in fields(Ink)]
        pairs += [(getattr(one.state.pose, name), getattr(other.state.pose, name)) for name in ("R", "t")]
        pairs += [(getattr(one.state.motion, name), getattr(other.state.motion, name)) for name in ("omega", "velocity")]
        assert all(same(a, b) for a, b in pairs)


def test_what_comes_back_is_the_same_to_look_at_and_can_grow(file):
    globe, back = drawn(), load_map(file)
    assert torch.equal(back.strength(), globe.strength())
    assert back.typical() == globe.typical()
    for m in (globe, back):
        m.draw(drawn().keyframes[:1])
    assert len(back.keyframes) == 4
    assert torch.equal(back.layers.votes, globe.layers.votes)
    assert torch.equal(back.known(), globe.known())
    assert back.known().any()


def test_the_keyframes_that_come_back_draw_the_panorama_again(file):
    back = load_map(file)
    again = back.layers_of(back.keyframes)
    torch.testing.assert_close(again.votes, back.layers.votes)
    torch.testing.assert_close(again.exposure, back.layers.exposure)


def test_texture_and_weight_are_there_for_others_to_look_at(file):
    globe = drawn()
    with h5py.File(file) as contents:
        assert contents.attrs["format"] == "torchcmax panorama"
        texture, weight = contents["sphere/texture"][()], contents["sphere/weight"][()]
        assert contents["sphere"].attrs["layout"].startswith("equirectangular")
    assert texture.shape == weight.shape == globe.sphere.size == SIZE
    assert texture.dtype == weight.dtype == np.float32
    assert 0 == texture.min() < 0.2 < texture.max() <= 1
    np.testing.assert_array_equal(texture, globe.strength().numpy())
    np.testing.assert_array_equal(weight, spread(globe.layers.most).numpy())
    assert weight.min() == 0


def test_the_middle_of_the_texture_looks_along_z_and_its_rows_go_down(tmp_path):
    """One edge straight ahead, one a quarter round to the right, one near straight down."""
    globe = Globe(40.0, torch.tensor([[-0.5, -0.4, 1.0], [0.5, 0.4, 1.0]]))
    height, width = globe.sphere.size
    globe.layers.exposure[0] = 30.0
    for ray in ((0.01, 0.01, 1.0), (1.0, 0.01, 0.01), (0.01, 1.0, 0.02)):
        x, y = globe.sphere.pixels(torch.tensor(ray)).round().int().tolist()
        globe.layers.votes[y, x] = 50.0
    save_map(tmp_path / "p.h5", globe)
    with h5py.File(tmp_path / "p.h5") as contents:
        found = np.argwhere(contents["sphere/texture"][()] > 0)
    assert found[0] == pytest.approx([height / 2, width / 2], abs=1)
    assert found[1] == pytest.approx([height / 2, 3 * width / 4], abs=1)
    assert found[2][0] > 0.97 * height
    assert len(found) == 3


def test_a_panorama_without_keyframes_comes_back(tmp_path):
    save_map(tmp_path / "p.h5", drawn(0))
    back = load_map(tmp_path / "p.h5")
    assert isinstance(back, Globe)
    assert back.keyframes == []
    assert back.sphere.size == SIZE
    assert not back.layers.votes.any()
    with h5py.File(tmp_path / "p.h5") as contents:
        assert not contents["sphere/texture"][()].any()


def test_the_same_panorama_makes_the_same_file(file, tmp_path):
    save_map(tmp_path / "p.h5", drawn())
    assert (tmp_path / "p.h5").read_bytes() == file.read_bytes()
    save_map(tmp_path / "p.h5", load_map(file))
    assert (tmp_path / "p.h5").read_bytes() == file.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["p.h5"]


def test_a_file_that_is_cut_off_anywhere_is_said_to_be(file, tmp_path):
    whole = file.read_bytes()
    for share in (0, 0.001, 0.2, 0.5, 0.9, 0.999):
        (tmp_path / "p.h5").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DataError, match=r"p\.h5: cannot be read as a map"):
            load_map(tmp_path / "p.h5")


def spoil(file, change, path):
    path.write_bytes(file.read_bytes())
    with h5py.File(path, "r+") as contents:
        change(contents)
    return path


def replaced(name, values):
    def change(contents):
        del contents[name]
        contents[name] = values

    return change


def spotted(name, value):
    def change(contents):
        contents[name][0, 0] = value

    return change


CELLS = 3, SIZE[0] // CELL, SIZE[1] // CELL


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.attrs.update(format="torchcmax"), "no map"),
        (lambda f: f.attrs.pop("format"), "no map"),
        (lambda f: f.attrs.update(format="torchcmax map"), "cannot be read as a map"),
        (lambda f: f.attrs.update(version=99), "version 99"),
        (lambda f: f.attrs.update(texture="{"), "cannot be read as a map"),
        (lambda f: f.attrs.update(texture=json.dumps({"grain": 1})), "grain"),
        (lambda f: f.attrs.update(texture=json.dumps({"exposure": -1})), "exposure"),
        (lambda f: f.attrs.pop("focal"), "focal"),
        (lambda f: f.attrs.update(focal=math.nan), "cannot be read as a map"),
        (lambda f: f.attrs.update(focal=110.0), "sphere/votes has the shape"),
        (lambda f: f.attrs.update(focal=-80.0), "sphere/votes has the shape"),
        (lambda f: f.pop("sphere"), "cannot be read as a map"),
        (lambda f: f.pop("border"), "border"),
        (lambda f: f["sphere"].pop("exposure"), "exposure"),
        (lambda f: f["keyframes"].pop("R"), "R"),
        (replaced("border", [[0.0, 1.0]]), "border has the shape"),
        (replaced("sphere/votes", np.zeros((SIZE[0], SIZE[1] - 1), np.float32)), "sphere/votes has the shape"),
        (replaced("sphere/votes", np.zeros(SIZE[::-1], np.float32)), "sphere/votes has the shape"),
        (replaced("sphere/exposure", np.zeros((2, *CELLS[1:]), np.float32)), "sphere/exposure has the shape"),
        (spotted("sphere/votes", math.nan), "sphere/votes holds a number that is not finite"),
        (spotted("sphere/exposure", math.inf), "sphere/exposure holds a number that is not finite"),
        (replaced("keyframes/events", [1, 2, 3]), "keyframes/ink/x has the shape"),
        (replaced("keyframes/events", [-1, 2, 1502]), "cannot be read as a map"),
        (replaced("keyframes/R", np.eye(3)), "keyframes/R has the shape"),
    ],
)
def test_a_file_that_was_tampered_with_is_named(change, words, file, tmp_path):
    with pytest.raises(DataError, match=words) as caught:
        load_map(spoil(file, change, tmp_path / "p.h5"))
    assert "p.h5" in str(caught.value)
    assert "what to do" in str(caught.value)


def test_what_others_may_look_at_is_not_read_back(file, tmp_path):
    """Texture and weight follow from the layers."""
    change = replaced("sphere/texture", np.zeros((2, 2)))
    assert torch.equal(load_map(spoil(file, change, tmp_path / "p.h5")).strength(), drawn().strength())


def test_a_place_that_cannot_be_written_is_named_and_the_old_file_stays(tmp_path, monkeypatch):
    with pytest.raises(DataError, match="cannot be written"):
        save_map(tmp_path / "nowhere" / "p.h5", drawn(1))
    (tmp_path / "p.h5").write_text("old")
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("", (), {"free": 8 << 20}))
    with pytest.raises(DataError, match="No space left"):
        save_map(tmp_path / "p.h5", drawn(1))
    assert (tmp_path / "p.h5").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
