"""The worked examples of learning, in a small version: they learn, compare themselves, and leave what they promise."""

from itertools import count
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

EXAMPLES = Path(__file__).parents[1] / "examples"
STEPS = 100


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("recordings")


def trained(name, cache, out, monkeypatch):
    """One example in its small version, a step a second by its clock: module, results, and what TensorBoard shows."""
    monkeypatch.syspath_prepend(EXAMPLES)
    module = __import__(name)
    monkeypatch.setattr("train_rotation.monotonic", map(float, count()).__next__)
    results = module.main(out, minutes=STEPS / 60, cache=cache, small=True)
    board = EventAccumulator(str(out))
    board.Reload()
    return module, results, board


def fell(board):
    """The loss at the beginning and at the end."""
    losses = torch.tensor([event.value for event in board.Scalars("train/loss")])
    assert len(losses) == STEPS - 1
    return losses[:10].mean(), losses[-10:].mean()


def test_a_network_learns_to_tell_rotation(cache, tmp_path, monkeypatch):
    module, results, board = trained("train_rotation", cache, tmp_path, monkeypatch)
    before, after = fell(board)
    assert after < before - 0.05
    assert results["error of the network, median, %"] < 60  # 100 of a network that says nothing moves
    assert results["evaluations, warm"] < results["evaluations, cold"]
    assert results["contrast, warm"] == pytest.approx(results["contrast, cold"], rel=1e-3)
    assert board.Tags()["images"]
    network = module.TurnNet(module.loaders(cache, True)[2])
    network.load_state_dict(torch.load(tmp_path / "network.pt", weights_only=True))


def test_a_network_learns_to_tell_flow_without_collapse(cache, tmp_path, monkeypatch):
    module, results, board = trained("train_flow", cache, tmp_path, monkeypatch)
    before, after = fell(board)
    assert after < before - 0.01
    assert results["contrast, % of the optimizer's"] > max(80, results["contrast at rest, % of the optimizer's"])
    assert results["error of the flow where events are, %"] < 80  # 100 of a flow of nothing
    assert results["the same of the worst window"] < 2
    assert board.Tags()["images"]
    network = module.FlowNet(module.loaders(cache, True)[2])
    network.load_state_dict(torch.load(tmp_path / "network.pt", weights_only=True))
