"""Losses under DistributedDataParallel: two ranks that share the windows learn what one does with all of them."""

import numpy as np
import pytest
import torch
import torch.distributed
from torch.nn.parallel import DistributedDataParallel

from torchcmax.core.camera import Camera, Canvas
from torchcmax.data import WindowDataset, collate, event_count
from torchcmax.io import Recording
from torchcmax.io.events import Events
from torchcmax.nn import Compensate, ContrastLoss, FlowContrastLoss

CAMERA = Camera.pinhole((20, 28))
CANVAS = Canvas.around(CAMERA, 0.0)


def some_windows(count=4):
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.integers(0, 200, 150 * count))
    events = Events(t, *(rng.integers(0, most, len(t)).astype(kind) for most, kind in ((28, "u2"), (20, "u2"), (2, "u1"))))
    dataset = WindowDataset(Recording("r", "r", CAMERA, lambda: iter([events])), 150)
    return [dataset[i] for i in range(count)]


class Learner(torch.nn.Module):
    """A network with the losses inside, as a training step has it."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.network = torch.nn.Conv2d(2, 2, 3, padding=1)
        self.head = torch.nn.Linear(2, 3)
        self.contrast, self.flow = ContrastLoss(CAMERA), FlowContrastLoss(CAMERA)
        self.compensate = Compensate(CAMERA, gradients="detached")

    def forward(self, window):
        flow = self.network(event_count(window, CANVAS))
        omega = self.head(flow.mean((2, 3))) + self.compensate(window).omega
        return self.contrast(window, omega) + self.flow(window, flow)


def learn(rank, ranks, folder):
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", f"file://{folder}/meeting", rank=rank, world_size=ranks)
    learner = DistributedDataParallel(Learner())
    learner(collate(some_windows()[rank::ranks]).window).backward()
    torch.save([parameter.grad for parameter in learner.parameters()], f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
@pytest.mark.skipif(not torch.distributed.is_gloo_available(), reason="this torch has no gloo")
def test_two_ranks_have_the_gradient_of_all_windows(tmp_path):
    torch.multiprocessing.spawn(learn, (2, tmp_path), nprocs=2)
    one = Learner()
    one(collate(some_windows()).window).backward()
    for rank in (0, 1):
        for found, parameter in zip(torch.load(tmp_path / f"{rank}.pt", weights_only=True), one.parameters(), strict=True):
            torch.testing.assert_close(found, parameter.grad, rtol=1e-4, atol=1e-6)
            assert parameter.grad.abs().max() > 0


def test_there_is_nothing_to_synchronize():
    assert not any(learner.state_dict() for learner in (ContrastLoss(CAMERA), FlowContrastLoss(CAMERA), Compensate(CAMERA)))
