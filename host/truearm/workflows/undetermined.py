"""Findings about parameters that a calibration did not determine although they move the end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.estimate.frame_choice import mounting
from truearm.findings import Finding
from truearm.model.chain import point_jacobians
from truearm.report.result_words import direction_text
from truearm.results import MOVES, NullDirection, weights_of
from truearm.types import Floats
from truearm.workflows.calibration import Calibration

SHOWN, TERMS = 3, 3  # combinations, and parameters of each
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


def undetermined(calibration: Calibration, q: Floats, own_frames: bool) -> list[Finding]:
    """Return what the observations did not determine of the end's position at joints q (n, j); empty if nothing.

    The pose of the base is left out with ``own_frames``: it moves all targets with the robot.
    """
    chain = calibration.chain
    jac = point_jacobians(chain, calibration.identified, q, np.zeros(3))[1]

    def moving(directions: Sequence[NullDirection]) -> list[NullDirection]:
        return [
            one for one in directions if np.abs(jac @ weights_of([one], chain.parameter_names)).max(initial=0.0) > MOVES
        ]

    findings = []
    places, defaults = mounting(chain, calibration.nominal), calibration.stored.defaults
    own = np.array(chain.parameter_names)
    base = set(own[places.base].tolist())
    held = moving(calibration.stored.defaults.frames)
    for key, what, mask, outside in (
        ("base", "pose of the base", places.base, own_frames),
        ("tool", "mounting of the tool", places.tool, False),
    ):
        names = set(getattr(defaults, key) or own[mask].tolist())
        directions = [direction for direction in held if names.intersection(direction.names)]
        if directions and not outside:
            held_names = [name for name in own.tolist() if name in names]
            values = {"what": what, "base": key == "base", **_held(held_names, directions)}
            findings.append(Finding("mounting-held", values))
            if key == "base":
                findings.append(Finding("own-frames-next"))
    null = moving(calibration.stored.null_space)
    if own_frames:  # a turn of the base together with the rig moves no target relative to the robot
        null = [direction for direction in null if set(own.tolist()).intersection(direction.names) - base]
    if null:
        values = {
            "terms": [direction_text(direction.weights, direction.names, TERMS) for direction in null[:SHOWN]],
            "more": max(len(null) - SHOWN, 0),
        }
        findings.append(Finding("null-space-moves-end", values))
    return findings


def unseen_within(calibration: Calibration) -> tuple[Floats, tuple[str, ...]]:
    """Return the directions (p, d) that the observations did not determine, without those that only place base or tool,
    and which of the two they place: errors are then relative to it.
    """
    unseen, places = calibration.unseen, mounting(calibration.chain, calibration.nominal)
    within = (unseen[~places.either] != 0.0).any(axis=0)
    placed = (unseen[:, ~within] != 0.0).any(axis=1)
    return unseen[:, within], tuple(name for name in ("base", "tool") if placed[getattr(places, name)].any())


def _held(names: Sequence[str], directions: Sequence[NullDirection]) -> dict[str, object]:
    """Return the names of a choice of frame; items of the rig, such as "sphere.s1.x", tell why there was one."""
    parts = {part for direction in directions for name in direction.names for part in name.split(".")[:-1]}
    items = [words for item, words in ITEMS.items() if item in parts]
    moved = {name for direction in directions for name in direction.names}
    return {"names": [name for name in names if name in moved], "items": " and ".join(items)}
