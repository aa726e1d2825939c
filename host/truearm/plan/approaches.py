"""A short plan to measure repeatability: a few poses, each approached many times from both sides of every joint.

At each pose the robot first stands still for a long time, to measure the noise of sensor and readings. Then it
repeatedly moves a short way off and comes back. The sides of a round are the rows of a Hadamard matrix, so each joint
approaches equally often from both sides (Plackett and Burman, Biometrika 33, 1946). Each round has a new random order,
so that drift is not correlated with a direction. The bar stays on: its free travel limits how far a joint moves off.

The poses are chosen greedily: they maximise the sum, over the joints, of the logarithm of the squared derivatives of
the length summed over the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from scipy.linalg import hadamard

from truearm.errors import Argument, PlanError
from truearm.model.chain import distance_jacobian, point_forward
from truearm.plan.bar_paths import Pace, moves_allowed, way_without_bar, ways_with_bar
from truearm.plan.measurement_limits import Pairing, Site, free_travel
from truearm.plan.options import ApproachOptions
from truearm.plan.route import Route, travelled
from truearm.plan.shells import candidates
from truearm.progress import steps_of
from truearm.types import Floats, Plan

FARTHEST = 0.05  # rad that a joint moves off
LEAST = 1.5e-3  # rad; with less, the side of a stop could be mistaken for a swing
SHARE = 0.9  # of the free travel, for all joints together
SHELL = "characterize"


def plan_approaches(site: Site, pairing: Pairing, options: ApproachOptions, pace: Pace) -> Route:
    """Return the route: via points with the bar on, poses, and repeated rows for long dwells. Raises PlanError."""
    q = candidates(site, [pairing], options.candidates, options.seed).q
    _, mounted = pairing.of(site.rig)
    # ∂length/∂joints (n, j) of the bar
    derivatives = distance_jacobian(site.arm.chain, site.arm.params, q, mounted.p_sphere, mounted.p_chuck)
    chosen = most_informative(derivatives, options.poses, lambda k: _away(site, q[k], derivatives[k], pairing))
    rng = np.random.default_rng([options.seed, 0xC4A2])
    long = max(1, round(options.long_dwell / pace.dwell))
    legs: list[tuple[Iterable[Floats], bool]] = []
    joints: list[Floats] = []
    for pose, step in steps_of(list(chosen.items()), "planning paths between poses"):
        legs.append(_between(site, joints[-1], q[pose], pairing, options.seed) if legs else ((), True))
        legs += [((), False)] * (long - 1)
        for _ in range(options.rounds):
            legs += [([q[pose] + signs * step], False) for signs in rng.permutation(approach_directions(len(step)))]
        joints += [q[pose]] * (len(legs) - len(joints))
    names = (np.full(len(joints), name) for name in (SHELL, pairing.bar, pairing.chuck, pairing.sphere))
    return travelled(site, Plan(np.array(joints), *names), legs, pace)


def approach_directions(joints: int) -> Floats:
    """Return the side from which each joint comes (k, j), ±1: Hadamard columns without the constant first one."""
    order = 1 << int(joints).bit_length()
    return np.asarray(hadamard(order)[:, 1 : joints + 1], dtype=np.float64)


def most_informative(derivatives: Floats, n: int, room: Callable[[int], Floats | None]) -> dict[int, Floats]:
    """Return the n of all poses (p, j) at which the length is most informative about every joint, chosen greedily.

    ``room`` returns how far each joint may move off a pose, None if the bar has no room there. Raises PlanError.
    """
    squared = np.square(derivatives)
    total = np.full(squared.shape[1], 1e-6)  # m²/rad²: limits the gain for a joint that no pose shows
    untried = np.ones(len(squared), bool)
    chosen: dict[int, Floats] = {}
    while len(chosen) < n:
        if not untried.any():
            raise PlanError(
                f"only {len(chosen)} poses leave the bar room to retract and return; ask for fewer ",
                *(Argument("poses"), " or give a ", Argument("result"), ", whose model needs less reserve"),
            )
        best = int(np.argmax(np.where(untried, np.sum(np.log(total + squared), axis=1), -np.inf)))
        untried[best] = False
        if (step := room(best)) is not None:
            chosen[best] = step
            total = total + squared[best]
    return chosen


def _away(site: Site, q: Floats, jac: Floats, pairing: Pairing) -> Floats | None:
    """Return how far each joint (j,) may move off a pose, for any sides; None if the bar's travel is too short."""
    bar, mounted = pairing.of(site.rig)
    length = np.linalg.norm(
        point_forward(site.arm.chain, site.arm.params, q[None], mounted.p_sphere)[0] - mounted.p_chuck
    )
    free = SHARE * (free_travel(bar, site.limits) - abs(float(length) - bar.zero))
    step = np.minimum(FARTHEST, np.maximum(free, 0.0) / (len(q) * np.maximum(np.abs(jac), 1e-9)))
    for _ in range(3):
        if step.min() < LEAST:
            return None
        sides = q + approach_directions(len(q)) * step
        if moves_allowed(site, sides, np.broadcast_to(q, sides.shape), pairing, site.limits).all():
            return np.asarray(step)
        step = 0.7 * step
    return None


def _between(site: Site, start: Floats, end: Floats, pairing: Pairing, seed: int) -> tuple[Floats, bool]:
    """Return via points between two poses, and whether the bar is removed on the way."""
    via = ways_with_bar(site, start[None], end[None], pairing)[0]
    if via is not None:
        return via, False
    via = way_without_bar(site, start, end, "two of the poses", seed)
    return via if len(via) else 0.5 * (start + end)[None], True
