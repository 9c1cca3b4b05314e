"""Poses, planes and velocities as text come back, and the bad ones are refused."""

import pytest
import torch
from samples import POSE, a_trajectory

from torchcmax.core.plane import Plane
from torchcmax.core.pose import Motion
from torchcmax.io import DataError
from torchcmax.io.trajectory import read_plane, read_trajectory, write_plane, write_trajectory, write_velocity


def test_trajectories_and_planes_come_back(tmp_path):
    write_trajectory(tmp_path / "t.txt", a_trajectory())
    found = read_trajectory(tmp_path / "t.txt")
    assert torch.equal(found.time, a_trajectory().time)
    torch.testing.assert_close(found.pose.t, a_trajectory().pose.t, rtol=0, atol=1e-11)
    torch.testing.assert_close(found.pose.R, a_trajectory().pose.R, rtol=0, atol=1e-11)
    plane = Plane(torch.tensor([[0.6, 0.0, -0.8]], dtype=torch.float64), torch.tensor([0.7], dtype=torch.float64))
    write_plane(tmp_path / "p.txt", plane)
    assert torch.equal(read_plane(tmp_path / "p.txt").normal, plane.normal)
    write_velocity(tmp_path / "v.txt", torch.tensor([1_500_000]), Motion(torch.tensor([[4.0, 5, 6]]), torch.tensor([[1.0, 2, 3]])))
    assert (tmp_path / "v.txt").read_text().splitlines()[1] == "1.500000 1 2 3 4 5 6"
    with pytest.raises(DataError, match="cannot be written"):
        write_plane(tmp_path / "p.txt" / "below.txt", plane)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0" + POSE + "2" + POSE + "1" + POSE, "line 3: time does not increase"),
        ("#\n0" + POSE + "0.0000004" + POSE, "line 3: time does not increase"),
        ("0" + POSE + "1 2 3\n", "line 2: 3 columns instead of 8"),
        ("0" + POSE + "a" + POSE, "line 2: not all are numbers"),
        ("0" + POSE + "nan" + POSE, "line 2: a number out of all range"),
        ("0" + POSE + "1 0 0 0 0 0 0 0\n", "line 2: .* no unit quaternion"),
        ("0" + POSE + "4e12" + POSE, "line 2: a number out of all range"),
        ("0" + POSE, "holds 1 poses"),
        ("", "holds 0 poses"),
    ],
)
def test_bad_trajectories(tmp_path, text, words):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(DataError, match=words):
        read_trajectory(tmp_path / "t.txt")


@pytest.mark.parametrize(
    ("text", "words"),
    [("0 0 nan 1", "no unit normal"), ("0 0 -1", "3 columns"), ("0 0 -2 1", "no unit normal"), ("0 0 -1 -1", "positive"), ("", "0 lines")],
)
def test_bad_planes(tmp_path, text, words):
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(DataError, match=words):
        read_plane(tmp_path / "p.txt")
