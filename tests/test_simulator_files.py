import dataclasses
import errno
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from torchcmax.io import opening
from torchcmax.io.errors import DataError
from torchcmax.io.recording import Events
from torchcmax.simulator import Simulation, simulate, velocity, write
from torchcmax.texture import texture

SMALL = Simulation(duration=0.03, width=64, height=48, focal=55.0)


def test_written_files_are_the_recording(tmp_path):
    told = []
    folder = write(SMALL, tmp_path / "new" / "small", told.append)
    assert sorted(p.name for p in folder.iterdir()) == sorted(
        ["README.md", "calib.txt", "events.h5", "groundtruth.txt", "plane.txt", "texture.png", "velocity.txt"]
    )
    assert told == sorted(told)
    assert told[-1] == pytest.approx(SMALL.duration, abs=2e-3)
    back, recording = opening.open(folder), simulate(SMALL)
    read, made = (Events.join(list(r.chunks())) for r in (back, recording))
    assert all((getattr(read, k) == getattr(made, k)).all() for k in "txyp")
    assert back.camera == recording.camera
    torch.testing.assert_close(back.truth.pose.R, recording.truth.pose.R, rtol=0, atol=1e-9)
    torch.testing.assert_close(back.plane.normal, recording.plane.normal)
    table = np.loadtxt(folder / "velocity.txt")
    motion = velocity(SMALL, torch.from_numpy(table[:, 0]))
    np.testing.assert_allclose(table[:, 1:], torch.cat([motion.velocity, motion.omega], -1), atol=1e-8)
    assert "* threshold: 0.25" in (folder / "README.md").read_text()


def test_a_changed_calibration_counts_in_the_folder_and_not_for_the_file_alone(tmp_path):
    folder = write(SMALL, tmp_path / "small")
    (folder / "calib.txt").write_text("60 61 30 25 0 0 0 0 0\n")
    assert opening.open(folder).camera.fx == 60
    assert opening.open(folder / "events.h5").camera.fx == SMALL.focal


def test_only_our_own_folder_is_replaced(tmp_path):
    folder = write(SMALL, tmp_path / "small")
    write(dataclasses.replace(SMALL, seed=3), folder)
    assert "* seed: 3" in (folder / "README.md").read_text()
    (folder / "thesis.txt").write_text("mine")
    with pytest.raises(DataError, match="was not written by the simulator"):
        write(SMALL, folder)
    assert (folder / "thesis.txt").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["small"]


@pytest.fixture
def no_work(monkeypatch):
    """Nothing may be simulated."""
    monkeypatch.setattr("torchcmax.simulator.simulate", lambda options: pytest.fail("simulated first"))


def test_a_place_that_cannot_be_written_is_said_before_the_work(tmp_path, no_work, monkeypatch):
    (tmp_path / "file").write_text("")
    for place in ("file", "file/small", "file/new/small"):
        with pytest.raises(DataError, match=r"cannot be written|was not written by"):
            write(SMALL, tmp_path / place)
    (tmp_path / "ring").symlink_to(tmp_path / "ring")
    with pytest.raises(DataError, match="cannot be written"):
        write(SMALL, tmp_path / "ring")
    (tmp_path / "locked").mkdir()
    monkeypatch.setattr("os.access", lambda place, mode: place.name != "locked")  # as root one may write everywhere
    for place in ("locked", "locked/small", "locked/new/small"):
        with pytest.raises(DataError, match=r"locked is no folder that you may write to"):
            write(SMALL, tmp_path / place)
    monkeypatch.setattr(Path, "is_mount", lambda place: place.name == "locked")
    with pytest.raises(DataError, match="mount point"):
        write(SMALL, tmp_path / "locked")


def test_a_folder_of_others_is_refused_before_the_work(tmp_path, no_work):
    (tmp_path / "thesis.txt").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path)
    for place in (tmp_path, tmp_path / "link"):
        with pytest.raises(DataError, match="was not written by the simulator"):
            write(SMALL, place)


@pytest.mark.parametrize("there", [True, False])
def test_a_link_stays_and_what_it_points_to_is_written(tmp_path, there):
    if there:
        (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    assert write(SMALL, tmp_path / "link") == tmp_path / "link"
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "disk" / "events.h5").is_file()
    write(SMALL, tmp_path / "link")  # and again, over itself
    assert sorted(p.name for p in tmp_path.iterdir()) == ["disk", "link"]


def test_what_was_put_into_the_folder_meanwhile_is_kept(tmp_path):
    folder = write(SMALL, tmp_path / "small")
    with pytest.raises(DataError, match="was not written by the simulator"):
        write(SMALL, folder, lambda done: (folder / "thesis.txt").write_text("mine"))
    assert (folder / "thesis.txt").read_text() == "mine"


def test_a_full_disk_is_said_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("usage", (), {"free": 1000}))
    with pytest.raises(DataError, match=r"small/events.h5: cannot be written.*No space left on device.*\n.*make room") as error:
        write(SMALL, tmp_path / "small")
    assert "partial" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_said_for_the_texts(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("torchcmax.simulator.write_velocity", full)
    with pytest.raises(DataError, match=r"cannot be written.*No space left"):
        write(SMALL, tmp_path / "small")
    assert list(tmp_path.iterdir()) == []


def test_the_same_seed_gives_the_same_files(tmp_path):
    first, second = (write(SMALL, tmp_path / name) for name in ("a", "b"))
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes(), path.name


def test_the_events_are_never_all_in_memory(tmp_path, monkeypatch):
    """Four times the duration, and nearly the same peak: what grows is the ground truth, as text."""
    monkeypatch.setattr("torchcmax.simulator.CHUNK", 5_000)
    peaks = []
    options = Simulation(duration=0.1, speed=0.0, noise=1000.0, refractory=0.0, width=32, height=24, focal=40.0, distortion=(0.0,) * 5)
    texture(options.scene, options.seed, options.focal)
    for duration in (0.1, 0.4):
        tracemalloc.start()
        write(dataclasses.replace(options, duration=duration), tmp_path / str(duration))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    whole = 13 * (0.4 - 0.1) * 1000 * 32 * 24
    print(peaks, whole)
    assert peaks[1] - peaks[0] < whole / 10
