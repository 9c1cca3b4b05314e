"""A small network tells how a camera turns, omega [3] rad/s, from a voxel grid.  Nobody shows it the truth: it learns from contrast alone.

    python examples/train_rotation.py --out logs/train_rotation --minutes 5
    tensorboard --logdir logs/train_rotation

Then it meets windows of other textures and motions, against the truth, and against the optimizer, of which it is the warm start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
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

BINS, WIDTH = 5, 32
RIDGE = 1e-3  # information of a cell that sees nothing, so that it stays at rest


class Cells(nn.Module):
    """Windows -> the motion in cells of 8 x 8 px, and how sure it is: information A [B, h, w, 2, 2], and A times the flow [B, h, w, 2, 1].

    An edge shows only the motion across it.  So a cell does not say a flow, but the terms of a least-squares problem, which add up over the
    cells, whatever the flow is sought for.  Flows are px of the sensor over the window: a window has a number of events, not a duration.
    """

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.canvas = Canvas.around(camera, 0.0).scaled(0.5)  # every second pixel is enough; then two strides of 2
        self.layers = nn.Sequential(
            nn.Conv2d(BINS, WIDTH, 5, 2, 2), nn.ReLU(), nn.Conv2d(WIDTH, WIDTH, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(WIDTH, 2 * WIDTH, 3, 2, 1), nn.ReLU(), nn.Conv2d(2 * WIDTH, 2 * WIDTH, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(2 * WIDTH, 5, 1),
        )  # fmt: skip

    def forward(self, window: Window, H_k: Tensor | None = None) -> tuple[Tensor, Tensor]:
        grid = voxel_grid(window, self.canvas, BINS, H_k)
        grid = grid / (5 * grid.abs().mean((1, 2, 3), keepdim=True)).clamp_min(1e-6)  # as if all had the same number of events a pixel
        u, v, a, b, c = self.layers(grid).unbind(1)
        root = torch.stack([a, torch.zeros_like(a), b, c], -1).unflatten(-1, (2, 2))  # so that the information is never negative
        A = root @ root.mT
        return A, A @ torch.stack([u, v], -1)[..., None]


class TurnNet(nn.Module):
    """Windows -> omega [B, 3] rad/s, in two looks: at the events as they came, and at what motion is left in them.

    What moves where is seen by convolutions, the same all over the image; how a turn moves each place is geometry, which is not learned.
    """

    J: Tensor  # [h, w, 2, 3] px/rad: how a turn about x, y and z moves each cell

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.cells = Cells(camera)
        canvas = self.cells.canvas
        rows, columns = (torch.arange(-(-n // 4)) * 4.0 for n in canvas.size)  # of the cells' middles on the canvas
        y, x = torch.meshgrid((rows - canvas.centre[1]) / canvas.focal, (columns - canvas.centre[0]) / canvas.focal, indexing="ij")
        moved = [x * y, -1 - x * x, y, 1 + y * y, -x * y, -x]  # (u, v) of the point (x, y, 1) by a turn about x, y and z
        self.focal = 2 * canvas.focal  # px of the sensor
        self.register_buffer("J", self.focal * torch.stack(moved, -1).unflatten(-1, (2, 3)), persistent=False)

    def forward(self, window: Window) -> Tensor:
        first: Tensor = self.look(window, torch.zeros_like(window.ray[:, 0]))
        return first + self.look(window, first.detach())  # what the first look got wrong is smaller, and easier to see

    def look(self, window: Window, omega: Tensor) -> Tensor:
        """The turn that is left when the events are compensated by omega: [B, 3] rad/s."""
        A, b = self.cells(window, displacement(window, omega, None, None, 0.5).homography())
        ridge = RIDGE * self.focal**2 * torch.eye(3, device=A.device)
        turn = torch.linalg.solve((self.J.mT @ A @ self.J).mean((1, 2)) + ridge, (self.J.mT @ b).mean((1, 2)))[..., 0]
        left: Tensor = turn / window.duration[:, None]
        return left


def fit(
    network: nn.Module,
    objective: Callable[[Window, float], Tensor],
    train: Iterable[Sample],
    camera: Camera,
    seconds: float,
    watch: Callable[[], dict[str, float]],
    board: SummaryWriter,
) -> None:
    """Train for so many seconds.  objective: window, blur in px -> loss | watch: what is shown ten times on the way, of unseen windows."""
    like = next(network.parameters())
    augment, chance = Augment(camera), torch.Generator(like.device).manual_seed(torch.initial_seed())
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    begin, shown = monotonic(), 0.0
    for step, sample in enumerate(chain.from_iterable(repeat(train))):
        done = (monotonic() - begin) / seconds
        if done >= 1:
            return
        # Far from the right motion a sharp image does not tell where to go, and a soft one does: begin with much blur.
        blur = max(1.0, 4.0 * 0.25 ** (1.3 * done))
        optimizer.param_groups[0]["lr"] = 2e-3 * min(1.0, (step + 1) / 50) * (1 - done)
        loss = objective(augment(sample.to(like.device, like.dtype), chance).window, blur)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        board.add_scalar("train/loss", loss.item(), step)
        board.add_scalar("train/blur", blur, step)
        if done >= shown:
            shown += 0.1
            with torch.no_grad():
                seen = watch()
            for name, value in seen.items():
                board.add_scalar(f"unseen/{name}", value, step)
            print(f"{done * seconds:4.0f} s, step {step}, loss {loss:.3f}; unseen:", *(f"{n} {v:.3f}" for n, v in seen.items()), flush=True)


def error(omega: Tensor, truth: Tensor) -> Tensor:
    """Of omega, % of the true speed: [B]."""
    percent: Tensor = 100 * (omega - truth).norm(dim=-1) / truth.norm(dim=-1)
    return percent


@torch.no_grad()
def compare(network: TurnNet, unseen: list[Sample], camera: Camera, board: SummaryWriter) -> dict[str, float]:
    """The network by itself, and as the start of the optimizer, on windows that it has not seen."""
    sought = Compensate(camera, gradients="detached")
    at_once = Compensate(camera, search=Search((1.0,)), gradients="detached")  # cold too, but without the rounds that are blurred
    loss, canvas, rows = ContrastLoss(camera, against="rest", reduction="none"), Canvas.around(camera), []
    for step, sample in enumerate(unseen):
        window, omega = sample.window, network(sample.window)
        cold, sharp, warm = sought(window), at_once(window), sought(window, start=omega)
        found = [result.estimate for result in (cold, sharp, warm)]
        told = [error(omega, sample.omega), error(cold.omega, sample.omega), loss(window, omega)]
        rows.append(torch.stack(told + [e.evaluations for e in found] + [e.contrast for e in found], 1))
        ways = tuple(displacement(window, turn, None, None, 0.5).homography() for turn in (torch.zeros_like(omega), omega, cold.omega))
        board.add_image("as they came, network, optimizer", pictures(window, ways, canvas, 0.5)[0], step, dataformats="HWC")
    table = torch.cat(rows)
    mean = table.mean(0).tolist()
    return {
        "error of the network, median, %": table[:, 0].median().item(),
        "error of the optimizer, median, %": table[:, 1].median().item(),
        "loss of the network, 0 at rest": mean[2],
        "evaluations, cold": mean[3],
        "evaluations, cold, in one round": mean[4],
        "evaluations, warm": mean[5],
        "evaluations saved, %": 100 * (1 - mean[5] / mean[3]),
        "contrast, cold": mean[6],
        "contrast, cold, in one round": mean[7],
        "contrast, warm": mean[8],
    }


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

    def objective(window: Window, blur: float) -> Tensor:
        loss: Tensor = ContrastLoss(camera, blur=blur, against="rest")(window, network(window))
        return loss

    def watch() -> dict[str, float]:
        return {"error_percent": torch.cat([error(network(sample.window), sample.omega) for sample in unseen]).median().item()}

    with SummaryWriter(str(out)) as board:
        fit(network, objective, train, camera, 60 * minutes, watch, board)
        return finish(out, network, compare(network, unseen, camera, board), board)


def finish(out: Path, network: nn.Module, results: dict[str, float], board: SummaryWriter) -> dict[str, float]:
    """Keep the network, to be read with torch.load(..., weights_only=True), and say what came out."""
    torch.save(network.state_dict(), out / "network.pt")
    for name, value in results.items():
        board.add_scalar(f"compare/{name}", value)
        print(f"{name:44} {value:8.3f}")
    print(f"network: {out / 'network.pt'}\ncurves: tensorboard --logdir {out}")
    return results


if __name__ == "__main__":
    auto_cli(main)
