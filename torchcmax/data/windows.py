"""Datasets of windows over recordings of any format, for a plain DataLoader with any number of workers."""

from __future__ import annotations

import hashlib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info
from tqdm import tqdm

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.core.pose import Trajectory
from torchcmax.data.sample import Sample, labelled
from torchcmax.io import DataError, Events, OpenOptions, Recording, open, save
from torchcmax.io.events import Packed

Transform = Callable[[Sample, torch.Generator], Sample]
MOST_HELD = 1 << 24  # events of a recording that are held in memory, 220 MB


@dataclass(frozen=True)
class Source:
    """What is known of a recording.  number: its place in the dataset."""

    number: int
    path: Path
    camera: Camera
    truth: Trajectory | None
    plane: Plane | None

    @classmethod
    def of(cls, number: int, recording: Recording) -> Source:
        table_of(recording.camera)  # now, so that workers that are forked have it
        return cls(number, recording.path, recording.camera, recording.truth, recording.plane)

    def sample(self, events: Events, first: int, before: int = 0) -> Sample:
        """A window of events, the first of which has a number; `before` more that come before it are looked at for their order.

        DataError where they are out of order or off the sensor.
        """
        if (late := events.t[1:] < events.t[:-1]).any():
            place = f"event {first - before + int(late.argmax()) + 2}"
            remedy = f"convert it, which sorts it: torchcmax convert {self.path} sorted.h5"
            raise DataError(self.path, f"{place} is earlier than the one before it", remedy, place)
        events = events[before:]
        try:
            window = Packed.of(events.strided(len(events), 1), self.camera.size).window(table_of(self.camera))
        except ValueError as error:
            raise DataError(self.path, str(error), "give the sensor's true size", f"events {first + 1} to {first + len(events)}") from error
        return labelled(window, self.number, first, int(events.t[-1]), self.truth, self.plane)


@dataclass(frozen=True)
class Store:
    """A recording whose events can be read anywhere.  read: from event, to event."""

    source: Source
    count: int
    read: Callable[[int, int], Events]

    @classmethod
    def of(cls, number: int, recording: Recording, cache: Path | None = None) -> Store:
        """A file that can be read anywhere is left where it is; another is converted into the cache, or held in memory."""
        if recording.pieces is None and cache is not None and recording.path.exists():
            recording = open(_converted(recording, cache))
        if recording.pieces is not None and recording.count is not None:
            return cls(Source.of(number, recording), recording.count, recording.pieces)
        held = _Held(recording)
        return cls(Source.of(number, recording), len(held.events), held)

    def windows(self, events: int, stride: int) -> int:
        """How many windows there are; DataError where there is none."""
        if self.count < events:
            problem = f"holds {self.count} events, fewer than one window of {events}"
            raise DataError(self.source.path, problem, f"take smaller windows: events={self.count}")
        return (self.count - events) // stride + 1

    def sample(self, first: int, events: int) -> Sample:
        before = min(first, 1)
        return self.source.sample(self.read(first - before, first + events), first, before)


@lru_cache(maxsize=16)
def table_of(camera: Camera) -> Tensor:
    """The ray of every pixel, [H * W, 3] float32."""
    return camera.rays().view(-1, 3).float()


class _Held:
    """All events of a recording, in memory."""

    def __init__(self, recording: Recording) -> None:
        parts, count = [], 0
        for chunk in recording.chunks():
            parts.append(chunk)
            count += len(chunk)
            if count > MOST_HELD:
                remedy = f"give a folder as cache, or convert it once: torchcmax convert {recording.path} {recording.name}.h5"
                raise DataError(recording.path, f"has more than {MOST_HELD} events, too many to be held in memory", remedy)
        if not parts:
            raise DataError(recording.path, "holds no events", "record or copy it again")
        self.events = Events.join(parts)

    def __call__(self, start: int, stop: int) -> Events:
        return self.events[start:stop]


def _converted(recording: Recording, cache: Path) -> Path:
    """Our own file of a recording, in the cache; made where it is not there, and again where the recording has changed."""
    path = recording.path.resolve()
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    state = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file()]
    truth = recording.truth
    known = None if truth is None else [part.numpy().tobytes() for part in (truth.time, truth.pose.R, truth.pose.t)]
    digest = hashlib.sha256(repr((state, recording.camera, recording.plane, known)).encode()).hexdigest()[:12]
    own = cache / f"{recording.name}-{digest}.h5"
    if not own.is_file():
        cache.mkdir(parents=True, exist_ok=True)
        with tqdm(total=recording.count, unit=" events", unit_scale=True, desc=f"converting {recording.name}") as bar:
            save(recording, own, lambda events: bar.update(events - bar.n))
    return own


class _Windows:
    """What both datasets share: how windows are cut, and the chance that augmentations are given."""

    def __init__(self, events: int, stride: int | None, transform: Transform | None, seed: int) -> None:
        self.events, self.stride = events, events if stride is None else stride
        if self.events < 2 or self.stride < 1:
            raise ValueError(f"a window wants at least 2 events and a stride of at least 1, got {events}, {stride}")
        if seed < 0:
            raise ValueError(f"a seed is at least 0, got {seed}")
        self.transform, self.seed = transform, seed
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # workers that live on see it change

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if not self._epoch.is_shared():  # a copy has its own
            self._epoch = self._epoch.clone().share_memory_()

    def set_epoch(self, epoch: int) -> None:
        """Other augmentations and another order of a stream in every epoch, as of torch's DistributedSampler."""
        self._epoch.fill_(epoch)

    def _chance(self, *numbers: int) -> torch.Generator:
        """The same for the same seed, epoch and numbers, in whichever worker."""
        entropy = np.random.SeedSequence([self.seed, int(self._epoch), *numbers]).generate_state(1, np.uint64)
        return torch.Generator().manual_seed(int(entropy[0] >> 1))

    def _transformed(self, sample: Sample, number: int) -> Sample:
        return sample if self.transform is None else self.transform(sample, self._chance(number))


def _listed(recordings: Sequence[Recording | Path | str] | Recording | Path | str) -> list[Recording | Path | str]:
    listed = [recordings] if isinstance(recordings, Recording | Path | str) else [*recordings]
    if not listed:
        raise ValueError("a dataset wants at least one recording")
    return listed


class WindowDataset(_Windows, Dataset[Sample]):
    """Windows of one or many recordings, each by its number: `dataset[i]` is a Sample of one window.

    recordings: paths of any format that `torchcmax.open` reads, or recordings | events: per window | stride: events from one window to the
    next, by default end to end | transform: sample, generator -> sample, as `Augment` | seed: of the transform's chance
    cache: a folder for copies of recordings that cannot be read anywhere, as all but HDF5 | options: how paths are opened

    Each worker of a DataLoader opens its own files; `collate` is its collate_fn.  The same number is the same sample with any number of
    workers.  DataError: what `open` says; a recording of fewer events than a window; one that is too long to be held in memory.
    """

    def __init__(
        self,
        recordings: Sequence[Recording | Path | str] | Recording | Path | str,
        events: int = 30_000,
        stride: int | None = None,
        transform: Transform | None = None,
        seed: int = 0,
        cache: Path | str | None = None,
        options: OpenOptions | None = None,
    ) -> None:
        super().__init__(events, stride, transform, seed)
        opened = (r if isinstance(r, Recording) else open(r, options) for r in _listed(recordings))
        self.stores = [Store.of(i, recording, None if cache is None else Path(cache)) for i, recording in enumerate(opened)]
        self._ends = [*accumulate(store.windows(self.events, self.stride) for store in self.stores)]

    @property
    def cameras(self) -> list[Camera]:
        """Of each recording."""
        return [store.source.camera for store in self.stores]

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, number: int) -> Sample:
        if not -len(self) <= number < len(self):
            raise IndexError(f"there are {len(self)} windows, asked for number {number}")
        number %= len(self)
        which = bisect_right(self._ends, number)
        first = (number - (self._ends[which - 1] if which else 0)) * self.stride
        return self._transformed(self.stores[which].sample(first, self.events), number)


class WindowStream(_Windows, IterableDataset[Sample]):
    """Windows of one or many recordings of any format, one after the other; nothing is converted or held.

    recordings, events, stride, transform, seed, options: as of `WindowDataset`
    shuffle: windows that wait in a buffer from which one is drawn at random, 0 for the order of the recordings
    shard: (rank, ranks), which part of the windows this process is to give

    The windows are dealt out in turn among ranks and workers: each comes once.  Where a file cannot be read anywhere, every worker reads
    all of it, and makes rays and transforms of its own windows only.
    """

    def __init__(
        self,
        recordings: Sequence[Recording | Path | str] | Recording | Path | str,
        events: int = 30_000,
        stride: int | None = None,
        transform: Transform | None = None,
        seed: int = 0,
        shuffle: int = 0,
        shard: tuple[int, int] = (0, 1),
        options: OpenOptions | None = None,
    ) -> None:
        super().__init__(events, stride, transform, seed)
        if shuffle < 0 or not 0 <= shard[0] < shard[1]:
            raise ValueError(f"a stream wants a buffer of 0 or more and a rank below the number of ranks, got {shuffle}, {shard}")
        self.recordings, self.shuffle, self.shard, self.options = _listed(recordings), shuffle, shard, options

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        own, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        rank, ranks = self.shard
        part, parts = own * ranks + rank, ranks * workers
        mine = (self._transformed(sample, number) for number, sample in self._windows(part, parts))
        return _shuffled(mine, self.shuffle, self._chance(part, parts)) if self.shuffle else mine

    def _windows(self, part: int, parts: int) -> Iterator[tuple[int, Sample]]:
        """Every parts-th window from number `part` on, with its number."""
        number = 0
        for which, listed in enumerate(self.recordings):
            recording = listed if isinstance(listed, Recording) else open(listed, self.options)
            if recording.pieces is not None and recording.count is not None:
                store = Store.of(which, recording)
                count = store.windows(self.events, self.stride)
                for i in range((part - number) % parts, count, parts):
                    yield number + i, store.sample(i * self.stride, self.events)
            else:
                count, source = 0, Source.of(which, recording)
                for block in recording.blocks(self.events, self.stride, 1):
                    if (number + count) % parts == part:
                        yield number + count, source.sample(block[0], count * self.stride)
                    count += 1
            number += count


def _shuffled(samples: Iterator[Sample], size: int, chance: torch.Generator) -> Iterator[Sample]:
    """The same samples; each waits in a buffer until it is drawn."""
    waiting: list[Sample] = []
    for sample in samples:
        if len(waiting) < size:
            waiting.append(sample)
            continue
        i = int(torch.randint(size, (), generator=chance))
        yield waiting[i]
        waiting[i] = sample
    for i in torch.randperm(len(waiting), generator=chance).tolist():
        yield waiting[i]
