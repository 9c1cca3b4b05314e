"""What the tests of the drives share: a simulation to run on, and an ear on its bus."""

from contextlib import contextmanager

import pytest

pytest.importorskip("canopen", reason="the extra rig is not installed")

from torchcmax.rig import objects as o
from torchcmax.rig.program import Move, Program
from torchcmax.rig.simnode import simulated

EMERGENCY, CONTROL, SDO = 0x80, 0x200, 0x600
STOPPING, SWITCHING = {o.QUICK, o.NO_VOLTAGE}, {o.SHUT_DOWN, o.SWITCH_ON, o.ENABLE, o.START, o.AT_ONCE}


class Ear:
    """Every frame on the bus, in order: (COB-ID, data)."""

    def __init__(self, line):
        self.frames = []
        line.network().notify = lambda can_id, data, timestamp: self.frames.append((can_id, bytes(data)))

    def controlwords(self, node=1):
        return [int.from_bytes(data, "little") for can_id, data in self.frames if can_id == CONTROL + node]

    def lawful(self):
        """No controlword that nobody means, and after a fault of any drive none that switches one on, until it is reset."""
        faulty = set()
        for can_id, data in self.frames:
            kind, node = can_id & 0x780, can_id & 0x7F
            code = int.from_bytes(data[:2], "little")
            if kind == EMERGENCY and node:
                (faulty.add if code >= 0x100 else faulty.discard)(node)
            elif kind == CONTROL:
                assert len(data) == 2
                assert code in (STOPPING if faulty else STOPPING | SWITCHING)
            elif kind == SDO and data[0] & 0xE0 == 0x20 and data[1:3] == b"\x40\x60":
                assert data[4] in (0, o.RESET)


@contextmanager
def rig_on_bus(rig, faults=None, places=None, lawful=True):
    """The simulation of a rig; that the host was lawful is asserted in the end."""
    with simulated(rig, places, faults) as simulation:
        simulation.ear = Ear(simulation.line)
        yield simulation
        if lawful:
            simulation.ear.lawful()


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
