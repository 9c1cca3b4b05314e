"""The loop closed: a planned motion, simulated drives, what a camera would see on them, tracking, clocks, and the rig's truth as judge."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("canopen", reason="the extra rig is not installed")
pytest.importorskip("scipy", reason="the extra rig is not installed")
from torchcmax.cli import main
from torchcmax.io.trajectory import read_trajectory
from torchcmax.simulator import Simulation

SLIDER = Path(__file__).parents[2] / "configs" / "rig" / "slider.yaml"
OFFSET = 12.345  # s, by which the camera's clock is ahead
PROFILE = """
profile:
  - {axis: x, pass: {x0_m: 0.25, x1_m: 0.5, v_mps: 0.5, a_mps2: 3}}
  - {axis: x, sync: {from_m: 0.45, to_m: 0.33, v_mps: 0.8, a_mps2: 8}}
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("loop")


def done(*arguments):
    status = main([*map(str, arguments), *(["--quiet"] if arguments[0] in ("track", "compensate") else [])])
    assert status == 0, arguments


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*have the time of the one before")
def test_a_tracked_pass_is_as_fast_as_the_encoders_say_and_the_clock_is_found(place, slider):
    run, recording = place / "run", place / "recording"
    (place / "profile.yaml").write_text(PROFILE)
    done("rig", "run", SLIDER, place / "profile.yaml", "--dry-run", "-o", run, "--quiet")
    assert not (run / "groundtruth.txt").exists()

    table = np.loadtxt(run / "groundtruth_driveclock.txt")
    table[:, 0] += OFFSET
    np.savetxt(place / "path.txt", table, fmt="%.12f")
    done("simulate", "--trajectory", place / "path.txt", "--focal", slider.focal, "--distance", slider.distance, "--out", recording)
    metres = float(Simulation(distance=slider.distance).plane.distance)  # to the tilted plane, as a ruler across it would say
    moving = ("--model", "translation", "--tracking.seconds", 0.025)  # windows with less of the rest between moves
    done("track", recording, *moving, "--distance", metres, "--images", 0, "--out", place / "tracked")
    short = ("--model", "translation", "--plane", "truth", "--events", 5000, "--images", 0)
    done("compensate", recording, *short, "--out", place / "velocities")

    done("rig", "sync", run, "--result", place / "velocities")
    clock = json.loads((run / "clock.json").read_text())
    assert clock["accepted"]
    assert clock["peak_to_side"] > 0.5
    error = clock["offset"] + (1 + clock["drift"]) * table[-1, 0] / 2 - OFFSET - table[-1, 0] / 2
    print(f"clock: off by {1e3 * error:.2f} ms, sigma {1e3 * clock['sigma']:.2f} ms")
    assert abs(error) < 0.5e-3  # 0.27 ms of it is the low-pass of the sensor's pixels

    done("rig", "truth", run)
    truth = read_trajectory(run / "groundtruth.txt")
    assert abs(float(truth.time[0]) * 1e-6 - OFFSET) < 0.5e-3
    done("evaluate", place / "tracked", "--truth", run / "groundtruth.txt", "--protocol", "similarity,velocity")
    by = {row["protocol"]: row for row in json.loads((place / "tracked" / "evaluation.json").read_text())["results"]}
    print({name: {key: value for key, value in row.items() if "percent" in key or key == "coverage"} for name, row in by.items()})
    assert by["velocity"]["v_percent"] < 3
    assert by["similarity"]["percent_of_path"] < 0.5
    assert by["similarity"]["coverage"] > 0.95
