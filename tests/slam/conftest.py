import pytest
from scenes import scene

from torchcmax.simulator import Simulation, write


@pytest.fixture(scope="session")
def sheet():
    """A small sensor for half a second before a poster, in windows of 3,000 events, with the truth."""
    return scene(Simulation(duration=0.5, width=120, height=90, focal=100), 3000)


@pytest.fixture(scope="session")
def poster():
    """The usual sensor for 0.3 s before a poster, in windows of 15,000 events, with the truth."""
    return scene(Simulation(duration=0.3), 15000)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """A recording in its folder: the usual sensor for 0.8 s before a poster, six degrees of freedom."""
    folder = tmp_path_factory.mktemp("recorded") / "poster"
    write(Simulation(duration=0.8), folder)
    return folder
