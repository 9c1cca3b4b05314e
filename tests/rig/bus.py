"""What the tests of the drives share: a simulation to run on, and an ear on its bus."""

from contextlib import contextmanager

import pytest

pytest.importorskip("canopen", reason="the extra rig is not installed")

from torchcmax.rig.program import Move, Program
from torchcmax.rig.simnode import simulated

CONTROL, SDO = 0x200, 0x600


class Ear:
    """Every frame on the bus, in order: (COB-ID, data)."""

    def __init__(self, line):
        self.frames = []
        line.network().notify = lambda can_id, data, timestamp: self.frames.append((can_id, bytes(data)))

    def controlwords(self, node=1):
        return [int.from_bytes(data, "little") for can_id, data in self.frames if can_id == CONTROL + node]


@contextmanager
def rig_on_bus(rig, faults=None, places=None):
    with simulated(rig, places, faults) as simulation:
        simulation.ear = Ear(simulation.line)
        yield simulation


def there_and_back(axis=0, far=0.3, v=0.5, a=5.0):
    """One axis goes and comes back, by profile position mode."""
    lasts = far / v + v / a
    second = round((lasts + 0.05) * 1e3) / 1e3
    return (Move(0.0, axis, "position", 0.1 + far, v, a), Move(second, axis, "position", 0.1, v, a)), second + lasts


def program(begin=(0.1,), **options):
    moves, duration = there_and_back(**options)
    return Program(moves, begin, round(duration + 0.05, 3))


def sync(simulation, count):
    """SYNCs from somebody who sends no heartbeat."""
    for _ in range(count):
        simulation.host.sync.transmit()
