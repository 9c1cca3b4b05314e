"""How warm a motor becomes: two bodies, winding and housing, between the current's heat and the air."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcmax.rig.motors import COPPER, REFERENCE, Motor, no_load_loss


@dataclass(frozen=True)
class TwoBody:
    """C_w dTw/dt = I^2 R(Tw) - (Tw - Th) / R_wh and C_h dTh/dt = (Tw - Th) / R_wh + P0(n) - (Th - Ta) / R_ha, temperatures in °C.

    The capacities are those of the data sheet's time constants: C_w = tau_w / R_wh, C_h = tau_h / R_ha.
    """

    motor: Motor
    ambient: float = REFERENCE

    def step(self, winding: float, housing: float, current: float, loss: float, dt: float) -> tuple[float, float]:
        """Temperatures after dt s, of constant current A and loss of the housing W: the midpoint rule, good where dt is far below tau_w."""
        dw, dh = self._slope(winding, housing, current, loss)
        dw, dh = self._slope(winding + dw * dt / 2, housing + dh * dt / 2, current, loss)
        return winding + dw * dt, housing + dh * dt

    def _slope(self, winding: float, housing: float, current: float, loss: float) -> tuple[float, float]:
        """K/s."""
        m = self.motor
        heat = current * current * m.resistance * (1 + COPPER * (winding - REFERENCE))
        through = (winding - housing) / m.winding_housing
        out = (housing - self.ambient) / m.housing_ambient
        return (heat - through) * m.winding_housing / m.winding_time, (through + loss - out) * m.housing_ambient / m.housing_time

    def run(
        self, current: np.ndarray, speed: np.ndarray, dt: float, begin: tuple[float, float] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """current [K] A, speed [K] rad/s, each for dt s -> temperatures of winding and housing [K] after each; begin: else of the air."""
        winding, housing = begin or (self.ambient, self.ambient)
        found = np.empty((len(current), 2))
        for k, (i, loss) in enumerate(zip(current.tolist(), no_load_loss(self.motor, speed).tolist(), strict=True)):
            winding, housing = self.step(winding, housing, i, loss, dt)
            found[k] = winding, housing
        return found[:, 0], found[:, 1]
