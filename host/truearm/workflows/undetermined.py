"""Sentences about parameters that a calibration did not determine although they move the end, with what to do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.estimate.frame_choice import mounting
from truearm.model.chain import point_jacobians
from truearm.results import MOVES, NullDirection, largest_terms, weights_of
from truearm.text import listed, one_line
from truearm.types import Floats
from truearm.workflows.calibration import Calibration

SHOWN, TERMS = 3, 3  # combinations, and parameters of each
NAMES = 8  # of held parameters
SMALLEST = 0.005  # weight in a combination that is shown
# In names of the rig's numbers, such as "sphere.s1.x", and in words.
ITEMS = {
    "chuck": "chucks",
    "socket": "sockets",
    "tracker": "trackers",
    "line": "line devices",
    "plane": "planes",
    "sphere": "spheres on the end",
    "target": "targets on the end",
}


def undetermined(calibration: Calibration, q: Floats, own_frames: bool) -> list[str]:
    """Return what the observations did not determine of the end's position at joints q (n, j); empty if nothing.

    The pose of the base is left out with ``own_frames``: it moves all targets with the robot.
    """
    chain = calibration.chain
    jac = point_jacobians(chain, calibration.identified, q, np.zeros(3))[1]

    def moving(directions: Sequence[NullDirection]) -> list[NullDirection]:
        return [
            one for one in directions if np.abs(jac @ weights_of([one], chain.parameter_names)).max(initial=0.0) > MOVES
        ]

    said = []
    places, defaults = mounting(chain, calibration.nominal), calibration.stored.defaults
    own = np.array(chain.parameter_names)
    base = set(own[places.base].tolist())
    held = moving(calibration.stored.defaults.frames)
    for what, key, mask, effect, outside in (
        ("pose of the base", "base", places.base, "moves and turns all targets together, as one body", own_frames),
        ("mounting of the tool", "tool", places.tool, "is the same offset in the end's frame at every pose", False),
    ):
        names = set(getattr(defaults, key) or own[mask].tolist())
        mine = [one for one in held if names.intersection(one.names)]
        if mine and not outside:
            said.append(_held(what, [name for name in own.tolist() if name in names], mine, effect))
            if key == "base":
                said.append(
                    "For targets relative to the robot's own base, run truearm correct or truearm map with --own-frames."
                )
    null = moving(calibration.stored.null_space)
    if own_frames:  # a turn of the base together with the rig moves no target relative to the robot
        null = [one for one in null if set(own.tolist()).intersection(one.names) - base]
    if null:
        these = "; ".join(_terms(one) for one in null[:SHOWN]) + f"; and {len(null) - SHOWN} more" * (len(null) > SHOWN)
        said.append(
            f"Unidentifiable combinations of parameters move the end (weights in m, rad and 1): {these}. Their nominal values are used. "
            "Measure what the lines “Next:” of truearm identify propose."
        )
    return said


def unseen_within(calibration: Calibration) -> tuple[Floats, tuple[str, ...]]:
    """Return the directions (p, d) that the observations did not determine, without those that only place base or tool,
    and which of the two they place: errors are then relative to it.
    """
    unseen, places = calibration.unseen, mounting(calibration.chain, calibration.nominal)
    within = (unseen[~places.either] != 0.0).any(axis=0)
    placed = (unseen[:, ~within] != 0.0).any(axis=1)
    return unseen[:, within], tuple(name for name in ("base", "tool") if placed[getattr(places, name)].any())


def _held(what: str, names: Sequence[str], directions: Sequence[NullDirection], effect: str) -> str:
    """Return a sentence on a choice of frame; items of the rig, such as "sphere.s1.x", tell why there was one."""
    parts = {part for one in directions for name in one.names for part in name.split(".")[:-1]}
    unknown = " and ".join(words for item, words in ITEMS.items() if item in parts)
    moved = {name for one in directions for name in one.names}
    shown = listed([one_line(name) for name in names if name in moved], NAMES)
    why = (
        f"the positions of the {unknown} are unknown"
        if unknown
        else "such observations cannot determine it in any pose"
    )
    then = (
        f"measure the {unknown}, write them into the rig with their standard deviations, and identify again"
        if unknown
        else "use another kind of observation"
    )
    return f"The {what} ({shown}) was held at its nominal value, because {why}. An error in it {effect}. To determine it, {then}."


def _terms(direction: NullDirection) -> str:
    terms = [term for term in largest_terms(direction.weights, direction.names) if abs(term[0]) >= SMALLEST]
    more = f" and {len(terms) - TERMS} more" * (len(terms) > TERMS)
    return " ".join(f"{weight:+.2f} {one_line(name)}" for weight, name in terms[:TERMS]) + more
