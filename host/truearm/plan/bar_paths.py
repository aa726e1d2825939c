"""Paths between poses with the bar on: straight in joint space, with via points where the bar would exceed its travel.

A straight joint move between two poses of a shell leaves the shell halfway. If some sample of a move violates the
limits, the middle of the move is brought back onto the shell by the smallest change of joints (Δq = J_dᵀ(J_d
J_dᵀ)⁻¹(zero − d), J_d = ∂d/∂q) and becomes a via point (Goswami 1993, Data collection). Both halves are then treated in
the same way, up to DEEPEST halvings. If no path is found, the bar must be removed for the move. Moves without a bar may
detour through a pose of the branch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.model.chain import along, point_forward, trace_point
from truearm.plan.measurement_limits import STEP, Pairing, Site, all_allowed
from truearm.types import Floats

DEEPEST = 4  # halvings: at most 15 via points
STEPS = 5  # of Newton's method; the third is exact to rounding for half the bulge of a shell
PEAK = 15.0 / 8.0  # peak speed of a quintic relative to its mean
SHORTEST = 0.2  # s for a move
BETWEEN = 1.005  # a speed may peak between two samples: by at most (6 joints · STEP/2)²/6 = 0.24 %; twice that
DETOURS = 60  # poses of the branch through which a move without a bar may pass


@dataclass(frozen=True)
class Pace:
    """Highest speeds of joints [rad/s] and of the bar's end [m/s], dwell at a pose and work at the bar [s]."""

    joint_speed: float = 0.8
    bar_speed: float = 0.25
    dwell: float = 2.0
    mount: float = 30.0


def samples(start: Floats, end: Floats) -> Floats:
    """Return joints (n, j) on the straight path, including both ends, at most STEP apart."""
    n = 2 + int(np.abs(end - start).max() / STEP)
    return start + np.linspace(0.0, 1.0, n)[:, None] * (end - start)


def way_with_bar(site: Site, start: Floats, end: Floats, pairing: Pairing, halvings: int = DEEPEST) -> Floats | None:
    """Return via points (v, j) between two poses with the bar on throughout; None if no path is found."""
    if all_allowed(site, samples(start, end), pairing, site.limits.tightened()):
        return np.zeros((0, len(start)))
    if halvings == 0:
        return None
    middle = onto_shell(site, 0.5 * (start + end), pairing)
    if not all_allowed(site, middle[None], pairing, site.limits.tightened()):
        return None
    before = way_with_bar(site, start, middle, pairing, halvings - 1)
    after = None if before is None else way_with_bar(site, middle, end, pairing, halvings - 1)
    return None if before is None or after is None else np.concatenate([before, middle[None], after])


def onto_shell(site: Site, q: Floats, pairing: Pairing) -> Floats:
    """Return the nearest joints (j,) at which the bar is at mid-travel."""
    bar, mounted = pairing.of(site.rig)
    for _ in range(STEPS):
        trace = trace_point(site.arm.chain, site.arm.params, q[None], mounted.p_sphere)
        vector = trace.p_base - mounted.p_chuck
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        jacobian = along(trace, vector / length).jac_joints[0]
        q = q + jacobian * (bar.zero - length[0, 0]) / (jacobian @ jacobian)
    return q


def way_without_bar(site: Site, start: Floats, end: Floats, seed: int = 0) -> Floats | None:
    """Return via points (v, j), none or one, for a collision-free move; None if no path is found."""
    tightened = site.limits.tightened()

    def free(a: Floats, b: Floats) -> bool:
        return all_allowed(site, samples(a, b), None, tightened)

    if free(start, end):
        return np.zeros((0, len(start)))
    branch = site.arm.branch
    q = np.random.default_rng([seed, 0xDE700]).uniform(branch.lower, branch.upper, (DETOURS, len(start)))
    length = np.abs(q - start).max(axis=1) + np.abs(q - end).max(axis=1)
    for via in q[np.argsort(length)]:
        if free(start, via) and free(via, end):
            return np.asarray(via[None])
    return None


def fastest(site: Site, start: Floats, end: Floats, p_end_point: Floats) -> float:
    """Return the largest |∂p/∂s| [m] of a point (3,) of the end over a straight joint move, s from 0 to 1."""
    n = max(3, len(samples(start, end)))
    q = start + np.linspace(0.0, 1.0, n)[:, None] * (end - start)
    p = point_forward(site.arm.chain, site.arm.params, q, p_end_point)
    rate = np.gradient(p, 1.0 / (n - 1), axis=0, edge_order=2)
    return float(np.linalg.norm(rate, axis=1).max()) * BETWEEN


def move_seconds(site: Site, start: Floats, end: Floats, p_end_point: Floats, pace: Pace) -> float:
    """Return the duration of a quintic move in which neither a joint nor the point ever exceeds the pace."""
    by_joints = float(np.abs(end - start).max()) / pace.joint_speed
    return max(PEAK * max(by_joints, fastest(site, start, end, p_end_point) / pace.bar_speed), SHORTEST)
