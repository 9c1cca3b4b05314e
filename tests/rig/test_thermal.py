"""The two-body model against closed forms."""

import numpy as np
import pytest

from torchcmax.rig.motors import COPPER, motor, thermal_current
from torchcmax.rig.thermal import TwoBody


@pytest.mark.parametrize("part", ["272763", "448590"])
def test_it_comes_to_its_steady_state(part):
    m = motor(part)
    model, current = TwoBody(m, 22.0), np.full(100_000, 0.8 * m.nominal_current)
    speed = np.full(100_000, m.nominal_speed)
    winding, housing = model.run(current, speed, 0.2)
    assert (winding[-1], housing[-1]) == pytest.approx(model.steady(current, speed), abs=1e-3)


@pytest.mark.parametrize("part", ["272763", "448590"])
def test_the_thermal_current_holds_the_highest_temperature(part):
    m = motor(part)
    limit = thermal_current(m, m.nominal_speed, 30.0)
    assert TwoBody(m, 30.0).steady(limit[None], np.array([m.nominal_speed]))[0] == pytest.approx(m.winding_max)


@pytest.mark.parametrize("part", ["272763", "448590"])
def test_it_is_the_exponential_of_its_matrix(part):
    """For constant current both equations are linear: T(t) = T_inf + exp(A t) (T_0 - T_inf)."""
    from scipy.linalg import expm

    m, ambient, current, dt = motor(part), 25.0, 2.0, 0.001
    heat = current**2 * m.resistance
    c_w, c_h = m.winding_time / m.winding_housing, m.housing_time / m.housing_ambient
    A = np.array([[(heat * COPPER - 1 / m.winding_housing) / c_w, 1 / m.winding_housing / c_w],
                  [1 / m.winding_housing / c_h, -(1 / m.winding_housing + 1 / m.housing_ambient) / c_h]])  # fmt: skip
    b = np.array([heat * (1 - 25 * COPPER) / c_w, ambient / m.housing_ambient / c_h])
    forever = -np.linalg.solve(A, b)
    winding, housing = TwoBody(m, ambient).run(np.full(5000, current), np.zeros(5000), dt)
    expected = forever + expm(A * 5.0) @ (ambient - forever)
    assert (winding[-1], housing[-1]) == pytest.approx(tuple(expected), abs=1e-5)


def test_the_winding_cools_with_its_time_constant():
    """Fast against the housing, which hardly changes: by 1 / e of the difference in tau_w."""
    m = motor("272763")
    winding, housing = TwoBody(m).run(np.zeros(2760), np.zeros(2760), 0.001, (100.0, 25.0))
    assert (winding[-1] - housing[-1]) / 75.0 == pytest.approx(np.exp(-1), abs=0.02)


def test_too_much_current_runs_away():
    m = motor("272763")
    assert TwoBody(m).steady(np.array([100.0]), np.zeros(1)) == (np.inf, np.inf)
