import importlib.util
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.io.trajectory import read_plane, read_trajectory, write_plane, write_trajectory
from torchcmax.score import Similarity, errors, inside, rotation, score, similarity

JUDGE = Path(__file__).parents[2] / "shared" / "tools" / "score_trajectory.py"
WALL = Plane(torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64), torch.tensor([1.7], dtype=torch.float64))


def vector(*numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def wave(seed, time, size, *, rate=2.0):
    """A smooth random vector over time: [M] µs -> [M, 3]."""
    a, b = torch.randn(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    s = time.double()[:, None] * 1e-6
    return size * (a * torch.sin(rate * s + b) + b * torch.cos(0.6 * rate * s + a) + 0.3 * s)


def path(seed=0, time=None):
    """A trajectory through space, at 1 kHz for two seconds unless told."""
    time = torch.arange(0, 2_000_001, 1000) if time is None else time
    return Trajectory(time, Pose(so3.exp(wave(seed, time, 0.5)), wave(seed + 1, time, 1.0)))


def moved(trajectory, similarity):
    """What an estimate says whose world lies at the similarity from the truth's."""
    pose = trajectory.pose
    R = similarity.R.mT
    return Trajectory(trajectory.time, Pose(R @ pose.R, (pose.t - similarity.t) @ R.mT / similarity.scale))


def noisy(trajectory, size, seed=5):
    w, d = torch.randn(2, len(trajectory), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * size
    return Trajectory(trajectory.time, Pose(so3.exp(w) @ trajectory.pose.R, trajectory.pose.t + d))


def every(trajectory, step, offset=0):
    return Trajectory(trajectory.time[offset::step], trajectory.pose[offset::step])


PLACE = Similarity(so3.exp(vector(2.0, -1.0, 0.7)), vector(3.0, -4.0, 0.5), vector(2.5)[0])


def square(a, *, eps=0.0, alpha=0.0):
    """Four poses on a line a apart, pushed aside by eps and turned by alpha in the pattern + - - +, which no line and no turn explains."""
    sign, zero = vector(1, -1, -1, 1), torch.zeros(4, dtype=torch.float64)
    t = torch.stack([a * torch.arange(4).double(), eps * sign, zero], -1)
    return Trajectory(torch.arange(4) * 50_000, Pose(so3.exp(torch.stack([zero, zero, alpha * sign], -1)), t))


def test_a_trajectory_moved_by_a_known_similarity_has_no_error():
    truth = path()
    found = similarity(moved(truth, PLACE).pose, truth.pose)
    torch.testing.assert_close((found.R, found.t, found.scale), (PLACE.R, PLACE.t, PLACE.scale), rtol=1e-12, atol=1e-12)
    result = score(every(moved(truth, PLACE), 7, 3), truth, WALL)
    assert result.position_max_m < 1e-13
    assert result.orientation_max_deg < 1e-12
    assert result.scale == pytest.approx(2.5, rel=1e-12)
    assert result.poses == len(truth.time[3::7])


def test_a_known_perturbation_has_its_error():
    eps, alpha = 0.1, 0.02
    result = score(square(1.0, eps=eps, alpha=alpha), square(1.0), WALL)
    rmse = (5 * eps**2 / (5 + 4 * eps**2)) ** 0.5  # what least squares leaves, with the scale 5 / (5 + 4 eps²)
    assert result.scale == pytest.approx(5 / (5 + 4 * eps**2), rel=1e-12)
    assert result.position_rmse_m == pytest.approx(rmse, rel=1e-12)
    assert result.percent_of_path == pytest.approx(100 * rmse / 3, rel=1e-12)
    assert result.percent_of_distance == pytest.approx(100 * rmse / 1.7, rel=1e-12)
    degrees = torch.rad2deg(vector(alpha)).item()
    assert (result.orientation_rmse_deg, result.orientation_max_deg) == pytest.approx((degrees, degrees), rel=1e-10)


@pytest.mark.parametrize("alpha", [1e-12, 1e-8, 1e-3, 1.0, 3.1])
def test_an_angle_of_any_size_is_told_exactly(alpha):
    truth = square(1.0)
    turned = Trajectory(truth.time, Pose(so3.exp(vector(0, alpha, 0).expand(4, 3)), truth.pose.t + vector(0, 0, 0.25)))
    identity = Similarity(torch.eye(3).double(), torch.zeros(3).double(), vector(1)[0])
    position, orientation = errors(turned, truth, identity)
    torch.testing.assert_close(position, torch.full_like(position, 0.25))
    torch.testing.assert_close(torch.deg2rad(orientation), torch.full_like(orientation, alpha), rtol=1e-9, atol=0)


def test_a_straight_path_is_not_free_to_turn_about_itself():
    truth = square(0.7)
    about = Similarity(so3.exp(vector(1.3, 0, 0)), vector(1, 2, 3), vector(0.2)[0])
    found = similarity(moved(truth, about).pose, truth.pose)
    torch.testing.assert_close(found.R, about.R, rtol=0, atol=1e-12)
    result = score(moved(truth, about), truth)
    assert (result.position_max_m, result.orientation_max_deg) == pytest.approx((0, 0), abs=1e-12)


def test_a_mirror_image_is_aligned_by_a_rotation_all_the_same():
    upright = torch.eye(3, dtype=torch.float64)
    turns = so3.exp(torch.cat([torch.zeros_like(upright[:1]), torch.pi * upright]))  # together they vote for no rotation at all
    corners = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]).double() * vector(3, 2, 1)
    found = similarity(Pose(turns, corners * vector(1, 1, -1)), Pose(upright.expand(4, 3, 3), corners))
    torch.testing.assert_close(found.R, upright, rtol=0, atol=1e-12)  # best of all that are no mirror: the short axis stays wrong


@pytest.mark.parametrize("offset", [0.0, 1234.567])
@pytest.mark.parametrize("still", ["estimate", "truth", "both"])
def test_without_movement_the_scale_is_one_and_orientations_tell_the_rotation(still, offset):
    truth = path()
    there = Pose(truth.pose.R, torch.full_like(truth.pose.t, offset) if still != "estimate" else truth.pose.t)
    here = Pose(PLACE.R.mT @ there.R, torch.full_like(truth.pose.t, offset / 3) if still != "truth" else truth.pose.t)
    found = similarity(here, there)
    assert found.scale == 1
    torch.testing.assert_close(found.R, PLACE.R, rtol=0, atol=1e-12)
    result = score(Trajectory(truth.time, here), Trajectory(truth.time, there))
    assert (result.percent_of_path is None) == (still != "estimate")
    assert all(value is None or torch.tensor(value).isfinite() for value in asdict(result).values())


def test_one_pose_alone_is_met_exactly():
    truth = path().pose[:1]
    found = similarity(Pose(PLACE.R.mT @ truth.R, truth.t + 5), truth)
    aligned = found @ Pose(PLACE.R.mT @ truth.R, truth.t + 5)
    torch.testing.assert_close((aligned.R, aligned.t, found.scale), (truth.R, truth.t, vector(1)[0]))


def test_a_recording_of_rotation_is_compared_by_its_orientations_only():
    truth = path()
    here = Trajectory(truth.time, Pose(PLACE.R.mT @ truth.pose.R, torch.zeros_like(truth.pose.t)))
    torch.testing.assert_close(rotation(here.pose, truth.pose).R, PLACE.R, rtol=0, atol=1e-12)
    result = score(here, truth, WALL, rotation_only=True)
    assert result.orientation_max_deg < 1e-12
    assert {name for name, value in asdict(result).items() if value is None} == {
        *("position_rmse_m", "position_max_m", "percent_of_path", "percent_of_distance", "scale")
    }


def test_the_errors_over_time_make_up_the_score():
    truth, estimate = path(), noisy(moved(path(), PLACE), 0.02)
    kept = inside(estimate, truth, 300_000, 1_500_000)
    position, orientation = errors(kept, truth, similarity(kept.pose, truth.at(kept.time)))
    result = score(estimate, truth, start_us=300_000, end_us=1_500_000)
    assert (len(position), position.max().item(), orientation.max().item()) == pytest.approx(
        (result.poses, result.position_max_m, result.orientation_max_deg)
    )
    assert position.square().mean().sqrt().item() == pytest.approx(result.position_rmse_m)


def test_gaps_are_not_covered_and_poses_outside_of_the_truth_do_not_count():
    truth = path()
    time = torch.cat([torch.arange(-500_000, 500_001, 50_000), torch.arange(600_000, 1_000_001, 100_000), torch.tensor([1_400_000])])
    estimate = path(time=time)
    result = score(estimate, truth)
    assert result.poses == 11 + 5 + 1
    assert result.coverage == pytest.approx(1 - (0.4 + 0.6) / 2)  # gaps of exactly 0.1 s are none
    assert score(estimate, truth, start_us=300_000, end_us=1_100_000).coverage == pytest.approx(1)
    assert score(estimate, truth, end_us=1_200_000).coverage == pytest.approx(1 - 0.2 / 1.2)
    assert score(estimate, truth, start_us=-(10**9), end_us=10**9) == result


def test_an_estimate_in_single_precision_is_scored_in_double():
    truth, estimate = path(), moved(path(), PLACE)
    single = Trajectory(estimate.time, Pose(estimate.pose.R.float(), estimate.pose.t.float()))
    result = score(single, truth)
    assert 0 < result.position_max_m < 1e-5
    assert 0 < result.orientation_max_deg < 1e-4


def test_an_estimate_that_cannot_be_compared_is_refused():
    truth = path()
    with pytest.raises(ValueError, match=r"no poses of the estimate in the truth's 0\.\.2000000 us.* covers 3000000\.\.4000000 us"):
        score(path(time=torch.arange(3_000_000, 4_000_001, 1000)), truth)
    with pytest.raises(ValueError, match=r"1 pose of the estimate in the truth's 0\.\.2000000 us, a score wants at least two"):
        score(path(time=torch.arange(2_000_000, 3_000_001, 1000)), truth)
    with pytest.raises(ValueError, match=r"the truth covers 0\.\.2000000 us, nothing of it lies between start 2500000 and end None"):
        score(truth, truth, start_us=2_500_000)
    with pytest.raises(ValueError, match="nothing of it lies between start 5 and end 4"):
        score(truth, truth, start_us=5, end_us=4)
    with pytest.raises(ValueError, match=r"the trajectory covers 0\.\.2000000 us, asked for -1000 us"):
        errors(path(time=torch.arange(-1000, 5000, 1000)), truth, PLACE)


def test_poses_that_do_not_belong_together_are_refused():
    truth = path().pose
    with pytest.raises(ValueError, match=r"as many poses \[M\], got t \(5, 3\) and \(2001, 3\)"):
        similarity(truth[:5], truth)
    with pytest.raises(ValueError, match=r"as many poses \[M\], got t \(0, 3\) and \(0, 3\)"):
        rotation(truth[:0], truth[:0])
    broken = truth.t.clone()
    broken[7, 1] = torch.nan
    with pytest.raises(ValueError, match="pose 7 of the estimate, from 0, holds a number that is not finite"):
        similarity(Pose(truth.R, broken), truth)
    with pytest.raises(ValueError, match="pose 7 of the truth"):
        rotation(truth, Pose(truth.R, broken))


@pytest.mark.parametrize("rotation_only", [False, True], ids=["similarity", "rotation"])
@pytest.mark.parametrize(("start", "end"), [(None, None), (250_500, None), (400_000, 1_700_250)])
@pytest.mark.parametrize("seed", [0, 10, 20])
def test_it_agrees_with_the_independent_judge(tmp_path, seed, start, end, rotation_only):
    if not JUDGE.is_file():
        pytest.skip(f"no judge at {JUDGE}")
    spec = importlib.util.spec_from_file_location("score_trajectory", JUDGE)
    judge = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(judge)
    time = torch.cat([torch.arange(-200_000, 900_000, 9_137), torch.arange(1_234_567, 1_800_000, 7_001)])
    names = [tmp_path / name for name in ("estimate.txt", "groundtruth.txt", "plane.txt")]
    write_trajectory(names[0], noisy(moved(path(seed, time), PLACE), 0.03, seed))
    write_trajectory(names[1], path(seed))
    write_plane(names[2], WALL)
    bound = {name: value * 1e-6 for name, value in (("start", start), ("end", end)) if value is not None}
    theirs = judge.score(*names, rotation=rotation_only, **bound)
    ours = score(read_trajectory(names[0]), read_trajectory(names[1]), read_plane(names[2]), start, end, rotation_only)
    assert {name: value for name, value in asdict(ours).items() if value is not None} == pytest.approx(theirs, rel=1e-6)
