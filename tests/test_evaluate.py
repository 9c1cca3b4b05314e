"""Results against ground truth: protocols, velocities, offsets, and the command."""

import csv
import dataclasses
import json
import math
import shutil
import sys
from pathlib import Path

import pytest
import torch
from test_score import PLACE, moved, noisy, path

from torchcmax.cli import main
from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.evaluate import ALL, EvaluateOptions, Run, evaluate
from torchcmax.io import DataError, DataNote, DataWarning
from torchcmax.io.trajectory import read_trajectory, write_trajectory
from torchcmax.protocols import PROTOCOLS
from torchcmax.velocity import Velocities, true_velocities, velocity_errors

MILLI = 1000
WALL = Plane(torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64), torch.tensor([5.0], dtype=torch.float64))
POSES = [name for name, protocol in PROTOCOLS.items() if protocol.align]
OURS = ["similarity", "rotation"]


def run_of(trajectory, **more):
    return Run("somebody's", Path("somebody.txt"), trajectory=trajectory, **more)


def judged(run, truth, name, *, plane=None, **options):
    (row,) = evaluate(run, truth, plane, Path("truth.txt"), (name,), EvaluateOptions(**options)).rows
    return row


def wants_evo(name):
    if PROTOCOLS[name].evo:
        pytest.importorskip("evo", reason="the extra eval is not installed")


def drifting(rate, seconds=4.0):
    """Truth that stands still, and an estimate of it that turns about z at a rate, deg/s, at 100 Hz."""
    time = torch.arange(0, round(seconds * 1e6) + 1, 10 * MILLI)
    still = torch.zeros(len(time), 3, dtype=torch.float64)
    turn = still.clone()
    turn[:, 2] = math.radians(rate) * time * 1e-6
    return Trajectory(time, Pose(so3.exp(still), still)), Trajectory(time, Pose(so3.exp(turn), still))


@pytest.mark.parametrize("name", POSES)
def test_a_perfect_estimate_in_another_world_has_no_error(name):
    wants_evo(name)
    truth = path()
    plane = Plane(WALL.normal, WALL.distance + 10)
    own = Plane((PLACE.R.mT @ plane.normal[0])[None], (plane.distance + PLACE.t @ plane.normal[0]) / PLACE.scale)
    row = judged(run_of(moved(truth, PLACE), plane=own), truth, name, plane=plane)
    assert row["rotation_max_deg"] < 1e-5  # evo takes an arc cosine
    assert row["coverage"] == 1
    if not PROTOCOLS[name].turning:
        assert row["scale"] == pytest.approx(2.5)
        assert row["ate_max_m"] < 1e-9
        assert row["percent_of_distance"] < 1e-8
    if PROTOCOLS[name].evo:
        assert row["rpe_pairs"] == 1001  # of two seconds at 1 kHz, those that have a pose one second later
        assert row["rpe_rotation_max_deg"] < 1e-5


@pytest.mark.parametrize("name", [n for n in POSES if not PROTOCOLS[n].turning])
def test_a_push_aside_that_no_alignment_explains_is_the_error(name):
    wants_evo(name)
    side = 3.0
    t = torch.tensor([[0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]], dtype=torch.float64).repeat(2, 1)
    push = torch.tensor([0.01, -0.01] * 4, dtype=torch.float64)  # out of the square's plane, up and down in turn
    time, R = torch.arange(8) * 50 * MILLI, torch.eye(3, dtype=torch.float64).repeat(8, 1, 1)
    estimate = t.clone()
    estimate[:, 2] = push
    row = judged(run_of(Trajectory(time, Pose(R, estimate)), metric=True), Trajectory(time, Pose(R, t)), name, delta=0.05)
    if name == "first_pose":  # the first of them is laid on the truth: the others are off by 0 and 2 cm
        assert row["ate_rmse_m"] == pytest.approx(0.02 / math.sqrt(2))
    elif name == "se3":
        assert row["ate_rmse_m"] == pytest.approx(0.01, rel=1e-6)
    else:  # a scale that is a little smaller fits a little better
        assert row["ate_rmse_m"] == pytest.approx(0.01, rel=1e-4)
    assert row["percent_of_path"] == pytest.approx(100 * row["ate_rmse_m"] / (7 * side))
    if PROTOCOLS[name].evo:
        assert row["rpe_translation_rmse_m"] == pytest.approx(0.02, rel=1e-4)


def test_drift_counts_from_the_pose_that_is_laid_on_the_truth():
    pytest.importorskip("evo", reason="the extra eval is not installed")
    truth, estimate = drifting(rate=0.5)
    run = run_of(estimate, turning=True)
    t = estimate.time.double() * 1e-6
    row = judged(run, truth, "cmax_slam")
    assert row["rotation_rmse_deg"] == pytest.approx(0.5 * float(t.square().mean().sqrt()), rel=1e-6)
    assert row["rpe_rotation_rmse_deg"] == pytest.approx(0.5, rel=1e-6)
    assert row["rpe_pairs"] == 301
    later = judged(run, truth, "cmax_slam", align_at=1.0)
    assert later["rotation_rmse_deg"] == pytest.approx(0.5 * float((t - 1).square().mean().sqrt()), rel=1e-6)
    assert judged(run, truth, "cmax_slam", delta=2.0)["rpe_rotation_rmse_deg"] == pytest.approx(1.0, rel=1e-6)
    assert judged(run, truth, "cmax_slam", end=1.0)["rotation_max_deg"] == pytest.approx(0.5, rel=1e-6)
    best = judged(run, truth, "rotation")
    assert best["rotation_rmse_deg"] == pytest.approx(0.5 * float((t - 2).square().mean().sqrt()), rel=1e-3)
    with pytest.raises(DataError, match="no pose at --align_at 9 s"):
        judged(run, truth, "cmax_slam", align_at=9.0)


def test_ours_and_evos_errors_are_the_same_numbers():
    pytest.importorskip("evo", reason="the extra eval is not installed")
    from torchcmax.alignment import absolute, evo_absolute

    truth = path()
    estimate = noisy(truth, 0.02)
    for own, other in zip(absolute(estimate, truth, PLACE), evo_absolute(estimate, truth, PLACE), strict=True):
        assert own == pytest.approx(other, rel=1e-7)


def test_pairs_across_a_gap_of_the_estimate_are_left_out():
    pytest.importorskip("evo", reason="the extra eval is not installed")
    truth = path()
    keep = (truth.time < 1_200_000) | (truth.time >= 1_500_000)
    row = judged(run_of(Trajectory(truth.time[keep], truth.pose[keep]), metric=True), truth, "se3")
    assert row["rpe_pairs"] == 200 + 500  # they end at 1.0..1.199 s and 1.501..2 s; at 1.5 s the gap ends
    assert row["coverage"] == pytest.approx(1 - 0.301 / 2)


def test_metres_are_judged_only_where_something_tells_them():
    pytest.importorskip("evo", reason="the extra eval is not installed")
    truth = path()
    double = Trajectory(truth.time, Pose(truth.pose.R, truth.pose.t * 2))
    with pytest.raises(DataError, match="plane distances"):
        judged(run_of(double), truth, "se3")
    assert judged(run_of(double, metric=True), truth, "se3")["ate_rmse_m"] > 0.1
    assert judged(run_of(double, metric=True), truth, "sim3")["ate_rmse_m"] < 1e-9


def test_a_straight_line_is_refused_by_umeyama_and_not_by_us():
    pytest.importorskip("evo", reason="the extra eval is not installed")
    time = torch.arange(11) * 10 * MILLI
    t = torch.zeros(11, 3, dtype=torch.float64)
    t[:, 0] = torch.linspace(0, 1, 11, dtype=torch.float64)
    slide = Trajectory(time, Pose(torch.eye(3, dtype=torch.float64).repeat(11, 1, 1), t))
    assert judged(run_of(slide), slide, "similarity")["ate_max_m"] < 1e-12
    with pytest.raises(DataError, match="do not tell how it lies"):
        judged(run_of(slide), slide, "sim3")


def test_all_leaves_out_what_cannot_judge_and_says_why():
    pytest.importorskip("evo", reason="the extra eval is not installed")
    truth = path()
    with pytest.warns(DataNote) as told:
        rows = evaluate(run_of(moved(truth, PLACE)), truth, None, Path("truth.txt"), ALL).rows  # in plane distances, without a plane
    assert [row["protocol"] for row in rows] == ["similarity", "rotation", "sim3", "cmax_slam"]
    assert [str(note.message).split()[1] for note in told] == ["se3", "first_pose"]
    beyond = Trajectory(truth.time[-1] + truth.time, truth.pose)  # one pose of it in the truth's time
    with pytest.warns(DataNote), pytest.raises(DataError, match="at least two"):
        evaluate(run_of(beyond), truth, None, Path("truth.txt"), ALL)


def test_a_run_that_holds_nothing_is_refused():
    with pytest.raises(DataError, match="neither a trajectory nor velocities"):
        evaluate(run_of(None), path(), None, Path("truth.txt"))


@pytest.mark.parametrize("name", ["sim3", "se3"])
def test_an_almost_straight_path_is_told_where_it_turns_the_world(name):
    pytest.importorskip("evo", reason="the extra eval is not installed")
    time, noise = torch.arange(101) * 10 * MILLI, torch.Generator().manual_seed(3)
    t = 1e-6 * torch.randn(101, 3, dtype=torch.float64, generator=noise)
    t[:, 0] = torch.linspace(0, 1, 101, dtype=torch.float64)
    R = torch.eye(3, dtype=torch.float64).repeat(101, 1, 1)
    truth = Trajectory(time, Pose(R, t))
    estimate = Trajectory(time, Pose(R, t * torch.tensor([1.0, -1, -1], dtype=torch.float64)))  # rolled by half a turn about the path
    with pytest.warns(DataWarning, match=f"{name} turns the world by 180.0 degrees"):
        row = judged(run_of(estimate, metric=True), truth, name, delta=0.1)
    assert row["rotation_rmse_deg"] == pytest.approx(180, abs=0.1)
    assert row["ate_max_m"] < 1e-9


def test_no_two_poses_so_far_apart_are_told():
    pytest.importorskip("evo", reason="the extra eval is not installed")
    with pytest.warns(DataNote, match="no pose has one 5 s later"):
        row = judged(run_of(path(), turning=True), path(), "cmax_slam", delta=5.0)
    assert row["rpe_pairs"] == 0


@pytest.mark.parametrize("offset", [0.0371, -0.012])
def test_an_offset_of_the_clocks_is_found(offset):
    truth = path()
    shifted = Trajectory(truth.time[100:-100] - round(offset * 1e6), truth.pose[100:-100])
    run = run_of(moved(shifted, PLACE))
    assert judged(run, truth, "similarity")["rotation_rmse_deg"] > 0.1
    assert judged(run, truth, "similarity", offset=str(offset))["rotation_rmse_deg"] < 1e-6
    found = evaluate(run, truth, None, Path("truth.txt"), ("similarity",), EvaluateOptions(offset="estimate"))
    assert found.offset == pytest.approx(offset, abs=3e-5)
    assert found.found
    assert found.rows[0]["rotation_rmse_deg"] < 0.01


def test_an_even_slide_tells_no_offset():
    time = torch.arange(0, 2_000_001, 10 * MILLI)
    t = torch.zeros(len(time), 3, dtype=torch.float64)
    t[:, 0] = time * 1e-6
    noise = 1e-3 * torch.randn(t.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    R = torch.eye(3, dtype=torch.float64).repeat(len(time), 1, 1)
    with pytest.raises(DataError, match="offset"):
        judged(run_of(Trajectory(time, Pose(R, t + noise))), Trajectory(time, Pose(R, t)), "similarity", offset="estimate")


def test_a_camera_that_stands_still_tells_no_offset():
    truth = path()
    still = (truth.time > 800_000) & (truth.time < 1_300_000)
    i = int(still.nonzero()[0])
    parts = (torch.where(still.view(-1, *[1] * (x.dim() - 1)), x[i], x) for x in (truth.pose.R, truth.pose.t))
    rests = Trajectory(truth.time, Pose(*parts))
    with pytest.raises(DataError, match="about as well"):  # only what is asked for counts
        judged(run_of(moved(rests, PLACE)), rests, "similarity", offset="estimate", begin=0.9, end=1.1)


@pytest.mark.parametrize(("size", "told"), [(0.0, "offset"), (1.0, "")])
def test_an_offset_of_velocities_is_told_by_turns_only(size, told):
    """A model without rotation fits best where the truth rests, here at 1.7 to 2.4 s; that is no offset."""
    time = torch.arange(0, 4_000_001, MILLI)
    s = time.double() * 1e-6
    s = torch.where(s < 1.7, s, (s - 0.7).clamp_min(1.7))
    turn = torch.stack([s.square().sin(), (2 * s).cos(), 0 * s], -1)
    truth = Trajectory(time, Pose(so3.exp(turn), torch.zeros(len(time), 3, dtype=torch.float64)))
    start = torch.arange(2_500_000, 3_000_000, 10 * MILLI)
    known = Velocities(start, start + 10 * MILLI, start, torch.zeros(len(start), 3, dtype=torch.float64), None, False)
    known = dataclasses.replace(known, omega=size * true_velocities(known, truth)[0]).later(-50 * MILLI)
    run = run_of(None, velocities=known)
    if told:
        with pytest.raises(DataError, match=told):
            judged(run, truth, "velocity", offset="estimate")
    else:
        assert judged(run, truth, "velocity", offset="estimate")["offset_s"] == pytest.approx(0.05, abs=3e-5)


def test_truth_of_a_body_becomes_that_of_the_camera():
    truth = path()
    q = so3.to_quaternion(PLACE.R).tolist()
    body = Trajectory(truth.time, truth.pose @ Pose(PLACE.R, PLACE.t).inverse())
    numbers = " ".join(map(repr, [*PLACE.t.tolist(), *q]))
    assert judged(run_of(truth), body, "similarity", extrinsic=numbers)["ate_max_m"] < 1e-9
    assert judged(run_of(truth), body, "similarity")["ate_max_m"] > 0.1


def test_gaps_of_the_truth_are_told():
    truth = path()
    keep = (truth.time < 500_000) | (truth.time > 900_000)
    with pytest.warns(DataWarning, match="1 gaps of more than 0.1 s, the longest of 0.402 s at 0.499"):
        judged(run_of(truth), Trajectory(truth.time[keep], truth.pose[keep]), "similarity")


def spinning(omega, velocity, seconds=2.0):
    """A camera that turns and moves at constant velocities of its own frame."""
    time = torch.arange(0, round(seconds * 1e6) + 1, MILLI)
    s = time.double()[:, None] * 1e-6
    R = so3.exp(torch.tensor(omega, dtype=torch.float64) * s)
    step = (R @ torch.tensor(velocity, dtype=torch.float64)) * 1e-3
    t = torch.cat([torch.zeros(1, 3, dtype=torch.float64), (step[1:] + step[:-1]).cumsum(0) / 2])
    return Trajectory(time, Pose(R, t))


def windows(truth, omega, linear, *, world, length=10 * MILLI):
    start = torch.arange(0, int(truth.time[-1]) - length + 1, length)
    at = start + length // 2 if world else start
    rows = [torch.tensor([v], dtype=torch.float64).expand(len(start), 3).clone() for v in (omega, linear)]
    return Velocities(start, start + length, at, rows[0], rows[1], world)


def test_velocities_are_compared_axis_by_axis_in_the_cameras_frame():
    omega, v = (0.5, -1.0, 2.0), (0.3, 0.1, -0.2)
    truth = spinning(omega, v)
    known = windows(truth, (0.5, -1.0, 2.1), (0.3, 0.15, -0.2), world=True)
    found = velocity_errors(known, truth, None, 1.0)
    assert found["omega_z_rmse_deg_s"] == pytest.approx(math.degrees(0.1), rel=1e-6)
    assert found["omega_x_rmse_deg_s"] == pytest.approx(0, abs=1e-6)
    assert found["omega_percent"] == pytest.approx(100 * 0.1 / math.sqrt(0.25 + 1 + 4), rel=1e-6)
    assert found["v_y_rmse_m_s"] == pytest.approx(0.05, rel=1e-3)
    assert found["v_x_rmse_m_s"] == pytest.approx(0, abs=1e-4)
    assert "v_y_rmse_m_s" not in velocity_errors(known, truth)  # nobody knows how many metres
    half = velocity_errors(windows(truth, omega, (0.6, 0.2, -0.4), world=True), truth, None, 0.5)
    assert half["v_rmse_m_s"] == pytest.approx(0, abs=1e-4)


def test_plane_distances_become_metres_by_the_planes_distance_at_each_moment():
    omega, v = (0.0, 0.0, 0.0), (0.0, 0.4, 1.0)  # towards the plane: nearer by two of five metres
    truth = spinning(omega, v)
    known = windows(truth, omega, (0, 0, 0), world=False)
    there = truth.at(known.at)
    distance = Plane(WALL.normal.expand(len(known), 3), WALL.distance.expand(len(known))).seen_from(there).distance
    assert distance[-1] == pytest.approx(5 - 1.99)
    linear = torch.tensor([v], dtype=torch.float64) / distance[:, None]
    found = velocity_errors(Velocities(known.start, known.end, known.at, known.omega, linear, False), truth, WALL)
    assert found["v_rmse_m_s"] == pytest.approx(0, abs=1e-9)


def test_a_rough_truth_is_smoothed_over_longer_than_a_window():
    truth = spinning((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    jitter = 2e-4 * torch.randn(len(truth), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    rough = Trajectory(truth.time, Pose(truth.pose.R @ so3.exp(jitter), truth.pose.t))
    run = run_of(None, velocities=windows(truth, (0.0, 0.0, 1.0), (0, 0, 0), world=False))
    plain, smooth = (judged(run, rough, "velocity", smooth=s)["omega_rmse_deg_s"] for s in (0.0, 0.1))
    assert plain > 5 * smooth > 0


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"delta": 0.0}, "--delta"),
        ({"smooth": -1.0}, "--smooth"),
        ({"offset": "soon"}, "--offset"),
        ({"offset": "nan"}, "--offset"),
        ({"extrinsic": "1 2 3"}, "--extrinsic"),
        ({"extrinsic": "0 0 0 0 0 0 2"}, "--extrinsic"),
        ({"begin": 2.0, "end": 1.0}, "--from"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, told):
    with pytest.raises(ValueError, match=told):
        EvaluateOptions(**options)


@pytest.fixture(scope="module")
def tracked(small, tmp_path_factory):
    """The folder of a run."""
    out = tmp_path_factory.mktemp("evaluated") / "run"
    assert main(["track", str(small), "--mapping.first", "5", "--to", "0.3", "--images", "0", "--out", str(out), "--quiet"]) == 0
    return out


def said(capsys, *arguments):
    """Exit status, what was printed, what was complained about."""
    try:
        status = main(["evaluate", *map(str, arguments)])
    except SystemExit as stop:
        status = stop.code
    out, err = capsys.readouterr()
    return status, out, err


def test_a_result_is_judged_where_it_lies(tracked, capsys):
    status, out, _ = said(capsys, tracked)
    assert status == 0
    head, similarity, velocity = out.splitlines()[:3]
    assert head.split()[:4] == ["result", "protocol", "ATE", "m"]
    assert (similarity.split()[1], velocity.split()[1]) == ("similarity", "velocity")
    found, summary = json.loads((tracked / "evaluation.json").read_text()), json.loads((tracked / "summary.json").read_text())
    row = found["results"][0]
    assert row["ate_rmse_m"] == pytest.approx(summary["error"]["position_rmse_m"], rel=1e-6)
    assert row["rotation_rmse_deg"] == pytest.approx(summary["error"]["orientation_rmse_deg"], rel=1e-6)
    assert row["to_s"] == pytest.approx(0.3, abs=0.01)  # the windows' time, not the truth's
    with (tracked / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["ate_rmse_m"]) == pytest.approx(row["ate_rmse_m"])
    assert 0 < float(rows[1]["omega_x_rmse_deg_s"]) < 60
    page = (tracked / "report.html").read_text()
    assert "ate rmse m" in page
    assert "Evaluation" in page


def test_velocities_of_a_result_are_those_of_the_simulated_camera(tracked, capsys):
    status, out, _ = said(capsys, tracked, "--protocol", "velocity", "--json")
    assert status == 0
    (found,) = json.loads(out)
    row = found["results"][0]
    assert row["omega_percent"] < 25  # of the fastest: right frame, right axis, right sign
    assert row["v_percent"] < 25


@pytest.mark.filterwarnings("ignore:.*turns the world")  # a third of a second is not far from a line
def test_every_protocol_judges_a_result(tracked, capsys):
    pytest.importorskip("evo", reason="the extra eval is not installed")
    status, out, _ = said(capsys, tracked, "--protocol", "all", "--json", "--delta", 0.1)
    assert status == 0
    (found,) = json.loads(out)
    assert [row["protocol"] for row in found["results"]] == list(PROTOCOLS)
    by = {row["protocol"]: row for row in found["results"]}
    assert by["sim3"]["ate_rmse_m"] <= by["similarity"]["ate_rmse_m"] <= by["first_pose"]["ate_rmse_m"]  # each least in its own
    assert by["sim3"]["ate_rmse_m"] <= by["se3"]["ate_rmse_m"]


def test_a_trajectory_of_another_system_is_judged_too(tracked, small, tmp_path, capsys):
    shifted = read_trajectory(tracked / "trajectory.txt")
    write_trajectory(tmp_path / "other.txt", shifted)
    status, out, _ = said(capsys, tmp_path / "other.txt", "--truth", small, "--csv", tmp_path / "table.csv")
    assert status == 0
    assert "similarity" in out
    with (tmp_path / "table.csv").open() as file:
        assert next(csv.DictReader(file))["result"] == "other"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other.txt", "table.csv"]
    status, _, err = said(capsys, tmp_path / "other.txt")
    assert status == 1
    assert "--truth" in err


def test_numbers_are_shown_also_where_they_cannot_be_kept(tracked, tmp_path, capsys):
    run = shutil.copytree(tracked, tmp_path / "run", ignore=shutil.ignore_patterns("evaluation.*"))
    (run / "evaluation.csv").mkdir()  # nothing can be renamed to it
    status, out, err = said(capsys, run)
    assert status == 1
    assert out.splitlines()[1].split()[1] == "similarity"
    assert "evaluation.csv: cannot be written" in err
    status, out, err = said(capsys, tracked, "--csv", tmp_path / "nowhere" / "table.csv")
    assert status == 1
    assert out.splitlines()[1].split()[1] == "similarity"
    assert "table.csv: cannot be written" in err


def test_one_of_several_that_cannot_be_judged_does_not_stop_the_others(tracked, tmp_path, capsys):
    status, out, err = said(capsys, tmp_path / "nothing", tracked)
    assert status == 1
    assert "nothing: there is no such folder" in err
    assert str(tracked) in out


def test_without_evo_the_usual_protocols_remain(tracked, capsys, monkeypatch):
    for name in [name for name in sys.modules if name == "evo" or name.startswith("evo.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "evo", None)
    assert said(capsys, tracked)[0] == 0
    status, _, err = said(capsys, tracked, "--protocol", "sim3")
    assert status == 1
    assert "torchcmax[eval]" in err


def test_unknown_protocols_and_empty_names_are_wrong_usage(tracked, capsys):
    status, _, err = said(capsys, tracked, "--protocol", "sim4")
    assert status == 2
    assert "first_pose" in err
    assert said(capsys, "")[0] == 2


def test_a_new_run_takes_the_old_evaluation_away(small, tmp_path, capsys):
    command = ["compensate", str(small), "--limit", "2", "--images", "0", "--out", str(tmp_path / "run"), "--quiet"]
    assert main(command) == 0
    assert said(capsys, tmp_path / "run")[0] == 0
    assert (tmp_path / "run" / "evaluation.json").is_file()
    assert main(command) == 0
    assert not (tmp_path / "run" / "evaluation.json").exists()
    assert not (tmp_path / "run" / "evaluation.csv").exists()


def test_all_finished_results_of_a_batch_are_judged(tracked, tmp_path, capsys):
    for name in "ab":
        shutil.copytree(tracked, tmp_path / name, ignore=shutil.ignore_patterns("evaluation.*"))
    rows = [{"folder": "a", "exit": 0}, {"folder": "b", "exit": 0}, {"folder": "c", "exit": 1}, {"folder": "..", "exit": 0}]
    (tmp_path / "batch.json").write_text(json.dumps({"results": rows}))
    status, text, _ = said(capsys, tmp_path)
    assert status == 0
    assert sum("velocity" in line for line in text.splitlines()) == 2
    assert sorted(p.parent.name for p in tmp_path.rglob("evaluation.json")) == ["a", "b"]
