"""Windows with what is known of them: the camera's motion, its pose and plane, and the flow that follows from these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.camera import Canvas
from torchcmax.core.model import Displacement
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.core.window import Window
from torchcmax.data.represent import exact


@dataclass(frozen=True)
class Sample:
    """B windows and their ground truth, in the frame of the camera at each window's first event; NaN where it is not known.

    window [B, N] | recording [B], event [B] int64: which recording, and which of its events is the window's first, both from 0
    omega [B, 3] rad/s | velocity [B, 3] plane distances/s, 0 where the camera does not move | normal [B, 3], unit, towards the camera
    distance [B] m of the plane | R [B, 3, 3], t [B, 3] m: the camera's pose T_wc at the window's first event
    All but the integers are of the windows' precision.  A window without duration has a pose, but no motion that is known.
    """

    window: Window
    recording: Tensor
    event: Tensor
    omega: Tensor
    velocity: Tensor
    normal: Tensor
    distance: Tensor
    R: Tensor
    t: Tensor

    def __len__(self) -> int:
        return len(self.window)

    def __getitem__(self, index: slice | Tensor) -> Sample:
        return Sample(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def known(self) -> Tensor:
        """Which windows have a true motion: [B] bool.  `sample[sample.known]` are those."""
        return self.omega.isfinite().all(-1) & self.velocity.isfinite().all(-1)

    def displacement(self) -> Displacement:
        """The true motion over each window, for `Displacement.homography`, which the representations take."""
        seconds = self.window.duration[:, None]
        return Displacement(self.omega * seconds, self.velocity * seconds, self.normal)

    @exact
    def flow(self, canvas: Canvas, at: float = 0.5) -> Tensor:
        """True optical flow, px over the whole window, of what each pixel of the canvas sees at a time, a share of the window.

        -> [B, 2, H, W], NaN where a pixel does not see the plane.  At the middle, 0.5, it is what `FlowContrastLoss` wants of its flow; at
        0 it is the flow of DSEC and MVSEC, from where a point is at the beginning.  A camera that only turns needs no plane.
        """
        (height, width), there = canvas.size, self.displacement()
        still = (there.shift == 0).all(-1, keepdim=True)
        there = replace(there, normal=torch.where(still, there.normal.new_tensor([0.0, 0.0, -1.0]), there.normal)).seen_at(at)
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixel = torch.stack([x, y], -1).view(-1, 2).to(self.omega)
        ray = torch.cat([(pixel - pixel.new_tensor(canvas.centre)) / canvas.focal, torch.ones_like(pixel[:, :1])], -1)
        rays = [_seen_after(there, ray, share - at) for share in (0.0, 1.0)]
        begin, end = (canvas.pixels(one) for one in rays)
        seen = (ray @ there.normal[..., None])[..., 0] < 0
        seen = (seen | still) & canvas.sees(rays[0]) & canvas.sees(rays[1])
        return torch.where(seen[..., None], end - begin, torch.nan).mT.reshape(len(self), 2, height, width)

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None, non_blocking: bool = False) -> Sample:
        """The same elsewhere, or in another precision; integers stay what they are."""

        def moved(value: Tensor) -> Tensor:
            return value.to(device, dtype if value.is_floating_point() else None, non_blocking=non_blocking)

        window = Window(*(moved(getattr(self.window, f.name)) for f in fields(Window)))
        return Sample(window, *(moved(getattr(self, f.name)) for f in fields(self)[1:]))

    def pin_memory(self) -> Sample:
        """In memory that a GPU reads by itself, as a DataLoader with pin_memory=True asks for."""
        window = Window(*(getattr(self.window, f.name).pin_memory() for f in fields(Window)))
        return Sample(window, *(getattr(self, f.name).pin_memory() for f in fields(self)[1:]))


def _seen_after(there: Displacement, ray: Tensor, share: float) -> Tensor:
    """Where points of the plane that are seen along rays [M, 3] are seen a share of the window later: -> rays [B, M, 3], up to scale."""
    point = ray + share * there.shift[:, None] * (ray @ there.normal[..., None])
    return point @ so3.exp(share * there.turn)


def collate(samples: Sequence[Sample]) -> Sample:
    """Samples as one batch; shorter windows are padded with polarity 0.  The `collate_fn` of a DataLoader."""
    window = Window.join([sample.window for sample in samples])
    return Sample(window, *(torch.cat([getattr(sample, f.name) for sample in samples]) for f in fields(Sample)[1:]))


def labelled(window: Window, recording: int, event: int, end: int, truth: Trajectory | None, plane: Plane | None) -> Sample:
    """One window [1, N] with the truth of its recording, where that covers it.  end: µs, time of its last event."""
    like, number = window.ray, torch.tensor([[recording], [event]])

    def unknown(*shape: int) -> Tensor:
        return like.new_full((1, *shape), torch.nan)

    found = Sample(window, number[0], number[1], unknown(3), unknown(3), unknown(3), unknown(), unknown(3, 3), unknown(3))
    start = int(window.start)
    if truth is None or start < truth.time[0] or end > truth.time[-1]:
        return found
    poses = truth.at(torch.tensor([start, end]))
    pose = poses[:1]
    found = replace(found, R=pose.R.to(like), t=pose.t.to(like))
    seen = None if plane is None else plane.seen_from(pose)
    if seen is not None:
        found = replace(found, normal=seen.normal.to(like), distance=seen.distance.to(like))
    if end == start:
        return found
    step, seconds = pose.inverse() @ poses[1:], (end - start) * 1e-6
    velocity = torch.where(step.t == 0, 0.0, torch.nan) if seen is None else step.t / seconds / seen.distance[:, None]
    return replace(found, omega=(so3.log(step.R) / seconds).to(like), velocity=velocity.to(like))
