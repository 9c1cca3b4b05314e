"""CiA 402 in numbers."""

from dataclasses import replace

import pytest

from torchcmax.rig import objects as o
from torchcmax.rig.axis import from_quadcounts, quadcounts
from torchcmax.rig.checks import PDOS
from torchcmax.rig.objects import FAMILIES, FORMATS, Object, State


def test_a_statusword_shows_one_state_at_most():
    """All 65536: those of bits 0 to 3, 5, 6; CiA 402-2 table of the statusword."""
    for word in range(1 << 16):
        shown = [state for state, (mask, value) in o.STATES.items() if word & mask == value]
        assert len(shown) <= 1
        assert o.state_of(word) == (shown[0] if shown else None)


@pytest.mark.parametrize(
    ("word", "state"),
    [(0x0240, State.DISABLED), (0x0231, State.READY), (0x0233, State.SWITCHED_ON), (0x0637, State.ENABLED), (0x0617, State.STOPPING),
     (0x0208, State.FAULT), (0x020F, State.FAULTING), (0x0000, State.NOT_READY)],
)  # fmt: skip
def test_words_of_real_drives(word, state):
    assert o.state_of(word) is state


def test_the_way_to_enabled_never_leads_through_a_fault():
    assert [o.towards_enabled(s) for s in (State.DISABLED, State.READY, State.SWITCHED_ON, State.ENABLED)] == [0x06, 0x07, 0x0F, 0x0F]
    assert {o.towards_enabled(s) for s in (State.FAULT, State.FAULTING, State.STOPPING, State.NOT_READY, None)} == {None}


@pytest.mark.parametrize("family", FAMILIES)
def test_pdos_carry_what_fits_and_the_controlword_once(family):
    pdos = o.pdos(family)
    assert all(sum(entry.size for entry in pdo.entries) <= 8 for pdo in pdos)
    assert [pdo.number for pdo in pdos if o.CONTROLWORD in pdo.entries] == [1]
    assert pdos[0].entries == (o.CONTROLWORD,)
    assert all(pdo.transmission == 1 for pdo in pdos if pdo.send)
    assert {entry for pdo in pdos for entry in pdo.entries} <= set(FAMILIES[family].objects)
    sent = [sum(entry.size for entry in pdo.entries) for pdo in pdos if pdo.send and pdo.entries]
    assert all(ours <= planned for ours, planned in zip(sent, PDOS, strict=True))  # the plan counts with these
    for pdo in pdos:
        values = tuple(-(i + 1) if entry.kind[0] == "i" else i + 1 for i, entry in enumerate(pdo.entries))
        assert pdo.unpack(pdo.pack(*values)) == values


@pytest.mark.parametrize("kind", FORMATS)
def test_numbers_go_both_ways(kind):
    obj, bits = Object(0x2000, 0, kind), int(kind[1:])
    ends = (-(1 << bits - 1), (1 << bits - 1) - 1) if kind[0] == "i" else (0, (1 << bits) - 1)
    assert obj.size == bits // 8
    assert all(obj.unpack(obj.pack(value)) == value for value in (*ends, 1))


def test_units_go_both_ways(slider, pantilt):
    for rig in (slider, pantilt):
        for axis in rig.axes:
            assert o.from_rpm(axis, o.rpm(axis, axis.limits.v / 2)) == pytest.approx(axis.limits.v / 2, rel=1e-3)
            counts = quadcounts(axis, axis.limits.max)
            assert quadcounts(axis, from_quadcounts(axis, counts)) == counts


@pytest.mark.parametrize(("method", "end"), [(17, "low"), (18, "high"), (1, "low"), (2, "high"), (-3, "high"), (-4, "low"), (35, None)])
def test_home_at_an_end_is_at_a_limit(pantilt, method, end):
    """Of the motor's way: of an axis whose motor is turned around, it is the other of its own."""
    for axis in pantilt.axes:
        found = o.settings(replace(axis, homing=replace(axis.homing, method=method)), 0.1)
        wanted = {"low": found[o.LOWEST] + o.INSIDE, "high": found[o.HIGHEST] - o.INSIDE, None: quadcounts(axis, axis.homing.offset)}
        assert found[FAMILIES[axis.family].home] == wanted[end]


def test_settings_supervise_and_limit(slider, pantilt):
    for rig in (slider, pantilt):
        for axis in rig.axes:
            found = o.settings(axis, 0.1)
            assert found[o.CONSUMER_HEARTBEAT] == 0x7F0064
            assert found[o.ABORT_OPTION] == 3
            assert found[o.LOWEST] < found[o.HIGHEST]
            assert found[FAMILIES[axis.family].peak_current] == round(axis.current_peak * 1e3)
            assert all(value > 0 for obj, value in found.items() if obj in (o.QUICK_STOP, o.FOLLOWING_WINDOW, o.HOMING_SPEED))
            for obj, value in found.items():
                assert obj.unpack(obj.pack(value)) == value
