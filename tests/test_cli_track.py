"""`torchcmax track` as a user meets it: exit status, messages, files."""

import json
from pathlib import Path

import pytest
import yaml

from torchcmax.cli import main
from torchcmax.commands import following
from torchcmax.io.trajectory import read_trajectory

SHORT = ("--mapping.first", 5, "--to", 0.3)  # the recording is short


def run(capsys, *arguments):
    """Exit status, what was printed, what was complained about."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:
        status = stop.code
    out, err = capsys.readouterr()
    return status, out, err


@pytest.fixture(scope="module")
def folder(small, tmp_path_factory):
    """The folder of a run, and its configuration."""
    out = tmp_path_factory.mktemp("tracked") / "run"
    assert main(["track", str(small), *map(str, SHORT), "--out", str(out), "--quiet"]) == 0
    return out


def test_it_says_how_it_went_and_where_to_look(small, tmp_path, capsys):
    status, out, err = run(capsys, "track", small, *SHORT, "--out", tmp_path / "run", "--images", 3)
    assert status == 0
    for word in ("windows", "keyframes", "0 s lost", "x real time", "% of the plane's distance", "degrees", "coverage"):
        assert word in out
    for name in ("trajectory.txt", "map.png"):
        assert str(tmp_path / "run" / name) in out
        assert (tmp_path / "run" / name).is_file()
    assert f"tensorboard --logdir {tmp_path / 'run'}" in out
    assert "x real time" in err
    assert len(list((tmp_path / "run" / "images").glob("*.png"))) >= 2


def test_the_bar_counts_the_seconds_of_the_recording(small, tmp_path, capsys):
    _, _, err = run(capsys, "track", small, "--mapping.first", 5, "--out", tmp_path / "run")
    last = err.strip().split("\r")[-1]
    assert "0.50/0.50 s" in last
    assert run(capsys, "track", small, *SHORT, "--out", tmp_path / "quiet", "--quiet")[2] == ""


def test_without_truth_there_is_no_error_to_tell(small, tmp_path, capsys):
    import h5py

    (tmp_path / "rec").mkdir()
    with h5py.File(small / "events.h5") as source, h5py.File(tmp_path / "rec" / "events.h5", "w") as copy:
        source.copy("events", copy)
    (tmp_path / "rec" / "calib.txt").write_text((small / "calib.txt").read_text())
    status, out, _ = run(capsys, "track", tmp_path / "rec", "--sensor", "120x90", *SHORT, "--out", tmp_path / "run", "--quiet")
    assert status == 0
    assert "error" not in out
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["error"] is None


def test_the_configuration_of_a_run_makes_the_same_run_again(small, folder, tmp_path, capsys):
    config = yaml.safe_load(json.loads((folder / "summary.json").read_text())["config"])
    assert (config["to"], config["from"], config["mapping"]["first"]) == (0.3, None, 5)
    (tmp_path / "again.yaml").write_text(yaml.safe_dump(config))
    assert run(capsys, "track", small, "--config", tmp_path / "again.yaml", "--out", tmp_path / "b", "--quiet")[0] == 0
    assert (tmp_path / "b" / "windows.csv").read_text() == (folder / "windows.csv").read_text()


def test_what_is_printed_as_configuration_is_understood(small, tmp_path, capsys):
    status, out, _ = run(capsys, "track", small, "--out", tmp_path / "o", "--from", 0.1, "--to", 0.2, "--print_config")
    assert status == 0
    assert (yaml.safe_load(out)["from"], yaml.safe_load(out)["to"]) == (0.1, 0.2)
    (tmp_path / "c.yaml").write_text(out)
    status, again, _ = run(capsys, "track", small, "--out", tmp_path / "o", "--config", tmp_path / "c.yaml", "--print_config")
    assert again == out


def test_from_to_and_distance_reach_the_trajectory(small, tmp_path, capsys):
    arguments = ("--from", 0.1, "--to", 0.3, "--distance", 2, "--mapping.first", 3, "--quiet")
    assert run(capsys, "track", small, *arguments, "--out", tmp_path / "a")[0] == 0
    assert run(capsys, "track", small, *arguments, "--distance", 4, "--out", tmp_path / "b")[0] == 0
    one, other = (read_trajectory(tmp_path / name / "trajectory.txt") for name in "ab")
    assert one.time[0] > 100_000
    assert one.time[-1] < 300_000
    assert (other.pose.t - 2 * one.pose.t).abs().max() < 1e-9


@pytest.mark.parametrize("model", ["translation", "rotation"])
def test_other_models_leave_out_what_they_do_not_have(model, small, tmp_path, capsys):
    assert run(capsys, "track", small, *SHORT, "--model", model, "--out", tmp_path / "o", "--quiet")[0] == 0
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["model"] == model
    assert (summary["error"]["position_rmse_m"] is None) == (model == "rotation")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--form", "3"), "did you mean --from?"),
        (("--from", "soon"), "from"),
        (("--from", "2", "--to", "1"), "--from must come before --to"),
        (("--distance", "-1"), "--distance wants metres above 0"),
        (("--model", "plana"), "did you mean planar?"),
        (("--tracking.displacment", "3"), "did you mean --tracking.displacement?"),
        (("--tracking.displacement", "0"), "tracking wants a displacement"),
        (("--images", "-1"), "--images wants"),
        (("--threads", "-1"), "--threads wants"),
        (("--device", "cuda:77"), "CUDA devices"),
        (("--out", ""), "--out wants the name of a folder"),
    ],
)
def test_wrong_usage_exits_with_2_and_names_the_nearest(arguments, words, small, tmp_path, capsys):
    status, _, err = run(capsys, "track", small, "--out", tmp_path / "o", *arguments)
    assert status == 2
    assert words in err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--map", "nowhere.h5"), "nowhere.h5: there is no such file"),
        (("--from", "99"), "has no event from the start"),
        (("--to", "-5"), "has no event before the end"),
        (("--to", "0.0005"), "cannot be tracked"),
    ],
)
def test_bad_data_exits_with_1_and_says_what_to_do(arguments, words, small, tmp_path, capsys):
    status, _, err = run(capsys, "track", small, "--out", tmp_path / "o", "--quiet", *arguments)
    assert status == 1
    assert words in err
    assert "what to do" in err
    assert not (tmp_path / "o" / "summary.json").exists()


def test_a_run_that_fails_before_its_first_window_leaves_the_earlier_results(small, folder, capsys):
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    assert run(capsys, "track", small, "--out", folder, "--from", 99, "--quiet")[0] == 1
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


def test_an_interrupted_run_keeps_what_is_done(small, tmp_path, capsys, monkeypatch):
    real = following.Progress.update

    def interrupted(self):
        real(self)
        if len(self._report.table) == 6:
            raise KeyboardInterrupt

    monkeypatch.setattr(following.Progress, "update", interrupted)
    status, _, err = run(capsys, "track", small, *SHORT, "--out", tmp_path / "o")
    assert status == 130
    assert "what was finished is kept" in err
    assert len(read_trajectory(tmp_path / "o" / "trajectory.txt")) == 6
    assert json.loads((tmp_path / "o" / "summary.json").read_text())["complete"] is False


def test_a_saved_map_is_tracked_against(small, folder, tmp_path, capsys):
    status, out, _ = run(capsys, "track", small, "--map", folder / "map.h5", *SHORT, "--out", tmp_path / "o", "--quiet")
    assert status == 0
    assert "% of the plane's distance" in out
    assert not (tmp_path / "o" / "map.h5").exists()
    assert yaml.safe_load(json.loads((tmp_path / "o" / "summary.json").read_text())["config"])["map"] == str(folder / "map.h5")


def test_help_teaches_every_option(capsys):
    status, out, _ = run(capsys, "track", "--help")
    assert status == 0
    for word in (
        "--from",
        "--to",
        "--distance",
        "--map",
        "--model",
        "--tracking.displacement",
        "--mapping.overlap",
        "px",
        "trajectory.txt",
    ):
        assert word in out


def test_the_demo_is_a_configuration_of_track(small, tmp_path, capsys):
    config = Path(__file__).parents[1] / "configs" / "demo_track.yaml"
    status, out, err = run(capsys, "track", small, "--config", config, "--out", tmp_path / "o", "--print_config")
    assert status == 0, err
    assert yaml.safe_load(out)["model"] == "planar"
