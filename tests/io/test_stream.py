"""A stream hands out windows of any size: every event once, in order, wherever the chunks end."""

import math
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchcmax.core.camera import Camera
from torchcmax.io import DataError, Events, OpenOptions, Recording, Stream, open

CAMERA = Camera((5, 7), 6.0, 6.5, 3.0, 2.0)
CALIB = "6 6.5 3 2 0 0 0 0 0\n"
ZERO = 1_468_940_293_844_896
NAMES = ("ray", "dt", "polarity", "start", "duration")


def readers():
    return [thread for thread in threading.enumerate() if thread.name.startswith("ahead")]


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert not readers()


def events_at(t):
    t = np.array(t, np.int64)
    rng = np.random.default_rng(len(t))
    return Events(t, *(rng.integers(0, most, len(t)).astype(kind) for most, kind in ((7, "u2"), (5, "u2"), (2, "u1"))))


def some_events(count, zero=ZERO):
    return events_at(np.cumsum(np.random.default_rng(count).integers(0, 5, count)) + zero)


def recording(events, chunk=10):
    return Recording(Path("r"), "r", CAMERA, lambda: (events[i : i + chunk] for i in range(0, len(events), chunk)))


def spans(stream, events=4, seconds=1.0):
    """The first time and the number of events of every window."""
    with stream:
        return [(window.start.item(), window.ray.shape[1]) for window in iter(lambda: stream.take(events, seconds), None)]


def assert_same(one, other):
    for name in NAMES:
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=0)


def assert_holds(window, events):
    """Every column of the window is that of the events."""
    assert_same(window, next(recording(events, len(events)).windows(len(events))))


@pytest.mark.parametrize("chunk", [1, 7, 20, 64, 1000])
@pytest.mark.parametrize("size", [2, 20, 203])
def test_a_fixed_number_of_events_gives_the_windows_of_the_recording(chunk, size):
    r = recording(some_events(203), chunk)
    with r.stream() as stream:
        assert isinstance(stream, Stream)
        for window in r.windows(size):
            assert_same(stream.take(size, math.inf), window)
        rest = stream.take(size, math.inf)
        assert (0 if rest is None else rest.ray.shape[1]) == (203 % size if 203 % size > 1 else 0)
        assert stream.take(size, math.inf) is None


@pytest.mark.parametrize("chunk", [1, 2, 3, 100])
def test_a_window_ends_with_its_last_event_within_the_seconds(chunk):
    r = recording(events_at([0, 10, 300_000, 300_001, 300_002, 700_000, 700_000]), chunk)
    assert spans(r.stream(), 10, 0.1 + 0.2) == [(0, 3), (300_001, 2), (700_000, 2)]  # 300,000 µs, though 0.1 + 0.2 > 0.3
    assert spans(r.stream(), 10, 0.29999) == [(0, 2), (300_000, 3), (700_000, 2)]
    assert spans(r.stream(), 2, 0.29999) == [(0, 2), (300_000, 2), (300_002, 2)]  # the last event is alone


@pytest.mark.parametrize("chunk", [1, 2, 100])
def test_a_window_has_a_second_event_however_late(chunk):
    assert spans(recording(events_at([0, 10**9, 2 * 10**9, 3 * 10**9]), chunk).stream(), 10, 1e-9) == [(0, 2), (2 * 10**9, 2)]


@given(
    gaps=st.lists(st.integers(0, 40), max_size=80),
    chunk=st.integers(1, 90),
    asked=st.lists(st.tuples(st.integers(2, 30), st.integers(1, 200)), min_size=1, max_size=8),
    looks=st.booleans(),
)
def test_nothing_is_lost_and_nothing_comes_twice_whatever_is_taken(gaps, chunk, asked, looks):
    events = events_at(ZERO + np.cumsum([0, *gaps]))
    with recording(events, chunk).stream() as stream:
        at = turn = 0
        while at < len(events) - 1:
            most, span = asked[turn % len(asked)]
            turn += 1
            if looks:
                stream.look(31, span * 3e-6)
            window = stream.take(most, span * 1e-6)
            within = int((events.t[at:] <= events.t[at] + span).sum())
            count = min(max(within, 2), most, len(events) - at)
            assert_holds(window, events[at : at + count])
            at += count
            assert stream.consumed == at
        assert stream.position == (None if at == len(events) else events.t[-1])
        assert stream.take(2, 1) is None
        assert stream.consumed == at


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_a_file_gives_the_same_windows_in_chunks_of_any_size(folder, chunk):
    events = some_events(50, 1_000_000)
    lines = "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True))
    r = open(folder(lines, CALIB), OpenOptions(sensor=(7, 5), chunk=chunk))
    with r.stream() as stream:
        assert_holds(stream.take(30, 1), events[:30])
        assert_holds(stream.take(30, 1), events[30:])
        assert stream.take(30, 1) is None


@pytest.mark.parametrize("chunk", [1, 3, 100])
@pytest.mark.parametrize("start", [None, -math.inf, 0, 1, 1.000001, 1.1, 1.15])
@pytest.mark.parametrize("end", [None, math.inf, 1.2, 1.1999999, 1.200001, 1.3, 9])
def test_start_is_inside_and_end_is_not(chunk, start, end):
    t = np.array([1_000_000, 1_000_000, 1_000_001, 1_100_000, 1_100_001, 1_150_000, 1_150_001, 1_199_999, 1_200_000, 1_300_000])
    low, high = (None if s is None else round(s * 1e6) if math.isfinite(s) else None for s in (start, end))
    inside = t[(t >= (-1 if low is None else low)) & (t < (1e9 if high is None else high))]
    events = events_at(t)
    with recording(events, chunk).stream(start, end) as stream:
        assert_holds(stream.take(100, 100), events[np.isin(t, inside)])
        assert stream.position is None


def counted(read):
    """An event every µs in ten chunks of ten; the numbers of those that were read go to the list, and that they were closed."""

    def chunks():
        try:
            for i in range(10):
                read.append(i)
                yield events_at(range(10 * i, 10 * i + 10))
        finally:
            read.append("closed")

    return Recording(Path("r"), "r", CAMERA, chunks)


def test_after_the_end_nothing_is_read():
    read = []
    assert spans(counted(read).stream(12e-6, 35e-6), 100) == [(12, 23)]
    assert read == [0, 1, 2, 3, "closed"]


def test_no_more_than_the_next_chunk_is_read_ahead():
    read = []
    with counted(read).stream() as stream:
        assert not read
        for _ in range(5):
            stream.take(2, 1)
        for _ in range(1000):
            if read == [0, 1]:
                break
            time.sleep(0.01)
        time.sleep(0.05)
        assert read == [0, 1]


def test_what_is_closed_early_was_not_done():
    with replace(counted([]), count=100).stream() as stream:
        stream.look(200, 1)
        stream.take(20, 1)
    assert stream.share == 0.2


def test_a_look_takes_nothing():
    with recording(some_events(50), 7).stream() as stream:
        for size in (20, 5, 50, 2):
            assert stream.look(size, 1).ray.shape[1] == size
        assert stream.position == some_events(50).t[0]
        assert (stream.consumed, stream.share) == (0, 0)
        assert_same(stream.look(20, 1), stream.take(20, 1))
        assert stream.position == some_events(50).t[20]


def test_what_was_looked_at_can_be_skipped_and_nothing_else():
    with recording(some_events(20), 7).stream() as looked, recording(some_events(20), 7).stream() as taken:
        for count in (3, 9, 2):
            window = looked.look(count, math.inf)
            looked.skip(window.ray.shape[1])
            assert_same(window, taken.take(count, math.inf))
            assert (looked.consumed, looked.position) == (taken.consumed, taken.position)
        for count in (0, 100):
            with pytest.raises(ValueError, match="only events that were looked at"):
                looked.skip(count)


def test_windows_come_to_the_device_that_is_asked_for(device):
    with recording(some_events(50)).stream(device=device) as stream:
        window = stream.take(20, 1)
        assert {getattr(window, name).device.type for name in NAMES} == {device.type}


def test_the_share_is_of_the_time_where_an_end_is_given():
    with recording(events_at(range(0, 1000, 100))).stream(0.0002, 0.0007) as stream:
        shares = [stream.share]
        while stream.take(2, 1):
            shares.append(stream.share)
        assert shares == pytest.approx([0, 0.2, 0.6])
        assert stream.position == 600  # alone: there is no more to do
        assert stream.share == 1


def test_the_share_is_of_the_events_where_their_number_is_known():
    with replace(recording(events_at(range(0, 1000, 100)), 3), count=10).stream(0.0004, 100) as stream:
        shares = [stream.share]
        while stream.take(2, 1):
            stream.look(4, 1)
            shares.append(stream.share)
        assert shares == pytest.approx([0, 1 / 3, 2 / 3, 1])


def test_no_share_is_made_up():
    with recording(some_events(40)).stream() as stream:
        stream.take(10, 1)
        assert stream.share is None
        assert stream.take(40, 1).ray.shape[1] == 30
        assert stream.take(2, 1) is None
        assert stream.share == 1


def test_waiting_for_the_reader_is_measured():
    def chunks():
        for i in range(2):
            time.sleep(0.1)
            yield events_at(range(10 * i, 10 * i + 10))

    with Recording(Path("r"), "r", CAMERA, chunks).stream() as stream:
        assert stream.waited == 0
        stream.take(10, 1)
        first = stream.waited
        assert first >= 0.1
        time.sleep(0.3)  # the reader is done meanwhile
        stream.take(10, 1)
        assert stream.waited - first < 0.1


@pytest.mark.parametrize(("start", "end"), [(1, 1), (2, 1), (1, 1 + 1e-8), (math.nan, None), (None, math.nan), (math.inf, None)])
def test_a_stretch_without_time_is_refused(start, end):
    with pytest.raises(DataError, match=r"^r: from .* is no stretch of time\n  what to do: give a start before the end"):
        recording(some_events(50)).stream(start, end)


@pytest.mark.parametrize("chunk", [1, 2, 100])
def test_a_start_after_the_last_event_says_how_long_the_recording_is(chunk):
    r = recording(events_at([1_500_000, 1_600_000, 1_700_000]), chunk)
    with r.stream(1.700001) as stream, pytest.raises(DataError) as caught:
        stream.take(2, 1)
    assert str(caught.value).startswith("r: has no event from the start at 1.700001 s on\n")
    assert "its clock runs from 1.500000 s to 1.700000 s" in caught.value.remedy
    with r.stream(1.7) as stream:
        assert stream.position == 1_700_000
        assert stream.take(2, 1) is None


@pytest.mark.parametrize("end", [0, 1.5])
def test_an_end_before_the_first_event_says_where_the_recording_begins(end):
    with recording(events_at([1_500_000, 1_600_000])).stream(None, end) as stream, pytest.raises(DataError) as caught:
        stream.look(2, 1)
    assert str(caught.value).startswith(f"r: has no event before the end at {end:.6f} s\n")
    assert "its clock begins at 1.500000 s" in caught.value.remedy


def test_a_recording_without_events_is_refused_and_a_gap_is_not():
    with recording(some_events(0)).stream() as stream, pytest.raises(DataError, match="holds no events"):
        stream.take(2, 1)
    assert spans(recording(events_at([1, 2, 9, 10])).stream(3e-6, 9e-6)) == []


@pytest.mark.parametrize("arguments", [(1, 1), (0, 1), (-5, 1), (2, 0), (2, -1), (2, math.nan)])
def test_windows_of_no_sense_are_refused(arguments):
    with recording(some_events(50)).stream() as stream:
        for ask in (stream.take, stream.look):
            with pytest.raises(ValueError, match="at least 2 events and more than 0 seconds"):
                ask(*arguments)


def test_an_error_of_the_reader_comes_where_its_events_are_wanted_and_is_not_taken_for_the_end():
    error = DataError("events.txt", "letters in a column", "mend it", "line 7")

    def chunks():
        yield some_events(50)
        raise error

    stream = Recording(Path("r"), "r", CAMERA, chunks).stream()
    assert stream.take(20, 1).ray.shape[1] == stream.take(20, 1).ray.shape[1] == 20
    with pytest.raises(DataError) as caught:
        stream.take(20, 1)
    assert caught.value is error
    with pytest.raises(ValueError, match="the stream is closed"):
        stream.take(2, 1)
    assert stream.consumed == 40


def test_an_error_in_a_file_is_told_with_its_place(folder):
    lines = "".join(f"0.{i:06} 1 2 0\n" for i in range(20)) + "0.000020 1 x 0\n0.000021 1 2 0\n"
    stream = open(folder(lines, CALIB), OpenOptions(sensor=(7, 5), chunk=4)).stream()
    with pytest.raises(DataError, match=r"events\.txt, line 21: "):
        stream.take(100, 1)


def test_closing_early_closes_the_file_and_leaves_no_thread():
    read = []
    stream = counted(read).stream()
    stream.take(8, 1)
    assert readers()
    stream.close()
    stream.close()
    assert read in ([0, "closed"], [0, 1, "closed"])
    assert not readers()
    for ask in (lambda: stream.take(2, 1), lambda: stream.look(2, 1), lambda: stream.position):
        with pytest.raises(ValueError, match="the stream is closed"):
            ask()
    assert stream.consumed == 8


def test_an_interrupt_does_not_wait_until_the_start_is_found():
    read = []

    def chunks():
        for i in range(1000):
            read.append(i)
            time.sleep(0.05)
            if i == 2:
                signal.raise_signal(signal.SIGINT)
            yield events_at([i])

    stream = Recording(Path("r"), "r", CAMERA, chunks).stream(1.0)
    with pytest.raises(KeyboardInterrupt):
        stream.take(2, 1)
    assert len(read) < 10


def test_forgetting_a_stream_ends_its_thread():
    stream = recording(some_events(500)).stream()
    stream.take(2, 1)
    assert readers()
    del stream
    assert not readers()
