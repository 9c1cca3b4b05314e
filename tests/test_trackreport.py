import csv
import io
import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchcmax.compensate import Compensation, compensate
from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.contrast import blur
from torchcmax.core.draw import Ink, draw
from torchcmax.core.warp import still
from torchcmax.folder import COLUMNS, TRACKED, WINDOWS, cell, check_place, written
from torchcmax.io import DataError, open
from torchcmax.io.trajectory import read_trajectory
from torchcmax.mapfile import load_map, save_map
from torchcmax.report import Report
from torchcmax.score import score
from torchcmax.slam.relocalize import Relocalizing
from torchcmax.slam.sense import Sensing
from torchcmax.slam.system import Slam
from torchcmax.track import TrackOptions, track
from torchcmax.trackreport import STATUS, TrackReport, compensation
from torchcmax.tracktable import KEYFRAMES, POSE, TABLE

SLAM = replace(Slam(), mapping=replace(Slam().mapping, first=5))


def options(**more):
    return TrackOptions(**{"slam": SLAM, "end": 0.35} | more)


def report(folder, small, every=4, stop=None, **more):
    """A run's folder; stop: an error after so many windows."""
    tracks = track(open(small), options(**more))
    with tracks.stream, TrackReport(folder, tracks, "model: planar\n", every) as run:
        for one in tracks:
            run.add(one)
            if stop is not None and one.index + 1 == stop[0]:
                raise stop[1]
    return run


@pytest.fixture(scope="module")
def run(small, tmp_path_factory):
    return report(tmp_path_factory.mktemp("run") / "new" / "folder", small)


def lines_of(path):
    return list(csv.DictReader(path.open()))


def board(folder):
    found = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    found.Reload()
    return found


def test_all_that_is_promised_is_there_and_nothing_else(run):
    names = {p.name for p in run.folder.iterdir() if not p.name.startswith("events.out")}
    assert names == {WINDOWS, "summary.json", "report.html", "images", *TRACKED}
    assert written(run.folder) == names - {"images"}


def test_windows_csv_has_the_columns_of_compensate_and_its_own(run):
    header = (run.folder / WINDOWS).read_text().splitlines()[0]
    signs = "status,reason,overlap,strength,supported,doubt,weakest,weakest_share"
    assert header == ",".join(COLUMNS) + f",time_us,tx,ty,tz,qx,qy,qz,qw,{signs},map,keyframe"
    lines = lines_of(run.folder / WINDOWS)
    assert [int(line["index"]) for line in lines] == list(range(len(lines)))
    assert len(lines) > 7
    for line in lines:
        assert int(line["start_us"]) < int(line["time_us"]) < int(line["end_us"]) < 350_000
        assert line["status"] in STATUS
        assert float(line["gain"]) == pytest.approx(float(line["contrast"]) / float(line["contrast_zero"]), rel=1e-6)


def test_the_tables_hold_the_final_poses(run):
    trajectory = run.tracks.trajectory()
    expected = torch.cat([trajectory.pose.t, so3.to_quaternion(trajectory.pose.R)], -1).numpy()
    found = [[float(line[name]) for name in POSE] for line in lines_of(run.folder / WINDOWS)]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    back = read_trajectory(run.folder / "trajectory.txt")
    assert torch.equal(back.time, trajectory.time)
    torch.testing.assert_close(back.pose.t, trajectory.pose.t, atol=1e-11, rtol=0)
    torch.testing.assert_close(back.pose.R, trajectory.pose.R, atol=1e-11, rtol=0)


def test_keyframes_csv_is_what_the_map_was_drawn_from(run):
    lines = lines_of(run.folder / "keyframes.csv")
    assert list(lines[0]) == list(KEYFRAMES)
    assert len(lines) == len(run.tracks.map.keyframes) >= 5
    for i, (line, keyframe) in enumerate(zip(lines, run.tracks.map.keyframes, strict=True)):
        assert (int(line["number"]), int(line["time_us"]), int(line["events"])) == (i, keyframe.time, keyframe.ink.x.shape[1])
        assert float(line["ty"]) == pytest.approx(keyframe.state.pose.t[0, 1].item(), abs=1e-8)
        assert float(line["omega_z"]) == pytest.approx(keyframe.state.motion.omega[0, 2].item(), rel=1e-6)


def test_the_map_is_saved_and_pictured(run):
    saved = load_map(run.folder / "map.h5")
    assert list(saved.tiles) == list(run.tracks.map.tiles)
    picture = Image.open(run.folder / "map.png")
    assert picture.mode == "RGB"
    assert min(picture.size) > 100


def test_the_summary_tells_the_run_in_numbers(run, small):
    summary = json.loads((run.folder / "summary.json").read_text())
    recording, lines = open(small), lines_of(run.folder / WINDOWS)
    assert summary["complete"] is True
    assert summary["windows"] == len(lines) == sum(summary["status"].values())
    assert summary["events"] == sum(int(line["events"]) for line in lines)
    assert summary["seconds"] == pytest.approx(0.35, abs=0.03)
    assert summary["keyframes"] == len(run.tracks.map.keyframes)
    assert summary["lost_seconds"] == 0
    assert summary["plane"]["normal"] == run.tracks.map.plane.normal[0].tolist()
    parts = summary["read_seconds"] + summary["compute_seconds"] + summary["report_seconds"]
    assert parts == pytest.approx(summary["wall_seconds"], abs=0.002)
    assert summary["real_time_factor"] == pytest.approx(summary["seconds"] / summary["wall_seconds"], rel=1e-2)
    expected = score(run.tracks.trajectory(), recording.truth, recording.plane, None, 350_000)
    assert summary["error"]["percent_of_distance"] == pytest.approx(expected.percent_of_distance, rel=1e-6)
    assert summary["error"]["coverage"] == expected.coverage > 0.9
    assert 0 < summary["error"]["plane_deg"] < 30


def test_positions_are_in_metres_when_the_distance_is_given(run, small, tmp_path):
    other = report(tmp_path, small, every=0, distance=1.5)
    one, scaled = (read_trajectory(folder / "trajectory.txt") for folder in (run.folder, tmp_path))
    torch.testing.assert_close(scaled.pose.t, 1.5 * one.pose.t, atol=1e-10, rtol=0)
    assert (tmp_path / WINDOWS).read_text() == (run.folder / WINDOWS).read_text()
    assert other.summary()["error"] == run.summary()["error"]


def test_tensorboard_shows_every_window(run):
    found, count = board(run.folder), len(run.table)
    names = "contrast contrast_zero gain omega_x v_z n_y evaluations converged overlap status events_per_second".split()
    for name in [*(f"window/{n}" for n in names), *(f"pose/{n}" for n in "tx ty tz rx_deg ry_deg rz_deg".split()), "map/keyframes"]:
        assert [event.step for event in found.Scalars(name)] == list(range(count)), name
    for name in ("error/live_percent_of_distance", "error/final_percent_of_distance", "error/live_orientation_deg"):
        assert len(found.Scalars(name)) == count
    assert found.Scalars("error/live_percent_of_distance")[0].value < 1e-3
    lines = lines_of(run.folder / WINDOWS)
    assert [event.value for event in found.Scalars("window/status")] == [STATUS[line["status"]] for line in lines]
    tracked = [i for i, line in enumerate(lines) if line["strength"]]
    assert [event.step for event in found.Scalars("window/strength")] == tracked
    assert "config/text_summary" in found.Tags()["tensors"]


def test_pictures_are_of_every_fourth_window_and_the_board_shows_some(run):
    names = [f"window_{i:05d}.png" for i in range(0, len(run.table), 4)]
    assert sorted(p.name for p in (run.folder / "images").iterdir()) == names
    found = board(run.folder)
    assert [event.step for event in found.Images("before_after")] == [0, 4, 8][: len(names)]
    assert [event.step for event in found.Images("map")] == [*[0, 4, 8][: len(names)], len(run.table) - 1]
    for event in (*found.Images("before_after"), *found.Images("map")):
        assert Image.open(io.BytesIO(event.encoded_image_string)).size == (event.width, event.height)


def test_what_is_shown_as_compensated_is_sharper(small):
    recording = open(small)
    window = list(track(recording, options()))[6]
    H_k = compensation(window).float()
    ink, canvas, owner = Ink.of(window.window, window.window.weight), Canvas.around(recording.camera), torch.zeros(1, dtype=torch.int64)
    before, after = (blur(draw(warp, ink, canvas, owner), 1.0).var() for warp in (still(H_k), H_k))
    assert after > 1.5 * before


def test_a_run_that_breaks_off_keeps_what_is_done_and_says_so(small, tmp_path):
    error = DataError("events.txt", "letters in a column", "mend it", "line 7")
    with pytest.raises(DataError, match="letters"):
        report(tmp_path, small, stop=(7, error))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["complete"] is False
    assert "line 7" in summary["stopped_by"]
    assert summary["windows"] == 7 == len(lines_of(tmp_path / WINDOWS))
    assert len(read_trajectory(tmp_path / "trajectory.txt")) == 7
    assert summary["error"]["poses"] == 7
    assert load_map(tmp_path / "map.h5").keyframes
    assert not list(tmp_path.glob(".*"))


def test_a_run_of_one_window_has_a_table_and_no_trajectory(small, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        report(tmp_path, small, stop=(1, KeyboardInterrupt()))
    (line,) = lines_of(tmp_path / WINDOWS)
    assert abs(float(line["qw"])) > 0.9
    assert not (tmp_path / "trajectory.txt").exists()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["error"], summary["complete"]) == (None, False)


def test_a_run_that_is_killed_leaves_a_folder_that_the_next_may_replace(small, tmp_path):
    tracks = track(open(small), options())
    killed = TrackReport(tmp_path, tracks, "", 1)
    for one in tracks:
        killed.add(one)
        break
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["complete"] is False
    assert "killed" in summary["stopped_by"]
    assert board(tmp_path).Scalars("window/gain")
    report(tmp_path, small, every=0)
    assert not list(tmp_path.glob(".*"))
    assert not list((tmp_path / "images").iterdir())
    assert json.loads((tmp_path / "summary.json").read_text())["complete"] is True


def test_a_disk_that_fills_up_at_the_end_is_named_and_the_table_stays(small, tmp_path, monkeypatch):
    import torchcmax.trackreport as module

    def full(path, *_):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "write_table", full)
    monkeypatch.setattr(module, "save_map", lambda path, _: full(path.with_name(".map.h5.part")))
    with pytest.raises(DataError, match="No space left on device"):
        report(tmp_path, small, every=0)
    assert len(lines_of(tmp_path / WINDOWS)) > 7
    assert lines_of(tmp_path / WINDOWS)[3]["qw"]
    assert written(tmp_path) == {WINDOWS, "summary.json", "report.html", "trajectory.txt", "truth.txt", "map.png"}


@pytest.mark.parametrize("name", ["map.png", "trajectory.txt", WINDOWS])
def test_what_another_program_wrote_is_not_replaced(name, small, tmp_path):
    (tmp_path / name).write_text("theirs")
    with pytest.raises(DataError, match="no run of ours wrote"):
        report(tmp_path, small)
    assert (tmp_path / name).read_text() == "theirs"


def test_runs_of_both_commands_replace_each_other_and_nothing_else(demo, small, tmp_path):
    recording, how = open(demo), Compensation(events=6000, limit=1)

    def compensated():
        with Report(tmp_path, recording, how, "", 1) as run:
            for window, estimate in compensate(recording, how):
                run.add(window, estimate)

    report(tmp_path, small, every=0)
    compensated()
    assert {p.name for p in tmp_path.iterdir() if "tfevents" not in p.name} == {WINDOWS, "summary.json", "report.html", "images"}
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "map.png").write_text("mine")
    compensated()
    assert (tmp_path / "map.png").read_text() == "mine"
    with pytest.raises(DataError, match=r"holds map\.png"):
        report(tmp_path, small)
    (tmp_path / "map.png").unlink()
    report(tmp_path, small, every=0)
    assert not list((tmp_path / "images").iterdir())
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 1


def test_a_map_to_track_against_is_not_replaced(run, small):
    with pytest.raises(DataError, match="is where the map to track against is"):
        TrackReport(run.folder, track(open(small), options(map=str(run.folder / "map.h5"))), "", 0)


def test_a_summary_cannot_name_files_of_others(small, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "precious").write_text("x")
    summary = {"versions": {"torchcmax": "1"}, "files": ["../precious", "notes.txt", WINDOWS]}
    (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    assert written(tmp_path / "run") == {WINDOWS, "summary.json", "report.html"}
    for broken in ("[]", "3", '{"versions": 3}', '{"versions": {"torchcmax": 1}, "files": 3}', "{"):
        (tmp_path / "run" / "summary.json").write_text(broken)
        with pytest.raises(DataError, match=r"holds summary\.json"):
            check_place(tmp_path / "run", open(small))


def test_cells():
    assert [cell(2.0, True), cell(1 / 3, False), cell(float("nan"), False), cell(True, True)] == ["2", "0.333333333", "", "1"]
    assert len(TABLE) == len(set(TABLE))


@pytest.fixture(scope="module")
def gap(small, tmp_path_factory):
    """The small recording without 0.1 s of its events, and a run that begins a second map behind them, and never finds the first."""
    folder = tmp_path_factory.mktemp("gap") / "poster"
    shutil.copytree(small, folder)
    with h5py.File(folder / "events.h5", "r+") as file:
        t = file["events/t"][()]
        keep = (t < 200_000) | (t >= 300_000)
        for name in ("t", "x", "y", "p"):
            column = file[f"events/{name}"][()][keep]
            del file[f"events/{name}"]
            file[f"events/{name}"] = column
    slam = replace(SLAM, sensing=Sensing(patience=0.05), relocalizing=Relocalizing(far=False))
    return folder, report(tmp_path_factory.mktemp("lost") / "run", folder, slam=slam, end=None)


def test_a_loss_and_what_was_tracked_behind_it_are_told(gap):
    _, run = gap
    summary = json.loads((run.folder / "summary.json").read_text())
    assert (summary["losses"], summary["recoveries"], summary["maps"], summary["maps_joined"]) == (1, 0, 2, 0)
    main, other = (m.number for m in run.tracks.atlas)
    assert {main, other} == {0, 1}
    assert {"map.h5", f"map_{other}.h5"} <= set(summary["files"])
    assert [load_map(run.folder / name).number for name in ("map.h5", f"map_{other}.h5")] == [main, other]
    lines = lines_of(run.folder / WINDOWS)
    assert {line["map"] for line in lines} == {"0", "1"}
    here = [line for line in lines if line["map"] == str(main)]
    assert len(read_trajectory(run.folder / "trajectory.txt")) == len(here) < len(lines)
    assert lines[0]["reason"] == ""


def test_the_board_says_nothing_of_where_a_lost_camera_is(gap):
    _, run = gap
    found = board(run.folder)
    status = {event.step: event.value for event in found.Scalars("window/status")}
    lost = [step for step, value in status.items() if value == STATUS["lost"]]
    assert lost
    assert len(status) == len(run.table)
    for name in ("pose/tx", "pose/rx_deg", "error/live_orientation_deg"):
        assert not {event.step for event in found.Scalars(name)} & set(lost)


def test_a_new_run_takes_the_place_of_every_map_of_the_last_one(gap, small):
    folder, run = gap
    assert list(run.folder.glob("map_*.h5"))
    report(run.folder, folder, end=0.19)
    assert not list(run.folder.glob("map_*.h5"))


def test_a_run_on_a_map_of_something_else_ends_without_a_trajectory(gap, run, tmp_path):
    m = load_map(run.folder / "map.h5")
    m.tiles.clear()
    save_map(tmp_path / "blank.h5", m)
    folder, _ = gap
    found = report(tmp_path / "run", folder, map=str(tmp_path / "blank.h5"), slam=replace(SLAM, atlas=False), end=0.15)
    assert {line["status"] for line in lines_of(found.folder / WINDOWS)} == {"lost"}
    assert all(line["tx"] == line["map"] == "" for line in lines_of(found.folder / WINDOWS))
    assert "trajectory.txt" not in found.files
    assert json.loads((found.folder / "summary.json").read_text())["error"] is None
