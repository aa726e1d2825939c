"""Estimate the possible effect of temperature on the lengths of a session if the bar has no thermometer."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from truearm.box.readiness import FAR, LVDT, LVDT_DRIFT, STEEL
from truearm.text import page
from truearm.units import DEGC, MM, PPM_PER_K

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.types import BallBar, Rig


def temperature_warning(result: SyncResult, rig: Rig) -> str:
    """Return a sentence on the possible error of the lengths, "" if no warning is needed.

    A warning is needed if the session was measured FAR from the box's temperature at which the ball-bar's channel was calibrated,
    and rows lack the bar's temperature.
    """
    table = result.table.select(result.table.kind == "ball_bar")
    noted = [
        one.calibrated_degc
        for ident in result.survey.idents.values()
        for stream in ident.streams.values()
        for one in stream.channels
        if one.name == LVDT and math.isfinite(one.calibrated_degc)
    ]
    unread = ~np.isfinite(table.bar_temperature)
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
        f"the box was up to {DEGC.text(abs(most), '.1f')} {'warmer' if most > 0.0 else 'colder'} than when {LVDT} was calibrated, "
        f"and no thermometer was read on the bar: lengths may be off by {MM.text(possible_error(bar, most), '.3f')} "
        f"({PPM_PER_K.text(expansion)} of {MM.text(bar.zero, '.0f')}, {PPM_PER_K.text(drift)} of {MM.text(0.5 * bar.travel, '.1f')}); "
        f"put a thermometer on the bar ({page('Build and measure the rig')}), or calibrate the box at this temperature"
    )


def coefficients(bar: BallBar) -> tuple[float, float]:
    """Return the expansion of a bar and the drift of its sensor's gain [1/K] from the rig, or usual values."""
    return bar.expansion or STEEL, bar.gain_drift or LVDT_DRIFT


def possible_error(bar: BallBar, warmer: float) -> float:
    """Return the possible error of a length [m] if bar and sensor are warmer by these kelvins, at the end of the
    stroke.
    """
    expansion, drift = coefficients(bar)
    return abs(warmer) * (abs(expansion) * bar.zero + abs(drift) * 0.5 * bar.travel)
