"""The rigs that the tests move."""

from pathlib import Path

import pytest

CONFIGS = Path(__file__).parents[2] / "configs" / "rig"


@pytest.fixture(scope="session")
def slider():
    """One linear axis with the motor 272763."""
    from torchcmax.rig.config import load

    return load(CONFIGS / "slider.yaml")


@pytest.fixture(scope="session")
def pantilt():
    """Two rotary axes, the second with its motor turned around."""
    from torchcmax.rig.config import load

    return load(CONFIGS / "pantilt.yaml")
