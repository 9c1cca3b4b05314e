"""Recordings for the examples: a small camera that only turns, simulated on first use; unseen ones have other textures and motions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from torch.utils.data import DataLoader, Dataset

from torchcmax.core.camera import Camera
from torchcmax.data import Sample, WindowDataset, collate
from torchcmax.io import Events, save
from torchcmax.simulator import Simulation, simulate

EVENTS = 5000  # of a window: some 2 to 8 px of motion on this sensor


@dataclass(frozen=True)
class Take:
    """Part of a simulated recording.  speed: how fast it goes along its path | begin, end: of the path, s at speed 1."""

    scene: str
    motion: str
    seed: int
    speed: float
    begin: float
    end: float
    noise: float = 1.0

    def file(self, folder: Path) -> Path:
        """Our HDF5 file of it, simulated where it is not there yet."""
        path = folder / f"{self.scene}_{self.motion}_{self.seed}_{self.speed:g}_{self.begin:g}_{self.end:g}.h5"
        if not path.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            options = Simulation(
                scene=self.scene, motion=self.motion, seed=self.seed, speed=self.speed, duration=self.end / self.speed, noise=self.noise,
                width=120, height=90, focal=100.0,
            )  # fmt: skip
            whole, first = simulate(options), self.begin / self.speed * 1e6

            def later() -> Iterator[Events]:
                return (chunk[chunk.t >= first] for chunk in whole.chunks())

            save(replace(whole, chunks=later), path)
        return path


# The simulator's planes all turn along one path, so the unseen ones take a later stretch of it.  No network is shown a panorama: neither
# its texture nor its motions.  The scene "lines" is left out: on so few pixels its own contrast does not peak at the truth.
SEEN = [
    Take("poster", "rotation", 1, 1.0, 0.0, 2.5),
    Take("poster", "rotation", 2, 2.0, 0.0, 2.5, noise=3.0),
    Take("poster", "rotation", 3, 0.5, 0.0, 2.5),
    Take("shapes", "rotation", 4, 1.0, 0.0, 2.5),
    Take("shapes", "rotation", 5, 2.0, 0.0, 2.5, noise=3.0),
    Take("shapes", "rotation", 6, 3.0, 0.0, 2.5),
]
UNSEEN = [
    Take("poster", "rotation", 101, 1.5, 2.5, 4.0),
    Take("shapes", "rotation", 102, 0.8, 2.5, 4.0),
    Take("panorama", "rotation", 103, 1.0, 0.0, 2.0),
    Take("panorama", "sweep", 104, 1.0, 0.0, 1.0),
]
SMALL_SEEN, SMALL_UNSEEN = [Take("shapes", "rotation", 4, 2.0, 0.0, 0.6)], [Take("shapes", "rotation", 102, 2.0, 0.6, 0.9)]


class Held(Dataset[Sample]):
    """Windows that are read once, as so few fit into memory.  Give a DataLoader the WindowDataset itself, and workers, if yours do not."""

    def __init__(self, windows: WindowDataset) -> None:
        self.samples = [windows[i] for i in range(len(windows))]

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, number: int) -> Sample:
        return self.samples[number]


def loaders(cache: Path, small: bool) -> tuple[DataLoader[Sample], DataLoader[Sample], Camera]:
    """Batches of windows to train with, shuffled, and of unseen ones in order; the camera of all."""
    seen, unseen = ([take.file(cache) for take in takes] for takes in ((SMALL_SEEN, SMALL_UNSEEN) if small else (SEEN, UNSEEN)))
    train, test = WindowDataset(seen, EVENTS, stride=EVENTS // 2), WindowDataset(unseen, EVENTS)
    batch = 8 if small else 32
    return (
        DataLoader(Held(train), batch, shuffle=True, drop_last=True, collate_fn=collate),
        DataLoader(Held(test), batch, collate_fn=collate),
        train.cameras[0],
    )
