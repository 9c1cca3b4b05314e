import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchcmax.board import Board
from torchcmax.compensate import Compensation, compensate
from torchcmax.core.camera import Canvas
from torchcmax.core.warp import still
from torchcmax.folder import COLUMNS, writing
from torchcmax.io import DataError, open
from torchcmax.picture import captioned, coloured, pictures, png
from torchcmax.report import Report, rows

HEADER = "index,start_us,end_us,events,contrast_zero,contrast,gain,omega_x,omega_y,omega_z,v_x,v_y,v_z,n_x,n_y,n_z,evaluations,converged"


@pytest.fixture(scope="module")
def results(demo):
    """Four windows in batches of three, with the free plane."""
    recording, options = open(demo), Compensation(model="planar", events=6000, batch=3, limit=4)
    return recording, options, list(compensate(recording, options))


def report(folder, results, every=2):
    recording, options, parts = results
    with Report(folder, recording, options, "model: planar\n", every) as written:
        for window, estimate in parts:
            written.add(window, estimate)
    return folder


@pytest.fixture(scope="module")
def folder(results, tmp_path_factory):
    return report(tmp_path_factory.mktemp("run") / "new" / "folder", results)


def test_windows_csv_has_the_columns_and_the_numbers_of_the_estimates(folder, results):
    text = (folder / "windows.csv").read_text()
    assert text.splitlines()[0] == HEADER
    lines = list(csv.DictReader(text.splitlines()))
    assert [int(line["index"]) for line in lines] == [0, 1, 2, 3]
    window, estimate = results[2][0]
    for i in range(3):
        line = lines[i]
        assert int(line["start_us"]) == window.start[i]
        assert int(line["end_us"]) == window.start[i] + round(window.duration[i].item() * 1e6)
        assert int(line["events"]) == 6000
        for name, vector in (("omega", estimate.motion.omega), ("v", estimate.motion.velocity), ("n", estimate.normal)):
            found = [float(line[f"{name}_{axis}"]) for axis in "xyz"]
            np.testing.assert_allclose(found, vector[i].numpy(), rtol=1e-6)
        assert float(line["gain"]) == pytest.approx(float(line["contrast"]) / float(line["contrast_zero"]), rel=1e-5)
        assert int(line["evaluations"]) == estimate.evaluations[i]
        assert line["converged"] == str(int(estimate.converged[i]))


def test_a_model_without_a_plane_leaves_the_normal_empty(demo, tmp_path):
    recording, options = open(demo), Compensation(events=6000, limit=1)
    report(tmp_path / "run", (recording, options, list(compensate(recording, options))))
    line = next(csv.DictReader((tmp_path / "run" / "windows.csv").open()))
    assert [line[f"n_{axis}"] for axis in "xyz"] == ["", "", ""]
    assert [line[f"v_{axis}"] for axis in "xyz"] == ["0", "0", "0"]


def test_pictures_are_of_every_second_window(folder):
    assert sorted(p.name for p in (folder / "images").iterdir()) == ["window_00000.png", "window_00002.png"]
    picture = Image.open(folder / "images" / "window_00000.png")
    assert picture.size == (2 * (240 + 2 * 60), 180 + 2 * 45 + 22)


def test_summary_counts_what_was_done(folder):
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["complete"] is True
    assert summary["windows"] == 4
    assert summary["events"] == 24000
    assert summary["pictures"] == 2
    assert summary["gain_median"] > 1


def test_tensorboard_reads_it_back(folder):
    board = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    board.Reload()
    tags = board.Tags()
    for name in ("contrast", "contrast_zero", "gain", "omega_x", "v_z", "n_y", "evaluations", "events_per_second"):
        assert [event.step for event in board.Scalars(f"window/{name}")] == [0, 1, 2, 3]
    assert [event.step for event in board.Images("before_after")] == [0, 2]
    curves = [tag for tag in tags["scalars"] if tag.startswith("optimizer/")]
    assert set(curves) == {f"optimizer/window_0000{i}/round_{r}_blur_{b}_px" for i in (0, 2) for r, b in ((1, 4), (2, 2), (3, 1))}
    values = [event.value for event in board.Scalars("optimizer/window_00000/round_3_blur_1_px")]
    assert values[-1] >= values[0]
    assert "config/text_summary" in tags["tensors"]


def test_a_run_that_breaks_off_keeps_what_is_done_and_says_so(results, tmp_path):
    recording, options, parts = results

    def break_off():
        with Report(tmp_path, recording, options, "", 1) as written:
            written.add(*parts[0])
            raise DataError("events.txt", "letters in a column", "mend it", "line 7")

    with pytest.raises(DataError):
        break_off()
    assert len((tmp_path / "windows.csv").read_text().splitlines()) == 4
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["complete"] is False
    assert "line 7" in summary["stopped_by"]
    assert not list(tmp_path.glob(".*"))


def test_a_second_run_replaces_the_first_and_nothing_else(results, tmp_path):
    report(tmp_path, results, every=1)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "images" / "mine.png").write_text("mine")
    report(tmp_path, results, every=4)
    assert sorted(p.name for p in (tmp_path / "images").iterdir()) == ["mine.png", "window_00000.png"]
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 1


def test_a_folder_that_cannot_be_written_is_named(results, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="cannot be written to"):
        report(tmp_path / "file" / "run", results)


def test_a_disk_that_fills_up_is_named_and_leaves_no_torn_file(tmp_path):
    def fill():
        with writing(tmp_path / "a.png") as name:
            name.write_bytes(b"half")
            raise OSError(28, "No space left on device")

    with pytest.raises(DataError, match="No space left on device"):
        fill()
    assert not list(tmp_path.iterdir())


def test_the_picture_shows_on_red_off_blue_and_both_dark():
    on, off = torch.zeros(4, 4), torch.zeros(4, 4)
    on[0, 0], off[1, 1] = 1, 1
    on[2, 2], off[2, 2] = 1, 1
    picture = coloured(on, off)
    assert tuple(picture[0, 0]) == (255, picture[0, 0][1], picture[0, 0][2])
    assert picture[0, 0][2] < 128
    assert picture[1, 1][0] < 128
    assert picture[1, 1][2] == 255
    assert picture[2, 2].max() < 128
    assert (picture[3, 3] == 255).all()
    assert captioned(picture, "text").shape == (26, 4, 3)


def test_the_second_half_of_a_picture_is_sharper(demo):
    recording, options = open(demo), Compensation(model="planar", limit=1)
    window, estimate = next(compensate(recording, options))
    drawn = pictures(window, (still(estimate.H_k), estimate.H_k), Canvas.around(recording.camera), 0.5)[0]
    for channel in (0, 2):  # red is what blue (OFF) events take away, and blue what red (ON) ones do; squared: the shades are roots
        before, after = np.split((1 - drawn[..., channel] / 255) ** 2, 2, axis=1)
        assert after.var() > 1.3 * before.var()


def test_rows_have_every_column(results):
    lines = rows(*results[2][0], first=7)
    assert list(lines[0]) == list(COLUMNS)
    assert [line["index"] for line in lines] == [7, 8, 9]


def test_a_picture_comes_back_from_png_pixel_by_pixel():
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    back = Image.open(io.BytesIO(png(picture)))
    assert back.mode == "RGB"
    np.testing.assert_array_equal(np.asarray(back), picture)


def test_the_board_shows_the_same_picture_as_the_file(folder):
    board = EventAccumulator(str(folder), size_guidance={"images": 0})
    board.Reload()
    for event in board.Images("before_after"):
        assert event.encoded_image_string == (folder / "images" / f"window_{event.step:05d}.png").read_bytes()
        assert Image.open(io.BytesIO(event.encoded_image_string)).size == (event.width, event.height)


def test_the_board_holds_the_numbers_of_the_table_and_no_others(folder):
    board = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    board.Reload()
    lines = list(csv.DictReader((folder / "windows.csv").open()))
    shown = {tag.removeprefix("window/") for tag in board.Tags()["scalars"] if tag.startswith("window/")}
    assert shown == set(COLUMNS) - {"index", "start_us", "end_us", "events"} | {"events_per_second"}
    for name in shown & set(COLUMNS):
        values = [event.value for event in board.Scalars(f"window/{name}")]
        np.testing.assert_allclose(values, [float(line[name]) for line in lines], rtol=1e-6)


def test_what_is_done_can_be_seen_while_the_run_goes_on(results, tmp_path):
    recording, options, parts = results
    with Report(tmp_path, recording, options, "", 1) as written:
        written.add(*parts[0])
        board = EventAccumulator(str(tmp_path))
        board.Reload()
        assert [event.step for event in board.Scalars("window/gain")] == [0, 1, 2]


def test_tones_are_of_the_brightest_pixels_but_for_a_few():
    """On 1000 pixels one is very bright: it does not make the others pale."""
    on = torch.ones(20, 50)
    on[0, 0] = 1000
    picture = coloured(on, torch.zeros(20, 50))
    assert (picture[1:] == [255, 0, 0]).all()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_an_error_of_the_board_where_it_is_met(tmp_path):
    board = Board(tmp_path)
    with Path("/dev/full").open("wb", buffering=0) as full:
        board._file.close()
        board._file = board._records._writer = full
        with pytest.raises(OSError, match="No space left"):
            board.scalars({"a": 1.0}, 0)


def test_what_cannot_be_written_at_the_end_keeps_nothing_else_from_being_written(results, tmp_path, monkeypatch):
    recording, options, parts = results

    def full(self):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Board, "close", full)
    with pytest.raises(DataError, match="No space left"), Report(tmp_path, recording, options, "", 0) as written:
        written.add(*parts[0])
    assert json.loads((tmp_path / "summary.json").read_text())["windows"] == 3
    assert (tmp_path / "windows.csv").is_file()
    assert (tmp_path / "report.html").is_file()


def test_a_run_that_was_killed_gives_way_to_the_next(results, tmp_path):
    recording, options, parts = results
    killed = Report(tmp_path, recording, options, "", 1)
    killed.add(*parts[0])
    assert "killed" in json.loads((tmp_path / "summary.json").read_text())["stopped_by"]
    assert not (tmp_path / "windows.csv").exists()
    with Report(tmp_path, recording, options, "", 0) as again:
        again.add(*parts[0])
    assert json.loads((tmp_path / "summary.json").read_text())["complete"]
    assert not list((tmp_path / "images").glob("*.png"))
    assert not list(tmp_path.glob(".*"))
