"""Configuration branches of arms: joint bounds within which no singularity has to be passed.

An arm reaches a pose in several ways (elbow up or down, wrist flipped or not), with singularities between them. A plan
stays in one: then joints go straight from any pose to any other, and the bar can stay on.
"""

from __future__ import annotations

import numpy as np

from truearm.errors import PlanError
from truearm.model.chain import Chain
from truearm.plan.branch_inverse import PUMA_ELBOW_UP, Branch


def _degrees(lower: list[float], upper: list[float], clearance: float, height: float = 0.08) -> Branch:
    return Branch(np.deg2rad(lower), np.deg2rad(upper), clearance, height)


BRANCHES = {
    "puma560": PUMA_ELBOW_UP,
    # elbow up, the wrist's axis 5 on the side of the elbow
    "ur5e": _degrees([-150.0, -170.0, -150.0, -200.0, -165.0, -180.0], [150.0, -10.0, -15.0, 60.0, -15.0, 180.0], 0.22),
    # wrist not flipped; the stretched elbow (q3 = -76°) is kept away from
    "irb120": _degrees([-155.0, -80.0, -60.0, -150.0, 12.0, -180.0], [155.0, 100.0, 65.0, 150.0, 115.0, 180.0], 0.15),
}


def branch_of(chain: Chain, bounds_deg: str | None = None) -> Branch:
    """The branch of a known robot, or that of a text "-150:150,-170:-10,…" with bounds of every joint in degrees.

    Raises PlanError for a robot that has none and for a text that does not give one pair a joint within its limits.
    """
    if bounds_deg is None:
        if chain.name not in BRANCHES:
            known = ", ".join(sorted(BRANCHES))
            raise PlanError(f"robot {chain.name} has no known branch ({known} do); give --branch LOW:HIGH,… in degrees")
        return BRANCHES[chain.name]
    pairs = [part.split(":") for part in bounds_deg.split(",")]
    if len(pairs) != len(chain.joints) or any(len(pair) != 2 for pair in pairs):
        raise PlanError(f"--branch needs LOW:HIGH in degrees for each of {len(chain.joints)} joints, between commas")
    try:
        lower, upper = np.deg2rad([[float(text) for text in pair] for pair in pairs]).T
    except ValueError as exc:
        raise PlanError(f"--branch: {exc}; it needs numbers in degrees") from exc
    if not (np.isfinite(lower) & np.isfinite(upper) & (lower < upper)).all():
        raise PlanError("--branch: every LOW must be below its HIGH")
    limits = np.array([(joint.lower, joint.upper) for joint in chain.joints])
    if (lower < limits[:, 0]).any() or (upper > limits[:, 1]).any():
        raise PlanError("--branch: a bound lies outside the joint's limits")
    return Branch(lower, upper)
