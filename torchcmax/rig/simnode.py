"""A simulated CiA 402 drive on python-can's virtual bus, with the physics of its motor, in the time that SYNCs count.

It does what an EPOS does in the modes that a rig uses, by the objects of its dictionary and the PDO mapping that the host wrote there.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import can
import canopen
from can.interfaces.virtual import VirtualBus
from canopen import objectdictionary

from torchcmax.rig import objects as o
from torchcmax.rig.axis import to_motor
from torchcmax.rig.config import Axis, Rig
from torchcmax.rig.objects import FAMILIES, Object, State
from torchcmax.rig.plant import SUBSTEPS, Plant, Ramp

TYPES = {"i8": objectdictionary.INTEGER8, "u8": objectdictionary.UNSIGNED8, "i16": objectdictionary.INTEGER16,
         "u16": objectdictionary.UNSIGNED16, "i32": objectdictionary.INTEGER32, "u32": objectdictionary.UNSIGNED32}  # fmt: skip
SYNC, HEARTBEAT = 0x80, 0x700
STOPPED, OPERATIONAL, PRE_OPERATIONAL = 4, 5, 127
NEAR = 4  # quadcounts from its target at which an axis has arrived
SLOW = 0.5  # rad/s of the motor: stands
HISTORY = 5  # entries of 0x1003
PDOS = 4


class Network(canopen.Network):
    """One end of a virtual bus, in lock-step: whatever is sent, and what is answered, has arrived when `send_message` returns."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.wire = VirtualBus(channel=line.channel)
        super().__init__(self.wire)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        super().send_message(can_id, data, remote)
        self.line.deliver()


class Line:
    """A virtual CAN bus without threads, which is why everything on it happens in the same order every time."""

    def __init__(self) -> None:
        self.channel = f"rig-{uuid.uuid4()}"
        self.networks: list[Network] = []
        self._delivering = False

    def network(self) -> Network:
        self.networks.append(Network(self))
        return self.networks[-1]

    def deliver(self) -> None:
        """Hand on all messages, and those that they cause."""
        if self._delivering:
            return
        self._delivering = True
        try:
            while sum(self._next(network) for network in self.networks):
                pass
        finally:
            self._delivering = False

    def _next(self, network: Network) -> bool:
        message: can.Message | None = network.wire.recv(0)
        if message is not None:
            network.notify(message.arbitration_id, message.data, message.timestamp)
        return message is not None

    def close(self) -> None:
        for network in self.networks:
            network.wire.shutdown()


@dataclass
class Faults:
    """What goes wrong with a simulated drive, from when it is set.

    rough: its velocity is that of whole counts in the last period
    altered: objects that say something else than what was written | aborted: objects whose writing is refused, with the abort code
    """

    blocked_rotor: bool = False
    dropped: bool = False
    muted: bool = False
    heat: float | None = None
    limit_input: bool = False
    rough: bool = False
    refused_mode: int | None = None
    vendor: int | None = None
    altered: dict[Object, int] = field(default_factory=dict)
    aborted: dict[Object, int] = field(default_factory=dict)


def dictionary(family: str) -> canopen.ObjectDictionary:
    """What a drive of the family has, with what it holds when it is switched on."""
    made = canopen.ObjectDictionary()
    entries = dict.fromkeys(FAMILIES[family].objects, 0) | _defaults(family)
    for index in {obj.index for obj in entries}:
        subs = {obj.sub: (obj, value) for obj, value in entries.items() if obj.index == index}
        if subs.keys() == {0}:
            made.add_object(_variable(*subs[0]))
            continue
        record = objectdictionary.ODRecord(f"0x{index:04X}", index)
        for sub, (obj, value) in ({0: (Object(index, 0, "u8"), max(subs))} | subs).items():
            record.add_member(_variable(obj, value, f"sub {sub}"))
        made.add_object(record)
    return made


def _variable(obj: Object, value: int, name: str = "") -> Any:
    variable = objectdictionary.ODVariable(name or str(obj), obj.index, obj.sub)
    variable.data_type, variable.default, variable.access_type = TYPES[obj.kind], value, "rw"
    return variable


def _defaults(family: str) -> dict[Object, int]:
    """As delivered: no heartbeat, soft limits off, and the controlword in every RPDO."""
    defaults = {
        o.VENDOR_ID: o.VENDOR, o.PRODUCT: 0x60630000 if family == "epos4" else 0x63220000, o.SERIAL: 12345678, o.SUPPORTED: 0b100101,
        o.FOLLOWING_WINDOW: 2000, o.VELOCITY_UNIT: o.RPM_UNIT,
        o.MODE: 1, o.QUICK_STOP: 10000, o.ACCELERATION: 10000, o.DECELERATION: 10000, o.PROFILE_VELOCITY: 1000,
        o.MAX_PROFILE_VELOCITY: 50000, o.HOMING_METHOD: 7, o.HOMING_SPEED: 100, o.HOMING_SLOWLY: 10, o.HOMING_ACCELERATION: 1000,
    }  # fmt: skip
    defaults |= {Object(0x1003, sub, "u32"): 0 for sub in range(1, HISTORY + 1)}
    for number in range(1, PDOS + 1):
        for base, kind, mapped in ((0x1400, 0x1600, [o.CONTROLWORD]), (0x1800, 0x1A00, [o.STATUSWORD])):
            where, what = base + number - 1, kind + number - 1
            defaults[Object(where, 1, "u32")] = o.OFF
            defaults[Object(where, 2, "u8")] = 255
            defaults[Object(where, 3, "u16")] = 10 if base == 0x1800 else 0  # inhibit time, 0.1 ms
            defaults[Object(what, 0, "u8")] = len(mapped)
            for sub in range(1, 9):
                entry = mapped[sub - 1] if sub <= len(mapped) else None
                defaults[Object(what, sub, "u32")] = entry.index << 16 | entry.sub << 8 | entry.size * 8 if entry else 0
    return defaults


class SimulatedDrive:
    """One drive with its axis.  place: where the axis stands when it is switched on, m or rad; it does not know that until it is homed."""

    def __init__(self, network: Network, rig: Rig, axis: Axis, place: float, faults: Faults | None = None) -> None:
        self.axis, self.period, self.faults = axis, rig.bus.sync_period, faults or Faults()
        self.family = FAMILIES[axis.family]
        self.plant = Plant(axis, rig.supply * rig.modulation, rig.ambient, float(to_motor(axis, place)))
        self.count = 2 * math.pi / (4 * axis.cpt)  # rad of the motor per quadcount
        self.zero = round(self.plant.place / self.count)  # where the encoder began to count
        self.state, self.mode, self.error, self.homed = State.DISABLED, 0, 0, False
        self.ramp = Ramp(self.plant.place, 0.0)
        self.controlword, self.answered, self.phase = 0, False, ""
        self.time, self.heard, self._told, self._spoken = 0.0, math.nan, math.nan, 0.0
        self.latched: list[tuple[list[Object], bytes]] = []
        self.sent: list[tuple[int, list[Object]]] = []
        self.number = axis.node_id
        self._counts, self._step = 0, o.speed_step(axis, self.period)
        self._delivered = _defaults(axis.family)
        self.node = canopen.LocalNode(axis.node_id, dictionary(axis.family))
        self.node._write_callbacks.clear()  # canopen's would start a thread that sends heartbeats; here they come with the SYNC
        self.node.add_write_callback(self._written)
        self.node.add_read_callback(self._read)
        network.add_node(self.node)
        self.network = network
        self._by_place = {(obj.index, obj.sub): obj for obj in (*self.family.objects, *self._delivered)}
        self.received: dict[int, tuple[int, list[Object]]] = {}
        network.unsubscribe(self.node.sdo.rx_cobid)
        network.subscribe(self.node.sdo.rx_cobid, self._on_sdo)
        network.subscribe(SYNC, self._on_sync)
        network.subscribe(HEARTBEAT + o.MASTER, self._on_heartbeat)
        network.subscribe(0, self._on_nmt)
        if self.faults.vendor is not None:
            self._put(o.VENDOR_ID, self.faults.vendor)

    # -- its dictionary

    def get(self, obj: Object) -> int:
        """What stands in its dictionary, whatever the host is told."""
        stored = self.node.data_store.get(obj.index, {}).get(obj.sub)
        return self._delivered.get(obj, 0) if stored is None else obj.unpack(stored)

    def _put(self, obj: Object, value: int) -> None:
        """Without the callbacks, which are for the host."""
        self.node.data_store.setdefault(obj.index, {})[obj.sub] = obj.pack(value)

    def _written(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        obj = self._by_place.get((index, subindex))
        if obj in self.faults.aborted:
            raise canopen.SdoAbortedError(self.faults.aborted[obj])
        if 0x1400 <= index < 0x1C00:
            self._may_map(index, subindex)
        if obj == o.MODE:
            self._take_mode(o.MODE.unpack(data))
        elif obj == o.CONTROLWORD:
            self._control(o.CONTROLWORD.unpack(data))
        elif obj == o.CONSUMER_HEARTBEAT:
            self.heard = math.nan  # it watches from the first on

    def _may_map(self, index: int, sub: int) -> None:
        """CiA 301: PDOs are mapped while the node is not operational, the PDO is off and, for its entries, empty."""
        link = Object(index & ~0x200, 1, "u32")
        if self._operational or not (self.get(link) & o.OFF or (index, sub) == (link.index, 1)):
            raise canopen.SdoAbortedError(0x08000022)
        if index != link.index and sub and self.get(Object(index, 0, "u8")):
            raise canopen.SdoAbortedError(0x06090030)

    def _take_mode(self, mode: int) -> None:
        """Unless it is refused, or there already."""
        if mode in (self.mode, self.faults.refused_mode) or mode < 1 or not self.get(o.SUPPORTED) >> (mode - 1) & 1:
            return
        self.mode, self.phase, self.answered = mode, "", False

    def _read(self, index: int, subindex: int, od: Any) -> int | None:
        obj = self._by_place.get((index, subindex))
        if obj in self.faults.altered:
            return self.faults.altered[obj]
        return None if obj is None else self._live(obj)

    def _live(self, obj: Object) -> int | None:
        """Objects that are measured, and not stored."""
        if obj == o.STATUSWORD:
            return self.statusword
        if obj == o.MODE_SHOWN:
            return self.mode
        if obj == o.ERROR_CODE:
            return self.error
        if obj == o.POSITION:
            return self.position
        if obj == o.VELOCITY:
            return round(self.plant.velocity * 30 / math.pi) if not self.faults.rough else round(self._counts * self._step)
        if obj == self.family.current:
            return round(self.plant.current * 1e3)
        if obj == self.family.following:
            most = (1 << 8 * obj.size - 1) - 1
            return max(-most, min(most, self.following))
        return None

    @property
    def position(self) -> int:
        """Quadcounts."""
        return round(self.plant.place / self.count) - self.zero

    @property
    def following(self) -> int:
        """Demanded minus actual position, quadcounts."""
        return round(self.ramp.place / self.count) - self.zero - self.position if self._moves else 0

    @property
    def _moves(self) -> bool:
        """Whether the servo is on."""
        return self.state in (State.ENABLED, State.STOPPING, State.FAULTING)

    @property
    def statusword(self) -> int:
        word = o.STATES[self.state][1] | 0x10 | (o.HOMED if self.homed else 0)
        arrived = self.ramp.done and abs(self.following) <= NEAR
        standing = abs(self.plant.velocity) < SLOW
        if self.mode == o.PROFILE_POSITION:
            return word | (o.ARRIVED if arrived and standing else 0) | (o.ANSWERED if self.answered else 0)
        if self.mode == o.HOMING:
            attained = self.phase == "attained"
            return word | (o.ARRIVED if standing else 0) | (o.ANSWERED if attained else 0) | (o.OFFSIDE if self.phase == "failed" else 0)
        return word | (o.ARRIVED if self.ramp.done else 0) | (o.ANSWERED if standing else 0)

    # -- the bus

    def _on_heartbeat(self, can_id: int, data: bytearray, timestamp: float) -> None:
        if not self.faults.dropped:
            self.heard = self.time

    def _on_sdo(self, can_id: int, data: bytearray, timestamp: float) -> None:
        if not self.faults.dropped and self.node.nmt._state != STOPPED:
            self.node.sdo.on_request(can_id, data, timestamp)

    def _on_nmt(self, can_id: int, data: bytearray, timestamp: float) -> None:
        if data[1] in (0, self.number) and data[0] == 1:
            self._map_pdos()

    def _map_pdos(self) -> None:
        """The PDOs as the host has mapped them."""
        for cob_id in self.received:
            self.network.unsubscribe(cob_id, self._on_rpdo)
        self.received, self.sent = {}, []
        for number in range(PDOS):
            for communication, mapping, mine in ((0x1400, 0x1600, False), (0x1800, 0x1A00, True)):
                cob_id = self.get(Object(communication + number, 1, "u32"))
                transmission = self.get(Object(communication + number, 2, "u8"))
                count = self.get(Object(mapping + number, 0, "u8"))
                places = [self.get(Object(mapping + number, sub, "u32")) for sub in range(1, count + 1)]
                entries = [self._by_place[place >> 16, place >> 8 & 0xFF] for place in places]
                if cob_id & o.OFF:
                    continue
                if mine:
                    self.sent.append((cob_id & 0x7FF, entries))
                else:
                    self.received[cob_id & 0x7FF] = transmission, entries
                    self.network.subscribe(cob_id & 0x7FF, self._on_rpdo)

    def _on_rpdo(self, can_id: int, data: bytearray, timestamp: float) -> None:
        transmission, entries = self.received[can_id]
        if self._operational:
            if transmission <= 240:
                self.latched.append((entries, bytes(data)))
            else:
                self._apply(entries, bytes(data))

    @property
    def _operational(self) -> bool:
        return not self.faults.dropped and self.node.nmt._state == OPERATIONAL

    def _apply(self, entries: list[Object], data: bytes) -> None:
        for entry in entries:
            value, data = entry.unpack(data[: entry.size]), data[entry.size :]
            if entry == o.CONTROLWORD:
                self._control(value)
            elif entry == o.MODE:
                self._take_mode(value)
            else:
                self._put(entry, value)

    def _on_sync(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Tell what is now, take what has come, and go on by a period."""
        if self._operational and not self.faults.muted:
            for cob_id, entries in self.sent:
                values = ((entry, self._live(entry)) for entry in entries)
                self.network.send_message(cob_id, b"".join(e.pack(self.get(e) if v is None else v) for e, v in values))
        latched, self.latched = self.latched, []
        for entries, word in latched:
            self._apply(entries, word)
        before = self.position + self.zero
        self._watch()
        self._run()
        self._counts = self.position + self.zero - before
        self.time += self.period
        produced = self.get(o.PRODUCER_HEARTBEAT) / 1e3
        if produced and self.time - self._spoken >= produced and not self.faults.dropped:
            self._spoken = self.time
            self.network.send_message(HEARTBEAT + self.number, bytes([self.node.nmt._state]))

    # -- the state machine

    def _control(self, word: int) -> None:
        before, self.controlword = self.controlword, word
        if word & o.RESET and not before & o.RESET:
            if self.state is State.FAULT:
                self.state, self.error = State.DISABLED, 0
                self.node.emcy.reset()
            return
        if self.state in (State.FAULT, State.FAULTING):
            return
        if not word & 2:
            self.state = State.DISABLED
        elif not word & 4:
            self._quick_stop()
        elif not word & 1:
            self.state = self.state if self.state is State.STOPPING else State.READY  # out of a quick stop leads no shutdown
        elif not word & 8:
            self.state = State.SWITCHED_ON if self.state in (State.READY, State.ENABLED, State.SWITCHED_ON) else self.state
        elif self.state in (State.SWITCHED_ON, State.STOPPING):
            self.state = State.ENABLED
            self.plant.release()
            self.ramp = Ramp(self.plant.place, 0.0)
        elif self.state is State.READY:
            self.state = State.SWITCHED_ON
        if self.state is State.ENABLED and not self.answered and word & 0x10 and not before & 0x10:
            self._begin()
        if not word & 0x10:
            self.answered = False

    def _quick_stop(self) -> None:
        if self.state is State.ENABLED:
            self.state = State.STOPPING
            self.ramp = self.ramp.at(0.0, self._rate(o.QUICK_STOP))
        elif self.state in (State.READY, State.SWITCHED_ON):
            self.state = State.DISABLED

    def _rate(self, obj: Object) -> float:
        """rpm or rpm/s -> rad/s or rad/s²; never 0."""
        return max(1, self.get(obj)) * math.pi / 30

    def _begin(self) -> None:
        """A new set point, or homing."""
        if self.mode == o.PROFILE_POSITION:
            self.answered = True
            target = (self.get(o.TARGET_POSITION) + self.zero) * self.count
            speed = min(self._rate(o.PROFILE_VELOCITY), self._rate(o.MAX_PROFILE_VELOCITY))
            self.ramp = self.ramp.to(target, speed, self._rate(o.ACCELERATION), self._rate(o.DECELERATION))
        elif self.mode == o.HOMING:
            method = self.get(o.HOMING_METHOD)
            if method in (35, 37):
                self._home()
            elif method in (17, 18, -3, -4):
                self.phase = "seeking"
                self.ramp = self.ramp.at((-1 if method in (17, -4) else 1) * self._rate(o.HOMING_SPEED), self._rate(o.HOMING_ACCELERATION))
            else:
                self.phase = "failed"

    def _seek(self) -> None:
        """Towards the limit switch, and slowly off it again: where it opens is home.  Or until a stop takes the current for it."""
        if self.get(o.HOMING_METHOD) < 0:
            if abs(self.plant.current) * 1e3 >= self.get(self.family.home_current):
                self.ramp = Ramp(self.plant.place, 0.0)
                self._home()
            return
        way = -1 if self.get(o.HOMING_METHOD) == 17 else 1
        closed = (self.plant.place / self.count - self.get(self.family.home)) * way >= 0
        if self.phase == "seeking" and closed:
            self.phase = "leaving"
            self.ramp = self.ramp.at(-way * self._rate(o.HOMING_SLOWLY), self._rate(o.HOMING_ACCELERATION))
        elif self.phase == "leaving" and not closed:
            self._home()
            self.ramp = self.ramp.at(0.0, self._rate(o.HOMING_ACCELERATION))

    def _home(self) -> None:
        self.zero = round(self.plant.place / self.count) - self.get(self.family.home)
        self.homed, self.phase = True, "attained"

    def fault(self, code: int) -> None:
        """Slow down by the quick stop's ramp, and let go."""
        if self.state in (State.FAULT, State.FAULTING):
            return
        self.state = State.FAULTING if self._moves else State.FAULT
        self.error = code
        self.ramp = self.ramp.at(0.0, self._rate(o.QUICK_STOP))
        history = [self.get(Object(0x1003, sub, "u32")) for sub in range(1, HISTORY)]
        for sub, value in enumerate([code, *history], 1):
            self._put(Object(0x1003, sub, "u32"), value)
        self._put(o.ERROR_COUNT, min(self.get(o.ERROR_COUNT) + 1, HISTORY))
        if not self.faults.dropped:
            self.node.emcy.send(code, 1)

    def _watch(self) -> None:
        """What a drive watches in every period."""
        limit = (self.get(o.CONSUMER_HEARTBEAT) & 0xFFFF) / 1e3
        if limit and self.time - self.heard > limit + self.period / 2:
            self.fault(o.HEARTBEAT_LOST)
            self.heard = math.nan
            if self.node.nmt._state == OPERATIONAL:
                self.node.nmt._state = PRE_OPERATIONAL  # CiA 301: where a node goes that hears nothing any more
        self.plant.blocked = self.faults.blocked_rotor
        if self.faults.heat is not None:
            self.plant.winding = self.faults.heat
        if self.plant.winding > self.plant.motor.winding_max:
            self.fault(o.TOO_WARM)
        if self.faults.limit_input and not (self.mode == o.HOMING and self._moves):
            self.fault(self.family.limit_switch)
        if not self._moves:
            return
        if abs(self.following) > self.get(o.FOLLOWING_WINDOW) and self.state is State.ENABLED:
            self.fault(o.FOLLOWING_ERROR)
        lowest, highest = self.get(o.LOWEST), self.get(o.HIGHEST)
        if self.homed and self.mode != o.HOMING and lowest < highest and not lowest <= self.position <= highest:
            self.fault(self.family.soft_limit)

    def _run(self) -> None:
        """One period of the servo and the physics."""
        if self.state is State.ENABLED and self.mode == o.PROFILE_VELOCITY_MODE:
            wanted = self.get(o.TARGET_VELOCITY) * math.pi / 30
            if wanted != self._told:
                up = abs(wanted) > abs(self.ramp.velocity)
                self._told, self.ramp = wanted, self.ramp.at(wanted, self._rate(o.ACCELERATION if up else o.DECELERATION))
        else:
            self._told = math.nan
        if self.state is State.ENABLED and self.phase in ("seeking", "leaving"):
            self._seek()
        dt, plant = self.period / SUBSTEPS, self.plant
        for _ in range(SUBSTEPS):
            asked = 0.0
            if self._moves:
                place, velocity, acceleration = self.ramp.advance(dt)
                asked = plant.follow(place, velocity, acceleration, round(plant.place / self.count) * self.count, dt)
            plant.step(asked, dt)
        if self.state is State.FAULTING and self.ramp.done:
            self.state = State.FAULT


class Simulation:
    """The simulated drives of a rig on their bus, and a network for the host.  places: of the axes when switched on, m or rad"""

    def __init__(self, rig: Rig, places: tuple[float, ...], faults: dict[str, Faults] | None = None) -> None:
        self.line = Line()
        self.host = self.line.network()
        drives = self.line.network()
        given = faults or {}
        self.drives = [SimulatedDrive(drives, rig, axis, x, given.get(axis.name)) for axis, x in zip(rig.axes, places, strict=True)]


def _near(axis: Axis) -> float:
    """A place a tenth of the way from home."""
    low, high = sorted((axis.limits.min, axis.limits.max), key=lambda x: float(to_motor(axis, x)))
    home = {-1: low, 1: high}.get(o.homing_end(axis), axis.homing.offset)
    return home + ((high if home != high else low) - home) / 10


@contextmanager
def simulated(rig: Rig, places: tuple[float, ...] | None = None, faults: dict[str, Faults] | None = None) -> Iterator[Simulation]:
    """The drives of a rig, switched on; by default a tenth of their ways from home, so that it is soon found."""
    away = tuple(_near(axis) for axis in rig.axes)
    made = Simulation(rig, places or away, faults)
    try:
        yield made
    finally:
        made.line.close()
