"""The data sheets: what they print hangs together, where it does not is known, and a wrong digit is noticed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from torchcmax.rig.errors import Refused
from torchcmax.rig.motors import (
    UNITS,
    available_speed,
    continuous_torque,
    current,
    motor,
    motors,
    resistance,
    thermal_current,
    verify,
    voltage,
)  # fmt: skip

PARTS = [*motors()]
EC, DC = PARTS[:4], PARTS[4:]
SPEED, HEAT = ("nominal_speed", "n0 - dn/dM M_N"), ("nominal_current", "that of T_max at n_N")
KNOWN = {SPEED: {*EC, "448588", "448589"}, HEAT: {"272762", "272763", *DC}}  # who do not keep them


def outside(of):
    return {(d.field, d.identity) for d in verify(of) if d.outside_rounding}


def test_nine_windings_of_two_motors():
    assert len(EC) == 4
    assert len(DC) == 5
    assert {motor(part).family for part in EC} == {"EC-max 30"}
    assert {motor(part).commutation for part in DC} == {"dc"}
    with pytest.raises(Refused, match=r"no data sheet of motor '272761'[^\n]*\n.*EC-max 30: 272762, 272763"):
        motor("272761")


@pytest.mark.parametrize("part", PARTS)
def test_identities_hold_within_rounding_but_for_known_ones(part):
    found = verify(motor(part))
    assert len(found) == 12
    assert outside(motor(part)) == {identity for identity, parts in KNOWN.items() if part in parts}
    assert all(abs(d.relative) < 0.0071 for d in found if not d.outside_rounding)
    assert next(abs(d.relative) for d in found if d.field == "nominal_current") < (0.005 if part in EC else 0.0011)


def test_known_deviations():
    """Of the nominal speed: brushless ones are printed 0.6 % lower, two windings of the RE 40 higher."""
    found = {part: next(d.relative for d in verify(motor(part)) if d.field == "nominal_speed") for part in PARTS}
    assert all(found[part] == pytest.approx(-0.006, abs=0.0006) for part in EC)
    assert found["448588"] == pytest.approx(0.0184, abs=0.0005)  # 2610 rpm printed, 2563 computed
    assert found["448589"] == pytest.approx(0.0045, abs=0.0005)
    assert all(abs(found[part]) < 0.004 for part in DC[2:])


def test_the_nominal_current_is_thermal_where_the_motor_is_brushless():
    """The specification's percentages; brushes bear far less than the winding, whose nominal torque therefore counts."""
    found = {part: next(d for d in verify(motor(part)) if (d.field, d.identity) == HEAT) for part in PARTS}
    off = [100 * (found[part].computed / found[part].printed - 1) for part in EC]
    assert off == pytest.approx([-2.8, -0.9, -0.2, -0.1], abs=0.05)
    times = [found[part].computed / found[part].printed for part in DC]
    assert (min(times), max(times)) == pytest.approx((1.71, 1.86), abs=0.006)
    for part in PARTS:
        m = motor(part)
        assert thermal_current(m, m.nominal_speed) == pytest.approx(found[part].computed)
    assert all(continuous_torque(motor(part), motor(part).nominal_speed) == motor(part).nominal_torque for part in DC)


PROTECTED = (
    "resistance torque_constant speed_constant time_constant inertia starting_current stall_torque no_load_speed gradient nominal_current "
    "nominal_torque efficiency"
).split()


@pytest.mark.parametrize("field", PROTECTED)
def test_a_wrong_digit_is_noticed(field):
    """The first or the second digit of any winding, one more or one less, brings a deviation that is not a known one."""
    unit, tried = UNITS[field][1], 0
    for part in PARTS:
        m = motor(part)
        printed = getattr(m, field) / unit
        first = 10.0 ** math.floor(math.log10(printed) + 1e-9)
        for step in (first, -first, first / 10, -first / 10):
            tried += 1
            assert outside(replace(m, **{field: (printed + step) * unit})) - outside(m), (part, printed, step)
    assert tried == 36


def test_what_no_identity_protects_is_pinned():
    pinned = {
        "no_load_current": ([302, 191, 130, 95.4, 49.7, 24.8, 18.1, 11.0, 8.62], 1e-3),
        "nominal_speed": ([6590, 8040, 8270, 8130, 2610, 2600, 2480, 2640, 2410], math.pi / 30),
        "inductance": ([0.049, 0.143, 0.312, 0.573, 0.0624, 0.330, 0.613, 1.70, 2.62], 1e-3),
        "housing_ambient": ([7.4] * 4 + [4.65] * 5, 1.0),
        "winding_housing": ([0.5] * 4 + [1.93] * 5, 1.0),
        "winding_time": ([2.76] * 4 + [41.5] * 5, 1.0),
        "housing_time": ([1000] * 4 + [809] * 5, 1.0),
        "winding_max": ([155] * 4 + [100] * 5, 1.0),
        "max_speed": ([15000] * 4 + [3330] * 5, math.pi / 30),
    }
    for field, (values, unit) in pinned.items():
        assert [getattr(motor(part), field) for part in PARTS] == pytest.approx([value * unit for value in values]), field
    assert all(m.source and m.pole_pairs == 1 for m in motors().values())


@pytest.mark.parametrize("part", PARTS)
def test_no_load_and_stall_are_those_printed(part):
    m = motor(part)
    assert current(m, 0.0, m.no_load_speed) == pytest.approx(m.no_load_current)
    assert voltage(m, current(m, 0.0, m.no_load_speed), m.no_load_speed) == pytest.approx(m.voltage, rel=0.005)
    assert available_speed(m, 0.0, m.voltage) == pytest.approx(m.no_load_speed, rel=0.005)
    assert voltage(m, m.starting_current, 0.0) == pytest.approx(m.voltage, rel=0.01)
    assert m.torque_constant * m.starting_current == pytest.approx(m.stall_torque, rel=0.005)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("volts", [12.0, 30.0])
def test_the_available_speed_is_where_the_voltage_ends(part, volts):
    m, torque = motor(part), np.linspace(-0.04, 0.04, 9)
    speed = available_speed(m, torque, volts, 80.0)
    np.testing.assert_allclose(voltage(m, current(m, torque, speed), speed, 80.0), volts)


def test_braking_takes_less_current_than_driving():
    for part in (EC[1], DC[2]):
        m = motor(part)
        driving, braking = current(m, 0.02, 100.0), current(m, -0.02, 100.0)
        assert driving > 0.02 / m.torque_constant > -braking
        assert current(m, -0.02, -100.0) == -driving
    assert resistance(motor(EC[0]), 125.0) == pytest.approx(0.447 * 1.39)
