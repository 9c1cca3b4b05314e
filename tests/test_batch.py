"""Many recordings: what is done once is not done again, what dies is begun again, and nothing is ever half there."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torchcmax import batch, job
from torchcmax.cli import main
from torchcmax.config import UsageError

BRIEF = ("--task", "compensate", "--set", "events=5000", "--set", "limit=2", "--set", "images=1")
LONG = ("--task", "compensate", "--set", "events=2000", "--set", "stride=200", "--set", "images=0", "--set", "batch=1")


@pytest.fixture
def recordings(demo, tmp_path):
    """Three copies of a recording, and a file that is none."""
    for name in ("a", "b", "c"):
        shutil.copytree(demo, tmp_path / "in" / name)
    (tmp_path / "in" / "notes.md").write_text("no recording")
    return tmp_path / "in"


def run(capsys, *arguments):
    status = main(["batch", *map(str, arguments)])
    said = capsys.readouterr()
    return status, said.out, said.err


def manifests(out):
    return {path.parent.relative_to(out).as_posix(): json.loads(path.read_text()) for path in sorted(out.rglob("manifest.json"))}


def whole(out):
    """Every result has all its files, and nothing is half-done."""
    for place, manifest in manifests(out).items():
        assert manifest["exit"] == 0, manifest
        assert json.loads((out / place / "summary.json").read_text())["complete"] is True
        assert (out / place / "report.html").is_file()
        assert (out / place / "log.txt").is_file()
    assert not list((out / ".running").glob("*")) if (out / ".running").exists() else True
    return True


@pytest.mark.slow
def test_a_folder_of_recordings_is_done_and_then_nothing_is_left_to_do(recordings, tmp_path, capsys):
    out = tmp_path / "out"
    status, said, err = run(capsys, recordings, *BRIEF, "--out", out, "--workers", 2)
    assert status == 0, said + err
    assert "3 finished now, 0 before, 0 failed" in said
    assert "notes.md" in err
    first = manifests(out)
    assert set(first) == {"a", "b", "c"}
    assert whole(out)
    assert len((out / "batch.csv").read_text().splitlines()) == 4
    assert json.loads((out / "batch.json").read_text())["totals"]["finished"] == 3
    page = (out / "report.html").read_text()
    assert all(f"{name}/report.html" in page for name in "abc")
    status, said, _ = run(capsys, recordings, *BRIEF, "--out", out, "--quiet")
    assert status == 0
    assert "0 finished now, 3 before, 0 failed" in said
    assert manifests(out) == first
    shutil.rmtree(out / "b")
    assert "1 finished now, 2 before" in run(capsys, recordings, *BRIEF, "--out", out, "--quiet")[1]
    again = manifests(out)
    assert again["a"] == first["a"]
    assert again["b"]["started"] > first["b"]["started"]
    status, _, err = run(capsys, recordings, *BRIEF, "--set", "model=planar", "--out", out, "--quiet")
    assert status == 1
    assert "model was rotation, wanted is planar" in err
    assert manifests(out) == again
    with (recordings / "c" / "calib.txt").open("a") as stream:
        stream.write("\n")
    status, _, err = run(capsys, recordings, *BRIEF, "--out", out, "--quiet")
    assert status == 1
    assert "of a recording that was another then" in err
    status, said, _ = run(capsys, recordings / "c", *BRIEF, "--out", out, "--quiet", "--again")
    assert "1 finished now" in said
    assert manifests(out)["c"]["input"] != first["c"]["input"]


@pytest.mark.slow
def test_what_fails_is_told_and_does_not_stop_the_others(recordings, tmp_path, capsys):
    (recordings / "b" / "events.h5").write_bytes(b"\x89HDF\r\n\x1a\n and then nothing")
    out = tmp_path / "out"
    status, said, err = run(capsys, recordings, *BRIEF, "--out", out, "--workers", 1, "--quiet")
    assert status == 1
    assert "2 finished now, 0 before, 1 failed" in said
    assert "failed: b: " in err
    found = manifests(out)
    assert set(found) == {"a", "b.failed", "c"}
    assert found["b.failed"]["exit"] == 1
    assert found["b.failed"]["error"] in (out / "b.failed" / "log.txt").read_text()
    shutil.copy(recordings / "a" / "events.h5", recordings / "b" / "events.h5")
    status, said, _ = run(capsys, recordings, *BRIEF, "--out", out, "--workers", 1, "--quiet")
    assert (status, set(manifests(out))) == (0, {"a", "b", "c"})
    assert "1 finished now, 2 before, 0 failed" in said


@pytest.mark.slow
def test_a_sweep_does_every_setting_and_tells_tensorboard(demo, tmp_path, capsys):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    out = tmp_path / "out"
    status, said, err = run(capsys, demo, *BRIEF, "--sweep", "model=rotation,translation", "--out", out, "--workers", 1, "--quiet")
    assert status == 0, said + err
    assert {name: found["settings"] for name, found in manifests(out).items()} == {
        "model=rotation/poster": {"model": "rotation"},
        "model=translation/poster": {"model": "translation"},
    }
    for model in ("rotation", "translation"):
        place = out / f"model={model}" / "poster"
        assert json.loads((place / "summary.json").read_text())["model"] == model
        board = EventAccumulator(str(place)).Reload()
        assert "_hparams_/session_start_info" in board.summary_metadata
        assert board.Scalars("result/gain_median")
    assert "model" in (out / "batch.csv").read_text().splitlines()[0].split(",")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--set", "evnts=3"), "did you mean"),
        (("--set", "events"), "key=value"),
        (("--sweep", "events=1"), "events"),
        (("--sweep", "out=a,b"), "cannot be set for single jobs"),
        (("--workers", "-1"), "at least 0"),
    ],
)
def test_wrong_usage_is_said_before_any_work(demo, tmp_path, capsys, words, message):
    try:
        status = main(["batch", str(demo), "--task", "compensate", "--out", str(tmp_path / "o"), *words])
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("name", ["calib.yaml", "camchain-a.yaml", "camera_info.yaml", "groundtruth.txt", "a_gt.hdf5"])
def test_what_lies_beside_a_file_belongs_to_it(tmp_path, name):
    (tmp_path / "a.raw").write_text("% evt 3.0")
    (tmp_path / "notes.txt").write_text("nothing")
    alone = job.fingerprint(tmp_path / "a.raw")
    assert list(alone[1]) == ["a.raw"]
    (tmp_path / name).write_text("1")
    one = job.fingerprint(tmp_path / "a.raw")
    (tmp_path / name).write_text("2")
    assert len({alone[0], one[0], job.fingerprint(tmp_path / "a.raw")[0]}) == 3


def test_texts_of_events_are_found_and_others_are_not(tmp_path):
    (tmp_path / "events.csv").write_text("t_us,x,y,p\n1,2,3,0\n")
    (tmp_path / "a.txt").write_text("0.1 96 133 0\n0.2 96 133 1\n")
    for name, text in {"groundtruth.txt": "0 0 0 0 0 0 0 1\n", "images.txt": "0.1 1 1 1\n", "notes.csv": "name,age\nA,3\n"}.items():
        (tmp_path / name).write_text(text)
    recordings, skipped = batch.found([str(tmp_path)], tmp_path / "out")
    assert [path.name for path in recordings] == ["a.txt", "events.csv"]
    assert [path.name for path in skipped] == ["groundtruth.txt", "images.txt", "notes.csv"]


def test_a_folder_that_is_being_written_to_is_not_taken(tmp_path):
    from torchcmax.io import DataError

    with batch.claimed(tmp_path), pytest.raises(DataError, match="another batch is writing there"), batch.claimed(tmp_path):
        pass


def test_a_log_names_files_where_they_end_up_and_a_full_disk_leaves_it_as_it_was(tmp_path, monkeypatch):
    attempt, place, log = tmp_path / ".running" / "00000.a", tmp_path / "a", tmp_path / "log.txt"
    log.write_text(f"motions: {attempt}/windows.csv\n")

    def full(path, text):
        with path.open("w") as stream:
            stream.write("half")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(Path, "write_text", full)
        job._move_names(log, attempt, place)
    assert log.read_text() == f"motions: {attempt}/windows.csv\n"
    job._move_names(log, attempt, place)
    assert log.read_text() == f"motions: {place}/windows.csv\n"
    assert [path.name for path in tmp_path.iterdir()] == ["log.txt"]


def test_names_are_told_apart_by_the_folders_above():
    paths = [Path("/x/one/events.txt"), Path("/x/two/events.txt"), Path("/x/rec.h5"), Path("/y/rec.h5")]
    assert list(batch.named(paths).values()) == ["one", "two", "x_rec.h5", "y_rec.h5"]


def test_a_sweep_is_the_product_of_its_values():
    assert batch.swept(["a=1,2", "b=[3,4],5"]) == [{"a": a, "b": b} for a in "12" for b in ("[3,4]", "5")]
    with pytest.raises(UsageError, match="twice"):
        batch.swept(["a=1", "a=2"])


def test_a_job_that_never_ends_in_peace_is_refused_a_recording_that_is_not_there(tmp_path, capsys):
    status, _, err = run(capsys, tmp_path / "nothing", *BRIEF, "--out", tmp_path / "o")
    assert status == 2
    assert "there is no recording" in err


def begun(recordings, out, *more):
    """A batch in a process of its own, and when its first jobs are on their way."""
    command = [sys.executable, "-m", "torchcmax.cli", "batch", recordings, *LONG, "--out", out, "--workers", "2", "--quiet", *more]
    process = subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    wait(lambda: len(list((out / ".running").glob("0*/windows.csv"))) + len(list((out / ".running").glob("0*/.windows.live.csv"))) > 0)
    return process


def wait(what, seconds=60):
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def children(process):
    """The workers: processes that were begun by this one to do jobs."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((place / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == process.pid and b"spawn_main" in (place / "cmdline").read_bytes():
                found.append(int(place.name))
        except (OSError, IndexError):
            continue
    return found


def alive(number):
    try:
        return (Path("/proc") / str(number) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="wants /proc")
def test_killed_workers_and_a_killed_parent_lose_nothing_and_do_nothing_twice(recordings, tmp_path, capsys):
    for name in ("d", "e"):
        shutil.copytree(recordings / "a", recordings / name)
    out = tmp_path / "out"
    process = begun(recordings, out)
    workers = children(process)
    os.kill(workers[0], signal.SIGKILL)
    wait(lambda: len(manifests_there(out)) >= 1)
    workers = children(process)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    wait(lambda: not any(alive(number) for number in workers))
    first = {place: json.loads((out / place / "manifest.json").read_text()) for place in manifests_there(out)}
    assert 1 <= len(first) < 5
    status, said, err = run(capsys, recordings, *LONG, "--out", out, "--workers", 2, "--quiet")
    assert status == 0, said + err
    assert f"{5 - len(first)} finished now, {len(first)} before, 0 failed" in said
    last = manifests(out)
    assert set(last) == {"a", "b", "c", "d", "e"}
    assert {place: last[place] for place in first} == first
    assert whole(out)


def manifests_there(out):
    return [path.parent.name for path in out.glob("[a-z]*/manifest.json")]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="wants /proc")
def test_ctrl_c_keeps_what_is_finished_and_leaves_nothing_half_done(recordings, tmp_path):
    out = tmp_path / "out"
    process = begun(recordings, out)
    wait(lambda: len(manifests_there(out)) >= 1)
    workers = children(process)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "what was finished is kept" in err
    assert not any(alive(number) for number in workers)
    assert whole(out)
    assert (out / "batch.csv").is_file()


@pytest.mark.slow
def test_a_worker_that_dies_of_its_job_every_time_is_told(recordings, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "evil"), os.environ.get("PYTHONPATH", "")]))
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "sitecustomize.py").write_text(
        "import os, sys, threading, time\n"
        "def look():\n"
        "    while True:\n"
        "        time.sleep(0.05)\n"
        f"        if any('.b.' in name for name in os.listdir({str(tmp_path / 'out' / '.running')!r})):\n"
        "            os.kill(os.getpid(), 9)\n"
        "if any('spawn_main' in word for word in sys.orig_argv):\n"
        "    threading.Thread(target=look, daemon=True).start()\n"
    )
    status, _, err = run(capsys, recordings, *LONG, "--out", tmp_path / "out", "--workers", 1, "--quiet", "--retries", 1)
    assert status == 1
    assert "killed by SIGKILL" in err
    found = manifests(tmp_path / "out")
    assert set(found) == {"a", "b.failed", "c"}
    assert found["b.failed"]["attempts"] == 2


@pytest.mark.slow
def test_all_recordings_at_hand_are_done_by_two_workers(shared, tmp_path, capsys):
    pytest.importorskip("faery")
    words = ("--task", "compensate", "--set", "limit=1", "--set", "events=10000", "--set", "camera=pinhole", "--set", "images=0")
    status, said, err = run(capsys, shared / "data", *words, "--out", tmp_path / "out", "--workers", 2, "--quiet")
    assert status == 0, said + err
    assert len(manifests(tmp_path / "out")) == 22  # with the decoded events of evt3.raw, which are a recording too
    assert whole(tmp_path / "out")
