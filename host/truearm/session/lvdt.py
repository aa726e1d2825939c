"""An LVDT on a ball-bar: counts → volts → extension [m] → length [m].

The box says the first two steps (scale and calibration polynomial of the channel), the rig says the third:
length = zero + gain · extension, centre to centre.
"""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.session.box_ident import Channel
from truearm.types import BallBar, Floats

# Two's complement ends of a 24-bit converter: at either the input was at least that large, and the reading says no more.
RAIL_HIGH = 2**23 - 1
RAIL_LOW = -(2**23)


def railed(counts: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the counts that stand at a rail of the 24-bit converter."""
    return np.asarray((counts >= RAIL_HIGH) | (counts <= RAIL_LOW))


def volts(counts: NDArray[Any], channel: Channel) -> Floats:
    """counts · scale, in the channel's ``unit``; any shape."""
    return counts * np.float64(channel.scale)


def extension(counts: NDArray[Any], channel: Channel) -> Floats:
    """Extension [m] of the counts of a calibrated channel; any shape.

    Raises SessionError if the channel has no calibration to a length, or the box describes it wrongly.
    """
    if channel.fault:
        raise SessionError(
            f"channel {channel.name!r} of the box cannot be used: {channel.fault}; correct the box's configuration and "
            "record anew"
        )
    unit = channel.length_unit
    if unit is None:
        raise SessionError(
            f"channel {channel.name!r} of the box has no calibration to metres; record with a calibrated box"
        )
    return np.asarray(unit.to_si(np.polynomial.polynomial.polyval(volts(counts, channel), channel.poly)))


def shown(channel: Channel, count: int) -> tuple[str, float]:
    """A usable channel's sample for a person to look at, and its name with the unit: metres where it is calibrated to a length."""
    seen, unit = count * channel.scale, channel.length_unit
    if unit is None:
        return f"{channel.name}_{channel.unit or 'raw'}", seen
    return f"{channel.name}_m", unit.to_si(reduce(lambda sum, factor: sum * seen + factor, reversed(channel.poly), 0.0))


def bar_length(extension: Floats, bar: BallBar) -> Floats:
    """Length [m], centre to centre, of a bar at these extensions [m]."""
    return bar.zero + bar.gain * extension


def out_of_travel(extension: Floats, bar: BallBar) -> NDArray[np.bool_]:
    """Mask of the extensions [m] that lie beyond the bar's stroke, where it stands at a stop or its LVDT has left its
    linear range."""
    return np.asarray(np.abs(extension) > 0.5 * bar.travel)
