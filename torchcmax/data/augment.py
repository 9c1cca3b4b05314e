"""Augmentations that keep the geometry right: a sample and its truth stay what some camera could have seen."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchcmax.core import so3
from torchcmax.core.camera import Camera
from torchcmax.core.window import Window
from torchcmax.data.represent import exact
from torchcmax.data.sample import Sample
from torchcmax.data.windows import table_of


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

    The camera at the last event is the new reference: the motion is seen from there, back, as are plane and pose.  `start` and `event`
    stay those of the stretch.
    """
    window = sample.window
    order = torch.where(which[:, None], _backwards(window), torch.arange(window.ray.shape[1], device=which.device))
    dt = torch.where(which[:, None], window.duration[:, None] - window.dt, window.dt).gather(1, order)
    polarity = torch.where(which[:, None], -window.polarity, window.polarity).gather(1, order)
    ray = window.ray.gather(1, order[..., None].expand_as(window.ray))
    last = sample.displacement().seen_at(1.0)
    seconds = window.duration[:, None]
    back = -last.shift / torch.where(seconds > 0, seconds, 1.0)
    still = (sample.velocity == 0).all(-1, keepdim=True)  # known even where the plane is not
    back = torch.where(still, 0.0, back)
    step = torch.where(still, 0.0, sample.velocity * seconds * sample.distance[:, None])
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
    """Adds events that mean nothing, at any pixel at any time of the window: a share of the number that each window has."""
    window = sample.window
    wanted = (share * (window.polarity != 0).sum(1, keepdim=True)).round()
    count = int(wanted.max())
    if not count:
        return sample
    which, when, sign = (_random(window.dt[:, :1].expand(-1, count), chance) for _ in range(3))
    table = table_of(camera).to(window.ray)
    ray = torch.cat([window.ray, table[(which * len(table)).long().clamp_max(len(table) - 1)]], 1)
    dt = torch.cat([window.dt, when * window.duration[:, None]], 1)
    added = torch.arange(count, device=window.ray.device) < wanted
    polarity = torch.cat([window.polarity, torch.where(sign < 0.5, -1.0, 1.0) * added], 1)
    dt, order = dt.sort(stable=True, dim=1)
    parts = ray.gather(1, order[..., None].expand_as(ray)), dt, polarity.gather(1, order), window.start, window.duration
    return replace(sample, window=Window(*parts))


def crop(sample: Sample, least: Tensor, most: Tensor) -> Sample:
    """Keeps the events in one rectangle of each window; the others become padding.  The camera stays what it is, and so does the truth.

    least, most [B, 2]: of the rays' (x, y), so that a distorted sensor has no part that no rectangle reaches
    """
    xy = sample.window.ray[..., :2]
    inside = ((xy >= least[:, None]) & (xy <= most[:, None])).all(-1)
    return replace(sample, window=replace(sample.window, polarity=sample.window.polarity * inside))


@dataclass(frozen=True)
class Augment:
    """A `transform` of the datasets: all of these by chance, the truth with them.  Works on batches [B, N] too, each window by itself.

    camera: whose rectangle noise and crops are of | mirror, upturn, backwards: probabilities | dropout: the largest share of events that is
    taken away | noise: the largest share that is added | crop: the smallest share of the sensor's height and width that is kept.  How much
    is taken, added and kept is one number for all windows of a call; where, and whether to mirror, is each window's own.
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
        return augmented(sample, self, chance)


@exact
def augmented(sample: Sample, by: Augment, chance: torch.Generator) -> Sample:
    """What an `Augment` makes of a sample."""
    chances = _random(sample.omega.new_empty(len(sample), 5), chance)
    sample = flip(sample, chances[:, 0] < by.mirror, 0)
    sample = flip(sample, chances[:, 1] < by.upturn, 1)
    sample = reverse(sample, chances[:, 2] < by.backwards)
    more = torch.rand(3, generator=chance, device=chance.device).tolist()
    if by.crop < 1:
        table = table_of(by.camera)[:, :2].to(chances)
        ends, share = table.abs().amax(0), by.crop + (1 - by.crop) * more[0]  # a mirror leaves them as they are
        least = (2 * chances[:, 3:] * (1 - share) - 1) * ends
        sample = crop(sample, least, least + 2 * share * ends)
    return disturb(drop(sample, by.dropout * more[1], chance), by.noise * more[2], by.camera, chance)


def _random(like: Tensor, chance: torch.Generator) -> Tensor:
    """Uniform numbers of this shape and precision, drawn where the generator is."""
    return torch.rand(like.shape, generator=chance, device=chance.device).to(like)
