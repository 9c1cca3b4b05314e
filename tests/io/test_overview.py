"""The summary of a recording is what counting by hand gives, however it is cut into chunks."""

import dataclasses
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.io import DataError, Events, OpenOptions, Recording, open, summary


def recording(t, chunk, x=None, p=None):
    count = len(t)
    x, p = np.zeros(count) if x is None else x, np.arange(count) % 2 if p is None else p
    events = Events(np.asarray(t, "i8"), np.asarray(x, "u2"), np.zeros(count, "u2"), np.asarray(p, "u1"))
    return Recording(Path("r"), "r", Camera.pinhole((4, 6)), lambda: (events[i : i + chunk] for i in range(0, count, chunk)))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([0, 1, 500, 9_999, 10_000, 50_000, 50_001, 3_000_000, 10**9]), min_size=1, max_size=50), st.integers(1, 9))
def test_numbers_agree_with_counting_by_hand(steps, chunk):
    t = np.cumsum(steps)
    found = summary(recording(t, chunk))
    gaps = [(int(a), int(b - a)) for a, b in pairwise(t) if b - a > 50_000]
    assert (found.count, found.first, found.last, found.duration) == (len(t), t[0], t[-1], t[-1] - t[0])
    assert (found.gaps, found.gap_count, found.gap_total) == (gaps[:20], len(gaps), sum(length for _, length in gaps))
    assert found.equal_times == (np.diff(t) == 0).sum()
    assert len(found.rates) <= 60
    assert sum(found.rates) * found.bin * 1e-6 == pytest.approx(len(t))
    expected = np.bincount((t - t[0]) // found.bin) * 1e6 / found.bin
    np.testing.assert_allclose(found.rates, expected)
    if found.duration >= 10_000:
        assert found.peak_rate == pytest.approx(np.unique((t - t[0]) // 10_000, return_counts=True)[1].max() * 100)
    assert f"\nevents        {len(t)}, " in str(found)


def test_a_hot_pixel_is_named():
    x = np.concatenate([np.full(2000, 3), np.repeat(np.arange(6), 10)])
    found = summary(recording(np.arange(len(x)), 100, x))
    assert found.hot_pixels == [(3, 0, 2010)]
    assert any("hot pixel" in problem for problem in found.problems)


def test_missing_polarity_and_times_are_problems():
    assert any("polarity" in problem for problem in summary(recording(np.arange(90), 7, p=np.ones(90))).problems)
    assert any("same time" in problem for problem in summary(recording(np.ones(90), 7)).problems)
    assert any("gaps" in problem for problem in summary(recording(np.arange(90) * 60_000, 7)).problems)


def test_events_out_of_order_are_counted_and_told(tmp_path):
    (tmp_path / "events.txt").write_text("0.3 1 1 0\n0.1 2 1 1\n0.2 3 1 0\n")
    found = summary(open(tmp_path, OpenOptions(camera="pinhole")))
    assert found.out_of_order == 2
    assert "2 of 3 events were out of order" in found.problems[0]


def test_no_events_is_an_error():
    with pytest.raises(DataError, match="holds no events"):
        summary(recording([], 5))


def with_truth(first, last):
    pose = Pose(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), torch.zeros(2, 3, dtype=torch.float64))
    plane = Plane(torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64), torch.tensor([2.5], dtype=torch.float64))
    truth = Trajectory(torch.tensor([first, last]), pose)
    return dataclasses.replace(recording(np.arange(100) * 1000, 7), truth=truth, plane=plane, guessed=True)


def test_the_page_begins_with_what_is_known_and_the_json_has_it_in_numbers():
    found = summary(with_truth(-5, 200_000))
    assert [line.split()[0] for line in str(found).splitlines()[:6]] == ["recording", "sensor", "calibration", "truth", "plane", "events"]
    for line in (
        "sensor        6 x 4, guessed from the events",
        "calibration   fx 7.2 fy 7.2 cx 2.5 cy 1.5 px, plumb_bob 0, 0, 0, 0, 0",
        "truth         2 poses, -0.000005 s to 0.200000 s",
        "plane         normal 0.0000 0.0000 -1.0000, distance 2.5000 m",
    ):
        assert line in str(found).splitlines()
    numbers = json.loads(json.dumps(dataclasses.asdict(found)))
    assert (numbers["recording"], numbers["sensor"], numbers["sensor_guessed"]) == ("r", [6, 4], True)
    assert numbers["calibration"] == {"model": "plumb_bob", "fx": 1.2 * 6, "fy": 1.2 * 6, "cx": 2.5, "cy": 1.5, "distortion": [0.0] * 5}
    assert numbers["truth"] == {"first_us": -5, "last_us": 200_000, "poses": 2}
    assert numbers["plane"] == [0.0, 0.0, -1.0, 2.5]
    bare = summary(recording(np.arange(90), 7))
    assert (bare.truth, bare.plane, bare.sensor_guessed) == (None, None, False)
    assert "truth         none\nplane         none\n" in str(bare)


def test_a_guessed_sensor_is_a_problem():
    assert "6 x 4, is guessed from the events" in summary(with_truth(0, 200_000)).problems[0]
    assert not any("guessed" in problem for problem in summary(recording(np.arange(90), 7)).problems)


@pytest.mark.parametrize(("first", "last", "covers"), [(0, 99_000, True), (1, 99_000, False), (0, 98_999, False)])
def test_a_truth_that_does_not_cover_the_events_is_a_problem(first, last, covers):
    told = [problem for problem in summary(with_truth(first, last)).problems if "does not cover" in problem]
    assert len(told) == (not covers)
    assert covers or (f"{last * 1e-6:.6f} s, the events 0.000000 s to 0.099000 s" in told[0])


def test_a_recording_at_hand(shared):
    found = summary(open(shared / "data/real/slider_depth"))
    assert (found.count, found.out_of_order, found.equal_times) == (50_000, 0, 11_763)
    assert ["guessed" in problem or "does not cover" in problem for problem in found.problems] == [True, True]
