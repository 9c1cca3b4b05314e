"""Moves that begin and end hard, with rests between them, as a motor makes them: some windows hold only a little of a motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_system import run

from torchcmax.io import open
from torchcmax.simulator import Simulation, write
from torchcmax.slam.options import Slam

SPEED, RATE = 0.7, 8.0  # m/s, m/s^2
MOVES = [(0.30, 0.1), (0.40, 0.35), (0.30, 0.6), (0.40, 0.45), (0.30, 0.3)]  # to where, m, and how long it rests there, s
ALONG = np.array([0.6, 0.8, 0.0])


def profile():
    """Every ms: time s, place m, velocity m/s along the way."""
    place, velocity = [np.full(50, 0.4)], [np.zeros(50)]
    for end, rest in MOVES:
        distance = end - place[-1][-1]
        top = min(SPEED, np.sqrt(abs(distance) * RATE))
        lasts = abs(distance) / top + top / RATE
        t = np.arange(1, round(lasts * 1000) + 1) / 1000
        v = np.minimum(np.minimum(t, lasts - t).clip(0) * RATE, top) * np.sign(distance)
        x = place[-1][-1] + v.cumsum() / 1000
        place += [x + (end - x[-1]) * np.linspace(0, 1, len(x)), np.full(round(rest * 1000), end)]
        velocity += [v, np.zeros(round(rest * 1000))]
    place, velocity = np.concatenate(place), np.concatenate(velocity)
    return np.arange(len(place)) / 1000, place, velocity


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """The recording, and the truth: time s, velocity [K, 3] in distances of the plane a second."""
    folder = tmp_path_factory.mktemp("moves")
    time, place, velocity = profile()
    rows = np.zeros((len(time), 8))
    rows[:, 0], rows[:, 1:4], rows[:, 7] = time, place[:, None] * ALONG, 1
    np.savetxt(folder / "path.txt", rows, fmt="%.9f")
    options = Simulation(trajectory=str(folder / "path.txt"), focal=335.0, distance=0.8)
    write(options, folder / "recording")
    return open(folder / "recording"), time, velocity[:, None] * ALONG / float(options.plane.distance)


@pytest.mark.parametrize("start", [0.0, 0.01, 0.02])
def test_the_motion_is_told_from_the_first_window_to_the_last(moved, start):
    recording, time, velocity = moved
    slam = Slam(model="translation")
    slam = replace(slam, tracking=replace(slam.tracking, seconds=0.025))
    system, (found,) = run(recording, (start, None), slam=slam)
    assert system.runs[0].losses == 0
    told = torch.cat([one.state.motion.velocity for one in found]).numpy()
    edges = [(one.window.start.item() * 1e-6, one.window.start.item() * 1e-6 + one.window.duration.item()) for one in found]
    true = np.array([velocity[(time >= a) & (time <= b)].mean(0) for a, b in edges])
    scale = (told * true).sum() / (told**2).sum()
    assert np.square(told * scale - true).sum() < 0.1**2 * np.square(true).sum()
    assert scale == pytest.approx(1, abs=0.05)
