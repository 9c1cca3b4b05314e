"""One drive as the host sees it: its dictionary by SDO, its commands and what it tells by PDO.

The CiA 402 state machine is walked here and in session.py, one controlword at a time: canopen's own profile sends controlwords that nobody
asked for (with a mode; after a reset), and swallows what goes wrong.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import can
import canopen

from torchcmax.rig import objects as o
from torchcmax.rig.axis import from_quadcounts, quadcounts
from torchcmax.rig.config import Axis
from torchcmax.rig.errors import DriveFault, LinkLost, Refused, RigError
from torchcmax.rig.objects import FAMILIES, Object, Pdo, State
from torchcmax.rig.program import Move

GONE = (can.CanError, OSError, RuntimeError)  # python-can's errors, those of adapters that were unplugged, and canopen's of no connection
STEADY = (2, 0.05)  # quadcounts, and part of its following error, the larger of which an axis that stands may still waver by
RECENT = 10  # answers, whose mean is a velocity
STANDS = 2.0  # rpm of the motor


@contextmanager
def bus() -> Iterator[None]:
    """LinkLost for what sending raises when the bus is off, its queue full, or its interface gone."""
    try:
        yield
    except GONE as error:
        remedy = "look at the interface (ip -details link show), cable and termination"
        raise LinkLost(f"the bus is gone: {str(error) or type(error).__name__}\n  what to do: {remedy}") from error


class Told(NamedTuple):
    """What a drive told with a SYNC, in its units: quadcounts, rpm, mA.  stamp, heard: s by the interface's and the host's clock, when its
    position came."""

    statusword: int = 0
    mode: int = 0
    error: int = 0  # of an EPOS2 always 0
    position: int = 0
    velocity: int = 0
    current: int = 0
    following: int = 0
    stamp: float = 0.0
    heard: float = 0.0


class Drive:
    """The drive of an axis on a network, and what it answers to SYNCs, one every `period` s.

    complete: whether it answered the last SYNC | missed: SYNCs that it has not answered, one after the other, and unanswered: in all
    silent: numbers of the SYNCs that it left unanswered lately | speeds: that it told lately, rpm
    steady: SYNCs for which its position has not changed | emergency: code of its last emergency message, until it takes that back
    broken: what went wrong while an answer was received
    """

    def __init__(self, network: canopen.Network, axis: Axis, period: float) -> None:
        self.slow = max(STANDS, o.speed_step(axis, period))  # rpm, that a motor at rest may be told to have
        self.axis, self.family, self.network = axis, FAMILIES[axis.family], network
        self.node = canopen.RemoteNode(axis.node_id, canopen.ObjectDictionary())
        network.add_node(self.node)
        self.pdos = o.pdos(axis.family)
        self.told, self.complete = Told(), False
        self.missed = self.unanswered = self.steady = self.emergency = 0
        self.silent: deque[int] = deque()
        self.speeds: deque[int] = deque(maxlen=RECENT)
        self.broken: Exception | None = None
        self._stands = 0  # quadcounts, about which it wavers
        self._wavers = max(STEADY[0], STEADY[1] * abs(int(quadcounts(axis, axis.limits.following))))
        self._parts: dict[int, tuple[int, ...]] = {}
        self._stamp = self._heard = 0.0
        self._tells = {pdo.base + axis.node_id: pdo for pdo in self.pdos if pdo.send and pdo.entries}
        for cob_id in self._tells:
            network.subscribe(cob_id, self._on_pdo)
        self.node.emcy.add_callback(self._on_emergency)

    def close(self) -> None:
        """It is heard no more."""
        for cob_id in self._tells:
            self.network.unsubscribe(cob_id, self._on_pdo)
        del self.network[self.axis.node_id]

    def __str__(self) -> str:
        return f"axis {self.axis.name} (node {self.axis.node_id})"

    # -- what it tells

    def _on_pdo(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """In the thread that receives: may not raise, as canopen would only log that.

        An answer begins with the first PDO, which goes first over the bus: what comes without it belongs to one that was not whole.
        """
        try:
            pdo = self._tells[can_id]
            values = pdo.unpack(bytes(data))
            if pdo.number == 1:
                self._parts = {}
            elif 1 not in self._parts:
                return
            self._parts[pdo.number] = values
            if o.POSITION in pdo.entries:
                self._stamp, self._heard = timestamp, time.monotonic()
            if len(self._parts) == len(self._tells):
                parts, self._parts = self._parts, {}
                word, mode, error = (*parts[1], 0)[:3]
                (place, speed), (current, following) = parts[2], parts[3]
                self.told = Told(word, mode, error, place, speed, current, following, self._stamp, self._heard)
                self.complete = True
        except Exception as error:
            self.broken = error

    def _on_emergency(self, message: canopen.emcy.EmcyError) -> None:
        """Codes below 0x100 say that there is no error any more."""
        self.emergency = message.code if message.code >= 0x100 else 0

    def expect(self) -> None:
        """What it has told when the next SYNC is over is its answer to that, or, where it is late, to the one before."""
        self.complete = False

    def count(self, k: int) -> None:
        """Whether it has answered SYNC k, and whether it stands."""
        if not self.complete:
            self.missed += 1
            self.unanswered += 1
            self.silent.append(k)
            return
        self.missed = 0
        self.speeds.append(self.told.velocity)
        self.steady += 1
        if abs(self.told.position - self._stands) > self._wavers:
            self._stands, self.steady = self.told.position, 0

    def forget(self) -> None:
        """Whatever came before its PDOs were mapped."""
        self._parts, self.complete, self.broken = {}, False, None
        self.pardon()

    def pardon(self) -> None:
        """What it left unanswered so far."""
        self.missed = self.unanswered = 0
        self.silent.clear()

    @property
    def state(self) -> State | None:
        return o.state_of(self.told.statusword)

    @property
    def says(self) -> str:
        """Its state in words."""
        return "in a state that is unknown" if self.state is None else self.state.value

    def shows(self, bit: int) -> bool:
        return bool(self.told.statusword & bit)

    @property
    def place(self) -> float:
        """m or rad."""
        return float(from_quadcounts(self.axis, self.told.position))

    @property
    def speed(self) -> float:
        """m/s or rad/s."""
        return o.from_rpm(self.axis, self.told.velocity)

    @property
    def mean_speed(self) -> float:
        """Of its latest answers, m/s or rad/s: one alone is as rough as its encoder."""
        return o.from_rpm(self.axis, sum(self.speeds) / max(1, len(self.speeds)))

    def arrived(self, move: Move | None) -> bool:
        """Whether it says so, is no faster than its encoder tells from rest within a SYNC, and is where a move should have brought it.

        Where there was no move yet, what it says of one means nothing.
        """
        there = move is None or move.kind == "velocity" or abs(self.place - move.target) <= self.axis.limits.following
        return (move is None or self.shows(o.ARRIVED)) and abs(self.told.velocity) <= self.slow and there

    # -- its dictionary

    def read(self, obj: Object) -> int:
        """By SDO; Refused where the drive refuses, LinkLost where it does not answer."""
        try:
            return obj.unpack(self.node.sdo.upload(obj.index, obj.sub))
        except (canopen.SdoAbortedError, canopen.SdoCommunicationError, struct.error, *GONE) as error:
            raise self._failed(f"{obj} cannot be read", error) from error

    def write(self, obj: Object, value: int) -> None:
        """By SDO; errors as of `read`."""
        try:
            self.node.sdo.download(obj.index, obj.sub, obj.pack(value))
        except (canopen.SdoAbortedError, canopen.SdoCommunicationError, struct.error, *GONE) as error:
            raise self._failed(f"{obj} cannot be set to {value}", error) from error

    def _failed(self, what: str, error: Exception) -> RigError:
        if isinstance(error, canopen.SdoAbortedError | struct.error):
            return Refused(f"{self}: {what}: {error}\n  what to do: compare family and firmware with the configuration")
        remedy = "look at power, cable, termination, bit rate and node id"
        return LinkLost(f"{self}: {what}: {str(error) or type(error).__name__}\n  what to do: {remedy}")

    def identity(self) -> dict[str, int]:
        """Vendor, product, serial number, modes."""
        told = {"vendor": o.VENDOR_ID, "product": o.PRODUCT, "serial": o.SERIAL, "modes": o.SUPPORTED}
        return {name: self.read(obj) for name, obj in told.items()}

    def identify(self, modes: set[int]) -> dict[str, int]:
        """Its identity; Refused where it is another drive than the configuration says, or cannot do a mode, or counts other units.

        A drive of another family than configured lacks objects that `configure` writes, and is refused there.
        """
        found = self.identity()
        serial = self.axis.serial
        wrong = None
        if found["vendor"] != o.VENDOR:
            wrong = f"its vendor is 0x{found['vendor']:X}, not maxon's 0x{o.VENDOR:X}"
        elif serial is not None and found["serial"] != serial:
            wrong = f"its serial number is {found['serial']}, not {serial}"
        elif any(not found["modes"] >> (mode - 1) & 1 for mode in modes):
            missing = [o.MODES[mode] for mode in sorted(modes) if not found["modes"] >> (mode - 1) & 1]
            wrong = f"it has no mode {', '.join(missing)}, but {', '.join(o.bits(found['modes'])) or 'none that is known'}"
        elif self.axis.family == "epos4" and (unit := self.read(o.VELOCITY_UNIT)) != o.RPM_UNIT:
            wrong = f"its unit of velocity is 0x{unit:08X}, not rpm (0x{o.RPM_UNIT:08X})"
        if wrong is not None:
            raise Refused(f"{self}: {wrong}\n  what to do: correct node_id, family or serial in the configuration, or the drive's set-up")
        return found

    def history(self) -> list[int]:
        """Codes of its last errors, latest first."""
        return [self.read(Object(0x1003, sub, "u32")) & 0xFFFF for sub in range(1, self.read(o.ERROR_COUNT) + 1)]

    def configure(self, timeout: float, homing: bool) -> dict[str, int]:
        """Write limits, supervision and the PDO mapping, and read all of it back; Refused where anything differs.

        homing: home is going to be found, and the one before is not to be believed from the first write on, however that ends.  The upper
        soft limit says so: it is one quadcount lower until `found_home`.
        """
        wanted = {obj: value for obj, value in o.settings(self.axis, timeout).items() if self.has(obj)}
        if homing:
            wanted = {o.HIGHEST: wanted[o.HIGHEST] - 1} | {obj: value for obj, value in wanted.items() if obj != o.HIGHEST}
        for obj, value in wanted.items():
            self.write(obj, value)
        for pdo in self.pdos:
            wanted |= self._map(pdo)
        links = {Object(pdo.communication, 1, "u32") for pdo in self.pdos}
        for obj, value in wanted.items():
            if ((found := self.read(obj)) ^ value) & ~(o.NO_REMOTE if obj in links else 0):  # of remote frames firmwares say what they like
                remedy = "look whether the drive's firmware knows the value, or a parameter lock is on"
                raise Refused(f"{self}: {obj} was set to {value} and reads {found}\n  what to do: {remedy}")
        return {str(obj): value for obj, value in wanted.items()}

    def believed(self) -> None:
        """Refused where its home was found under another configuration, by which places were elsewhere."""
        if not self.read(o.STATUSWORD) & o.HOMED:
            return
        wanted = o.settings(self.axis, 0.0)
        for obj in (self.family.home, o.HOMING_METHOD, o.LOWEST, o.HIGHEST):
            if (found := self.read(obj)) != wanted[obj]:
                what = f"its home was not found under this configuration: {obj} is {found}, not {wanted[obj]}"
                raise Refused(f"{self}: {what}\n  what to do: torchcmax rig home")

    def found_home(self) -> None:
        """Let `believed` see that the search for home ended well."""
        self.write(o.HIGHEST, o.settings(self.axis, 0.0)[o.HIGHEST])

    def wake(self) -> None:
        """A node that NMT has stopped, as the host does with drives that it hears no more, answers no SDO before it is pre-operational."""
        try:
            self.read(o.STATUSWORD)
        except LinkLost:
            with bus():
                self.node.nmt.send_command(o.PREPARE)

    def unwatch(self) -> None:
        """Let it not notice the host's silence, which would be its next fault: only for a drive that is disabled."""
        self.write(o.CONSUMER_HEARTBEAT, 0)

    def has(self, obj: Object) -> bool:
        """Whether its firmware has an object that is not wanted of all."""
        if obj not in self.family.optional:
            return True
        try:
            self.read(obj)
        except Refused:
            return False
        return True

    def _map(self, pdo: Pdo) -> dict[Object, int]:
        """Write a PDO's mapping, as CiA 301 wants it: off, emptied, filled, on -> what must then be read."""
        cob_id, kind = Object(pdo.communication, 1, "u32"), Object(pdo.communication, 2, "u8")
        count = Object(pdo.mapping, 0, "u8")
        here = pdo.base + self.axis.node_id | (o.NO_REMOTE if pdo.send else 0)
        entries = {
            Object(pdo.mapping, sub, "u32"): entry.index << 16 | entry.sub << 8 | entry.size * 8 for sub, entry in enumerate(pdo.entries, 1)
        }
        self.write(cob_id, here | o.OFF)
        if not entries:
            return {cob_id: here | o.OFF}
        self.write(kind, pdo.transmission)
        quiet = {Object(pdo.communication, 3, "u16"): 0} if pdo.send else {}  # EPOS4's inhibit time leaves SYNCs unanswered
        for obj, value in quiet.items():
            self.write(obj, value)
        self.write(count, 0)
        for obj, value in entries.items():
            self.write(obj, value)
        self.write(count, len(entries))
        self.write(cob_id, here)
        return {cob_id: here, kind: pdo.transmission, count: len(entries), **quiet, **entries}

    # -- its commands, which it takes with the next SYNC

    def control(self, word: int) -> None:
        """A controlword."""
        self._send(1, word)

    def aim(self, move: Move) -> None:
        """The set point of a move, which starts with a controlword, or at the next SYNC where it is one of velocity."""
        axis = self.axis
        v, a = o.rpm(axis, move.v), max(1, abs(o.rpm(axis, move.a)))
        self._send(3, a, a)
        if move.kind == "position":
            self._send(2, int(quadcounts(axis, move.target)), max(1, abs(v)))
        else:
            self.turn(o.PROFILE_VELOCITY_MODE, v)

    def turn(self, mode: int, rpm: int = 0) -> None:
        """A mode, and the velocity that profile velocity mode is to have."""
        self._send(4, mode, rpm)

    def _send(self, number: int, *values: int) -> None:
        pdo = next(pdo for pdo in self.pdos if not pdo.send and pdo.number == number)
        with bus():
            self.network.send_message(pdo.base + self.axis.node_id, pdo.pack(*values))

    def check(self) -> None:
        """DriveFault where it is in a fault state, or has said so, which it does before it answers a SYNC with that state."""
        if self.broken is not None:
            raise self.broken
        if self.state in (State.FAULT, State.FAULTING) or self.emergency:
            axis = self.axis
            where = f"at {self.place:.4f} {'m' if axis.kind == 'linear' else 'rad'}, {self.told.following} quadcounts behind its demand"
            raise DriveFault(
                f"{self}: {o.error_text(self.told.error or self.emergency)}, {where}\n  what to do: remove the cause; then --reset-fault"
            )
