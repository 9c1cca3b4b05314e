"""Windows are cut from the stream of events wherever the chunks end."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchcmax.core.camera import Camera
from torchcmax.io import DataError, Events, Recording
from torchcmax.io.events import Packed

CAMERA = Camera((5, 7), 6.0, 6.5, 3.0, 2.0)


def some_events(count):
    rng = np.random.default_rng(count)
    t = np.cumsum(rng.integers(0, 5, count)) + 1_468_940_293_844_896
    return Events(t, *(rng.integers(0, most, count).astype(kind) for most, kind in ((7, "u2"), (5, "u2"), (2, "u1"))))


def recording(events, chunk):
    return Recording(Path("r"), "r", CAMERA, lambda: (events[i : i + chunk] for i in range(0, len(events), chunk)))


@pytest.mark.parametrize("chunk", [1, 3, 10, 64, 1000])
@pytest.mark.parametrize("batch", [1, 2, 5])
@pytest.mark.parametrize(("size", "stride"), [(10, None), (10, 3), (10, 10), (4, 23), (2, 1), (100, 7)])
def test_windows_are_the_stretches_of_the_stream_whatever_the_chunks_and_batches(chunk, batch, size, stride):
    events = some_events(203)
    windows = list(recording(events, chunk).windows(size, stride, batch))
    starts = range(0, len(events) - size + 1, stride or size)
    assert [len(window) for window in windows[:-1]] == [batch] * (len(windows) - 1)
    assert sum(map(len, windows)) == len(starts)
    rows = [window[i : i + 1] for window in windows for i in range(len(window))]
    table = CAMERA.rays().float()
    for start, row in zip(starts, rows, strict=True):
        part = events[start : start + size]
        torch.testing.assert_close(row.ray[0], table[part.y.astype(int), part.x.astype(int)], rtol=0, atol=0)
        assert row.start.item() == part.t[0]
        np.testing.assert_allclose(row.dt[0], (part.t - part.t[0]) * 1e-6, rtol=1e-6)
        assert row.dt.dtype == row.ray.dtype == row.polarity.dtype == torch.float32
        assert row.duration.item() == row.dt[0, -1].item()
        np.testing.assert_array_equal(row.polarity[0], np.where(part.p, 1, -1))


def test_a_recording_can_be_read_twice():
    r = recording(some_events(50), 7)
    first, second = (torch.cat([w.ray for w in r.windows(10)]) for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize("count", [0, 1, 9])
def test_fewer_events_than_a_window_is_said(count):
    with pytest.raises(DataError, match=f"holds {count} events, fewer than one window of 10"):
        list(recording(some_events(count), 4).windows(10))


@pytest.mark.parametrize("arguments", [(1,), (10, 0), (10, 5, 0)])
def test_windows_of_no_sense_are_refused(arguments):
    with pytest.raises(ValueError, match="at least"):
        next(recording(some_events(50), 7).windows(*arguments))


def test_events_off_the_sensor_are_refused_and_not_taken_for_others():
    events = some_events(50)
    events.x[20] = 7  # of a sensor that is 7 wide: would be the first pixel of the next row
    with pytest.raises(ValueError, match=r"pixel \(7, 4\) are not on the sensor of 7 x 5"):
        next(recording(events, 50).windows(50))


@pytest.mark.parametrize("length", [(1 << 31) - 1, 1 << 31, 1 << 40])
def test_windows_may_last_longer_than_half_an_hour(length):
    t = np.array([-5, 12, length - 5])
    events = Events(t, np.zeros(3, "u2"), np.zeros(3, "u2"), np.ones(3, "u1"))
    (window,) = recording(events, 3).windows(3)
    np.testing.assert_allclose(window.dt[0], (t + 5) * 1e-6, rtol=1e-7)
    assert window.start.tolist() == [-5]


@pytest.mark.parametrize("bits", [23, 24])
def test_microseconds_are_told_apart_as_far_as_float32_can(bits):
    t = (1 << bits) - np.arange(1000, 0, -1)
    events = Events(np.concatenate([[0], t]), *(np.zeros(1001, kind) for kind in ("u2", "u2", "u1")))
    (window,) = recording(events, 1001).windows(1001)
    np.testing.assert_array_equal(window.dt[0, 1:].numpy(), (t * 1e-6).astype(np.float32))


def test_events_go_to_the_device_in_nine_bytes():
    events = some_events(60)
    packed = Packed.of(events.strided(20, 20), CAMERA.size)
    assert sum(getattr(packed, name).element_size() for name in ("pixel", "offset", "polarity")) == 9
    assert packed.pixel.flatten().tolist() == (events.y.astype(int) * 7 + events.x).tolist()


def test_windows_come_to_the_device_that_is_asked_for(device):
    for window in recording(some_events(203), 64).windows(10, 7, 3, device):
        kinds = {getattr(window, name).device.type for name in ("ray", "dt", "polarity", "start", "duration")}
        assert kinds == {device.type}


def test_the_file_is_closed_when_nobody_wants_more_windows():
    closed = []

    def chunks():
        try:
            while True:
                yield some_events(50)
        finally:
            closed.append(True)

    windows = Recording(Path("r"), "r", CAMERA, chunks).windows(20)
    next(windows)
    windows.close()
    assert closed
