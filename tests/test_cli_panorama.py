"""`torchcmax panorama` as a user meets it: exit status, messages, files."""

import csv
import json
import math
import shutil
from itertools import pairwise

import numpy as np
import pytest
import yaml
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchcmax.cli import main
from torchcmax.commands import following
from torchcmax.core import so3
from torchcmax.io import open
from torchcmax.io.trajectory import read_trajectory
from torchcmax.mapfile import load_map
from torchcmax.simulator import Simulation, write
from torchcmax.slam.globe import Globe

FILES = {
    "trajectory.txt",
    "truth.txt",
    "report.html",
    "windows.csv",
    "keyframes.csv",
    "panorama.png",
    "panorama_cropped.png",
    "panorama.h5",
    "summary.json",
}
BRIEF = ("--mapping.first", 3, "--to", 0.3, "--images", 0, "--quiet")


def run(capsys, *arguments):
    """Exit status, what was printed, what was complained about."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:
        status = stop.code
    out, err = capsys.readouterr()
    return status, out, err


def rows(file):
    with file.open() as lines:
        return list(csv.DictReader(lines))


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def apart(one, other):
    """Degrees [M] between the orientations of one trajectory and those of another at the same times."""
    return so3.log(one.pose.R.mT @ other.at(one.time).R).norm(dim=-1).rad2deg()


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A small sensor that turns for half a second in a panorama."""
    folder = tmp_path_factory.mktemp("street") / "street"
    write(Simulation(scene="panorama", motion="rotation", duration=0.5, width=120, height=90, focal=100), folder)
    return folder


@pytest.fixture(scope="module")
def folder(street, tmp_path_factory):
    """The folder of a run: nobody writes there."""
    out = tmp_path_factory.mktemp("turned") / "run"
    assert main(["panorama", str(street), "--out", str(out), "--images", "4", "--quiet"]) == 0
    return out


@pytest.fixture(scope="module")
def wall(small, tmp_path_factory):
    """The folder of a run of `track` before a plane."""
    out = tmp_path_factory.mktemp("tracked") / "run"
    assert main(["track", str(small), *map(str, BRIEF), "--out", str(out)]) == 0
    return out


def test_it_says_how_it_went_and_where_to_look(street, tmp_path, capsys):
    out = tmp_path / "run"
    status, said, err = run(capsys, "panorama", street, "--out", out, "--images", 0)
    assert status == 0
    for words in ("9 windows", "keyframes", "0 s lost", "x real time", "degrees", "coverage 1.000", f"tensorboard --logdir {out}"):
        assert words in said
    assert "plane" not in said
    for name in ("trajectory.txt", "panorama.png"):
        assert str(out / name) in said
    assert "0.50/0.50 s" in err.strip().split("\r")[-1]


def test_all_files_are_written_and_the_summary_names_them(folder):
    names = {p.name for p in folder.iterdir()}
    assert {n for n in names if not n.startswith("events.out.tfevents.")} == {*FILES, "images"}
    assert set(summary(folder)["files"]) == FILES - {"summary.json", "report.html"}
    assert {p.name for p in (folder / "images").iterdir()} == {f"window_{i:05d}.png" for i in (0, 4, 8)}


def test_the_camera_only_turns_and_is_where_the_truth_says(street, folder):
    found, truth = read_trajectory(folder / "trajectory.txt"), open(street).truth
    assert not np.loadtxt(folder / "trajectory.txt")[:, 1:4].any()
    assert len(found) == 9
    off = truth.at(found.time).R @ found.pose.R.mT  # one turn for all: that of the frame at the first event
    error = so3.log(off[:1].mT @ off).norm(dim=-1).rad2deg()
    assert error.max() < 0.5
    told = summary(folder)["error"]
    assert told["orientation_rmse_deg"] < 0.5
    assert told["orientation_rmse_deg"] <= told["orientation_max_deg"] < 0.5
    assert told["coverage"] == 1


def test_windows_have_no_normal_of_a_plane_and_do_not_move(street, folder):
    lines = rows(folder / "windows.csv")
    assert len(lines) == 9
    for line in lines:
        assert [line[f"n_{axis}"] for axis in "xyz"] == ["", "", ""]
        assert [float(line[name]) for name in ("v_x", "v_y", "v_z", "tx", "ty", "tz")] == [0] * 6
        assert float(line["gain"]) > 1
        assert int(line["map"]) == 0
    assert {line["status"] for line in lines} == {"start", "ok"}
    assert all(int(a["end_us"]) < int(b["start_us"]) for a, b in pairwise(lines))
    velocity = np.loadtxt(street / "velocity.txt")
    times = [int(line["time_us"]) * 1e-6 for line in lines]
    true = np.stack([np.interp(times, velocity[:, 0], velocity[:, column]) for column in (4, 5, 6)], 1)
    off = np.abs([[float(line[f"omega_{axis}"]) for axis in "xyz"] for line in lines] - true)
    assert off[:-1].max() < 0.1
    assert off.max() < 0.4  # the last window is short


def test_table_and_trajectory_and_keyframes_tell_the_same(folder):
    lines, frames = rows(folder / "windows.csv"), rows(folder / "keyframes.csv")
    numbers = np.loadtxt(folder / "trajectory.txt")
    turns = np.array([[float(line[name]) for name in ("qx", "qy", "qz", "qw")] for line in lines])
    np.testing.assert_allclose(numbers[:, 4:], turns, atol=1e-8)
    np.testing.assert_allclose(numbers[:, 0] * 1e6, [int(line["time_us"]) for line in lines], atol=1)
    assert len(frames) == summary(folder)["keyframes"] >= 8
    by_time = {line["time_us"]: line for line in lines}
    for number, frame in enumerate(frames):
        assert int(frame["number"]) == number
        assert [float(frame[name]) for name in ("tx", "ty", "tz", "v_x", "v_y", "v_z")] == [0] * 6
        window = by_time[frame["time_us"]]
        assert float(frame["qy"]) == pytest.approx(float(window["qy"]), abs=1e-8)
        assert 0 < int(frame["events"]) <= int(window["events"])


def test_the_summary_is_of_a_panorama_and_not_of_a_plane(folder):
    found = summary(folder)
    assert found["complete"] is True
    assert found["model"] == "rotation"
    assert "plane" not in found
    world = found["panorama"]
    assert set(world) == {"height", "width", "seen_share", "event_area", "event_area_sr", "gradient_magnitude"}
    assert world["width"] == 2 * world["height"] == 2 * load_map(folder / "panorama.h5").sphere.height
    view = 4 * math.asin(math.sin(math.atan(60 / 100)) * math.sin(math.atan(45 / 100)))  # sr of the sensor, but for the lens
    assert view < world["seen_share"] * 4 * math.pi < 4 * view
    assert 0 < world["event_area_sr"] < world["seen_share"] * 4 * math.pi
    assert world["gradient_magnitude"] > 0
    known = {name for name, value in found["error"].items() if value is not None}
    assert known == {"poses", "orientation_rmse_deg", "orientation_max_deg", "coverage"}


def test_the_pictures_show_edges_and_the_cropped_one_is_a_part(folder):
    whole, part = (np.asarray(Image.open(folder / name)) for name in ("panorama.png", "panorama_cropped.png"))
    world = summary(folder)["panorama"]
    assert whole.shape[1] == world["width"]
    assert part.shape[0] < whole.shape[0]
    inner = whole[: world["height"]]
    assert (inner == 235).all(-1).mean() > 1 - 1.5 * world["seen_share"]  # never seen
    assert (inner.max(-1) < 60).sum() > 100  # edges
    assert ((inner[..., 0].astype(int) - inner[..., 2]) > 100).any()  # the path's end is red


def test_the_board_shows_curves_and_pictures(folder):
    (curves,) = folder.glob("events.out.tfevents.*")
    board = EventAccumulator(str(curves), {"images": 0, "scalars": 0}).Reload()
    tags = board.Tags()
    assert {"window/gain", "window/omega_y", "pose/ry_deg", "map/keyframes", "window/status"} <= set(tags["scalars"])
    assert not {"window/n_x", "window/n_z"} & set(tags["scalars"])
    assert len(board.Scalars("window/gain")) == 9
    assert {"before_after", "map"} <= set(tags["images"])


def test_without_truth_there_is_no_error_to_tell(street, tmp_path, capsys):
    import h5py

    (tmp_path / "rec").mkdir()
    with h5py.File(street / "events.h5") as source, h5py.File(tmp_path / "rec" / "events.h5", "w") as copy:
        source.copy("events", copy)
    shutil.copy(street / "calib.txt", tmp_path / "rec")
    status, out, _ = run(capsys, "panorama", tmp_path / "rec", "--sensor", "120x90", *BRIEF, "--out", tmp_path / "run")
    assert status == 0
    assert "error" not in out
    assert summary(tmp_path / "run")["error"] is None
    assert summary(tmp_path / "run")["panorama"]["seen_share"] > 0


def test_the_configuration_of_a_run_makes_the_same_run_again(street, folder, tmp_path, capsys):
    config = yaml.safe_load(summary(folder)["config"])
    assert "distance" not in config
    assert "model" not in config
    assert (config["to"], config["from"], config["map"], config["images"]) == (None, None, None, 4)
    (tmp_path / "again.yaml").write_text(yaml.safe_dump(config))
    assert run(capsys, "panorama", street, "--config", tmp_path / "again.yaml", "--out", tmp_path / "b", "--quiet")[0] == 0
    for name in ("windows.csv", "trajectory.txt", "keyframes.csv", "panorama.png", "panorama_cropped.png", "panorama.h5"):
        assert (tmp_path / "b" / name).read_bytes() == (folder / name).read_bytes(), name


def test_from_and_to_cut_the_recording(street, folder, tmp_path, capsys):
    assert run(capsys, "panorama", street, "--from", 0.1, *BRIEF, "--out", tmp_path / "o")[0] == 0
    found, whole = read_trajectory(tmp_path / "o" / "trajectory.txt"), read_trajectory(folder / "trajectory.txt")
    assert found.time[0] > 100_000
    assert found.time[-1] < 300_000
    lines = rows(tmp_path / "o" / "windows.csv")
    assert 100_000 <= int(lines[0]["start_us"]) < 105_000
    assert 290_000 < int(lines[-1]["end_us"]) < 300_000
    assert float(lines[0]["qw"]) > 0.995  # the world is the camera at the first event of the stretch
    relative = so3.log(found.pose.R[:1].mT @ found.pose.R[-1:]).norm()
    there = whole.at(found.time[[0, -1]]).R
    assert float(relative) == pytest.approx(float(so3.log(there[:1].mT @ there[1:]).norm()), abs=math.radians(0.7))


def test_a_second_run_replaces_the_first_and_nothing_else(street, folder, tmp_path, capsys):
    out = tmp_path / "run"
    shutil.copytree(folder, out)
    for name in ("notes.txt", "images/mine.png", "panorama_3.txt"):
        (out / name).write_text("mine")
    (out / "panorama_2.h5").write_text("not of the run before")
    assert run(capsys, "panorama", street, *BRIEF, "--out", out)[0] == 0
    names = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file() and "tfevents" not in p.name}
    assert names == {*FILES, "notes.txt", "images/mine.png", "panorama_3.txt", "panorama_2.h5"}  # no picture of windows is left
    assert len(list(out.glob("events.out.tfevents.*"))) == 1
    assert (out / "notes.txt").read_text() == (out / "images" / "mine.png").read_text() == "mine"
    assert len(rows(out / "windows.csv")) == len(np.loadtxt(out / "trajectory.txt")) == summary(out)["windows"] < 9


def test_a_run_of_track_is_replaced_as_a_whole_and_the_other_way_round(street, small, wall, tmp_path, capsys):
    out = tmp_path / "run"
    shutil.copytree(wall, out)
    (out / "map_7.h5").write_text("mine")
    assert run(capsys, "panorama", street, *BRIEF, "--out", out)[0] == 0
    assert {p.name for p in out.iterdir() if "tfevents" not in p.name} == {*FILES, "images", "map_7.h5"}
    assert run(capsys, "track", small, *BRIEF, "--out", out)[0] == 0
    assert not list(out.glob("panorama*"))
    assert (out / "map.png").exists()
    assert (out / "map_7.h5").read_text() == "mine"


@pytest.mark.parametrize("name", ["panorama.png", "panorama_cropped.png", "panorama.h5", "trajectory.txt", "keyframes.csv"])
def test_a_file_of_somebody_else_is_not_replaced(name, street, tmp_path, capsys):
    (tmp_path / name).write_text("mine")
    status, _, err = run(capsys, "panorama", street, *BRIEF, "--out", tmp_path)
    assert status == 1
    assert f"holds {name}, which no run of ours wrote" in err
    assert "give another --out" in err
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {name: "mine"}


def test_the_recording_is_no_place_for_the_results(street, capsys):
    before = {p.name for p in street.iterdir()}
    status, _, err = run(capsys, "panorama", street, *BRIEF, "--out", street)
    assert status == 1
    assert "is where the recording is" in err
    assert {p.name for p in street.iterdir()} == before


def test_a_run_that_fails_before_its_first_window_leaves_the_earlier_results(street, folder, capsys):
    before = contents(folder)
    assert run(capsys, "panorama", street, "--out", folder, "--from", 99, "--quiet")[0] == 1
    assert contents(folder) == before


def test_a_saved_panorama_is_tracked_against_from_another_start(street, folder, tmp_path, capsys):
    saved = (folder / "panorama.h5").read_bytes()
    arguments = ("--map", folder / "panorama.h5", "--from", 0.2, "--images", 0, "--quiet")
    status, out, _ = run(capsys, "panorama", street, *arguments, "--out", tmp_path / "o")
    assert status == 0
    assert "degrees" in out
    assert (folder / "panorama.h5").read_bytes() == saved
    assert {p.name for p in (tmp_path / "o").iterdir() if "tfevents" not in p.name} == {*FILES, "images"} - {"panorama.h5"}
    assert "panorama.h5" not in summary(tmp_path / "o")["files"]
    found, whole = read_trajectory(tmp_path / "o" / "trajectory.txt"), read_trajectory(folder / "trajectory.txt")
    assert len(found) == 5
    assert found.time[0] < 240_000
    inside = found.time <= whole.time[-1]
    assert inside.sum() >= 4
    assert apart(found, whole)[inside].max() < 0.5  # in the world of the first run, though the camera begins 24 degrees from there
    assert summary(tmp_path / "o")["error"]["coverage"] == 1
    assert summary(tmp_path / "o")["losses"] == 0
    assert (tmp_path / "o" / "keyframes.csv").read_text() == (folder / "keyframes.csv").read_text()
    assert yaml.safe_load(summary(tmp_path / "o")["config"])["map"] == str(folder / "panorama.h5")


def test_another_recording_of_the_same_scene_finds_itself_in_the_panorama(street, folder, tmp_path, capsys):
    """Twice as fast along the same path, to where the map ends."""
    options = Simulation(scene="panorama", motion="rotation", duration=0.25, speed=2, width=120, height=90, focal=100)
    recording = write(options, tmp_path / "fast")
    status, _, _ = run(capsys, "panorama", recording, "--map", folder / "panorama.h5", "--out", tmp_path / "o", "--images", 0, "--quiet")
    assert status == 0
    found, truth, first = read_trajectory(tmp_path / "o" / "trajectory.txt"), open(recording).truth, open(street).truth
    assert so3.log(truth.at(found.time).R.mT @ first.at(2 * found.time).R).norm(dim=-1).max() < 1e-3
    assert apart(found, truth).max() < 0.7
    assert summary(tmp_path / "o")["error"]["coverage"] == 1


def test_another_scene_is_not_taken_for_the_panorama(folder, tmp_path, capsys):
    options = Simulation(scene="panorama", motion="rotation", duration=0.2, speed=2, seed=5, width=120, height=90, focal=100)
    recording = write(options, tmp_path / "elsewhere")
    before = (folder / "panorama.h5").read_bytes()
    assert run(capsys, "panorama", recording, "--map", folder / "panorama.h5", "--out", tmp_path / "o", "--quiet")[0] == 0
    lines = rows(tmp_path / "o" / "windows.csv")
    assert len(lines) >= 4
    assert all(line["status"] == "lost" or line["map"] != "0" for line in lines)
    assert not (tmp_path / "o" / "trajectory.txt").exists()
    assert "trajectory.txt" not in summary(tmp_path / "o")["files"]
    assert (tmp_path / "o" / "panorama.png").exists()
    assert (folder / "panorama.h5").read_bytes() == before


def test_the_map_to_track_against_is_not_written_over(street, folder, capsys):
    before = contents(folder)
    status, _, err = run(capsys, "panorama", street, "--map", folder / "panorama.h5", "--out", folder, "--quiet")
    assert status == 1
    assert "is where the map to track against is" in err
    assert contents(folder) == before


def test_maps_of_planes_and_panoramas_are_told_apart(street, small, folder, wall, tmp_path, capsys):
    status, _, err = run(capsys, "panorama", street, "--map", wall / "map.h5", "--out", tmp_path / "o", "--quiet")
    assert status == 1
    assert "map.h5: is a map of a plane" in err
    assert "torchcmax track --map" in err
    status, _, err = run(capsys, "track", small, "--map", folder / "panorama.h5", "--out", tmp_path / "o", "--quiet")
    assert status == 1
    assert "panorama.h5: is a panorama" in err
    assert "torchcmax panorama --map" in err
    assert not (tmp_path / "o").exists()


def test_an_interrupted_run_keeps_what_is_done(street, tmp_path, capsys, monkeypatch):
    real = following.Progress.update

    def interrupted(self):
        real(self)
        if len(self._report.table) == 6:
            raise KeyboardInterrupt

    monkeypatch.setattr(following.Progress, "update", interrupted)
    status, _, err = run(capsys, "panorama", street, "--mapping.first", 3, "--out", tmp_path / "o")
    assert status == 130
    assert "what was finished is kept" in err
    found = summary(tmp_path / "o")
    assert found["complete"] is False
    assert found["stopped_by"].startswith("KeyboardInterrupt")
    assert set(found["files"]) == FILES - {"summary.json", "report.html"}
    assert found["windows"] == len(rows(tmp_path / "o" / "windows.csv")) == 6
    assert len(read_trajectory(tmp_path / "o" / "trajectory.txt")) == 6
    assert found["error"]["orientation_rmse_deg"] < 1
    globe = load_map(tmp_path / "o" / "panorama.h5")
    assert isinstance(globe, Globe)
    assert len(globe.keyframes) == found["keyframes"] >= 3
    assert not [p for p in (tmp_path / "o").iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--form", "3"), "did you mean --from?"),
        (("--mapping.overlp", "0.5"), "did you mean --mapping.overlap?"),
        (("--relocalizing.step", "[8]"), "did you mean --relocalizing.steps?"),
        (("--distance", "2"), "--distance is not known"),
        (("--model", "planar"), "--model is not known"),
        (("--from", "soon"), "from"),
        (("--from", "2", "--to", "1"), "--from must come before --to"),
        (("--to", ".nan"), "--to wants seconds of the recording's clock"),
        (("--tracking.displacement", "0"), "tracking wants a displacement"),
        (("--images", "-1"), "--images wants"),
        (("--device", "cuda:77"), "CUDA devices"),
        (("--out", ""), "--out wants the name of a folder"),
    ],
)
def test_wrong_usage_exits_with_2_and_names_the_nearest(arguments, words, street, tmp_path, capsys):
    status, _, err = run(capsys, "panorama", street, "--out", tmp_path / "o", *arguments)
    assert status == 2
    assert words in err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--map", "nowhere.h5"), "nowhere.h5: there is no such file"),
        (("--from", "99"), "has no event from the start"),
        (("--to", "-5"), "has no event before the end"),
    ],
)
def test_bad_data_exits_with_1_and_says_what_to_do(arguments, words, street, tmp_path, capsys):
    status, _, err = run(capsys, "panorama", street, "--out", tmp_path / "o", "--quiet", *arguments)
    assert status == 1
    assert words in err
    assert "what to do" in err
    assert not (tmp_path / "o" / "summary.json").exists()


def test_a_map_that_is_cut_off_is_named(street, folder, tmp_path, capsys):
    whole = (folder / "panorama.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    status, _, err = run(capsys, "panorama", street, "--map", tmp_path / "cut.h5", "--out", tmp_path / "o", "--quiet")
    assert status == 1
    assert "cut.h5: cannot be read as a map" in err
    assert "copy it again" in err
    assert not (tmp_path / "o").exists()


def test_help_teaches_every_option(capsys):
    status, out, _ = run(capsys, "panorama", "--help")
    assert status == 0
    for word in (
        "--out",
        "--from",
        "--to",
        "--map",
        "--images",
        "--device",
        "--atlas",
        "--tracking.displacement",
        "--mapping.overlap",
        "--sensing.patience",
        "--texture.exposure",
        "--relocalizing.steps",
        "trajectory.txt",
        "panorama.png",
        "panorama_cropped.png",
        "panorama.h5",
        "equirectangular",
    ):
        assert word in out
    assert "--distance" not in out
    assert "--model" not in out
    assert "panorama" in run(capsys, "--help")[1]


def test_a_panorama_of_another_sensor_is_refused_by_its_name(folder, tmp_path, capsys):
    other = write(Simulation(scene="panorama", motion="rotation", duration=0.05, width=120, height=90, focal=140), tmp_path / "other")
    assert main(["panorama", str(other), "--map", str(folder / "panorama.h5"), "--out", str(tmp_path / "run"), "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "panorama.h5" in said
    assert "100.00 px, not 140.00 px" in said


def test_no_file_is_named_that_is_not_there(street, tmp_path, capsys):
    """One window makes a map, but no trajectory."""
    assert main(["panorama", str(street), "--to", "0.0005", "--out", str(tmp_path / "run"), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "trajectory.txt" not in said
    assert "panorama.png" in said
    assert not (tmp_path / "run" / "trajectory.txt").exists()
