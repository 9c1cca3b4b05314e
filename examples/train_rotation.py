"""A small network tells how a camera turns, omega [3] rad/s, from a voxel grid.  Nobody shows it the truth: it learns from contrast alone.

    python examples/train_rotation.py --out logs/train_rotation --minutes 5
    tensorboard --logdir logs/train_rotation

Then it meets windows of other textures and motions, against the truth, and against the optimizer, of which it is the warm start.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, repeat
from pathlib import Path
from time import monotonic

import torch
from jsonargparse import auto_cli
from recordings import loaders
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.estimate import Search
from torchcmax.core.window import Window
from torchcmax.data import Augment, Sample, voxel_grid
from torchcmax.nn import Compensate, ContrastLoss
from torchcmax.nn.image import displacement
from torchcmax.picture import pictures


class TurnNet(nn.Module):
    """Windows -> omega [B, 3] rad/s, in two looks: at the events as they came, and at what motion is left in them.

    Convolutions see local motion, which is the same all over the image; how a turn moves each place is geometry, and need not be learned.
    So the network tells a flow for each cell, and how sure it is of it in which direction (an edge shows only the motion across it); the
    turn that fits all cells best is a least-squares problem of three unknowns.  A window has a number of events, not a duration: flows and
    turns are over the window, and only the result is divided by its seconds.
    """

    def __init__(self, camera: Camera, bins: int = 5, width: int = 32) -> None:
        super().__init__()
        self.canvas, self.bins = Canvas.around(camera, 0.0).scaled(0.5), bins
        self.layers = nn.Sequential(
            nn.Conv2d(bins, width, 5, 2, 2), nn.ReLU(), nn.Conv2d(width, width, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(width, 2 * width, 3, 2, 1), nn.ReLU(), nn.Conv2d(2 * width, 2 * width, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(2 * width, 5, 1),
        )  # fmt: skip
        rows, columns = (torch.arange(-(-n // 4)) * 4.0 for n in self.canvas.size)
        y, x = torch.meshgrid(rows - self.canvas.centre[1], columns - self.canvas.centre[0], indexing="ij")
        x, y = x / self.canvas.focal, y / self.canvas.focal
        flow = [x * y, -1 - x * x, y, 1 + y * y, -x * y, -x]  # of a point on the plane z = 1 by a turn about x, y, z
        self.register_buffer("flow", torch.stack(flow, -1).view(-1, 2, 3), persistent=False)

    def forward(self, window: Window) -> Tensor:
        first: Tensor = self.look(window, torch.zeros_like(window.ray[:, 0]))
        return first + self.look(window, first.detach())  # what the first look got wrong is smaller, and easier to see

    def look(self, window: Window, omega: Tensor) -> Tensor:
        """The turn that is left when the events are compensated by omega: [B, 3] rad/s."""
        H_k = displacement(window, omega, None, None, 0.5).homography()
        grid = voxel_grid(window, self.canvas, self.bins, H_k)
        grid = grid / (5 * grid.abs().mean((1, 2, 3), keepdim=True)).clamp_min(1e-6)  # as if all had the same number of events a pixel
        u, v, *sure = self.layers(grid).flatten(2).unbind(1)  # each [B, cells]
        root = torch.stack([sure[0], sure[1], torch.zeros_like(u), sure[2]], -1).unflatten(-1, (2, 2))  # of the information, so it is >= 0
        J, r = root @ self.flow, root @ torch.stack([u, v], -1)[..., None]
        A, b = (J.mT @ J).mean(1) + 1e-3 * torch.eye(3, device=J.device), (J.mT @ r).mean(1)
        turn = torch.linalg.solve(A, b)[..., 0] / (2 * self.canvas.focal)  # cells tell px of the sensor
        omega: Tensor = turn / window.duration[:, None]
        return omega


def error(omega: Tensor, truth: Tensor) -> Tensor:
    """Of omega, a share of the true speed: [B]."""
    return (omega - truth).norm(dim=-1) / truth.norm(dim=-1)


def fit(
    network: TurnNet, train: Iterable[Sample], unseen: list[Sample], camera: Camera, seconds: float, device: str, board: SummaryWriter
) -> None:
    """Train for so many seconds; the truth of the unseen windows is looked at for the curve alone."""
    augment, chance = Augment(camera), torch.Generator(device).manual_seed(torch.initial_seed())
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    begin, shown = monotonic(), 0.0
    for step, sample in enumerate(chain.from_iterable(repeat(train))):
        done = (monotonic() - begin) / seconds
        if done >= 1:
            return
        # Far from the right motion a sharp image does not tell where to go, and a soft one does: begin with much blur.
        blur = max(1.0, 4.0 * 0.25 ** (1.3 * done))
        optimizer.param_groups[0]["lr"] = 2e-3 * min(1.0, (step + 1) / 50) * (1 - done)
        window = augment(sample.to(device, torch.float32), chance).window
        loss = ContrastLoss(camera, blur=blur, against="rest")(window, network(window))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        board.add_scalar("train/loss", loss.item(), step)
        board.add_scalar("train/blur", blur, step)
        if done >= shown:
            shown += 0.1
            with torch.no_grad():
                percent = 100 * torch.cat([error(network(s.window), s.omega) for s in unseen]).median().item()
            board.add_scalar("unseen/error_percent", percent, step)
            print(f"{done * seconds:4.0f} s, step {step}: loss {loss.item():.3f}, error of unseen windows {percent:.1f} %", flush=True)


@torch.no_grad()
def compare(network: TurnNet, unseen: list[Sample], camera: Camera, board: SummaryWriter) -> dict[str, float]:
    """The network by itself, and as the start of the optimizer, on windows that it has not seen."""
    sought = Compensate(camera, gradients="detached")
    at_once = Compensate(camera, search=Search((1.0,)), gradients="detached")  # cold too, but without the rounds that are blurred
    loss = ContrastLoss(camera, against="rest", reduction="none")
    rows = []
    for step, sample in enumerate(unseen):
        window, omega = sample.window, network(sample.window)
        cold, sharp, warm = sought(window), at_once(window), sought(window, start=omega)
        found = [result.estimate for result in (cold, sharp, warm)]
        numbers = [error(omega, sample.omega), error(cold.omega, sample.omega), loss(window, omega)]
        rows.append(torch.stack(numbers + [e.evaluations for e in found] + [e.contrast for e in found], 1))
        ways = tuple(displacement(window, turn, None, None, 0.5).homography() for turn in (torch.zeros_like(omega), omega, cold.omega))
        board.add_image(
            "as they came | network | optimizer", pictures(window, ways, Canvas.around(camera), 0.5)[0], step, dataformats="HWC"
        )
    table = torch.cat(rows)
    middle, mean = table.median(0).values.tolist(), table.mean(0).tolist()
    results = {
        "error of the network, median, %": 100 * middle[0],
        "error of the optimizer, median, %": 100 * middle[1],
        "loss of the network, at rest 0": mean[2],
        "evaluations, cold": mean[3],
        "evaluations, cold, one round": mean[4],
        "evaluations, warm": mean[5],
        "contrast, cold": mean[6],
        "contrast, cold, one round": mean[7],
        "contrast, warm": mean[8],
        "evaluations saved, %": 100 * (1 - mean[5] / mean[3]),
    }
    for name, value in results.items():
        board.add_scalar(f"compare/{name}", value)
    return results


def main(
    out: Path = Path("logs/train_rotation"),
    minutes: float = 5.0,
    seed: int = 0,
    device: str = "cpu",
    cache: Path = Path("logs/recordings"),
    small: bool = False,
) -> dict[str, float]:
    """Train, compare, write curves and pictures for TensorBoard and the network's state_dict.

    Args:
        out: folder to write
        minutes: of training; simulating the recordings, once, and the comparison come on top
        seed: of the network and of chance
        device: cpu or cuda
        cache: folder of the simulated recordings
        small: few windows, to see that it runs
    """
    torch.manual_seed(seed)
    train, test, camera = loaders(cache, small)
    unseen = [sample.to(device, torch.float32) for sample in test]
    network = TurnNet(camera).to(device)
    with SummaryWriter(str(out)) as board:
        fit(network, train, unseen, camera, 60 * minutes, device, board)
        results = compare(network, unseen, camera, board)
    torch.save(network.state_dict(), out / "network.pt")  # read it with torch.load(..., weights_only=True)
    print("\n".join(f"{name:36} {value:8.3f}" for name, value in results.items()) + f"\ncurves: tensorboard --logdir {out}")
    return results


if __name__ == "__main__":
    auto_cli(main)
