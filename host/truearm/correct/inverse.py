"""Inverse kinematics of any chain: joint readings that bring the end to a pose, or its origin to a point.

Levenberg–Marquardt on the pose error e (position, rotation vector), all targets at once:

    Δq = Jᵀ·(J·Jᵀ + λ²·I)⁻¹·e ,

with a separate λ for each target, divided by ten after a step that reduced ‖e‖ and multiplied by ten after any other.
Near the solution λ is negligible and the steps are Newton's: the error is squared at each step, down to rounding. For a
robot with more joints than needed, and for a target without orientation, the joint motion from the starting point is
the smallest.

The smallest singular value of the Jacobian shows how close a singularity is: an error of one moves the joints by 1/σ.
Here metres count in units of LEVER, to make a rotation of the wrist comparable with a motion of the arm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from truearm.model.chain import Chain, end_and_jacobian, forward, joint_jacobian
from truearm.model.poses import apart
from truearm.progress import steps_of
from truearm.types import Floats

LEVER = 0.5  # m
MAX_STEPS = 100
TOLERANCE = 1e-12  # LEVERs and rad, of ‖e‖; rounding leaves about 1e-16 for an arm of one metre
GOOD = 1e-10  # of ‖e‖, 0.05 nm: counts as reached
LARGEST_STEP = 0.5  # rad, m
DAMPING_START, DAMPING_LEAST, DAMPING_MOST = 1e-3, 1e-6, 1e3  # the square of the least exceeds the rounding of J·Jᵀ
N_SAMPLES = 20_000  # random joint vectors as candidates to start a search from
N_NEAR = 150  # of these, the ones considered for each target, and
N_STARTS = 24  # used as starts: the most different ones, since an arm with six joints has up to 16 configurations
PASSES = 6  # continuations from the previous solution, whose configuration may be missing among those found
EDGE = 0.01  # rad beyond a quarter turn: an axis at 0 is there to within the digits of the program's numbers
SAME = 1e-6  # rad, m between solutions
ROOM = 0.05  # rad, m: typical motion of a joint by a correction
PART = 2_000  # targets whose solutions are compared at once
CELL = 0.1  # LEVERs and of axes: targets in one cell start from each other's solutions
NEXT = 0.5  # rad, m from the robot's previous position: beyond this, a nearer solution may have been missed
SINGULAR = 0.1  # twice the margin of corrections
CHUNK = 2_000  # targets solved at once: Jacobians of 1 MB


class Inverse(NamedTuple):
    """Joint readings found for n targets."""

    q: Floats  # (n, j)
    reached: NDArray[np.bool_]  # (n,)
    singular_value: Floats  # (n,) smallest, of the Jacobian at q


class Origins(NamedTuple):
    """The robot's previous position for each of n targets.

    Either another target (n,), -1 for the one before, or joint readings (n, j), NaN where it is a target.
    """

    target: NDArray[np.int_]
    q: Floats


def inverse(
    chain: Chain, params: Floats, targets: Floats, q_start: Floats, oriented: bool = True, bounded: bool = False
) -> Inverse:
    """Return the solutions for targets (n, 4, 4) that are nearest downhill from q_start (n, j).

    oriented : False if only the origin matters. bounded : True if no step may leave the joint limits, within which
        q_start must be; otherwise limits are ignored.
    """
    parts = [slice(at, at + CHUNK) for at in range(0, max(len(targets), 1), CHUNK)]
    parts_done = steps_of(parts, f"solving for the joints of {len(targets)} targets")
    found = [_inverse(chain, params, targets[part], q_start[part], oriented, bounded) for part in parts_done]
    return Inverse(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _inverse(chain: Chain, params: Floats, targets: Floats, q_start: Floats, oriented: bool, bounded: bool) -> Inverse:
    q = np.array(q_start, dtype=float)
    damping = np.full(len(q), DAMPING_START)
    error, jac = _error_and_jacobian(chain, params, targets, q, oriented)
    size = np.linalg.norm(error, axis=-1)
    for _ in range(MAX_STEPS):
        at = np.flatnonzero((size > TOLERANCE) & (damping < DAMPING_MOST))
        if not at.size:
            break
        if bounded:
            there = _within_limits(chain, q[at], jac[at], error[at], damping[at])
        else:
            there = q[at] + _step(jac[at], error[at], damping[at])
        new, new_jac = _error_and_jacobian(chain, params, targets[at], there, oriented)
        new_size = np.linalg.norm(new, axis=-1)
        better = new_size < size[at]
        damping[at] = np.where(better, np.maximum(0.1 * damping[at], DAMPING_LEAST), 10.0 * damping[at])
        taken = at[better]
        q[taken], error[taken], size[taken], jac[taken] = there[better], new[better], new_size[better], new_jac[better]
    return Inverse(q, size < GOOD, np.asarray(np.linalg.svd(jac, compute_uv=False)[..., -1]))


def _error_and_jacobian(
    chain: Chain, params: Floats, targets: Floats, q: Floats, oriented: bool
) -> tuple[Floats, Floats]:
    """Return the error towards the targets (n, 6), and ``jacobian``."""
    pose, jac = end_and_jacobian(chain, params, q)
    jac[:, :3] /= LEVER
    return scaled(apart(targets, pose), oriented), jac if oriented else jac[:, :3]


def jacobian(chain: Chain, params: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Return the Jacobian (n, 6, j), or (n, 3, j) for the position alone, with positions in LEVERs."""
    jac = joint_jacobian(chain, params, q)
    jac[..., :3, :] /= LEVER
    return jac if oriented else jac[..., :3, :]


def singular_value(chain: Chain, params: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Return the smallest singular value (n,) of ``jacobian``."""
    return np.asarray(np.linalg.svd(jacobian(chain, params, q, oriented), compute_uv=False)[..., -1])


def scaled(error: Floats, oriented: bool = True) -> Floats:
    """Return a difference (n, 6) scaled like the rows of ``jacobian``."""
    error = np.concatenate([error[..., :3] / LEVER, error[..., 3:]], axis=-1)
    return error if oriented else error[..., :3]


def _within_limits(chain: Chain, q: Floats, jac: Floats, error: Floats, damping: Floats) -> Floats:
    """Return the joints (n, j) after a step in which a joint stops at its limit; from there the others move alone."""
    lower, upper = chain.limits
    there = q + _step(jac, error, damping)
    for _ in range(q.shape[1]):
        stopped = ((there < lower) & (q <= lower)) | ((there > upper) & (q >= upper))
        if not stopped.any():
            break
        jac = np.where(stopped[:, None], 0.0, jac)
        there = q + _step(jac, error, damping)
    return np.clip(there, lower, upper)


def _step(jac: Floats, error: Floats, damping: Floats) -> Floats:
    normal = jac @ jac.swapaxes(-1, -2) + damping[:, None, None] ** 2 * np.eye(jac.shape[-2])
    step = (jac.swapaxes(-1, -2) @ np.linalg.solve(normal, error[..., None]))[..., 0]
    return np.asarray(step * np.minimum(1.0, LARGEST_STEP / np.maximum(np.abs(step).max(axis=-1), 1e-300))[:, None])


def search(
    chain: Chain,
    params: Floats,
    targets: Floats,
    oriented: bool = True,
    home: Floats | None = None,
    quadrants: Floats | None = None,
    origins: Origins | None = None,
) -> Inverse:
    """Return solutions within the joint limits for targets (n, 4, 4).

    Each is sought from the previous solution and from N_STARTS of the N_NEAR best of N_SAMPLES joint vectors. Among an
    arm's configurations, the one nearest to the robot's previous position is taken. That position is given by
    ``origins`` or is the previous solution; for the first target it is ``home`` (j,) (default: the middle of the
    limits), which positions without orientation stay near. Joints with a range of more than one turn use the number of turns that brings them nearest. ``quadrants``
    (n, j), NaN where it does not matter, has priority: the quarter turn in which a reading must lie, as ⌊q/90°⌋. For a
    target that is not reached, the nearest result is returned.
    """
    stock, (lower, upper) = solutions(chain, params, targets, oriented), _sampled_range(chain)
    n, _, j = stock.q.shape
    first = 0.5 * (lower + upper) if home is None else home
    asked = np.full((n, j), np.nan) if quadrants is None else quadrants
    begun = Origins(np.full(n, -1), np.full((n, j), np.nan)) if origins is None else origins
    if home is not None and not oriented:  # among a continuum of joints, random starts do not end near home
        stock = _with(stock, inverse(chain, params, targets, np.tile(home, (n, 1)), oriented))
    chosen, near = _chosen(chain, params, stock, first, asked, oriented, begun)
    for _ in range(PASSES if oriented else 0):  # without orientation there is a free choice of joints
        far = np.flatnonzero(~chosen.reached | (np.abs(chosen.q - near).max(axis=-1) > NEXT))
        if not far.size:
            break
        went_on = Inverse(near.copy(), np.zeros(n, dtype=bool), np.zeros(n))
        for part, of_far in zip(went_on, inverse(chain, params, targets[far], near[far]), strict=True):
            part[far] = of_far
        stock = _with(stock, went_on)
        near_before = near
        chosen, near = _chosen(chain, params, stock, first, asked, oriented, begun)
        if np.abs(near - near_before).max(initial=0.0) < SAME:
            break
    return chosen


def several_fit(
    chain: Chain, params: Floats, targets: Floats, quadrants: Floats, oriented: bool = True
) -> NDArray[np.bool_]:
    """Return for which targets (n, 4, 4) several solutions within the joint limits fit the quarter turns (n, j) best, as in ``search``."""
    stock = solutions(chain, params, targets, oriented)
    found = np.zeros(len(targets), dtype=bool)
    for i, asked in enumerate(quadrants):
        q = turned(chain, params, stock.q[i], np.where(np.isnan(asked), 0.0, 0.5 * np.pi * (asked + 0.5)))
        misplaced = _misplaced(q, asked)[stock.reached[i] & within(chain, q)]
        found[i] = (misplaced == misplaced.min(initial=np.inf)).sum() > 1
    return found


def solutions(chain: Chain, params: Floats, targets: Floats, oriented: bool) -> Inverse:
    """Return solutions (n, k) for targets, ignoring limits; those of targets near another start from its solutions."""
    lower, upper = _sampled_range(chain)
    q_seeds = np.random.default_rng(0).uniform(lower, upper, (N_SAMPLES, len(lower)))
    tree = KDTree(_features(forward(chain, params, q_seeds), oriented))

    def searched(rows: NDArray[np.int_]) -> Inverse:
        parts = []
        for at in range(0, max(len(rows), 1), CHUNK // N_STARTS):
            some = targets[rows[at : at + CHUNK // N_STARTS]]
            starts = _unlike(q_seeds[tree.query(_features(some, oriented), k=N_NEAR)[1]])
            found = inverse(chain, params, np.repeat(some, N_STARTS, axis=0), starts.reshape(-1, len(lower)), oriented)
            shape = (len(some), N_STARTS)
            of_each = Inverse(
                found.q.reshape(*shape, len(lower)), found.reached.reshape(shape), found.singular_value.reshape(shape)
            )
            outside = _only_outside(chain, of_each, oriented)
            goals, starts = np.repeat(some[outside], N_STARTS, axis=0), starts[outside].reshape(-1, len(lower))
            for part, bounded in zip(of_each, inverse(chain, params, goals, starts, oriented, True), strict=True):
                part[outside] = bounded.reshape(part[outside].shape)
            parts.append(_distinct(chain, params, of_each) if oriented else of_each)
        return _stacked(parts)

    if not oriented or not targets.size:
        return searched(np.arange(len(targets)))
    cells = np.floor(_features(targets, oriented) / CELL).astype(int)
    _, leaders, cell_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    led = searched(leaders)
    cell_of = cell_of.reshape(-1)
    stock, order = [led], [leaders]
    others = np.setdiff1d(np.arange(len(targets)), leaders)
    for at in range(0, len(others), PART):
        rows = others[at : at + PART]
        begin = _rows(led, cell_of[rows])
        which, slot = np.nonzero(begin.reached)
        near = Inverse(begin.q.copy(), np.zeros_like(begin.reached), begin.singular_value.copy())
        for part, found in zip(near, inverse(chain, params, targets[rows[which]], begin.q[which, slot]), strict=True):
            part[which, slot] = found
        near = _distinct(chain, params, near)
        # A solution may be lost on the way if it merges with another, or begins between the two targets.
        lost = near.reached.sum(axis=1) < begin.reached.sum(axis=1)
        lost |= np.where(begin.reached, begin.singular_value, np.inf).min(axis=1) < SINGULAR
        lost |= _only_outside(chain, near, oriented)
        stock += [_rows(near, ~lost), searched(rows[lost])]
        order += [rows[~lost], rows[lost]]
    back = np.argsort(np.concatenate(order))
    return _rows(_stacked(stock), back)


def _with(stock: Inverse, solution: Inverse) -> Inverse:
    """Return solutions (n, k) and another one of each target (n,)."""
    return Inverse(*(np.concatenate([a, b[:, None]], axis=1) for a, b in zip(stock, solution, strict=True)))


def _only_outside(chain: Chain, found: Inverse, oriented: bool) -> NDArray[np.bool_]:
    """Return whether all solutions of a target (n, k) are beyond the limits although the arm has others (redundant)."""
    redundant = found.q.shape[-1] > (6 if oriented else 3)
    return np.asarray(redundant & found.reached.any(axis=1) & ~(found.reached & within(chain, found.q)).any(axis=1))


def _rows(of: Inverse, rows: NDArray[Any]) -> Inverse:
    return Inverse(of.q[rows], of.reached[rows], of.singular_value[rows])


def _distinct(chain: Chain, params: Floats, found: Inverse) -> Inverse:
    """Return the reached solutions of (n, k), each once, and at least one for each target.

    Solutions that differ by whole turns of a joint count as one.
    """
    turn = 2.0 * np.pi / np.abs(chain.law.gain.of(params))
    same = np.broadcast_to(found.reached[:, None], (*found.reached.shape, found.reached.shape[1]))
    for i, joint in enumerate(chain.joints):
        difference = found.q[:, :, None, i] - found.q[:, None, :, i]
        if joint.kind == "revolute":
            difference -= turn[i] * np.round(difference / turn[i])
        same = same & (np.abs(difference) < SAME)
    again = np.tril(same, -1).any(axis=-1)
    last = np.argsort(again | ~found.reached, axis=1, kind="stable")
    kept = found.reached & ~again
    width = max(1, int(kept.sum(axis=1).max(initial=1)))
    rows = np.arange(len(last))[:, None]
    return Inverse(
        found.q[rows, last[:, :width]], kept[rows, last[:, :width]], found.singular_value[rows, last[:, :width]]
    )


def _stacked(parts: list[Inverse]) -> Inverse:
    """Return the solutions of several sets of targets, padded to the largest number per target."""
    width = max(part.q.shape[1] for part in parts)
    wide = [
        Inverse(*(np.concatenate([of, np.repeat(of[:, :1], width - of.shape[1], axis=1)], axis=1) for of in part))
        for part in parts
    ]
    for part, before in zip(wide, parts, strict=True):
        part.reached[:, before.q.shape[1] :] = False
    return Inverse(*(np.concatenate(column) for column in zip(*wide, strict=True)))


def _chosen(
    chain: Chain, params: Floats, stock: Inverse, first: Floats, asked: Floats, oriented: bool, origins: Origins
) -> tuple[Inverse, Floats]:
    """Return, of k solutions (n, k), those nearest to the robot's previous positions, and these positions (n, j)."""
    middle, free = 0.5 * np.pi * (asked + 0.5), np.isnan(asked)

    def nearest(rows: NDArray[np.int_], here: Floats) -> tuple[Floats, NDArray[np.bool_], Floats]:
        q = turned(chain, params, stock.q[rows], np.where(free[rows], here, middle[rows])[:, None])
        usable, singular_values = stock.reached[rows] & within(chain, q), stock.singular_value[rows]
        far = np.abs(q - here[:, None]).max(axis=-1) + 1e3 * _misplaced(q, asked[rows, None]) + 1e6 * ~usable
        if not oriented:  # then joints at a limit or a singularity are the worse choice
            far += 1e2 * (~within(chain, q, ROOM) | (singular_values < SINGULAR))
        best = np.arange(len(rows)), np.argmin(far, axis=1)
        return q[best], usable[best], singular_values[best]

    # All targets are solved at once from where the robot is likely to be; those for which it is elsewhere, again.
    order, every = _followed(origins.target), np.arange(len(asked))
    given: NDArray[np.bool_] = np.asarray(np.isfinite(origins.q).all(axis=1))
    likely, _, _ = nearest(every, np.broadcast_to(first, asked.shape))
    previous = np.empty_like(every)
    previous[order] = np.roll(order, 1)
    near = np.where(given[:, None], origins.q, likely[np.where(origins.target < 0, previous, origins.target)])
    chosen, usable, margin = nearest(every, near)
    here, good = first, np.zeros(len(asked), dtype=bool)
    for i in order:
        before = origins.target[i]
        if given[i]:
            here = origins.q[i]
        elif before >= 0 and good[before]:
            here = chosen[before]
        if not (near[i] == here).all():
            near[i] = here
            chosen[i], usable[i], margin[i] = (part[0] for part in nearest(every[i : i + 1], near[i : i + 1]))
        good[i] = usable[i]
        here = chosen[i] if good[i] else here
    return Inverse(chosen, good, margin), near


def _followed(origin: NDArray[np.int_]) -> list[int]:
    """Return the targets in an order in which each follows the robot's previous target, unless that is circular."""
    order: list[int] = []
    seen = np.zeros(len(origin), dtype=bool)
    for i in range(len(origin)):
        way = []
        at = i
        while at >= 0 and not seen[at]:
            seen[at] = True
            way.append(at)
            at = int(origin[at])
        order += reversed(way)
    return order


def turned(chain: Chain, params: Floats, q: Floats, near: Floats) -> Floats:
    """Return joint readings (…, j) shifted by whole turns as close to ``near`` (…, j) as the limits allow.

    A reading that is beyond a limit only by rounding is returned as the limit.
    """
    turn, law = 2.0 * np.pi / np.abs(chain.law.gain.of(params)), chain.law
    lower, upper = chain.limits + np.array([[-GOOD], [GOOD]])
    turning = np.array([joint.kind == "revolute" for joint in chain.joints])
    turns = np.clip(np.round((near - q) / turn), np.ceil((lower - q) / turn), np.floor((upper - q) / turn))
    turns = np.where(turning, turns, 0.0)
    there = q + turn * turns
    if turns.any() and not law.affine:
        same = law.angles(params, q) + 2.0 * np.pi * np.sign(law.gain.of(params)) * turns
        there = np.where(turns.any(axis=-1, keepdims=True), law.readings(params, same, near=there), q)
    return _at_limit(chain, there)


def _at_limit(chain: Chain, q: Floats) -> Floats:
    """Return joint readings (…, j) with those that are beyond a limit only by rounding at the limit."""
    there = np.clip(q, *chain.limits)
    return np.where(np.abs(there - q) < GOOD, there, q)


def within(chain: Chain, q: Floats, room: float = 0.0) -> NDArray[np.bool_]:
    """Return whether joint readings (…, j) are inside the limits by ``room`` [rad, m]."""
    lower, upper = chain.limits
    return np.asarray(((q >= lower + room) & (q <= upper - room)).all(axis=-1))


def _sampled_range(chain: Chain) -> tuple[Floats, Floats]:
    """Return the limits for sampling: one turn for a revolute joint without limits or with a larger range."""
    middle = [0.5 * (j.lower + j.upper) if np.isfinite(j.lower + j.upper) else 0.0 for j in chain.joints]
    half = [min(0.5 * (j.upper - j.lower), np.pi) for j in chain.joints]
    return np.array(middle) - half, np.array(middle) + half


def _unlike(q: Floats) -> Floats:
    """Return (n, N_STARTS, j) of q (n, k, j): the first, then repeatedly the one farthest from all taken before."""
    each = np.arange(len(q))
    taken = [np.zeros(len(q), dtype=int)]
    apart_from = np.full(q.shape[:2], np.inf)
    for _ in range(N_STARTS - 1):
        last = q[each, taken[-1]][:, None]
        apart_from = np.minimum(apart_from, np.abs(q - last).max(axis=-1))
        taken.append(apart_from.argmax(axis=1))
    return np.stack([q[each, which] for which in taken], axis=1)


def _misplaced(q: Floats, quadrants: Floats) -> Floats:
    """Return the number (…) of joints of q (…, j) outside the required quarter turns (…, j), NaN where any will do."""
    beyond = np.abs(q - 0.5 * np.pi * (quadrants + 0.5)) > 0.25 * np.pi + EDGE  # never true for NaN
    return np.asarray(beyond.sum(axis=-1), dtype=float)


def _features(poses: Floats, oriented: bool) -> Floats:
    """Return positions in LEVERs and two axes: the distance between two poses for inverse kinematics."""
    position = poses[..., :3, 3] / LEVER
    return np.concatenate([position, poses[..., :3, 2], poses[..., :3, 0]], axis=-1) if oriented else position
