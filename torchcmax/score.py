"""How far an estimated trajectory is from ground truth, after the similarity that one camera cannot know."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Pose, Trajectory

GAP = 100_000  # µs; a longer time without a pose is not covered
STILL = 1e-12  # of the largest coordinate: positions that spread less are rounding, not movement


@dataclass(frozen=True)
class Similarity:
    """x_truth = scale * R @ x_estimate + t.  R [3, 3] | t [3] m | scale [], metres per unit of the estimate."""

    R: Tensor
    t: Tensor
    scale: Tensor

    def __matmul__(self, pose: Pose) -> Pose:
        """The estimate's poses [M] in the truth's world, t in metres."""
        return Pose(self.R @ pose.R, self.scale * (pose.t @ self.R.mT) + self.t)

    def back(self, pose: Pose) -> Pose:
        """The truth's poses [M] in the estimate's world and unit."""
        return Pose(self.R.mT @ pose.R, (pose.t - self.t) @ self.R / self.scale)


@dataclass(frozen=True)
class Score:
    """Errors of the aligned poses; positions and scale are None where only rotations were compared.

    percent_of_path: of the truth's path between start and end, None where it stands still | percent_of_distance: of the plane's,
    None without a plane | coverage: share of the truth's time between start and end that is in no gap above GAP
    scale: metres per unit of the estimate
    """

    poses: int
    position_rmse_m: float | None
    position_max_m: float | None
    percent_of_path: float | None
    percent_of_distance: float | None
    orientation_rmse_deg: float
    orientation_max_deg: float
    coverage: float
    scale: float | None


def similarity(estimate: Pose, truth: Pose) -> Similarity:
    """The similarity that fits positions and orientations best, poses [M] each, M >= 1.

    Least squares for the positions (Umeyama 1991), but with a rotation for which orientations vote too, with equal weight: both moments
    are at most 1 in trace. Positions alone leave a straight path free to turn about itself. Where estimate or truth stands still,
    orientations vote alone and the scale, which nothing tells, is 1.
    """
    estimate = _like(estimate, truth)
    mean_x, mean_y = estimate.t.mean(0), truth.t.mean(0)
    x, y = estimate.t - mean_x, truth.t - mean_y
    moment = _turn(estimate, truth)
    moves = bool(_moves(x, estimate.t) and _moves(y, truth.t))
    if moves:
        moment = moment + (y / y.norm()).mT @ (x / x.norm())
    R = _nearest_rotation(moment)
    scale = (y * (x @ R.mT)).sum() / (x * x).sum() if moves else torch.ones_like(moment[0, 0])
    return Similarity(R, mean_y - scale * (R @ mean_x), scale)


def rotation(estimate: Pose, truth: Pose) -> Similarity:
    """The one rotation that fits the orientations best, without translation or scale: poses [M] each, for a camera that only turns."""
    R = _nearest_rotation(_turn(_like(estimate, truth), truth))
    return Similarity(R, torch.zeros_like(R[0]), torch.ones_like(R[0, 0]))


def inside(estimate: Trajectory, truth: Trajectory, start_us: int | None = None, end_us: int | None = None) -> Trajectory:
    """The estimate's poses within the truth's time and start..end, both included."""
    first, last = common(truth, start_us, end_us)
    keep = (estimate.time >= first) & (estimate.time <= last)
    count, own = int(keep.sum()), f"it covers {estimate.time[0].item()}..{estimate.time[-1].item()} us"
    if count < 2:
        place = f"the truth's {first}..{last} us"
        raise ValueError(f"{count or 'no'} pose{'s' * (count != 1)} of the estimate in {place}, a score wants at least two; {own}")
    return Trajectory(estimate.time[keep], estimate.pose[keep])


def errors(estimate: Trajectory, truth: Trajectory, at_similarity: Similarity) -> tuple[Tensor, Tensor]:
    """Distances from the truth, interpolated at the estimate's times (all within it): -> position [M] m, orientation [M] deg."""
    there = truth.at(estimate.time.to(truth.time.device))
    here = at_similarity @ _like(estimate.pose, there)
    angle = so3.log(there.R.mT @ here.R).norm(dim=-1)  # exact for small angles, where an arc cosine is not
    return (here.t - there.t).norm(dim=-1), torch.rad2deg(angle)


def score(
    estimate: Trajectory,
    truth: Trajectory,
    plane: Plane | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    rotation_only: bool = False,
) -> Score:
    """The estimate [M] against the truth, in metres, between start and end: aligned by one similarity over all its poses.

    plane [1] of the truth, in metres | rotation_only: align by one rotation, and compare orientations only
    """
    span = common(truth, start_us, end_us)
    kept = inside(estimate, truth, *span)
    there = truth.at(kept.time.to(truth.time.device))
    best = rotation(kept.pose, there) if rotation_only else similarity(kept.pose, there)
    position, orientation = errors(kept, truth, best)
    rmse = None if rotation_only else _rms(position)
    path = path_length(truth, span)
    return Score(
        poses=len(kept),
        position_rmse_m=rmse,
        position_max_m=None if rotation_only else position.max().item(),
        percent_of_path=100 * rmse / path if rmse is not None and path > 0 else None,
        percent_of_distance=100 * rmse / plane.distance[0].item() if rmse is not None and plane is not None else None,
        orientation_rmse_deg=_rms(orientation),
        orientation_max_deg=orientation.max().item(),
        coverage=coverage(kept.time, span),
        scale=None if rotation_only else best.scale.item(),
    )


def common(truth: Trajectory, start_us: int | None = None, end_us: int | None = None) -> tuple[int, int]:
    """The truth's time between start and end, µs."""
    first, last = int(truth.time[0]), int(truth.time[-1])
    start, end = first if start_us is None else max(start_us, first), last if end_us is None else min(end_us, last)
    if end <= start:
        raise ValueError(f"the truth covers {first}..{last} us, nothing of it lies between start {start_us} and end {end_us}")
    return start, end


def _like(estimate: Pose, truth: Pose) -> Pose:
    """The estimate where the truth is, in float64; both must be poses [M] of known numbers."""
    if estimate.t.shape != truth.t.shape or estimate.t.dim() != 2 or not len(estimate.t):
        raise ValueError(f"estimate and truth must be as many poses [M], got t {tuple(estimate.t.shape)} and {tuple(truth.t.shape)}")
    for name, pose in (("estimate", estimate), ("truth", truth)):
        unknown = ~(pose.R.isfinite().all(-1).all(-1) & pose.t.isfinite().all(-1))
        if unknown.any():
            raise ValueError(f"pose {int(unknown.int().argmax())} of the {name}, from 0, holds a number that is not finite")
    return Pose(estimate.R.to(truth.R), estimate.t.to(truth.t))


def _moves(deviation: Tensor, position: Tensor) -> Tensor:
    """Whether positions [M, 3] spread about their mean by more than rounding."""
    return deviation.abs().max() > STILL * position.abs().max()


def _turn(estimate: Pose, truth: Pose) -> Tensor:
    """Mean of the rotations from the estimate's world to the truth's, a third of it: [3, 3]."""
    return (truth.R @ estimate.R.mT).mean(0) / 3


def _nearest_rotation(moment: Tensor) -> Tensor:
    """The rotation R that makes tr(R^T moment) largest: [3, 3] -> [3, 3]."""
    U, _, Vh = torch.linalg.svd(moment)
    sign = torch.ones_like(moment[0])
    sign[2] = torch.linalg.det(U @ Vh).sign()  # a mirror image is no rotation
    R: Tensor = (U * sign) @ Vh
    return R


def path_length(truth: Trajectory, span: tuple[int, int]) -> float:
    """Length of the path through the truth's own poses within the span, m."""
    t = truth.pose.t[(truth.time >= span[0]) & (truth.time <= span[1])]
    return float(t.diff(dim=0).norm(dim=-1).sum())


def coverage(time: Tensor, span: tuple[int, int]) -> float:
    """Share of the span, µs, less the gaps that are longer than GAP, those before the first and behind the last pose too."""
    ends = time.new_tensor(span)
    gaps = torch.cat([ends[:1], time, ends[1:]]).diff()
    return 1 - gaps[gaps > GAP].sum().item() / (span[1] - span[0])


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
