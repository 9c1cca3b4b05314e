"""Augmentations that keep the geometry right: a sample and its truth stay what some camera could have seen."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.window import Window
from torchcmax.data.sample import Sample


def flip(sample: Sample, which: Tensor, axis: int) -> Sample:
    """Some samples in a mirror: axis 0 changes left and right, 1 up and down, about the optical axis.  which [B] bool.

    A mirror S turns velocities and normals to S v, and the axial omega to -S omega; poses are those of the mirrored world, S R S and S t.
    """
    mirror = torch.ones(len(sample), 3, device=sample.omega.device, dtype=sample.omega.dtype)
    mirror[which, axis] = -1
    turned = mirror * mirror.prod(-1, keepdim=True)
    window = replace(sample.window, ray=sample.window.ray * mirror[:, None].to(sample.window.ray))
    R = mirror[:, :, None] * sample.R * mirror[:, None]
    return replace(
        sample,
        window=window,
        omega=sample.omega * turned,
        velocity=sample.velocity * mirror,
        normal=sample.normal * mirror,
        R=R,
        t=sample.t * mirror,
    )


def reverse(sample: Sample, which: Tensor) -> Sample:
    """Some samples backwards in time: the last event is the first, and what became brighter becomes darker.  which [B] bool.

    The camera at the last event is the new reference: the motion is seen from there, back, as are plane and pose.
    """
    window = sample.window
    order = torch.where(which[:, None], _backwards(window), torch.arange(window.ray.shape[1], device=which.device))
    dt = torch.where(which[:, None], window.duration[:, None] - window.dt, window.dt).gather(1, order)
    polarity = torch.where(which[:, None], -window.polarity, window.polarity).gather(1, order)
    ray = window.ray.gather(1, order[..., None].expand_as(window.ray))
    last = sample.displacement().seen_at(1.0)
    seconds = window.duration[:, None]
    back = -last.shift / torch.where(seconds > 0, seconds, 1.0)
    back = torch.where(sample.velocity == 0, 0.0, back)  # known even where the plane is not
    step = sample.velocity * seconds * sample.distance[:, None]
    step = torch.where(sample.velocity == 0, 0.0, step)
    there = {
        "omega": -sample.omega,
        "velocity": back,
        "normal": last.normal,
        "distance": sample.distance * (1 + (sample.normal * sample.velocity * seconds).sum(-1)),
        "R": sample.R @ so3.exp(sample.omega * seconds),
        "t": sample.t + (sample.R @ step[..., None])[..., 0],
    }
    chosen = {name: torch.where(which.view(-1, *[1] * (new.ndim - 1)), new, getattr(sample, name)) for name, new in there.items()}
    return replace(sample, window=Window(ray, dt.clamp_min(0), polarity, window.start, window.duration), **chosen)


def _backwards(window: Window) -> Tensor:
    """Indices of events from the last to the first, the padding at the end left where it is: -> [B, N]."""
    place = torch.arange(window.ray.shape[1], device=window.ray.device)
    length = (place + 1).mul(window.polarity != 0).amax(1, keepdim=True)
    return torch.where(place < length, length - 1 - place, place)


def drop(sample: Sample, share: float, chance: torch.Generator) -> Sample:
    """Takes a share of the events away at random: their polarity becomes 0, as of padding."""
    kept = _random(sample.window.polarity, chance) >= share
    return replace(sample, window=replace(sample.window, polarity=sample.window.polarity * kept))


def disturb(sample: Sample, share: float, camera: Camera, chance: torch.Generator) -> Sample:
    """Adds events that mean nothing, anywhere on the sensor at any time of the window: a share of the number that is there."""
    window = sample.window
    count = round(share * window.ray.shape[1])
    if not count:
        return sample
    u, v, when, sign = (_random(window.dt[:, :1].expand(-1, count), chance) for _ in range(4))
    (height, width), canvas = camera.size, Canvas.around(camera, 0.0)
    xy = torch.stack([u * (width - 1) - canvas.centre[0], v * (height - 1) - canvas.centre[1]], -1) / canvas.focal
    ray = torch.cat([window.ray, torch.cat([xy, torch.ones_like(xy[..., :1])], -1)], 1)
    dt = torch.cat([window.dt, when * window.duration[:, None]], 1)
    real = (window.polarity != 0).any(1, keepdim=True)  # nothing is added where nothing is
    polarity = torch.cat([window.polarity, torch.where(sign < 0.5, -1.0, 1.0) * real], 1)
    dt, order = dt.sort(stable=True, dim=1)
    parts = ray.gather(1, order[..., None].expand_as(ray)), dt, polarity.gather(1, order), window.start, window.duration
    return replace(sample, window=Window(*parts))


def crop(sample: Sample, canvas: Canvas, corner: Tensor, size: tuple[float, float]) -> Sample:
    """Keeps the events in one rectangle of each window; the others become padding.  The camera stays what it is, and so does the truth.

    corner [B, 2] px (x, y) of the canvas | size (height, width) px
    """
    xy = canvas.pixels(sample.window.ray)
    inside = ((xy >= corner[:, None]) & (xy <= corner[:, None] + corner.new_tensor([size[1], size[0]]))).all(-1)
    return replace(sample, window=replace(sample.window, polarity=sample.window.polarity * inside))


@dataclass(frozen=True)
class Augment:
    """A `transform` of the datasets: all of these by chance, the truth with them.  Works on batches [B, N] too, each window by itself.

    camera: whose rectangle noise and crops are of | mirror, upturn, backwards: probabilities | dropout: the largest share of events that is
    taken away | noise: the largest share that is added | crop: the smallest share of the sensor's height and width that is kept
    """

    camera: Camera
    mirror: float = 0.5
    upturn: float = 0.5
    backwards: float = 0.5
    dropout: float = 0.1
    noise: float = 0.02
    crop: float = 1.0

    def __post_init__(self) -> None:
        for f in fields(self)[1:]:
            if not 0 <= getattr(self, f.name) <= 1:
                raise ValueError(f"{f.name} wants 0 to 1, got {getattr(self, f.name)}")

    def __call__(self, sample: Sample, chance: torch.Generator) -> Sample:
        chances = _random(sample.omega.new_empty(len(sample), 5), chance)
        sample = flip(sample, chances[:, 0] < self.mirror, 0)
        sample = flip(sample, chances[:, 1] < self.upturn, 1)
        sample = reverse(sample, chances[:, 2] < self.backwards)
        more = torch.rand(3, generator=chance, device=chance.device).tolist()
        if self.crop < 1:
            canvas = Canvas.around(self.camera, 0.0)
            share = self.crop + (1 - self.crop) * more[0]
            height, width = (share * (n - 1) for n in canvas.size)
            corner = chances[:, 3:] * chances.new_tensor([canvas.size[1] - 1 - width, canvas.size[0] - 1 - height])
            sample = crop(sample, canvas, corner, (height, width))
        return disturb(drop(sample, self.dropout * more[1], chance), self.noise * more[2], self.camera, chance)


def _random(like: Tensor, chance: torch.Generator) -> Tensor:
    """Uniform numbers of this shape and precision, drawn where the generator is."""
    return torch.rand(like.shape, generator=chance, device=chance.device).to(like)
