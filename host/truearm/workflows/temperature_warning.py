"""What temperature may have done to the lengths of a session whose bar has no thermometer."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from truearm.units import DEGC, MM, PPM_PER_K

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.types import BallBar, Rig

FAR = 2.0  # K: 12 µm of a steel bar of half a metre
STEEL = 11.5e-6  # 1/K, where the rig declares no expansion
LVDT = 1e-4  # 1/K, of an LVDT's gain (docs/hardware.md), where the rig declares no drift


def temperature_warning(result: SyncResult, rig: Rig, channel: str = "lvdt") -> str:
    """Return a sentence on the possible error of the lengths, "" where there is nothing to say.

    The session was measured FAR from the box's temperature at which ``channel`` was calibrated, and rows lack the bar's temperature.
    """
    table = result.table.select(result.table.kind == "ball_bar")
    noted = [
        one.calibrated_degc
        for ident in result.survey.idents.values()
        for stream in ident.streams.values()
        for one in stream.channels
        if one.name == channel and math.isfinite(one.calibrated_degc)
    ]
    unread = ~np.isfinite(table.column("bar_temperature", np.nan))
    warmer = table.temperature[unread] - (noted[0] if noted else np.nan)
    if not np.isfinite(warmer).any():
        return ""
    most = float(warmer[np.nanargmax(np.abs(warmer))])
    if abs(most) < FAR:
        return ""
    used = [rig.bars[name] for name in np.unique(table.bar[unread]).tolist() if name in rig.bars]
    bar = max(used, key=lambda one: possible_error(one, most))
    expansion, drift = coefficients(bar)
    return (
        f"the box was up to {DEGC.text(abs(most), '.1f')} {'warmer' if most > 0.0 else 'colder'} than when {channel} was calibrated, "
        f"and no thermometer was read on the bar: lengths may be off by {MM.text(possible_error(bar, most), '.3f')} "
        f"({PPM_PER_K.text(expansion)} of {MM.text(bar.zero, '.0f')}, {PPM_PER_K.text(drift)} of {MM.text(0.5 * bar.travel, '.1f')}); "
        "put a thermometer on the bar (docs/hardware.md), or calibrate the box at this temperature"
    )


def coefficients(bar: BallBar) -> tuple[float, float]:
    """Expansion of a bar and drift of its sensor's gain [1/K]: the rig's, or usual ones."""
    return bar.expansion or STEEL, bar.gain_drift or LVDT


def possible_error(bar: BallBar, warmer: float) -> float:
    """How far a length [m] may be off if the bar and its sensor are so many kelvins warmer: both at the end of the stroke."""
    expansion, drift = coefficients(bar)
    return abs(warmer) * (abs(expansion) * bar.zero + abs(drift) * 0.5 * bar.travel)
