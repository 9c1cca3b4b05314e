from itertools import pairwise

import numpy as np
import pytest

from torchcmax.sensor import Response, Sensor


def still_sensor(pixels=20_000, **changes):
    """A sensor that has seen constant light."""
    response = Response(**{"threshold": 0.25, "mismatch": 0.0, "noise": 0.0, "refractory": 0.0, "bandwidth": 0.0} | changes)
    return Sensor(response, 0, np.zeros(pixels, np.float32))


@pytest.mark.parametrize("rate", [1, 10, 100, 1000])
@pytest.mark.parametrize("refractory", [0, 5])
def test_noise_is_as_frequent_as_asked_less_the_share_of_the_refractory_time(rate, refractory):
    sensor, light = still_sensor(noise=rate, refractory=refractory), np.zeros(20_000, np.float32)
    seconds = {1: 1.0, 10: 0.5, 100: 0.1, 1000: 0.04}[rate]
    times = np.arange(0, round((seconds + 0.03) * 1e6) + 1, 2000)
    t = np.concatenate([sensor.step(light, start, end)[0] for start, end in pairwise(times)])
    measured = (t >= 30_000).sum() / 20_000 / seconds  # by then the first events of all pixels are forgotten
    assert measured == pytest.approx(rate / (1 + rate * refractory * 1e-3), rel=0.03)


def scripted(sensor, monkeypatch, noise):
    """The sensor makes this noise: (t, pixel, polarity), by pixel and time."""
    t, pixel, p = (np.array(column) for column in zip(*noise, strict=True))
    monkeypatch.setattr(sensor, "_noise", lambda start, end: (t, pixel, p.astype(np.uint8)))
    sensor.memory[:] = 0


def test_noise_and_crossings_of_a_pixel_go_in_their_order_of_time(monkeypatch):
    """Light rises by 2.2 thresholds in 1 ms: it crosses at 454 and 909 us, unless the pixel is blind for 200 us after an event."""
    sensor = still_sensor(4, refractory=0.2)
    scripted(sensor, monkeypatch, [(800, 0, 0), (850, 0, 1), (100, 1, 0), (250, 1, 0), (350, 1, 0), (460, 2, 0), (654, 2, 0), (660, 2, 1)])
    t, pixel, p = sensor.step(np.full(4, 0.55, np.float32), 0, 1000)
    found = [list(zip(t[pixel == k].tolist(), p[pixel == k].tolist(), strict=True)) for k in range(4)]
    assert found[0] == [(454, 1), (800, 0), (1000, 1)]  # the later noise leaves the earlier crossing, and delays the one after it
    assert found[1] == [(100, 0), (350, 0), (550, 1), (909, 1)]  # noise in the blind time is lost; the crossing comes when it ends
    assert found[2] == [(454, 1), (654, 0), (909, 1)]  # the first noise falls in the time after a crossing, the next just behind it
    assert found[3] == [(454, 1), (909, 1)]
    assert (np.diff(t) >= 0).all()


def test_without_a_refractory_time_all_noise_is_kept(monkeypatch):
    sensor = still_sensor(2)
    scripted(sensor, monkeypatch, [(5, 1, 1), (5, 1, 0), (6, 1, 1), (900, 1, 1)])
    t, pixel, p = sensor.step(np.zeros(2, np.float32), 0, 1000)
    assert (t.tolist(), pixel.tolist(), p.tolist()) == ([5, 5, 6, 900], [1, 1, 1, 1], [1, 0, 1, 1])
