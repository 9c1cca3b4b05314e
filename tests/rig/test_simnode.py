"""The simulated drive is as strict as a real one."""

import pytest
from bus import rig_on_bus, sync

from torchcmax.rig import objects as o
from torchcmax.rig.drive import Drive
from torchcmax.rig.errors import Refused
from torchcmax.rig.objects import Object, State

OPERATE = b"\x01\x01"  # NMT: node 1 becomes operational


@pytest.fixture
def simulation(slider):
    with rig_on_bus(slider, lawful=False) as made:
        yield made


@pytest.fixture
def host(simulation, slider):
    made = Drive(simulation.host, slider.axes[0], slider.bus.sync_period)
    made.configure(0.1, homing=False)
    return made


@pytest.fixture
def send(simulation, host):
    """A controlword, and the state that it leads to."""
    simulation.host.send_message(0, OPERATE)

    def act(word):
        host.control(word)
        sync(simulation, 1)
        return simulation.drives[0].state

    return act


def test_the_state_machine_has_no_short_cuts(simulation, send):
    """CiA 402-2, transitions 0 to 16."""
    way = [
        (o.ENABLE, State.DISABLED),
        (o.SWITCH_ON, State.DISABLED),
        (o.SHUT_DOWN, State.READY),
        (o.SWITCH_ON, State.SWITCHED_ON),
        (o.ENABLE, State.ENABLED),
        (o.QUICK, State.STOPPING),
        (o.SHUT_DOWN, State.STOPPING),
        (o.NO_VOLTAGE, State.DISABLED),
    ]
    assert [send(word) for word, _ in way] == [state for _, state in way]


def test_only_a_reset_leads_out_of_a_fault(simulation, host, send):
    simulation.drives[0].fault(0x2310)
    assert host.emergency == 0x2310
    assert {send(word) for word in (o.SHUT_DOWN, o.ENABLE, o.NO_VOLTAGE)} == {State.FAULT}
    assert send(o.RESET) is State.DISABLED
    assert host.emergency == 0


def test_pdos_are_mapped_as_the_standard_says(simulation, host):
    """CiA 301: off, then empty, and not while the node is operational."""
    link, count, entry = Object(0x1800, 1, "u32"), Object(0x1A00, 0, "u8"), Object(0x1A00, 1, "u32")
    with pytest.raises(Refused, match="0x08000022"):
        host.write(count, 0)
    host.write(link, 0x181 | o.OFF)
    with pytest.raises(Refused, match="0x06090030"):
        host.write(entry, 0x60410010)
    simulation.host.send_message(0, OPERATE)
    with pytest.raises(Refused, match="0x08000022"):
        host.write(link, 0x181)


def test_what_a_drive_would_send_by_itself_is_off(host):
    assert host.read(Object(0x1803, 1, "u32")) & o.OFF


def test_firmware_may_say_of_remote_frames_what_it_likes(simulation, host):
    simulation.drives[0].faults.altered[Object(0x1800, 1, "u32")] = 0x181
    host.configure(0.1, homing=False)
    simulation.drives[0].faults.altered[Object(0x1800, 1, "u32")] = 0x182
    with pytest.raises(Refused, match="0x1800:01 was set to"):
        host.configure(0.1, homing=False)


def test_a_disabled_drive_notices_the_silence_of_the_host_too(simulation, host):
    sync(simulation, 150)
    assert simulation.drives[0].state is State.DISABLED  # nothing was heard yet
    simulation.host.send_message(0x77F, b"\x05")
    sync(simulation, 150)
    assert simulation.drives[0].state is State.FAULT
    assert host.emergency == o.HEARTBEAT_LOST


def test_an_axis_has_mechanical_ends(simulation):
    plant = simulation.drives[0].plant
    plant.velocity = 700.0
    plant.place = max(plant.ends) - 10
    sync(simulation, 100)
    assert plant.place == max(plant.ends)
    assert plant.velocity == 0
