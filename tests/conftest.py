import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest
import torch

torch.set_num_threads(1)  # spinning threads cost 30x on a shared machine

TOLERANCE = {torch.float32: {"rtol": 1e-4, "atol": 1e-5}, torch.float64: {"rtol": 1e-9, "atol": 1e-11}}
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]
SHARED = Path(__file__).parents[2] / "shared"


@pytest.fixture(params=DEVICES)
def device(request):
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["f32", "f64"])
def dtype(request):
    return request.param


@pytest.fixture
def close(dtype):
    return lambda a, b: torch.testing.assert_close(a, b, **TOLERANCE[dtype])


@pytest.fixture
def rand(device, dtype):
    """Random numbers that are the same on every device: drawn on the CPU, then moved."""
    generator = torch.Generator().manual_seed(0)
    return lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64).to(device, dtype)


@pytest.fixture(autouse=True)
def threads():
    """One, also after a test that ran the command line, which takes all."""
    from torchcmax import kernels

    yield
    kernels.set_threads(0)


@pytest.fixture(scope="session")
def shared():
    """The folder of recordings and judges beside the checkout."""
    if not (SHARED / "data").is_dir():
        pytest.skip("the recordings in ../shared are not here")
    return SHARED


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """A small simulated recording in its folder: 0.12 s before a poster, six degrees of freedom."""
    from torchcmax.simulator import Simulation, write

    folder = tmp_path_factory.mktemp("demo") / "poster"
    write(Simulation(duration=0.12), folder)
    return folder


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A simulated recording of a small sensor: half a second before a poster, six degrees of freedom."""
    from torchcmax.simulator import Simulation, write

    folder = tmp_path_factory.mktemp("small") / "poster"
    write(Simulation(duration=0.5, width=120, height=90, focal=100), folder)
    return folder


def pytest_collection_modifyitems(items):
    """The longest file goes first, so that at the end no process waits for it."""
    items.sort(key=lambda item: item.path.name != "test_readme.py")
