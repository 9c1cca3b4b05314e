"""torchcmax rig: what each command prints, writes and exits with."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("canopen", reason="the extra rig is not installed")
pytest.importorskip("scipy", reason="the extra rig is not installed")
from torchcmax.cli import main
from torchcmax.io.trajectory import read_trajectory
from torchcmax.rig import runner

CONFIGS = Path(__file__).parents[2] / "configs" / "rig"
SLIDER, PASS = CONFIGS / "slider.yaml", CONFIGS / "slider_pass.yaml"
SHORT = "profile: [{axis: x, move: {to_m: 0.1, v_mps: 0.2}}, {axis: x, return: {v_mps: 0.2}}]\n"


def said(capsys, *arguments):
    """Exit status, what was printed, what was complained about."""
    try:
        status = main(["rig", *map(str, arguments)])
    except SystemExit as stop:
        status = stop.code
    return status, *capsys.readouterr()


@pytest.fixture(scope="module")
def profile(tmp_path_factory):
    file = tmp_path_factory.mktemp("profile") / "short.yaml"
    file.write_text(SHORT)
    return file


@pytest.fixture(scope="module")
def moved(profile, tmp_path_factory):
    """The folder of a run on simulated drives."""
    out = tmp_path_factory.mktemp("moved") / "run"
    assert main(["rig", "run", str(SLIDER), str(profile), "--dry-run", "--repeat", "2", "-o", str(out), "--quiet"]) == 0
    return out


def test_motors_shows_the_data_sheets_and_what_deviates(capsys):
    status, out, _ = said(capsys, "motors", "--verify")
    assert status == 0
    lines = out.splitlines()
    assert sum(line.split()[0].isdigit() and "=" not in line for line in lines) == 9
    assert "272763         24               9340" in out
    (suspect,) = (line for line in lines if line.startswith("448588") and "nominal_speed" in line)
    assert "printed 2610, computed 2563" in suspect  # a cell of the data sheet that does not fit the others
    assert "OUTSIDE" in suspect


def test_plan_prints_every_check_and_touches_nothing(capsys, tmp_path):
    status, out, _ = said(capsys, "plan", SLIDER, PASS, "-o", tmp_path / "plan")
    assert status == 0
    assert "upper soft limit" in out
    assert "NOT KEPT" not in out
    plan = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert plan["ok"]
    assert {path.name for path in (tmp_path / "plan").iterdir()} >= {"motion.png", "oprange_x.png"}
    assert all(check["ok"] for check in plan["checks"])


def test_a_plan_that_breaks_a_limit_is_refused_with_its_checks(capsys, tmp_path):
    (tmp_path / "far.yaml").write_text("profile: [{axis: x, move: {to_m: 0.9, v_mps: 0.5}}]")
    status, out, err = said(capsys, "plan", SLIDER, tmp_path / "far.yaml")
    assert status == 2
    assert "NOT KEPT" in out
    assert "upper soft limit" in err
    status, _, err = said(capsys, "run", SLIDER, tmp_path / "far.yaml", "--dry-run", "-o", tmp_path / "run")
    assert status == 2
    assert not (tmp_path / "run").exists()


def test_an_unknown_key_is_refused_with_its_line(capsys, tmp_path):
    text = SLIDER.read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("supply_v", "suply_v"))
    status, _, err = said(capsys, "plan", tmp_path / "rig.yaml", PASS)
    assert status == 2
    assert f"line {text[: text.index('supply_v')].count(chr(10)) + 1}:" in err
    assert "did you mean supply_v" in err
    assert said(capsys, "plan", tmp_path / "none.yaml", PASS)[0] == 2


def test_hardware_does_not_move_without_arm(capsys, profile, tmp_path):
    for action in (("run", SLIDER, profile, "-o", tmp_path / "run"), ("home", SLIDER, "-o", tmp_path / "run")):
        status, _, err = said(capsys, *action)
        assert status == 2
        assert "--arm" in err
        assert "emergency stop" in err
    assert not (tmp_path / "run").exists()


def test_an_interface_that_is_not_there_is_a_lost_link(capsys, profile, tmp_path):
    armed = ("--arm", "--interface", "socketcan", "--channel", "nowhere0", "--quiet")
    status, _, err = said(capsys, "run", SLIDER, profile, *armed, "-o", tmp_path / "run")
    assert status == 4
    assert "nowhere0" in err
    assert "mind:" in err  # whose duty the emergency stop is
    assert not (tmp_path / "run" / "groundtruth.txt").exists()


def test_a_dry_run_leaves_everything_that_a_run_does_and_says_so(moved, capsys):
    names = {path.name for path in moved.iterdir()}
    wanted = "config.lock.yaml profile.yaml plan.json encoder.csv log.jsonl run.json groundtruth_driveclock.txt twist.txt truth.json"
    assert names == {*wanted.split(), "motion.png", "repeat.png", "oprange_x.png"}
    assert all((moved / name).read_bytes().startswith(b"\x89PNG") for name in names if name.endswith(".png"))
    assert "groundtruth.txt" not in names
    assert (moved / "config.lock.yaml").read_bytes() == SLIDER.read_bytes()
    said_ = json.loads((moved / "truth.json").read_text())
    assert (said_["status"], said_["simulated"], said_["truth"]) == ("complete", True, False)
    assert 0 <= said_["repeatability"]["x"] < 1e-4  # the simulation repeats itself but for what heats and what the encoder rounds
    x = read_trajectory(moved / "groundtruth_driveclock.txt").pose.t[:, 0]
    assert float(x.max()) == pytest.approx(0.1, abs=2e-4)
    table = np.loadtxt(moved / "twist.txt")
    assert abs(table[:, 1]).max() == pytest.approx(0.2, rel=0.02)


def test_two_dry_runs_are_the_same(moved, profile, tmp_path):
    assert main(["rig", "run", str(SLIDER), str(profile), "--dry-run", "--repeat", "2", "-o", str(tmp_path / "run"), "--quiet"]) == 0
    for name in ("encoder.csv", "groundtruth_driveclock.txt", "twist.txt", "plan.json"):
        assert (tmp_path / "run" / name).read_bytes() == (moved / name).read_bytes(), name


def test_home_check_and_record_work_on_simulated_drives(capsys, tmp_path):
    assert said(capsys, "home", SLIDER, "--dry-run", "-o", tmp_path / "home", "--quiet")[0] == 0
    assert "homed" in (tmp_path / "home" / "log.jsonl").read_text()
    status, out, _ = said(capsys, "check", SLIDER, "--dry-run")
    assert status == 0
    assert json.loads(out)["x"]["vendor"] == 0xFB
    status, _, _ = said(capsys, "record", SLIDER, "--dry-run", "--duration", 0.2, "-o", tmp_path / "hand", "--quiet")
    assert status == 0
    assert len(np.loadtxt(tmp_path / "hand" / "groundtruth_driveclock.txt")) == pytest.approx(200, abs=2)
    assert said(capsys, "record", SLIDER, "--dry-run", "--duration", 0, "-o", tmp_path / "hand")[0] == 2


def test_who_presses_ctrl_c_gets_a_stopped_rig_and_no_truth(capsys, profile, tmp_path, monkeypatch):
    follow = runner.Session.follow

    def pressed(session, program):
        if session.recording:
            os.kill(os.getpid(), signal.SIGINT)
        follow(session, program)

    monkeypatch.setattr(runner.Session, "follow", pressed)
    status, _, err = said(capsys, "run", SLIDER, profile, "--dry-run", "-o", tmp_path / "run", "--quiet")
    assert status == 5
    assert "stopped by the user" in err
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"].startswith("aborted")
    assert not (tmp_path / "run" / "groundtruth.txt").exists()


def seen_by_camera(moved, folder, offset):
    """A result as compensate leaves it: windows of 10 ms with the velocity of the truth, in distances of 0.8 m."""
    table = np.loadtxt(moved / "twist.txt")
    folder.mkdir()
    rows = ["index,start_us,end_us,events,gain,v_x,v_y,v_z"]
    for k, i in enumerate(range(5, len(table) - 5, 10)):
        start = round((table[i, 0] + offset) * 1e6) - 5000
        rows.append(f"{k},{start},{start + 10_000},{round(100 + 40_000 * abs(table[i, 1]))},1.1,{table[i, 1] / 0.8},0,0")
    (folder / "windows.csv").write_text("\n".join(rows) + "\n")
    (folder / "summary.json").write_text(json.dumps({"versions": {"torchcmax": "1"}, "config": ""}))
    return folder


@pytest.fixture(scope="module")
def patterned(tmp_path_factory):
    """A run with the pattern that clocks are aligned by."""
    place = tmp_path_factory.mktemp("patterned")
    (place / "sync.yaml").write_text("profile: [{axis: x, sync: {from_m: 0.1, to_m: 0.2, v_mps: 0.7, a_mps2: 10}}]")
    assert main(["rig", "run", str(SLIDER), str(place / "sync.yaml"), "--dry-run", "-o", str(place / "run"), "--quiet"]) == 0
    return place / "run"


def test_sync_and_truth_write_ground_truth_in_the_cameras_clock(patterned, capsys, tmp_path):
    result = seen_by_camera(patterned, tmp_path / "result", 77.5)
    status, out, _ = said(capsys, "sync", patterned, "--result", result)
    assert status == 0
    assert "ahead" in out
    clock = json.loads((patterned / "clock.json").read_text())
    assert clock["offset"] == pytest.approx(77.5, abs=2e-4)
    status, out, _ = said(capsys, "truth", patterned)
    assert status == 0
    truth, drives = (read_trajectory(patterned / name) for name in ("groundtruth.txt", "groundtruth_driveclock.txt"))
    assert (truth.time - drives.time).double().mean() * 1e-6 == pytest.approx(77.5, abs=2e-4)
    assert json.loads((patterned / "truth.json").read_text())["sigma_t"] < 1e-3


def test_a_clock_that_is_not_known_is_no_ground_truth(moved, patterned, capsys, tmp_path):
    assert said(capsys, "truth", moved)[0] == 6
    result = seen_by_camera(moved, tmp_path / "result", 3.0)  # the same move twice
    status, _, err = said(capsys, "sync", moved, "--result", result)
    assert status == 6
    assert "sync pattern" in err
    assert not json.loads((moved / "clock.json").read_text())["accepted"]
    status, _, err = said(capsys, "truth", moved)
    assert status == 6
    assert not (moved / "groundtruth.txt").exists()
    assert said(capsys, "sync", moved)[0] == 2
    assert said(capsys, "sync", tmp_path, "--result", result)[0] == 2


def test_an_option_that_is_mistyped_is_answered_with_the_nearest(capsys):
    status, _, err = said(capsys, "run", SLIDER, PASS, "--dry-rnu", "-o", "x")
    assert status == 2
    assert "--dry-run" in err
