"""Ground truth from text, EuRoC's csv, and recordings."""

import numpy as np
import pytest
import torch

from torchcmax.io import DataError
from torchcmax.io.truth import read_truth

HALF = 0.5**0.5
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]\n"
    f"1403636579758555392,4.5,-1.75,0.5,{HALF},0,0,{HALF},0.1\n"
    f"1403636579763555584,4.5,-1.5,0.5,{HALF},{HALF},0,0,0.1\n"
)


def test_euroc_has_nanoseconds_and_its_quaternion_begins_with_w(tmp_path):
    (tmp_path / "data.csv").write_text(EUROC)
    truth, plane = read_truth(tmp_path / "data.csv")
    assert plane is None
    assert truth.time.tolist() == [1403636579758555, 1403636579763556]  # not what float64 would make of 1.4e18 ns
    assert truth.pose.t.tolist() == [[4.5, -1.75, 0.5], [4.5, -1.5, 0.5]]
    turned = truth.pose.R @ torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    np.testing.assert_allclose(turned, [[-2, 1, 3], [1, -3, 2]], atol=1e-9)  # a quarter about z, a quarter about x


def test_names_of_columns_need_no_mark(tmp_path):
    (tmp_path / "data.csv").write_text(EUROC.removeprefix("#"))
    assert len(read_truth(tmp_path / "data.csv")[0]) == 2


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("1403636579768555392,1,2,3,1,0,0", "line 4"),
        ("1403636579768555392,1,2,3,one,0,0,0", "not all are numbers"),
        ("1403636579768555392,1,2,3,0.1,0,0,0", "no unit quaternion"),
        ("1403636579763555584,1,2,3,1,0,0,0", "time does not increase"),
        ("1403636579768555392,1,nan,3,1,0,0,0", "out of all range"),
        ("99999999999999999999999,1,2,3,1,0,0,0", "out of all range"),
        ("1403636579768555392,1e200,2,3,1,0,0,0", "out of all range"),
        ("1e999999999,1,2,3,1,0,0,0", "out of all range"),  # not written out
        ("nan,1,2,3,1,0,0,0", "out of all range"),
        ("1403636579.7685554,1,2,3,1,0,0,0", "no whole number of nanoseconds"),
    ],
)
def test_a_wrong_line_of_euroc_is_named(tmp_path, line, told):
    (tmp_path / "data.csv").write_text(EUROC + line + "\n")
    with pytest.raises(DataError, match=told) as error:
        read_truth(tmp_path / "data.csv")
    assert "line 4" in str(error.value)


def test_text_and_recording_tell_the_same(demo):
    text, plane = read_truth(demo / "groundtruth.txt")
    own, beside = read_truth(demo)
    assert torch.equal(text.time, own.time)
    assert torch.equal(text.pose.t, own.pose.t)
    assert plane is not None
    assert beside is not None
    assert torch.equal(plane.distance, beside.distance)


def test_what_has_no_truth_is_told(tmp_path):
    (tmp_path / "events.txt").write_text("0.1 1 2 0\n0.2 3 4 1\n")
    with pytest.raises(DataError, match="has no ground truth"):
        read_truth(tmp_path)
    with pytest.raises(DataError, match="no such"):
        read_truth(tmp_path / "groundtruth.txt")
