"""A short plan to measure a robot's repeatability: a few poses, each approached many times from both sides of every
joint.

At each pose the robot first stands still for a long time, to measure the noise of sensor and readings. Then it
repeatedly moves a short way off and comes back, with each joint approaching from its own side. The sides of a round are
the rows of a Hadamard matrix, so each joint approaches equally often from both sides and independently of all others,
and the same few visits separate the effects of the joints on the bar (Plackett and Burman, Biometrika 33, 1946). Each
round has a new random order, so that drift is not correlated with a direction. The bar stays on: the bar's free travel
limits how far a joint moves off.

The poses are those at which the bar is most informative about every joint. They are chosen greedily to maximise the
sum, over the joints, of the logarithm of the squared derivatives of the length summed over the poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import hadamard

from truearm.errors import Argument, PlanError
from truearm.model.chain import along, point_forward, trace_point
from truearm.plan.bar_paths import Pace, move_seconds, moves_allowed, way_without_bar, ways_with_bar
from truearm.plan.measurement_limits import Pairing, Site, free_travel
from truearm.plan.route import Route
from truearm.plan.shells import candidates
from truearm.progress import steps_of
from truearm.types import Floats, Plan

FARTHEST = 0.05  # rad that a joint moves off
LEAST = 1.5e-3  # rad; with less, the side of a stop could be mistaken for a swing
SHARE = 0.9  # of the free travel, for all joints together
SHELL = "characterize"


class ApproachesWanted(NamedTuple):
    """The number of poses, the number of rounds of visits to each, and the seconds of the long dwell at each."""

    n_poses: int = 4
    rounds: int = 4
    long_s: float = 20.0
    n_candidates: int = 400
    seed: int = 0


def plan_approaches(site: Site, pairing: Pairing, wanted: ApproachesWanted, pace: Pace) -> Route:
    """Return the route: via points with the bar on, poses, and repeated rows for long dwells. Raises PlanError."""
    found = candidates(site, [pairing], wanted.n_candidates, wanted.seed)
    derivatives = length_derivatives(site, found.q, pairing)
    both = list(zip(found.q, derivatives, strict=True))
    away = [
        _away(site, q, jac, pairing)
        for q, jac in steps_of(both, "looking for poses at which every joint moves the bar")
    ]
    reached = np.array([step is not None for step in away])
    if reached.sum() < wanted.n_poses:
        raise PlanError(
            *(
                f"only {int(reached.sum())} poses leave the bar room to retract and return; ask for fewer ",
                Argument("poses"),
            ),
            *(" or give a ", Argument("result"), ", whose model needs less reserve"),
        )
    usable = np.flatnonzero(reached)
    chosen = usable[most_informative(derivatives[usable], wanted.n_poses)]
    rng = np.random.default_rng([wanted.seed, 0xC4A2])
    stops: list[tuple[Floats, bool, bool]] = []  # joints, whether the bar is read, whether it is mounted there
    for pose in steps_of(chosen.tolist(), "planning paths between poses"):
        q, step = found.q[pose], away[pose]
        assert step is not None
        if stops:
            via, mount = _between(site, stops[-1][0], q, pairing, wanted.seed)
            stops += [(place, False, False) for place in via]
        else:
            mount = True
        long = max(1, round(wanted.long_s / pace.dwell))
        stops += [(q, True, mount and k == 0) for k in range(long)]
        for _ in range(wanted.rounds):
            for signs in rng.permutation(approach_directions(len(q))):
                stops += [(q + signs * step, False, False), (q, True, False)]
    return _route(site, stops, pairing, pace)


def approach_directions(joints: int) -> Floats:
    """Return the side from which each joint comes (k, j), ±1: Hadamard columns without the constant first one."""
    order = 1 << int(joints).bit_length()
    return np.asarray(hadamard(order)[:, 1 : joints + 1], dtype=np.float64)


def most_informative(derivatives: Floats, n: int) -> list[int]:
    """Return the n of all poses (p, j) at which the length is most informative about every joint, chosen greedily."""
    squared = np.square(derivatives)
    total = np.full(squared.shape[1], 1e-6)  # m²/rad²: limits the gain for a joint that no pose shows
    chosen: list[int] = []
    for _ in range(n):
        gain = np.sum(np.log(total + squared), axis=1)
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        total = total + squared[chosen[-1]]
    return chosen


def length_derivatives(site: Site, q: Floats, pairing: Pairing) -> Floats:
    """Return ∂length/∂joints (n, j) of the bar at joints q (n, j)."""
    _, mounted = pairing.of(site.rig)
    trace = trace_point(site.arm.chain, site.arm.params, q, mounted.p_sphere)
    vector = trace.p_base - mounted.p_chuck
    return np.asarray(along(trace, vector / np.linalg.norm(vector, axis=1, keepdims=True)).jac_joints)


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
    via = way_without_bar(site, start, end, seed)
    if via is None:
        raise PlanError("no collision-free path to two of the poses was found; try another ", Argument("seed"))
    return via if len(via) else 0.5 * (start + end)[None], True


def _route(site: Site, stops: list[tuple[Floats, bool, bool]], pairing: Pairing, pace: Pace) -> Route:
    q = np.array([stop[0] for stop in stops])
    read, mount = (np.array([stop[k] for stop in stops]) for k in (1, 2))
    pose = np.where(read, np.cumsum(read) - 1, -1)
    n = int(read.sum())
    names = (np.full(n, name) for name in (SHELL, pairing.bar, pairing.chuck, pairing.sphere))
    sphere = np.array(site.rig.spheres[pairing.sphere].xyz)
    seconds = np.array([0.0, *move_seconds(site, q[:-1], q[1:], sphere, pace)])
    return Route(Plan(q[read], *names), q, pose, mount, seconds, pace)
