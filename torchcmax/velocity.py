"""Angular and linear velocity of windows against ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory


@dataclass(frozen=True)
class Velocities:
    """Of M windows.  start, end [M] int64 µs | at [M] µs: the moment in whose camera frame they are told

    omega [M, 3] rad/s | linear [M, 3] in distances of the plane a second: at that moment, or, where `world`, of the world's unit;
    None where the model has none
    """

    start: Tensor
    end: Tensor
    at: Tensor
    omega: Tensor
    linear: Tensor | None
    world: bool

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, keep: Tensor) -> Velocities:
        linear = None if self.linear is None else self.linear[keep]
        return Velocities(self.start[keep], self.end[keep], self.at[keep], self.omega[keep], linear, self.world)

    def later(self, offset: int) -> Velocities:
        """The same, so many µs later."""
        return Velocities(self.start + offset, self.end + offset, self.at + offset, self.omega, self.linear, self.world)


def within(velocities: Velocities, truth: Trajectory, span: tuple[int, int], smooth: int = 0) -> Velocities:
    """Those that last some time, lie in the span, and whose stretch of the truth is known; smooth: as of `true_velocities`."""
    start, end = _stretch(velocities, smooth)
    keep = (velocities.end > velocities.start) & (velocities.start >= span[0]) & (velocities.end <= span[1])
    return velocities[keep & (start >= truth.time[0]) & (end <= truth.time[-1])]


def true_velocities(velocities: Velocities, truth: Trajectory, smooth: int = 0) -> tuple[Tensor, Tensor]:
    """Mean velocities of the truth over each window, in the camera's frame at its moment: -> rad/s [M, 3], m/s [M, 3].

    smooth: µs; the mean is taken over at least so long about the window's middle, where the truth is too rough for less
    """
    start, end = _stretch(velocities, smooth)
    before, after, frame = truth.at(start), truth.at(end), truth.at(velocities.at).R
    seconds = (end - start).double()[:, None] * 1e-6
    turn = (before.R @ so3.log(before.R.mT @ after.R)[..., None])[..., 0]  # of the world
    return _into(frame, turn) / seconds, _into(frame, after.t - before.t) / seconds


def velocity_errors(
    velocities: Velocities, truth: Trajectory, plane: Plane | None = None, scale: float | None = None, smooth: int = 0
) -> dict[str, float | int | None]:
    """RMSE by axis and of the whole vector, deg/s and m/s; None where nothing is told, or nobody knows how many metres it is.

    plane [1]: of the truth, m, for velocities in its distances | scale: metres per unit of the world, for those of the world
    percent: of the fastest that the truth is
    """
    omega, linear = true_velocities(velocities, truth, smooth)
    found: dict[str, float | int | None] = {"windows": len(velocities)}
    found |= _told("omega", torch.rad2deg(velocities.omega), torch.rad2deg(omega), "deg_s")
    metres: Tensor | None = None
    if velocities.world and scale is not None:
        metres = torch.full_like(omega[:, 0], scale)
    elif not velocities.world and plane is not None:
        there = truth.at(velocities.at)
        metres = Plane(plane.normal.expand(len(velocities), 3), plane.distance.expand(len(velocities))).seen_from(there).distance
    if velocities.linear is not None and metres is not None:
        found |= _told("v", velocities.linear * metres[:, None], linear, "m_s")
    return found


def _stretch(velocities: Velocities, smooth: int) -> tuple[Tensor, Tensor]:
    """From when to when the truth is looked at, µs."""
    lack = (smooth - (velocities.end - velocities.start)).clamp_min(0)
    return velocities.start - lack // 2, velocities.end + lack - lack // 2


def _into(frame: Tensor, vector: Tensor) -> Tensor:
    """Vectors of the world in the camera's frame: [M, 3, 3], [M, 3] -> [M, 3]."""
    return (frame.mT @ vector[..., None])[..., 0]


def _told(name: str, estimate: Tensor, truth: Tensor, unit: str) -> dict[str, float | int | None]:
    """Errors of vectors [M, 3]."""
    error = estimate.double() - truth
    rmse = error.square().mean(0).sqrt().tolist()
    whole, fastest = float(error.square().sum(-1).mean().sqrt()), float(truth.norm(dim=-1).max())
    found: dict[str, float | int | None] = {f"{name}_{axis}_rmse_{unit}": value for axis, value in zip("xyz", rmse, strict=True)}
    percent = 100 * whole / fastest if fastest > 0 else None
    return found | {f"{name}_rmse_{unit}": whole, f"{name}_max_{unit}": float(error.norm(dim=-1).max()), f"{name}_percent": percent}
