"""Sentences about parameters that a calibration did not determine although they move the end, with what to do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.estimate.frame_choice import mounting
from truearm.model.chain import Chain, point_jacobians
from truearm.results import NullDirection
from truearm.text import listed, one_line
from truearm.types import Floats
from truearm.workflows.calibration import Calibration

MOVES = 1e-6  # m of motion by an unseen direction with a largest weight of 1
SHOWN, TERMS = 3, 3  # combinations, and parameters of each
PARTS = 3  # of the name of a number of the rig: "sphere.s1.x", with several rigs after the rig's name


def undetermined(calibration: Calibration, q: Floats, own_frames: bool) -> list[str]:
    """Return what the observations did not determine of the end's position at joints q (n, j); empty if nothing.

    The pose of the base is left out with ``own_frames``: it moves all targets with the robot.
    """
    chain = calibration.chain
    jac = point_jacobians(chain, calibration.identified, q, np.zeros(3))[1]

    def moving(directions: Sequence[NullDirection]) -> list[NullDirection]:
        return [one for one in directions if np.abs(jac @ _column(chain, one)).max(initial=0.0) > MOVES]

    said = []
    places = mounting(chain, calibration.nominal)
    own = np.array(chain.parameter_names)
    base, tool = set(own[places.base].tolist()), set(own[places.tool].tolist())
    held = moving(calibration.stored.frames)
    for what, names, outside in (("pose of the base", base, own_frames), ("mounting of the tool", tool, False)):
        mine = [one for one in held if names.intersection(one.names)]
        if mine and not outside:
            said.append(_held(what, mine, set(own.tolist())))
    if said and not own_frames and any(base.intersection(one.names) for one in held):
        said.append(
            "For targets relative to the robot's own base, run truearm correct or truearm map with --own-frames."
        )
    if null := moving(calibration.stored.null_space):
        these = "; ".join(_terms(one) for one in null[:SHOWN]) + f"; and {len(null) - SHOWN} more" * (len(null) > SHOWN)
        said.append(
            f"Unidentifiable combinations of parameters move the end: {these}. Their nominal values are used. "
            "Measure what the lines “Next:” of truearm identify propose."
        )
    return said


def unseen_by_use(calibration: Calibration, own_frames: bool) -> Floats:
    """Return the directions (p, d) that the observations did not determine, with ``own_frames`` without the base's pose."""
    unseen = calibration.unseen
    base = mounting(calibration.chain, calibration.nominal).base
    return unseen[:, (unseen[~base] != 0.0).any(axis=0)] if own_frames else unseen


def _held(what: str, directions: Sequence[NullDirection], robot: set[str]) -> str:
    """Return a sentence on a choice of frame; items of the rig, such as "sphere.s1.x", tell why there was one."""
    mine = dict.fromkeys(name for one in directions for name in one.names if name in robot)
    rig = [name.split(".") for one in directions for name in one.names if name not in robot]
    kinds = " and ".join(dict.fromkeys(f"{one_line(parts[-3])}s" for parts in rig if len(parts) >= PARTS))
    why = f"the positions of the {kinds} are unknown" if kinds else "such observations cannot determine it in any pose"
    then = (
        f"measure the {kinds}, write them into the rig with their standard deviations, and identify again"
        if kinds
        else "use another kind of observation"
    )
    return (
        f"The {what} ({listed([one_line(name) for name in mine])}) was held at its nominal value, because {why}. "
        f"An error in it shifts every pose alike. To determine it, {then}."
    )


def _column(chain: Chain, direction: NullDirection) -> Floats:
    weights = dict(zip(direction.names, direction.weights, strict=True))
    return np.array([weights.get(name, 0.0) for name in chain.parameter_names])


def _terms(direction: NullDirection) -> str:
    terms = sorted(zip(direction.weights, direction.names, strict=True), key=lambda term: -abs(term[0]))
    more = f" and {len(terms) - TERMS} more" * (len(terms) > TERMS)
    return " ".join(f"{weight:+.2f} {one_line(name)}" for weight, name in terms[:TERMS]) + more
