import json
from dataclasses import fields

import h5py
import pytest
import torch

from torchcmax.core.camera import Camera
from torchcmax.core.draw import Ink
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion, Pose
from torchcmax.core.so3 import exp
from torchcmax.core.state import State
from torchcmax.io import DataError
from torchcmax.mapfile import load_map, save_map
from torchcmax.slam.map import Keyframe, Map, Texture

CAMERA = Camera.pinhole((60, 80))


def drawn(keyframes=3, seed=0):
    """A map that windows of 500, 501, ... random events drew from places beside each other."""
    random = torch.Generator().manual_seed(seed)
    plane = Plane.tilted(torch.tensor([[0.1, -0.2]], dtype=torch.float64))
    m = Map(plane, CAMERA.fx, CAMERA.rays().float().reshape(-1, 3), Texture(exposure=21.0, blur=(3.0, 1.0)), number=7)
    for i in range(keyframes):
        rays = CAMERA.rays().reshape(-1, 3).float()[torch.randint(60 * 80, (500 + i,), generator=random)]
        s = torch.rand(500 + i, generator=random).sort().values - 0.5
        ink = Ink(rays[None, :, 0], rays[None, :, 1], s[None], torch.ones(1, 500 + i))
        shift = torch.tensor([[0.4 * i, 0.1 * i, -0.05 * i]], dtype=torch.float64)
        pose = Pose(exp(torch.tensor([[0.01, 0.02, 0.3]], dtype=torch.float64) * i), shift)
        state = State(pose, Motion(torch.full((1, 3), 0.3, dtype=torch.float64), torch.full((1, 3), 2.0, dtype=torch.float64)))
        m.draw([Keyframe(1_700_000_000_000_000 + 40_000 * i, state, torch.full((1,), 0.04, dtype=torch.float64), ink)])
    assert len(m.keyframes) == keyframes
    return m


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.h5"
    save_map(path, drawn())
    return path


def same(a, b):
    return torch.equal(a, b) and a.dtype == b.dtype


def test_a_map_comes_back_bit_for_bit(file):
    m, back = drawn(), load_map(file)
    assert (back.number, back.focal, back.texture) == (7, m.focal, m.texture)
    assert same(back.plane.normal, m.plane.normal)
    assert same(back.plane.distance, m.plane.distance)
    assert same(back.border, m.border)
    assert list(back.tiles) == list(m.tiles)
    assert len(m.tiles) > 4
    for name, tile in m.tiles.items():
        assert same(back.tiles[name].votes, tile.votes)
        assert same(back.tiles[name].exposure, tile.exposure)
    assert len(back.keyframes) == len(m.keyframes)
    for one, other in zip(back.keyframes, m.keyframes, strict=True):
        assert one.time == other.time
        pairs = [(one.seconds, other.seconds)]
        pairs += [(getattr(one.ink, f.name), getattr(other.ink, f.name)) for f in fields(Ink)]
        pairs += [(getattr(one.state.pose, name), getattr(other.state.pose, name)) for name in ("R", "t")]
        pairs += [(getattr(one.state.motion, name), getattr(other.state.motion, name)) for name in ("omega", "velocity")]
        assert all(same(a, b) for a, b in pairs)


def test_what_comes_back_is_the_same_map_to_look_at_and_can_grow(file):
    m, back = drawn(), load_map(file)
    torch.testing.assert_close(back.strength(back.assembled(back.whole())), m.strength(m.assembled(m.whole())), rtol=0, atol=0)
    back.draw(m.keyframes[:1])
    assert len(back.keyframes) == 4


def test_a_map_without_keyframes_or_tiles_comes_back(tmp_path):
    save_map(tmp_path / "m.h5", drawn(0))
    back = load_map(tmp_path / "m.h5")
    assert back.tiles == {}
    assert back.keyframes == []


def test_the_same_map_makes_the_same_file(file, tmp_path):
    save_map(tmp_path / "m.h5", drawn())
    assert (tmp_path / "m.h5").read_bytes() == file.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]


def test_a_file_that_is_cut_off_anywhere_is_said_to_be(file, tmp_path):
    whole = file.read_bytes()
    for share in (0, 0.001, 0.2, 0.5, 0.9, 0.999):
        (tmp_path / "m.h5").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DataError, match="cannot be read as a map"):
            load_map(tmp_path / "m.h5")


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.attrs.update(format="torchcmax"), "no map"),
        (lambda f: f.attrs.update(version=99), "version 99"),
        (lambda f: f.attrs.update(texture="{"), "cannot be read as a map"),
        (lambda f: f.attrs.update(texture=json.dumps({"grain": 1})), "grain"),
        (lambda f: f.attrs.update(texture=json.dumps({"exposure": -1})), "exposure"),
        (lambda f: f.attrs.pop("focal"), "focal"),
        (lambda f: f.pop("border"), "border"),
        (lambda f: f["keyframes"].pop("R"), "R"),
        (replaced("plane/normal", [[0.0, 1.0]]), "plane/normal has the shape"),
        (replaced("plane/distance", [float("nan")]), "not finite"),
        (replaced("keyframes/events", [1, 2, 3]), "keyframes/ink/x has the shape"),
        (replaced("keyframes/events", [-1, 2, 1502]), "cannot be read as a map"),
        (replaced("tiles/place", [[1, 2]]), "tiles/votes has the shape"),
    ],
)
def test_a_file_that_was_tampered_with_is_named(change, words, file, tmp_path):
    with pytest.raises(DataError, match=words) as caught:
        load_map(spoil(file, change, tmp_path / "m.h5"))
    assert "m.h5" in str(caught.value)
    assert "what to do" in str(caught.value)


def test_files_of_other_kinds_are_refused(tmp_path, demo):
    (tmp_path / "m.h5").write_text("words")
    for path, words in ((tmp_path / "m.h5", "cannot be read"), (tmp_path / "none.h5", "no such file"), (tmp_path, "no such file")):
        with pytest.raises(DataError, match=words):
            load_map(path)
    with pytest.raises(DataError, match="is an HDF5 file, but no map"):
        load_map(demo / "events.h5")


def test_a_place_that_cannot_be_written_is_named_and_the_old_file_stays(file, tmp_path, monkeypatch):
    with pytest.raises(DataError, match="cannot be written"):
        save_map(tmp_path / "nowhere" / "m.h5", drawn())
    (tmp_path / "m.h5").write_text("old")
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("", (), {"free": 1000}))
    with pytest.raises(DataError, match="No space left"):
        save_map(tmp_path / "m.h5", drawn())
    assert (tmp_path / "m.h5").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
