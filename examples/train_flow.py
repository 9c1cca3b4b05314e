"""A small network tells the optical flow, px over a window at every pixel, from a voxel grid.  It learns from contrast alone.

    python examples/train_flow.py --out logs/train_flow --minutes 5
    tensorboard --logdir logs/train_flow

It does not know that the camera only turns.  The optimizer does, and searches for three numbers a window: how much of its contrast does a
flow reach that is free, and is it by seeing the motion, or by drawing the events together (event collapse)?
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jsonargparse import auto_cli
from recordings import loaders
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from train_rotation import RIDGE, Cells, finish, fit

from torchcmax.core.camera import Camera, Canvas
from torchcmax.core.contrast import CONTRASTS
from torchcmax.core.contrast import blur as blurred
from torchcmax.core.window import Window
from torchcmax.data import Sample
from torchcmax.nn import Compensate, FlowContrastLoss, ImageOfWarpedEvents
from torchcmax.nn.flow import sampled
from torchcmax.picture import coloured

SPREAD = 2.0  # cells that a cell listens to, standard deviation: an edge that shows half of the motion has neighbours that show the rest
SHARPEST = 2.0  # px: with less blur a free flow fits what single pixels happen to show, and errs more (26 % against 21 % after 350 steps)


class FlowNet(nn.Module):
    """Windows -> flow [B, 2, H, W] px over the window, in two looks: at the events as they came, and after they followed the first flow."""

    place: Tensor  # [H W, 2] of each pixel, in cells

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.cells, self.canvas = Cells(camera), Canvas.around(camera, 0.0)
        y, x = torch.meshgrid(*(torch.arange(n) for n in self.canvas.size), indexing="ij")
        self.register_buffer("place", (torch.stack([x, y], -1).view(-1, 2) - 0.5) / 8, persistent=False)

    def forward(self, window: Window) -> Tensor:
        first = self.look(window)
        flow: Tensor = first + self.look(self.moved(window, first.detach()))
        return flow

    def look(self, window: Window) -> Tensor:
        """The flow of these events, smooth as its cells are."""
        A, b = self.cells(window)
        terms = torch.cat([A, b], -1).permute(0, 3, 4, 1, 2)  # [B, 2, 3, h, w]
        terms = blurred(terms.flatten(0, 2), SPREAD).view_as(terms).permute(0, 3, 4, 1, 2)
        flow = torch.linalg.solve(terms[..., :2] + RIDGE * torch.eye(2, device=b.device), terms[..., 2]).permute(0, 3, 1, 2)
        dense: Tensor = sampled(flow, self.place.expand(len(flow), -1, -1)).mT.unflatten(-1, self.canvas.size)
        return dense

    def moved(self, window: Window, flow: Tensor) -> Window:
        """The window's events where the flow takes them at its middle."""
        xy = self.canvas.pixels(window.ray)
        there = xy + (0.5 - window.phase)[..., None] * sampled(flow, xy)
        point = (there - there.new_tensor(self.canvas.centre)) / self.canvas.focal
        return replace(window, ray=torch.cat([point, window.ray[..., 2:]], -1))


def judged(image: Tensor) -> tuple[Tensor, Tensor]:
    """Images of warped events [B, 2, H, W] -> contrast as the optimizer sees it, and the share of events in the fullest 1 % of pixels."""
    both = image.sum(1)
    votes = both.flatten(1)
    return CONTRASTS["variance"](blurred(both, 1.0)), votes.topk(votes.shape[1] // 100).values.sum(1) / votes.sum(1)


@torch.no_grad()
def compare(network: FlowNet, unseen: list[Sample], camera: Camera, board: SummaryWriter | None = None) -> dict[str, float]:
    """The network's flow beside the optimizer's rotation, on windows that neither has seen; with a board, pictures too."""
    followed, turned = FlowContrastLoss(camera, polarity="split").image, ImageOfWarpedEvents(camera, "split", margin=0.1)  # of one size
    sought, rows = Compensate(camera, gradients="detached"), []
    for step, sample in enumerate(unseen):
        window, flow, truth = sample.window, network(sample.window), sample.flow(network.canvas)
        images = followed(window, torch.zeros_like(flow)), followed(window, flow), turned(window, sought(window).omega)
        (rest, _), (told, fullest), (best, fullest_of_best) = map(judged, images)
        xy = network.canvas.pixels(window.ray)
        off = sampled(flow - truth, xy).norm(dim=-1).mean(1) / sampled(truth, xy).norm(dim=-1).mean(1)
        rows.append(torch.stack([told / best, rest / best, (told - rest) / (best - rest), off, fullest / fullest_of_best], 1))
        if board is not None:
            picture = np.concatenate([coloured(*image[0].cpu()) for image in images], 1)
            board.add_image("as they came, network, optimizer", picture, step, dataformats="HWC")
    table = torch.cat(rows)
    middle = (100 * table.median(0).values).tolist()
    return {
        "contrast, % of the optimizer's": middle[0],
        "contrast at rest, % of the optimizer's": middle[1],
        "gain over rest, % of the optimizer's": middle[2],
        "error of the flow where events are, %": middle[3],
        "fullest 1 % of pixels, times the optimizer's": middle[4] / 100,
        "the same of the worst window": table[:, 4].max().item(),
    }


def main(
    out: Path = Path("logs/train_flow"),
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
    network = FlowNet(camera).to(device)

    def objective(window: Window, blur: float) -> Tensor:
        loss: Tensor = FlowContrastLoss(camera, blur=max(SHARPEST, blur), against="rest")(window, network(window))
        return loss

    def watch() -> dict[str, float]:
        found = [*compare(network, unseen, camera).values()]
        return {"contrast_percent": found[0], "gain_percent": found[2], "error_percent": found[3], "fullest_of_worst": found[5]}

    with SummaryWriter(str(out)) as board:
        fit(network, objective, train, camera, 60 * minutes, watch, board)
        return finish(out, network, compare(network, unseen, camera, board), board)


if __name__ == "__main__":
    auto_cli(main)
