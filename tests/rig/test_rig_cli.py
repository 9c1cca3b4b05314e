"""torchcmax rig: what each command prints, writes and exits with."""

import json
import os
import shutil
import signal
import subprocess
import sys
from importlib import import_module
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
ARMED = ("--arm", "--interface", "socketcan", "--channel", "nowhere0", "--quiet")
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


def hit(monkeypatch, where, name, what):
    """Something happens as this function is called."""
    calm = getattr(where, name)

    def struck(*arguments, **options):
        what()
        return calm(*arguments, **options)

    monkeypatch.setattr(where, name, struck)


def raising(error):
    def what():
        raise error

    return what


def sent(number):
    return lambda: os.kill(os.getpid(), number)


@pytest.fixture
def older(moved, tmp_path):
    """A run of before, with a clock that was accepted and its ground truth, and pictures of an axis that is no more."""
    out = shutil.copytree(moved, tmp_path / "older")
    (out / "truth.json").write_text(json.dumps(json.loads((out / "truth.json").read_text()) | {"truth": True}))
    for name in ("clock.json", "groundtruth.txt", "oprange_z.png"):
        (out / name).write_text("older")
    return out


OF_THE_RUN = {"encoder.csv", "run.json", "log.jsonl", "groundtruth_driveclock.txt", "groundtruth.txt", "clock.json", "twist.txt"}


def left(out):
    """Names of files; none of them half."""
    names = {path.name for path in out.iterdir()}
    assert not [name for name in names if name.endswith(".part")]
    return names


def test_a_run_whose_bus_cannot_be_opened_leaves_nothing_of_an_older_one(older, profile, capsys, tmp_path):
    status, _, err = said(capsys, "run", SLIDER, profile, *ARMED, "-o", older)
    assert status == 4
    assert "nowhere0" in err
    assert "mind:" in err  # whose duty the emergency stop is
    assert left(older) == {"config.lock.yaml", "profile.yaml", "plan.json", "motion.png", "oprange_x.png", "truth.json"}
    told = json.loads((older / "truth.json").read_text())
    assert told["status"].startswith("aborted: socketcan nowhere0")
    assert not told["truth"]
    assert said(capsys, "sync", older, "--result", tmp_path)[0] == 2
    assert said(capsys, "truth", older)[0] == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", ["plan.plan", "picture.motion"])
def test_who_stops_it_while_planning_loses_nothing_and_while_drawing_has_nothing_of_an_older_run(
    number, name, older, profile, capsys, monkeypatch
):
    module, name = name.split(".")
    hit(monkeypatch, import_module(f"torchcmax.rig.{module}"), name, sent(number))
    before, whole = signal.getsignal(signal.SIGTERM), {path.name: path.read_bytes() for path in older.iterdir()}
    status, _, err = said(capsys, "run", SLIDER, profile, "--dry-run", "-o", older, "--quiet")
    assert status == 5
    assert "stopped by the user" in err
    if module == "plan":
        assert {path.name: path.read_bytes() for path in older.iterdir()} == whole
    else:
        assert not left(older) & OF_THE_RUN
        assert said(capsys, "truth", older)[0] == 2
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_plan_that_is_refused_leaves_the_older_run(older, capsys, tmp_path):
    (tmp_path / "far.yaml").write_text("profile: [{axis: x, move: {to_m: 0.9, v_mps: 0.5}}]")
    before = left(older)
    assert said(capsys, "run", SLIDER, tmp_path / "far.yaml", "--dry-run", "-o", older, "--quiet")[0] == 2
    assert left(older) == before


def test_who_presses_ctrl_c_gets_a_stopped_rig_and_no_truth(older, profile, capsys, monkeypatch):
    hit(monkeypatch, runner.Session, "follow", sent(signal.SIGINT))
    status, _, err = said(capsys, "run", SLIDER, profile, "--dry-run", "-o", older, "--quiet")
    assert status == 5
    assert "stopped by the user" in err
    for name in ("run.json", "truth.json"):
        assert json.loads((older / name).read_text())["status"].startswith("aborted: stopped by the user")
    assert not left(older) & {"groundtruth.txt", "clock.json", "repeat.png", "oprange_z.png"}


def test_a_run_that_ends_before_its_first_sample_says_so_and_leaves_nothing_older(older, profile, capsys, monkeypatch):
    hit(monkeypatch, runner.Session, "go", sent(signal.SIGINT))
    assert said(capsys, "run", SLIDER, profile, "--dry-run", "-o", older, "--quiet")[0] == 5
    told = json.loads((older / "truth.json").read_text())
    assert told["status"].startswith("aborted: stopped by the user")
    assert not told["truth"]
    assert not left(older) & {"groundtruth_driveclock.txt", "groundtruth.txt", "clock.json", "twist.txt", "repeat.png", "oprange_z.png"}


@pytest.mark.parametrize("error", [ZeroDivisionError("of nothing"), BrokenPipeError(32, "Broken pipe")])
def test_what_nobody_thought_of_is_told_whole_and_is_a_fault(error, capsys, tmp_path, monkeypatch):
    hit(monkeypatch, runner.Session, "home", raising(error))
    status, _, err = said(capsys, "home", SLIDER, "--dry-run", "-o", tmp_path / "home", "--quiet")
    assert status == 3
    assert "Traceback" in err
    assert str(error) in err
    assert json.loads((tmp_path / "home" / "run.json").read_text())["status"].startswith("aborted")


def test_who_no_longer_reads_what_is_said_does_not_stop_a_rig(tmp_path):
    """`rig home ... 2>&1 | head`: the bar and the last line find nobody."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "torchcmax.cli", "rig", "home", SLIDER, "--dry-run", "-o", tmp_path / "home"]
    assert subprocess.run(command, stdout=writer, stderr=writer, check=False).returncode == 0
    os.close(writer)
    assert json.loads((tmp_path / "home" / "run.json").read_text())["status"] == "complete"


def test_a_record_that_cannot_be_made_truth_of_is_told(capsys, tmp_path):
    status, _, err = said(capsys, "record", SLIDER, "--dry-run", "--duration", 0.01, "-o", tmp_path / "hand", "--quiet")
    assert status == 2
    assert "too few" in err
    assert not json.loads((tmp_path / "hand" / "truth.json").read_text())["truth"]


def test_a_run_that_is_repeated_where_it_lies_with_its_own_files_is_the_same(older, moved, capsys):
    again = ("run", older / "config.lock.yaml", older / "profile.yaml", "--dry-run", "--repeat", 2, "-o", older, "--quiet")
    assert said(capsys, *again)[0] == 0
    assert left(older) == left(moved)
    for name in ("encoder.csv", "groundtruth_driveclock.txt", "twist.txt", "plan.json", "config.lock.yaml", "profile.yaml"):
        assert (older / name).read_bytes() == (moved / name).read_bytes(), name


def test_a_file_where_a_folder_is_wanted_is_told(profile, capsys, tmp_path):
    (tmp_path / "file").write_text("mine")
    for action in (("plan", SLIDER, profile), ("run", SLIDER, profile, "--dry-run"), ("home", SLIDER, "--dry-run")):
        status, _, err = said(capsys, *action, "-o", tmp_path / "file")
        assert status == 2
        assert "another folder" in err
    assert said(capsys, "home", SLIDER, "--dry-run", "-o", tmp_path / "file" / "in")[0] == 2
    assert (tmp_path / "file").read_text() == "mine"


def test_a_plan_does_not_go_into_the_folder_of_a_run(older, profile, capsys):
    before = {path: path.read_bytes() for path in older.iterdir()}
    status, _, err = said(capsys, "plan", SLIDER, profile, "-o", older)
    assert status == 2
    assert "holds a run" in err
    assert {path: path.read_bytes() for path in older.iterdir()} == before


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


@pytest.fixture
def aligned(patterned, tmp_path):
    """A copy of it with the camera's clock."""
    out = shutil.copytree(patterned, tmp_path / "aligned")
    assert main(["rig", "sync", str(out), "--result", str(seen_by_camera(out, tmp_path / "result", 77.5))]) == 0
    return out


def test_sync_and_truth_write_ground_truth_in_the_cameras_clock(aligned, capsys):
    status, out, _ = said(capsys, "sync", aligned, "--result", aligned.parent / "result")
    assert status == 0
    assert "77.50" in out
    clock = json.loads((aligned / "clock.json").read_text())
    assert clock["offset"] == pytest.approx(77.5, abs=2e-4)
    assert clock["configuration"] == json.loads((aligned / "run.json").read_text())["configuration"]
    assert said(capsys, "truth", aligned)[0] == 0
    truth, drives = (read_trajectory(aligned / name) for name in ("groundtruth.txt", "groundtruth_driveclock.txt"))
    assert (truth.time - drives.time).double().mean() * 1e-6 == pytest.approx(77.5, abs=2e-4)
    told = json.loads((aligned / "truth.json").read_text())
    half = float(drives.time[-1] - drives.time[0]) * 0.5e-6
    assert told["sigma_t"] == pytest.approx(np.hypot(clock["sigma"], clock["drift_sigma"] * half), rel=1e-6)
    assert told["sigma_t"] < 1e-3


def test_a_configuration_that_is_not_the_runs_is_refused(aligned, capsys):
    lock = aligned / "config.lock.yaml"
    lock.write_text(lock.read_text().replace("direction: [1, 0, 0]", "direction: [0, 1, 0]"))
    for action in (("truth", aligned), ("sync", aligned, "--result", aligned.parent / "result")):
        status, _, err = said(capsys, *action)
        assert status == 2
        assert "not the configuration of this run" in err
    assert not (aligned / "groundtruth.txt").exists()


@pytest.mark.parametrize("of", ["configuration", "record"])
def test_a_clock_of_another_run_is_refused(aligned, capsys, of):
    clock = json.loads((aligned / "clock.json").read_text())
    (aligned / "clock.json").write_text(json.dumps(clock | {of: "0" * 64}))
    status, _, err = said(capsys, "truth", aligned)
    assert status == 2
    assert "another run" in err
    assert not (aligned / "groundtruth.txt").exists()


def test_a_new_clock_takes_away_what_was_made_by_the_older(aligned, moved, capsys, tmp_path):
    assert said(capsys, "truth", aligned)[0] == 0
    before = {path: path.read_bytes() for path in aligned.iterdir()}
    for missing in (("--result", tmp_path / "none"), ("--events", tmp_path / "none.npz")):  # nothing was asked of the clocks
        status, _, err = said(capsys, "sync", aligned, *missing)
        assert status == 2
        assert "none" in err
    assert {path: path.read_bytes() for path in aligned.iterdir()} == before
    for result, status in ((tmp_path / "result", 0), (seen_by_camera(moved, tmp_path / "foreign", 3.0), 6)):
        assert said(capsys, "truth", aligned)[0] == 0
        assert said(capsys, "sync", aligned, "--result", result)[0] == status
        assert not left(aligned) & {"groundtruth.txt", "truth.json", "twist.txt"}
    assert said(capsys, "truth", aligned)[0] == 6
    told = json.loads((aligned / "truth.json").read_text())
    assert not told["truth"]
    assert told["clock"]["reason"]


def test_events_with_a_stray_stamp_are_refused_and_not_counted_for_ever(aligned, capsys, tmp_path):
    t = np.append(np.arange(0, 9_000_000, 100), 1_700_000_000_000_000)  # us: the last of the year 2023
    zeros = np.zeros(len(t), np.uint16)
    np.savez(tmp_path / "events.npz", t=t, x=zeros, y=zeros, p=zeros.astype(bool))
    status, _, err = said(capsys, "sync", aligned, "--events", tmp_path / "events.npz")
    assert status == 6
    assert "more than 21600 s" in err
    assert not json.loads((aligned / "clock.json").read_text())["accepted"]


def test_planning_clocks_and_truth_need_no_bus(aligned, profile, tmp_path):
    actions = [
        ["plan", SLIDER, profile, "-o", tmp_path / "plan"],
        ["sync", aligned, "--result", tmp_path / "result"],
        ["truth", aligned],
    ]
    script = "import sys; sys.modules.update(can=None, canopen=None); from torchcmax.cli import main\n"
    script += "".join(f"assert main({['rig', *map(str, action)]}) == 0\n" for action in actions)
    subprocess.run([sys.executable, "-c", script], check=True)


def test_a_clock_that_is_not_known_is_no_ground_truth(moved, capsys, tmp_path):
    moved = shutil.copytree(moved, tmp_path / "run")
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
