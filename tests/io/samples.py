"""What the tests share: good files, and how a refusal is checked."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.camera import Camera
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.io import DataError, Events, OpenOptions, Recording, open

ECD = "199.09 198.83 132.19 110.71 -0.3684 0.1509 -0.000296 -0.000759 0.0\n"
POSE = " 0 0 0 0 0 0 1\n"
CALIB = "200 200 120 90 0 0 0 0 0\n"
GOOD = "0.000001 1 2 0\n0.000002 3 4 1\n0.000003 5 6 1\n"


def read(path, **options):
    return Events.join(list(open(path, OpenOptions(**{"sensor": (240, 180), **options})).chunks()))


def refused(path, *words, **options):
    with pytest.raises(DataError) as caught:
        read(path, **options)
    for word in (*words, "what to do: "):
        assert word in str(caught.value)
    assert caught.value.remedy
    return caught.value


def noise(count=100_000):
    rng = np.random.default_rng(0)
    x, y = (rng.integers(0, most, count).astype("u2") for most in (240, 180))
    events = Events(np.sort(rng.integers(0, 10**7, count)), x, y, rng.integers(0, 2, count).astype("u1"))
    return Recording(Path("noise"), "noise", Camera.pinhole((180, 240)), lambda: iter([events]))


def a_trajectory():
    generator = torch.Generator().manual_seed(0)
    w, t = torch.randn(2, 6, 3, generator=generator, dtype=torch.float64)
    return Trajectory(torch.tensor([-1_500_000, -1, 0, 1, 999_999, 1_468_940_293_844_896]), Pose(so3.exp(w), t))
