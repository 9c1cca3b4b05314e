"""The summary of a recording is what counting by hand gives, however it is cut into chunks."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcmax.core.camera import Camera
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
    assert str(found).startswith(f"events        {len(t)}")


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


def test_a_recording_at_hand(shared):
    found = summary(open(shared / "data/real/slider_depth"))
    assert (found.count, found.out_of_order, found.equal_times, found.problems) == (50_000, 0, 11_763, [])
