"""The two-body model against closed forms and against what a general solver makes of its equations."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from torchcmax.rig.motors import COPPER, motor, no_load_loss, thermal_current
from torchcmax.rig.thermal import TwoBody

both = pytest.mark.parametrize("part", ["272763", "448590"])


def linear(m, ambient, current, speed):
    """A [2, 2] and T_inf [2] of dT/dt = A (T - T_inf): for constant current and speed both equations are linear."""
    heat, loss = current**2 * m.resistance, float(no_load_loss(m, speed))
    c_w, c_h = m.winding_time / m.winding_housing, m.housing_time / m.housing_ambient
    A = np.array([[(heat * COPPER - 1 / m.winding_housing) / c_w, 1 / m.winding_housing / c_w],
                  [1 / m.winding_housing / c_h, -(1 / m.winding_housing + 1 / m.housing_ambient) / c_h]])  # fmt: skip
    b = np.array([heat * (1 - 25 * COPPER) / c_w, (loss + ambient / m.housing_ambient) / c_h])
    return A, -np.linalg.solve(A, b)


@both
def test_it_is_the_exponential_of_its_matrix(part):
    """T(t) = T_inf + exp(A t) (T_0 - T_inf)."""
    m = motor(part)
    A, forever = linear(m, 25.0, 2.0, m.nominal_speed)
    winding, housing = TwoBody(m).run(np.full(5000, 2.0), np.full(5000, m.nominal_speed), 0.001)
    expected = forever + expm(A * 5.0) @ (25.0 - forever)
    assert (winding[-1], housing[-1]) == pytest.approx(tuple(expected), abs=1e-5)


@both
def test_it_comes_to_its_steady_state(part):
    m = motor(part)
    winding, housing = TwoBody(m, 22.0).run(np.full(100_000, 0.8 * m.nominal_current), np.full(100_000, m.nominal_speed), 0.2)
    assert (winding[-1], housing[-1]) == pytest.approx(tuple(linear(m, 22.0, 0.8 * m.nominal_current, m.nominal_speed)[1]), abs=1e-3)


@both
def test_the_thermal_current_holds_the_highest_temperature(part):
    m = motor(part)
    limit = float(thermal_current(m, m.nominal_speed, 30.0))
    assert linear(m, 30.0, limit, m.nominal_speed)[1][0] == pytest.approx(m.winding_max)
    winding, _ = TwoBody(m, 30.0).run(np.full(100_000, limit), np.full(100_000, m.nominal_speed), 0.2)
    assert winding[-1] == pytest.approx(m.winding_max, abs=0.01)


@both
def test_motions_heat_as_a_general_solver_says(part):
    """Current and speed that change: at every sample the solution of the equations, its tolerance 1e-9."""
    m, random = motor(part), np.random.default_rng(3)
    dt = m.winding_time / 300
    current = np.repeat(random.uniform(-3, 3, 40) * m.nominal_current, 25)
    speed = np.repeat(random.uniform(-1, 1, 40) * m.nominal_speed, 25)

    def slope(_, T, i, loss):
        through = (T[0] - T[1]) / m.winding_housing
        heat = i * i * m.resistance * (1 + 0.0039 * (T[0] - 25))
        c_w, c_h = m.winding_time / m.winding_housing, m.housing_time / m.housing_ambient
        return [(heat - through) / c_w, (through + loss - (T[1] - 40.0) / m.housing_ambient) / c_h]

    T, expected = np.array([60.0, 45.0]), []
    for k in range(0, len(current), 25):
        n = speed[k]
        loss = m.torque_constant * m.no_load_current * (n * n / m.no_load_speed if m.commutation == "ec" else abs(n))
        times = dt * np.arange(1, 26)
        found = solve_ivp(slope, (0, times[-1]), T, t_eval=times, args=(current[k], loss), rtol=1e-9, atol=1e-9).y
        T = found[:, -1]
        expected.append(found)
    ran = TwoBody(m, 40.0).run(current, speed, dt, (60.0, 45.0))
    np.testing.assert_allclose(ran, np.concatenate(expected, 1), atol=1e-3)
    assert np.ptp(ran[0]) > 1


@both
def test_bodies_cool_with_their_time_constants(part):
    """A housing held by the winding that is as warm, a winding by a housing that hardly changes: each by 1 / e of the difference."""
    m = motor(part)
    steps = round(m.winding_time / 0.01)
    winding, housing = TwoBody(m).run(np.zeros(steps), np.zeros(steps), 0.01, (100.0, 25.0))
    c_w, c_h = m.winding_time / m.winding_housing, m.housing_time / m.housing_ambient
    apart = np.exp(-1 - m.winding_time / m.winding_housing / c_h)  # both come nearer: the rates of the two bodies add
    assert (winding[-1] - housing[-1]) / 75.0 == pytest.approx(apart, rel=0.02)
    assert c_w * (winding[-1] - 100.0) == pytest.approx(-c_h * (housing[-1] - 25.0), rel=0.1)  # what one loses the other gains
    steps = round(m.housing_time / 0.1)
    winding, housing = TwoBody(m).run(np.zeros(steps), np.zeros(steps), 0.1, (60.0, 60.0))
    slow = 1 / -np.linalg.eigvals(linear(m, 25.0, 0.0, 0.0)[0]).max()  # s, longer than tau_h as the winding's heat leaves with it
    assert slow == pytest.approx(m.housing_time * (1 + c_w / c_h), rel=0.05)
    assert (housing[-1] - 25.0) / 35.0 == pytest.approx(np.exp(-m.housing_time / slow), abs=0.01)


def test_too_much_current_runs_away():
    """Where the winding's resistance grows faster than its heat leaves there is no steady state."""
    winding, _ = TwoBody(motor("272763")).run(np.full(3000, 60.0), np.zeros(3000), 0.01)
    assert (np.diff(winding, 2) > 0).all()
