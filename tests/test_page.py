import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from torchcmax.batchpage import write_batch_page
from torchcmax.commands import report
from torchcmax.folder import versions
from torchcmax.io import DataError
from torchcmax.page import write_page
from torchcmax.resultfiles import read_result
from torchcmax.resultplots import angles

VOID = {"meta", "link", "img", "br"}
EVIL = '<script>alert("&")</script>'


class Page(HTMLParser):
    """Headings, cells and addresses of a page, whose tags must be closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.links, self.charts = [], {}, [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.links += [attrs[name] for name in ("src", "href") if name in attrs]
        self.charts += [attrs["aria-label"]] if tag == "svg" else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.words.setdefault(self.open[-1], []).append(data)


def result(folder, windows=40, truth=True, status=None, **more):
    """A folder as `track` leaves it, of a camera that goes along x and is lost from window 10 to 12."""
    (folder / "images").mkdir(parents=True)
    status = status or ["lost" if 10 <= i < 13 else "weak" if i == 13 else "ok" for i in range(windows)]
    heads = "index,start_us,end_us,events,gain,omega_x,omega_y,omega_z,v_x,v_y,v_z,status,reason,weakest"
    lines = [f"{i},{i * 20000},{(i + 1) * 20000},1000,{1 + i / 10},0.1,,0,1,0,0,{status[i]},,v_y" for i in range(windows)]
    (folder / "windows.csv").write_text("\n".join([heads, *lines]) + "\n")
    poses = [f"{i * 0.02 + 0.01:.6f} {i * 0.1} 0 0 0 0 0 1" for i in range(windows) if status[i] != "lost"]
    (folder / "trajectory.txt").write_text("# t tx ty tz qx qy qz qw\n" + "\n".join(poses) + "\n")
    if truth:
        (folder / "truth.txt").write_text("\n".join(poses) + "\n")
    for i in range(0, windows, 5):
        Image.fromarray(np.full((20, 40, 3), i, np.uint8)).save(folder / "images" / f"window_{i:05d}.png")
    Image.fromarray(np.zeros((30, 50, 3), np.uint8)).save(folder / "map.png")
    summary = {
        "complete": True, "stopped_by": None, "recording": "poster", "path": "/data/poster", "windows": windows, "events": 1000 * windows,
        "seconds": 0.02 * windows, "lost_seconds": 0.06, "plane": {"normal": [0.0, 0.0, -1.0], "distance": 1.0},
        "error": {"orientation_rmse_deg": 0.2, "coverage": 0.9}, "config": "distance: null\n", "files": ["windows.csv"],
        "versions": versions(),
    } | more  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def text_of(folder):
    return write_page(folder).read_text()


def test_a_page_has_all_that_the_folder_tells(tmp_path):
    page = Page(text_of(result(tmp_path / "a")))
    wanted = [
        "Summary",
        "Trajectory",
        "Errors over time",
        "Contrast and events",
        "Motion",
        "Map",
        "Best and worst windows",
        "How it was made",
    ]
    assert page.words["h2"] == wanted
    assert page.words["h1"] == ["poster"]
    assert "Position" in page.charts
    assert "Velocity" in page.charts


def test_a_page_needs_no_network_and_no_other_file(tmp_path):
    text = text_of(result(tmp_path / "a"))
    assert all(link.startswith("data:") for link in Page(text).links)
    assert not re.search(r"https?://|@import|url\(", text)


def test_names_of_recordings_may_hold_anything(tmp_path):
    folder = result(tmp_path / "a", recording=EVIL, stopped_by=EVIL, complete=False, config=EVIL, error={EVIL: 1.0})
    (folder / "manifest.json").write_text(json.dumps({"name": EVIL, "settings": {EVIL: EVIL}}))
    (folder / "evaluation.json").write_text(json.dumps({EVIL: {EVIL: EVIL}, "list": [{EVIL: EVIL}]}))
    text = text_of(folder)
    assert "<script>alert" not in text
    assert Page(text).words["h1"] == [EVIL]


def test_lost_and_weak_windows_are_shaded_and_lines_break_there(tmp_path):
    text = text_of(result(tmp_path / "a"))
    assert "<title>lost: 0.200 to 0.260</title>" in text
    assert "<title>weak: 0.260 to 0.280</title>" in text
    [position] = re.findall(r'<path class="line h0" data-name="x" d="([^"]+)"', text.split('aria-label="Orientation"')[0])
    assert position.count("M") == 2


def test_without_truth_there_are_no_errors_over_time(tmp_path):
    page = Page(text_of(result(tmp_path / "a", truth=False)))
    assert "Errors over time" not in page.words["h2"]
    assert "Trajectory" in page.words["h2"]


@pytest.mark.parametrize("windows", [0, 1, 2])
def test_no_window_and_one_window_are_a_page_too(tmp_path, windows):
    assert "Summary" in Page(text_of(result(tmp_path / "a", windows))).words["h2"]


def test_a_run_that_was_lost_all_the_time_is_a_page_too(tmp_path):
    page = Page(text_of(result(tmp_path / "a", 5, status=["lost"] * 5)))
    assert "Trajectory" not in page.words["h2"]


def test_a_stopped_run_says_why(tmp_path):
    assert "Not complete: KeyboardInterrupt: " in text_of(result(tmp_path / "a", complete=False, stopped_by="KeyboardInterrupt: "))


def test_a_run_that_goes_on_is_shown_as_far_as_it_came(tmp_path):
    folder = result(tmp_path / "a", complete=False, stopped_by="it is still running, or was killed")
    whole = (folder / "windows.csv").read_text()
    (folder / "windows.csv").unlink()
    (folder / ".windows.live.csv").write_text(whole[: whole.rindex("\n39,") + 6])
    assert len(read_result(folder).numbers["gain"]) == 39
    assert "still running" in text_of(folder)


def test_best_and_worst_windows_are_those_with_pictures(tmp_path):
    captions = [text for text in Page(text_of(result(tmp_path / "a"))).words["figcaption"] if "window" in text]
    assert [re.search(r"(Best|Worst): window (\d+)", text).groups() for text in captions] == [
        ("Best", "35"), ("Best", "30"), ("Best", "25"), ("Worst", "0"), ("Worst", "5"), ("Worst", "10"),
    ]  # fmt: skip


def test_a_large_map_is_made_smaller(tmp_path):
    folder = result(tmp_path / "a")
    noise = np.random.default_rng(0).integers(0, 255, (1500, 3000, 3), np.uint8)
    Image.fromarray(noise).save(folder / "map.png", compress_level=0)
    assert len(text_of(folder)) < 5e6


def test_a_clock_that_began_long_ago_is_made_readable(tmp_path):
    folder = result(tmp_path / "a")
    for name, shift in (("windows.csv", 1_500_000_000_000_000), ("trajectory.txt", 1_500_000_000), ("truth.txt", 1_500_000_000)):
        lines = (folder / name).read_text().splitlines()
        moved = [_moved(line, shift) if line[0].isdigit() else line for line in lines]
        (folder / name).write_text("\n".join(moved) + "\n")
    text = text_of(folder)
    assert "time, s since 1500000000.000000" in text
    assert "<title>lost: 0.200 to 0.260</title>" in text


def _moved(line, shift):
    if "," not in line:
        first, rest = line.split(" ", 1)
        return f"{float(first) + shift:.6f} {rest}"
    index, start, end, rest = line.split(",", 3)
    return f"{index},{int(start) + shift},{int(end) + shift},{rest}"


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("summary.json", "{", "cannot be read"), ("summary.json", "[]", "is no JSON object"), ("summary.json", "{}", "not a summary"),
        ("windows.csv", "", "has no column index"), ("windows.csv", "index,start_us,end_us,events,gain\n1,2\n", "has 2 columns"),
        ("windows.csv", "index,start_us,end_us,events,gain\n1,2,3,4,x\n", "'x' as gain"), ("trajectory.txt", "1 2 3\n", "no trajectory"),
        ("truth.txt", "1 2 3 4 5 6 7 x\n", "no trajectory"), ("map.png", "nothing", "as a picture"),
        ("manifest.json", "1", "no JSON object"),
        ("evaluation.json", "\0", "cannot be read"),
    ],
)  # fmt: skip
def test_a_broken_file_is_named_with_a_remedy(tmp_path, name, content, problem):
    folder = result(tmp_path / "a")
    (folder / name).write_text(content)
    with pytest.raises(DataError, match=problem) as caught:
        write_page(folder)
    assert caught.value.path == folder / name
    assert caught.value.remedy
    assert not (folder / "report.html").exists()


def test_links_that_lead_out_of_the_folder_are_not_followed(tmp_path):
    folder = result(tmp_path / "a")
    (tmp_path / "secret.json").write_text('{"secret": "word"}')
    (folder / "evaluation.json").symlink_to(tmp_path / "secret.json")
    assert "secret" not in text_of(folder)


def test_angles_give_back_the_turns_they_were_made_of_beyond_a_half_turn():
    def about(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array(
            {0: [[1, 0, 0], [0, c, -s], [0, s, c]], 1: [[c, 0, s], [0, 1, 0], [-s, 0, c]], 2: [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis]
        )

    wanted = np.stack([np.linspace(0, 400, 90), np.linspace(-60, 60, 90), np.linspace(10, -250, 90)], -1)
    R = np.stack([about(1, a) @ about(0, b) @ about(2, c) for a, b, c in np.deg2rad(wanted)])
    np.testing.assert_allclose(angles(R), wanted, atol=1e-9)


def test_the_trajectory_is_turned_as_its_quaternions_say(tmp_path):
    folder = result(tmp_path / "a")
    half = np.deg2rad(30) / 2
    (folder / "trajectory.txt").write_text(f"0.01 1 2 3 0 {np.sin(half)} 0 {np.cos(half)}\n")
    poses = read_result(folder).trajectory
    np.testing.assert_allclose(angles(poses.rotation), [[30, 0, 0]], atol=1e-9)
    assert poses.position.tolist() == [[1, 2, 3]]


def batch(folder):
    """Two results over a sweep, and a failure."""
    rows = []
    for value in ("1", "2"):
        result(folder / f"poster {value}", lost_seconds=float(value))
        write_page(folder / f"poster {value}")
        rows.append({"name": "poster", "folder": f"poster {value}", "settings": {"events": value}, "exit": 0, "seconds": 3.5})
    (folder / "bad.failed").mkdir()
    rows.append({"name": "bad", "folder": "bad.failed", "settings": {}, "exit": 1, "seconds": 0.1, "error": f"is no recording {EVIL}"})
    rows = [row | {"task": "track", "recording": f"/data/{row['name']}", "error": row.get("error")} for row in rows]
    (folder / "batch.json").write_text(json.dumps({"results": rows}))
    return rows


def test_the_page_of_a_batch_links_its_results_and_has_failures_on_top(tmp_path):
    text = write_batch_page(tmp_path, batch(tmp_path)).read_text()
    page = Page(text)
    assert page.words["h2"] == ["Failed", "Results"]
    assert page.words["pre"] == [f"is no recording {EVIL}"]
    assert [link for link in page.links if not link.startswith("data:")] == ["poster%201/report.html", "poster%202/report.html"]
    assert {"recording", "events", "lost, s", "coverage", "work, s"} <= set(page.words["th"])
    assert "keyframes" not in page.words["th"]  # no result has any
    assert "2 finished, 1 failed" in text


def test_a_batch_without_results_is_a_page_too(tmp_path):
    assert "0 finished, 0 failed" in write_batch_page(tmp_path, []).read_text()


def test_report_makes_the_pages_again_of_results_and_of_a_batch_with_all_its_results(tmp_path, capsys):
    batch(tmp_path)
    for page in tmp_path.glob("*/report.html"):
        page.unlink()
    alone = result(tmp_path.with_name(f"{tmp_path.name}_alone"))
    assert report.run(report.build().parse_args([str(alone), str(tmp_path)])) == 0
    assert {page.parent.name for page in tmp_path.glob("*/report.html")} == {"poster 1", "poster 2"}
    assert capsys.readouterr().out.splitlines() == [f"report: {alone}/report.html", f"report: {tmp_path}/report.html"]


def test_a_broken_result_is_told_and_stops_no_other_page(tmp_path, capsys):
    batch(tmp_path)
    for page in tmp_path.glob("*/report.html"):
        page.unlink()
    (tmp_path / "poster 1" / "summary.json").write_text("{")
    assert report.run(report.build().parse_args([str(tmp_path)])) == 1
    out, err = capsys.readouterr()
    assert "poster 1/summary.json: cannot be read" in err
    assert out == f"report: {tmp_path}/report.html\n"
    assert [page.parent.name for page in tmp_path.glob("*/report.html")] == ["poster 2"]


def test_a_broken_batch_stops_no_other_folder(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "batch.json").write_text("{")
    alone = result(tmp_path / "b")
    assert report.run(report.build().parse_args([str(tmp_path / "a"), str(alone)])) == 1
    out, err = capsys.readouterr()
    assert "a/batch.json: cannot be read" in err
    assert out == f"report: {alone}/report.html\n"


def test_results_that_are_broken_are_told_also_where_the_page_of_their_batch_cannot_be_written(tmp_path, capsys):
    batch(tmp_path)
    (tmp_path / "poster 1" / "summary.json").write_text("{")
    (tmp_path / "report.html").mkdir()
    assert report.run(report.build().parse_args([str(tmp_path)])) == 1
    err = capsys.readouterr().err
    assert "poster 1/summary.json: cannot be read" in err
    assert f"{tmp_path}/report.html: cannot be written" in err


def test_report_of_a_folder_without_a_run_is_an_error(tmp_path, capsys):
    assert report.run(report.build().parse_args([str(tmp_path)])) == 1
    assert "has no summary.json" in capsys.readouterr().err


def test_a_batch_never_reaches_out_of_its_folder(tmp_path):
    outside = result(tmp_path / "outside")
    folder = tmp_path / "batch"
    folder.mkdir()
    row = {"name": "x", "folder": "../outside", "settings": {}, "exit": 0, "seconds": 1.0, "task": "track", "recording": "x", "error": None}
    (folder / "batch.json").write_text(json.dumps({"results": [row]}))
    report.run(report.build().parse_args([str(folder)]))
    assert not (outside / "report.html").exists()
    assert "data:image" not in (folder / "report.html").read_text()
