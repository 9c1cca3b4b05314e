"""Programs on the virtual bus, in lock-step with simulated drives."""

import json
import math
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from bus import program, rig_on_bus, sync

from torchcmax.rig import objects as o
from torchcmax.rig import session
from torchcmax.rig.config import load
from torchcmax.rig.errors import DriveFault, Refused
from torchcmax.rig.objects import State
from torchcmax.rig.plan import plan
from torchcmax.rig.plant import Ramp
from torchcmax.rig.profilefile import load_profile
from torchcmax.rig.program import Move, Program
from torchcmax.rig.record import read_encoder
from torchcmax.rig.runner import check, home, run, watch_encoders
from torchcmax.rig.simnode import SimulatedDrive

QC = 2  # quadcounts within which an axis stands where it should


@pytest.fixture(scope="module")
def passed(slider, tmp_path_factory):
    """A run there and back, what was heard on the bus, and its drives afterwards."""
    out = tmp_path_factory.mktemp("run")
    with rig_on_bus(slider) as simulation:
        said = run(slider, program(), out, simulate=True, network=simulation.host)
        return out, said, simulation


def test_a_run_ends_where_it_should_and_disabled(passed, slider):
    out, said, simulation = passed
    assert said["status"] == "complete"
    (drive,) = simulation.drives
    assert drive.state is State.DISABLED
    assert drive.plant.current == 0
    assert abs(drive.position - 0.1 / 0.75 * 120000) <= QC
    encoder = read_encoder(out / "encoder.csv", slider)
    assert encoder.place[-1, 0] == pytest.approx(0.1, abs=QC * 6.25e-6)
    assert encoder.place.max() == pytest.approx(0.4, abs=QC * 6.25e-6)
    assert np.diff(encoder.time) == pytest.approx(0.001)
    assert not (out / "groundtruth.txt").exists()


def test_the_bus_saw_the_controlwords_that_were_meant_and_no_other(passed):
    """Enabled once for homing and once more; home; then a set point and its end for the approach and each of two moves; switched off."""
    _, _, simulation = passed
    move = [o.AT_ONCE, o.ENABLE]
    enabled = [o.SHUT_DOWN, o.SWITCH_ON, o.ENABLE]
    assert simulation.ear.controlwords() == [*enabled, o.START, o.ENABLE, *move, *move, *move, o.SHUT_DOWN, o.NO_VOLTAGE]
    others = {can_id for can_id, _ in simulation.ear.frames} - {
        0,
        0x80,
        0x77F,
        0x201,
        0x301,
        0x401,
        0x501,
        0x181,
        0x281,
        0x381,
        0x601,
        0x581,
    }
    assert not others


def test_two_runs_are_the_same_to_the_byte(passed, slider, tmp_path):
    run(slider, program(), tmp_path, simulate=True)
    for name in ("encoder.csv", "log.jsonl", "run.json"):
        assert (tmp_path / name).read_bytes() == (passed[0] / name).read_bytes()


def test_the_drive_follows_the_closed_form_of_its_trapezoid(passed, slider):
    """0.5 m/s by 5 m/s²: from rest at SYNC 0, as a trapezoid in whole rpm."""
    encoder = read_encoder(passed[0] / "encoder.csv", slider)
    t = encoder.time[:700]
    rise, speed = 0.1, 0.5
    ramped = np.where(t < rise, 5.0 * t**2 / 2, speed * (t - rise / 2))
    late = np.clip(t - 0.3 / speed, 0, rise)
    expected = 0.1 + np.where(t < 0.6, ramped, 0.3 - 2.5 * (rise - late) ** 2)
    assert abs(encoder.place[:700, 0] - expected).max() < 1e-3


@pytest.mark.parametrize("name", ["slider_pass", "pantilt_sweep"])
def test_what_was_planned_is_what_happens(name, tmp_path, request):
    rig_name = name.split("_")[0]
    rig = request.getfixturevalue(rig_name)
    planned = plan(rig, load_profile(f"configs/rig/{name}.yaml", rig))
    planned.refuse()
    run(rig, planned.program, tmp_path, simulate=True)
    encoder = read_encoder(tmp_path / "encoder.csv", rig)
    count = len(planned.samples.time)
    for k, axis in enumerate(rig.axes):
        room = 1e-3 if axis.kind == "linear" else math.radians(0.2)
        assert abs(encoder.place[:count, k] - planned.samples.x[:, k]).max() < room
        peak = abs(planned.samples.current[:, k]).max()
        measured = abs(encoder.current[:count, k]).max()
        assert measured <= 1.08 * peak
        assert measured >= 0.92 * peak or axis.gravity  # a plan reckons with gravity that acts either way
        assert abs(encoder.place[-1, k] - planned.samples.x[-1, k]) <= QC * abs(planned.rig.axes[k].transmission.travel / 4 / axis.cpt)


def test_two_axes_start_on_one_sync(pantilt, tmp_path):
    period = pantilt.bus.sync_period
    turn = Program(tuple(Move(10 * period, k, "position", 0.2, 0.5, 2.0) for k in (0, 1)), (0.0, 0.0), 1.0)
    run(pantilt, turn, tmp_path, simulate=True)
    encoder = read_encoder(tmp_path / "encoder.csv", pantilt)
    first = [int((abs(encoder.velocity[:, k]) > 0).argmax()) for k in (0, 1)]
    assert first[0] == first[1] == 11  # the SYNC after the one that started both
    events = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    starts = [event["k"] for event in events if event["what"] == "move"]
    assert starts[-1] == starts[-2]


def test_velocity_mode_keeps_a_constant_velocity(slider, tmp_path):
    turn = Program((Move(0.0, 0, "velocity", 0.0, 0.2, 2.0), Move(1.0, 0, "velocity", 0.3, 0.0, 2.0)), (0.1,), 1.2)
    run(slider, turn, tmp_path, simulate=True)
    encoder = read_encoder(tmp_path / "encoder.csv", slider)
    assert encoder.velocity[200:1000, 0] == pytest.approx(0.2, abs=2e-3)
    assert encoder.place[-1, 0] == pytest.approx(0.3, abs=1e-3)


def test_the_same_again(slider, tmp_path):
    said = run(slider, program(), tmp_path, simulate=True, repeat=3)
    encoder = read_encoder(tmp_path / "encoder.csv", slider)
    parts = [encoder.place[first : first + 1000, 0] for first, _ in said["cycles"]]
    assert len(parts) == 3
    assert abs(parts[1] - parts[0]).max() < 2e-5  # 3 quadcounts, of where friction left it
    assert abs(parts[2] - parts[0]).max() < 2e-5


@pytest.mark.parametrize("place", [-0.01, 0.3, 0.74])
def test_home_is_found_from_anywhere(slider, tmp_path, place):
    with rig_on_bus(slider, places=(place,)) as simulation:
        home(slider, tmp_path, simulate=True, network=simulation.host)
        (drive,) = simulation.drives
        assert drive.homed
        true = drive.plant.place / drive.count
        assert abs(drive.position - true) <= QC  # home is at its place on the axis
        assert drive.position * 6.25e-6 == pytest.approx(slider.axes[0].homing.offset, abs=QC * 6.25e-6)
        assert drive.state is State.DISABLED


@pytest.mark.parametrize("method", [18, 35, -3, -4])
def test_home_by_other_methods(slider, tmp_path, method):
    axis = slider.axes[0]
    rig = replace(
        slider, axes=(replace(axis, homing=replace(axis.homing, method=method, offset=0.7, current=1.0 if method < 0 else None)),)
    )
    with rig_on_bus(rig) as simulation:
        home(rig, tmp_path, simulate=True, network=simulation.host)
        (drive,) = simulation.drives
        assert drive.position * 6.25e-6 == pytest.approx(0.7, abs=QC * 6.25e-6)
        off = {-3: -0.0154, -4: 0.0154}.get(method, 0.0) / 6.25e-6  # m: the mechanical stops are 2 % of the way beyond the limits
        assert method == 35 or abs(drive.position - drive.plant.place / drive.count - off) <= (20 if off else QC)


def test_a_run_leaves_drives_that_the_next_finds_well(slider, tmp_path):
    """They do not take the silence of the host, once it has finished, for a fault."""
    with rig_on_bus(slider) as simulation:
        (drive,) = simulation.drives
        for _ in range(2):
            assert run(slider, program(far=0.05), tmp_path, simulate=True, network=simulation.host)["status"] == "complete"
            assert not drive.get(o.CONSUMER_HEARTBEAT)
            sync(simulation, 500)
            assert drive.state is State.DISABLED


def test_hardware_is_not_moved_unless_armed_or_homed(slider, tmp_path):
    with pytest.raises(Refused, match=r"not armed\n.*--arm"):
        run(slider, program(), tmp_path, simulate=False)
    with rig_on_bus(slider) as simulation:
        with pytest.raises(Refused, match=r"home is not known\n.*rig home"):
            run(slider, program(), tmp_path, simulate=False, arm=True, network=simulation.host)
        assert simulation.drives[0].state is State.DISABLED
        assert o.ENABLE not in simulation.ear.controlwords()


def test_hardware_is_run_in_real_time_and_timed_by_when_positions_came(slider, tmp_path, monkeypatch):
    """The same session, paced; one answer is lost on the way, and some SYNCs cannot be sent in time."""
    monkeypatch.setattr(session, "STALL", 1.0)  # of a machine that is not this test's alone
    with rig_on_bus(slider, places=(0.1,)) as simulation:
        home(slider, tmp_path / "home", simulate=True, network=simulation.host)
        heard, lost = simulation.host.notify, []

        def lossy(can_id, data, timestamp):
            if can_id == 0x281 and simulation.drives[0].plant.velocity > 100 and not lost:
                lost.append(timestamp)
                return
            heard(can_id, data, timestamp)

        simulation.host.notify = lossy
        late = []

        def hold(k):
            if lost:
                late.append(k)
            if len(late) == 20:
                time.sleep(0.03)

        said = run(slider, program(far=0.05), tmp_path, simulate=False, arm=True, watch=hold, network=simulation.host)
    assert said["status"] == "complete"
    rows = np.loadtxt(tmp_path / "encoder.csv", delimiter=",", skiprows=1, usecols=(0, 1, 9))
    assert said["unanswered"] == {"x": 1}
    steps = np.diff(rows[:, 0])
    assert steps.max() >= 25  # what could not be sent in time is left out
    assert said["syncs"]["left_out"] >= steps.max() - 1
    assert rows[:, 1] == pytest.approx(rows[:, 2] - rows[0, 2], abs=2e-6)
    apart = rows[:, 1] - (rows[:, 0] - rows[0, 0]) * slider.bus.sync_period
    assert abs(np.median(apart[-100:]) - np.median(apart[:100])) < 0.01  # so that SYNCs go on to count time
    encoder = read_encoder(tmp_path / "encoder.csv", slider)
    assert len(encoder.time) == rows[-1, 0] - rows[0, 0] + 1
    assert (np.diff(encoder.time) > 0).all()
    assert abs(np.diff(encoder.place[:, 0])).max() < 2e-3
    assert '"not answered"' in (tmp_path / "log.jsonl").read_text()


def test_a_rig_that_is_moved_by_hand_is_recorded_and_never_switched_on(slider, tmp_path):
    with rig_on_bus(slider) as simulation:
        (drive,) = simulation.drives

        def push(k):
            drive.plant.place += 0.1

        said = watch_encoders(slider, tmp_path, 0.5, simulate=True, watch=push, network=simulation.host)
        assert set(simulation.ear.controlwords()) <= {o.SHUT_DOWN, o.NO_VOLTAGE}
        assert drive.state is State.DISABLED
    encoder = read_encoder(tmp_path / "encoder.csv", slider)
    assert said["status"] == "complete"
    assert len(encoder.time) == 500
    assert np.ptp(encoder.place[:, 0]) > 0.05


def test_check_reads_and_writes_nothing(slider, pantilt):
    for rig in (slider, pantilt):
        with rig_on_bus(rig) as simulation:
            found = check(rig, simulate=True, seconds=0.01, network=simulation.host)
            assert [axis.name for axis in rig.axes] == [*found][:-1]
            first = found[rig.axes[0].name]
            assert first["modes"] == ["profile position", "profile velocity", "homing"]
            assert first["state"] == "switch on disabled"
            assert "0x1016:01" in first["differs"]  # a new drive does not watch the host
            assert not any(can_id & 0x780 in (0x200, 0x300, 0x400, 0x500) for can_id, _ in simulation.ear.frames)
            requests = [data[0] for can_id, data in simulation.ear.frames if can_id & 0x780 == 0x600]
            assert requests
            assert {byte & 0xE0 for byte in requests} == {0x40}  # uploads alone


def test_both_families_are_driven(slider, tmp_path):
    older = replace(slider, axes=(replace(slider.axes[0], family="epos2"),))
    with rig_on_bus(older) as simulation:
        said = run(older, program(), tmp_path, simulate=True, network=simulation.host)
        assert said["status"] == "complete"
        assert check(older, simulate=True, seconds=0.01, network=simulation.host)["x"]["differs"].keys() == {
            "0x1016:01"
        }  # nobody watches the host between runs
        with pytest.raises(Refused, match=r"0x6007:00 cannot be set.*Object does not exist"):  # the configuration says another family
            run(slider, program(), tmp_path, simulate=True, network=simulation.host)


@pytest.mark.parametrize(
    ("damage", "told"),
    [(lambda s: "", "is no record"), (lambda s: s.splitlines()[0] + "\n", "holds no sample"),
     (lambda s: s.replace("x,", "y,", 3), "is no record|do not fit"), (lambda s: s[:-20], "line"),
     (lambda s: s + s.splitlines()[5] + "\n", "not in order"), (lambda s: s.replace(",16000,", ",nan,", 1), "not finite")],
)  # fmt: skip
def test_damaged_records_are_refused(passed, slider, tmp_path, damage, told):
    path = tmp_path / "encoder.csv"
    path.write_text(damage((passed[0] / "encoder.csv").read_text()))
    with pytest.raises(Refused, match=told):
        read_encoder(path, slider)
    with pytest.raises(Refused, match="cannot be read"):
        read_encoder(tmp_path / "none.csv", slider)


def test_ramps_end_where_they_should_whatever_they_begin_with():
    rng = np.random.default_rng(0)
    for _ in range(500):
        begin, velocity, target = rng.uniform(-5, 5), rng.uniform(-30, 30), rng.uniform(-20, 20)
        speed, up, down = rng.uniform(5, 40), *rng.uniform(10, 200, 2)
        ramp = Ramp(begin, velocity).to(target, speed, up, down)
        lasts = sum(piece[0] for piece in ramp.pieces)
        places = [ramp.advance(lasts / 1000) for _ in range(1001)]
        assert places[-1][0] == pytest.approx(target, abs=1e-9)
        assert places[-1][1] == 0
        assert max(abs(v) for _, v, _ in places) <= max(speed, abs(velocity)) * (1 + 1e-9)
        assert max(abs(b[1] - a[1]) for a, b in pairwise(places)) <= max(up, down) * lasts / 1000 * (1 + 1e-9)


def test_a_config_of_the_package_runs_from_its_file(tmp_path):
    rig = load("configs/rig/slider.yaml")
    assert run(rig, program(far=0.05), tmp_path, simulate=True)["configuration"] == rig.digest


def test_a_host_that_stalls_is_noticed_by_the_drive(slider, tmp_path):
    """Nobody sends heartbeats any more: the drive stops within twice the time that it was told to wait."""
    with rig_on_bus(slider) as simulation:
        (drive,) = simulation.drives

        def stall(k):
            if drive.plant.velocity > 200:
                sync(simulation, round(2 * slider.bus.heartbeat_timeout / slider.bus.sync_period) + 100)
                assert drive.state is State.FAULT
                assert drive.error == o.HEARTBEAT_LOST
                assert abs(drive.plant.velocity) < 1

        with pytest.raises(DriveFault, match="heartbeat"):
            run(slider, program(), tmp_path, simulate=True, watch=stall, network=simulation.host)


def test_a_bus_with_threads_that_the_host_opens_itself(slider, tmp_path, monkeypatch):
    """As a real one: drives that answer when they come to it, and what is received in another thread.  Of a machine that may be busy."""
    import canopen

    monkeypatch.setattr(session, "STALL", 5.0)
    monkeypatch.setattr(session, "LOST", (5, 2.0))
    bus = replace(slider.bus, interface="virtual", channel=str(tmp_path), sync_period=0.005, heartbeat_timeout=1.0)
    rig = replace(slider, rate=200.0, bus=bus)
    network = canopen.Network()
    network.connect(interface=bus.interface, channel=bus.channel)
    try:
        drive = SimulatedDrive(network, rig, rig.axes[0], 0.02)
        home(rig, tmp_path / "home", simulate=False, arm=True)
        assert drive.homed
        moves = (
            Move(0.0, 0, "velocity", 0.16, 0.3, 3.0),
            Move(0.2, 0, "velocity", 0.16, 0.0, 3.0),
            Move(0.6, 0, "position", 0.1, 0.3, 3.0),
        )
        said = run(rig, Program(moves, (0.1,), 1.0), tmp_path / "run", simulate=False, arm=True)
    finally:
        network.disconnect()
    assert said["status"] == "complete"
    assert drive.state is State.DISABLED
    assert drive.position * 6.25e-6 == pytest.approx(0.1, abs=QC * 6.25e-6)
    encoder = read_encoder(tmp_path / "run" / "encoder.csv", rig)
    assert encoder.place[:, 0].max() == pytest.approx(0.16, abs=0.05)  # farther by 0.3 m/s where the drive's time, of SYNCs, went slower
    assert encoder.time[-1] > 1.0
