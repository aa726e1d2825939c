"""Whether a systematic error leaves open where the tool is: an item that is off in all rows by an unknown amount.

Two of three coordinates of a chuck may be off by 1 mm beyond doubt, while the third only turns base and arm with it. The
covariance of a fit that takes the chuck's place as known does not contain that.
"""

from __future__ import annotations

from truearm.results import Effect, SystematicErrors
from truearm.units import UNITS


def tool_undetermined(wrong: SystematicErrors | None) -> bool:
    """Return whether an item is off in all rows by numbers known less accurately than a drawing gives them."""
    if wrong is None:
        return False
    return any(
        not of.sigma <= UNITS[of.unit].weak_sigma
        for one in wrong.found
        if one.effect is not None and one.effect == Effect(one.effect.what)
        for of in one.off_by
    )
