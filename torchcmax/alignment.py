"""What lays poses on the truth's, and how far they are from it then: absolute (ATE) and relative (RPE) errors, through evo."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcmax.core.pose import Pose, Trajectory
from torchcmax.score import GAP, Similarity, errors, rotation, similarity

Statistics = dict[str, float]
KEPT = ("rmse", "mean", "median", "std", "max")  # of the statistics
WANTED = "pip install 'torchcmax[eval]'"


def laid(how: str, estimate: Pose, truth: Pose, scale: float = 1.0, at: int = 0) -> Similarity:
    """The similarity that a protocol lays poses [M] on the truth's with.

    how: similarity, rotation, sim3, se3, pose | scale: metres per unit of the estimate, for se3 and pose | at: the pose, for pose
    ValueError where positions do not tell a rotation, as on a straight line | ImportError without evo
    """
    if how == "similarity":
        return similarity(estimate, truth)
    if how == "rotation":
        return rotation(estimate, truth)
    size = truth.t.new_tensor(scale)
    if how == "pose":
        R = truth.R[at] @ estimate.R[at].mT
        return Similarity(R, truth.t[at] - size * (R @ estimate.t[at]), size)
    from evo.core.geometry import GeometryException, umeyama_alignment

    x, y = (pose.t.numpy().T for pose in (estimate, truth))
    try:
        R, t, found = umeyama_alignment(x * scale if how == "se3" else x, y, with_scale=how == "sim3")
    except GeometryException as error:
        raise ValueError(f"its positions do not tell how it lies to the truth's: {error}") from error
    return Similarity(torch.from_numpy(R), torch.from_numpy(t), torch.as_tensor(found * 1.0).to(truth.t) if how == "sim3" else size)


def absolute(estimate: Trajectory, truth: Trajectory, best: Similarity) -> tuple[Statistics, Statistics]:
    """Of positions, m, and orientations, deg, at the estimate's times, without evo."""
    return tuple(_statistics(error) for error in errors(estimate, truth, best))  # type: ignore[return-value]


def evo_absolute(estimate: Trajectory, truth: Trajectory, best: Similarity) -> tuple[Statistics, Statistics]:
    """The same as evo's APE has it, translation part and rotation angle."""
    from evo.core import metrics

    pair = _path(truth.at(estimate.time)), _path(best @ estimate.pose)
    return tuple(  # type: ignore[return-value]
        _evo(metrics.APE(relation), pair) for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg)
    )


def evo_relative(estimate: Trajectory, truth: Trajectory, best: Similarity, delta: int) -> tuple[int, Statistics, Statistics]:
    """evo's RPE over delta µs, from each of the estimate's poses on where one follows: how many pairs, of positions, orientations.

    The pose at the end of the stretch is interpolated, unless the estimate has a gap above GAP there.
    """
    from evo.core import metrics

    end = estimate.time + delta
    after = torch.searchsorted(estimate.time, end).clamp_max(len(estimate) - 1)
    known = (end <= estimate.time[-1]) & (end <= truth.time[-1]) & (estimate.time[after] - estimate.time[(after - 1).clamp_min(0)] <= GAP)
    count = int(known.sum())
    if not count:
        return 0, {}, {}
    times = torch.cat([estimate.time[known], end[known]])
    pair = _path(truth.at(times)), _path(best @ estimate.at(times))
    relations = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg
    # begins first, ends behind: all pairs so many frames apart are ours
    found = [_evo(metrics.RPE(relation, count, metrics.Unit.frames, all_pairs=True), pair) for relation in relations]
    return count, found[0], found[1]


def _path(pose: Pose) -> Any:
    """Poses [M] as evo's."""
    from evo.core.trajectory import PosePath3D

    matrix = torch.eye(4, dtype=torch.float64).repeat(len(pose.t), 1, 1)
    matrix[:, :3, :3], matrix[:, :3, 3] = pose.R, pose.t
    return PosePath3D(poses_se3=list(matrix.numpy()))


def _evo(metric: Any, pair: tuple[Any, Any]) -> Statistics:
    metric.process_data(pair)
    return {name: float(value) for name, value in metric.get_all_statistics().items() if name in KEPT}


def _statistics(error: Tensor) -> Statistics:
    values = error.numpy()
    rmse = float(np.sqrt(np.mean(np.square(values))))
    return dict(zip(KEPT, (rmse, *(float(of(values)) for of in (np.mean, np.median, np.std, np.max))), strict=True))
