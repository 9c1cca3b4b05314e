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


@dataclass(frozen=True)
class Sample:
    """B windows and their ground truth, in the frame of the camera at each window's first event; NaN where it is not known.

    window [B, N] | recording [B], event [B] int64: which recording, and which of its events is the window's first, both from 0
    omega [B, 3] rad/s | velocity [B, 3] plane distances/s, 0 where the camera does not move | normal [B, 3], unit, towards the camera
    distance [B] m of the plane | R [B, 3, 3], t [B, 3] m: the camera's pose T_wc at the window's first event
    All but the integers are of the windows' precision.
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

    def displacement(self) -> Displacement:
        """The true motion over each window, for `Displacement.homography`, which the representations take."""
        seconds = self.window.duration[:, None]
        return Displacement(self.omega * seconds, self.velocity * seconds, self.normal)

    def flow(self, canvas: Canvas, at: float = 0.5) -> Tensor:
        """True optical flow, px over the whole window, of what each pixel of the canvas sees at a time, a share of the window.

        -> [B, 2, H, W].  At the middle, 0.5, it is what `FlowContrastLoss` wants of its flow; at 0 it is the flow of DSEC and MVSEC,
        from where a point is at the beginning.  A camera that only turns needs no plane.
        """
        (height, width), there = canvas.size, self.displacement()
        still = (there.shift == 0).all(-1, keepdim=True)
        there = replace(there, normal=torch.where(still, there.normal.new_tensor([0.0, 0.0, -1.0]), there.normal)).seen_at(at)
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixel = torch.stack([x, y], -1).view(-1, 2).to(self.omega)
        ray = torch.cat([(pixel - pixel.new_tensor(canvas.centre)) / canvas.focal, torch.ones_like(pixel[:, :1])], -1)
        begin, end = (canvas.pixels(_seen_after(there, ray, share - at)) for share in (0.0, 1.0))
        return (end - begin).mT.reshape(len(self), 2, height, width)

    def to(self, device: torch.device | str, dtype: torch.dtype) -> Sample:
        """The same elsewhere, or in another precision; integers stay what they are."""
        rest = (getattr(self, f.name) for f in fields(self)[1:])
        moved = (value.to(device, dtype) if value.is_floating_point() else value.to(device) for value in rest)
        return Sample(self.window.to(device, dtype), *moved)

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


def labelled(window: Window, recording: int, event: int, truth: Trajectory | None, plane: Plane | None) -> Sample:
    """One window [1, N] with the truth of its recording, where that covers it."""
    like, number = window.ray, torch.tensor([[recording], [event]])

    def unknown(*shape: int) -> Tensor:
        return like.new_full((1, *shape), torch.nan)

    found = Sample(window, number[0], number[1], unknown(3), unknown(3), unknown(3), unknown(), unknown(3, 3), unknown(3))
    end = window.start + (window.duration.double() * 1e6).round().long()
    if truth is None or window.start < truth.time[0] or end > truth.time[-1]:
        return found
    pose, motion = truth.at(window.start), truth.motion(window.start, window.duration)
    velocity = torch.where(motion.velocity == 0, 0.0, torch.nan)
    if plane is not None:
        seen = plane.seen_from(pose)
        velocity = motion.velocity / seen.distance[:, None]
        found = replace(found, normal=seen.normal.to(like), distance=seen.distance.to(like))
    return replace(found, omega=motion.omega.to(like), velocity=velocity.to(like), R=pose.R.to(like), t=pose.t.to(like))
