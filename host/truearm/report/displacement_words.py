"""What is said about a base or tool that a fit places elsewhere than described, from the content of result.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from truearm.units import DEG, MM, UNITS, from_shown


def displacement_sentences(document: Mapping[str, Any]) -> list[str]:
    """Return that base or tool stands elsewhere than described, and what it means if it does not; empty if neither does."""
    found = document["displaced"]
    if not found:
        return []
    each = []
    for one in found:
        sizes = []
        for name, unit, scale, digits in (("distance_mm", "m", MM, ".3g"), ("turn_deg", "rad", DEG, ".2g")):
            size = from_shown(one[name], unit)
            if size > UNITS[unit].weak_sigma:
                sizes.append(scale.text(size, digits))
        each.append(f"the {one['frame']} {' and '.join(sizes)} from where it is described")
    text = " and ".join(each)
    place, they_are, they_were = (
        ("its place", "it is", "it was") if len(each) == 1 else ("their places", "they are", "they were")
    )
    return [
        f"The fit places {text}. This is normal if nobody measured {place}: the rig then defines where {they_are}. If {they_were} "
        "measured, positions in the rig are wrong by as much, and so is the tool. No residual shows this: check the positions "
        "in the rig."
    ]
