"""A laboratory that warms up, with the ball-bar, its sensor, and the thermometers on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from truearm.types import REFERENCE_DEGC, Floats, Rig

STEEL = 11.5e-6  # 1/K
THERMOMETERS = {"bar": bytes.fromhex("28aa0102030405a7"), "sensor": bytes.fromhex("28bb0102030405cb")}
STEP = 62.5  # m°C, of a DS18B20


@dataclass(frozen=True)
class Thermal:
    """The bar starts at ``begin`` [°C] and warms up linearly by ``drift`` [K] over the session.

    Its sensor and the box are ``ahead`` [K] warmer. ``expansion`` of the bar's zero and ``gain_drift`` of its sensor
    [1/K] are relative to the reference temperature. ``thermometers``: those of ``THERMOMETERS`` that are on the wire.
    """

    begin: float = REFERENCE_DEGC
    drift: float = 0.0
    ahead: float = 0.0
    expansion: float = STEEL
    gain_drift: float = 0.0
    thermometers: tuple[str, ...] = ("bar", "sensor")

    def degc(self, name: str, share: Floats) -> Floats:
        """Return the temperature (m,) [°C] of the item ``name`` at elapsed shares (m,) of the session."""
        bar = self.begin + self.drift * np.clip(share, 0.0, 1.0)
        return np.asarray(bar if name == "bar" else bar + self.ahead)

    def readings(self, share: float) -> tuple[tuple[bytes, int], ...]:
        """Return address and m°C of each thermometer on the wire."""
        degc = {name: float(self.degc(name, np.array([share]))[0]) for name in self.thermometers}
        return tuple((THERMOMETERS[name], round(STEP * round(1e3 * value / STEP))) for name, value in degc.items())

    def declared(self, rig: Rig) -> Rig:
        """Return ``rig`` with a data sheet's coefficients for its bars: these ones, to a tenth."""
        bars = {
            name: replace(
                bar,
                expansion=self.expansion,
                expansion_sigma=0.1 * abs(self.expansion),
                gain_drift=self.gain_drift,
                gain_drift_sigma=0.1 * abs(self.gain_drift),
            )
            for name, bar in rig.bars.items()
        }
        return replace(rig, bars=bars)

    def named(self) -> dict[str, str]:
        """Return the thermometers by their names in the box's configuration."""
        return {name: THERMOMETERS[name].hex() for name in self.thermometers}
