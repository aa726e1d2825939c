"""Inverse kinematics of any chain: joint readings that bring the end to a pose, or its origin to a point.

Levenberg–Marquardt on the pose error e (position, rotation vector), all targets at once:

    Δq = Jᵀ·(J·Jᵀ + λ²·I)⁻¹·e ,

with a λ of its own for each target: a tenth after a step that lowered ‖e‖, ten times after one that did not. Near the
solution λ vanishes and the steps are Newton's: the error squares, down to rounding. A robot with more joints than
needed, and a target without orientation, take the smallest joint motion from where they start.

The Jacobian's smallest singular value says how near a singularity is: the joints move 1/σ for an error of one. Metres
count in units of LEVER there, so that a turn of the wrist and a motion of the arm compare.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from truearm.model.chain import Chain, forward, joint_jacobian
from truearm.model.poses import apart
from truearm.types import Floats

LEVER = 0.5  # m
MAX_STEPS = 100
TOLERANCE = 1e-12  # LEVERs and rad, of ‖e‖; rounding leaves some 1e-16 of an arm of a metre
GOOD = 1e-10  # of ‖e‖, 0.05 nm: what counts as reached
LARGEST_STEP = 0.5  # rad, m
DAMPING_START, DAMPING_LEAST, DAMPING_MOST = 1e-3, 1e-9, 1e3
N_SAMPLES = 20_000  # random joint vectors to start a search from
N_NEAR = 150  # of them that are looked at for each target, and
N_STARTS = 24  # started from: those most unlike each other, since an arm of six joints has up to 16 configurations
ROOM = 0.05  # rad, m: what a correction moves a joint by, as a rule
SINGULAR = 0.1  # twice the margin of corrections
CHUNK = 20_000  # targets solved at once: Jacobians of 10 MB


class Inverse(NamedTuple):
    """Joint readings found for n targets."""

    q: Floats  # (n, j)
    reached: NDArray[np.bool_]  # (n,)
    singular_value: Floats  # (n,) smallest, of the Jacobian there


def inverse(chain: Chain, params: Floats, targets: Floats, q_start: Floats, oriented: bool = True) -> Inverse:
    """The solutions for targets (n, 4, 4) that are nearest downhill from q_start (n, j); limits are not looked at.

    oriented : False where only the origin matters.
    """
    parts = [slice(at, at + CHUNK) for at in range(0, max(len(targets), 1), CHUNK)]
    found = [_inverse(chain, params, targets[part], q_start[part], oriented) for part in parts]
    return Inverse(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _inverse(chain: Chain, params: Floats, targets: Floats, q_start: Floats, oriented: bool) -> Inverse:
    q = np.array(q_start, dtype=float)
    damping = np.full(len(q), DAMPING_START)
    error = _error(chain, params, targets, q, oriented)
    size = np.linalg.norm(error, axis=-1)
    for _ in range(MAX_STEPS):
        at = np.flatnonzero((size > TOLERANCE) & (damping < DAMPING_MOST))
        if not at.size:
            break
        step = _step(jacobian(chain, params, q[at], oriented), error[at], damping[at])
        there = q[at] + step
        new = _error(chain, params, targets[at], there, oriented)
        new_size = np.linalg.norm(new, axis=-1)
        better = new_size < size[at]
        damping[at] = np.where(better, np.maximum(0.1 * damping[at], DAMPING_LEAST), 10.0 * damping[at])
        taken = at[better]
        q[taken], error[taken], size[taken] = there[better], new[better], new_size[better]
    return Inverse(q, size < GOOD, singular_value(chain, params, q, oriented))


def jacobian(chain: Chain, params: Floats, q: Floats, oriented: bool = True) -> Floats:
    """(n, 6, j), or (n, 3, j) of the position alone, with positions in LEVERs."""
    jac = joint_jacobian(chain, params, q)
    jac[..., :3, :] /= LEVER
    return jac if oriented else jac[..., :3, :]


def singular_value(chain: Chain, params: Floats, q: Floats, oriented: bool = True) -> Floats:
    """(n,) the smallest of ``jacobian``."""
    return np.asarray(np.linalg.svd(jacobian(chain, params, q, oriented), compute_uv=False)[..., -1])


def scaled(error: Floats, oriented: bool = True) -> Floats:
    """A difference (n, 6) as ``jacobian`` has its rows."""
    error = np.concatenate([error[..., :3] / LEVER, error[..., 3:]], axis=-1)
    return error if oriented else error[..., :3]


def _error(chain: Chain, params: Floats, targets: Floats, q: Floats, oriented: bool) -> Floats:
    return scaled(apart(targets, forward(chain, params, q)), oriented)


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
) -> Inverse:
    """Solutions within the joint limits for targets (n, 4, 4), each from N_STARTS of the N_NEAR best of N_SAMPLES joint vectors.

    Of an arm's configurations that is taken which is nearest to the solution before, of the first target nearest to
    ``home`` (j,) (default: the middle of the limits). ``quadrants`` (n, j), NaN where it does not matter, is stronger:
    the quarter turn that a reading shall lie in, as ⌊q/90°⌋. Where no target is reached, what came nearest is returned.
    """
    lower, upper = _sampled_range(chain)
    q_seeds = np.random.default_rng(0).uniform(lower, upper, (N_SAMPLES, len(lower)))
    tree = KDTree(_features(forward(chain, params, q_seeds), oriented))
    parts = [targets[at : at + CHUNK // N_STARTS] for at in range(0, max(len(targets), 1), CHUNK // N_STARTS)]
    near_by = (q_seeds[tree.query(_features(part, oriented), k=N_NEAR)[1]] for part in parts)
    starts = np.concatenate([_unlike(q) for q in near_by])
    n, k, j = starts.shape
    found = inverse(chain, params, np.repeat(targets, k, axis=0), starts.reshape(n * k, j), oriented)
    q = wrapped(chain, found.q).reshape(n, k, j)
    good = found.reached.reshape(n, k) & within(chain, q)
    if not oriented:  # where the joints are ours to choose, those at a limit or a singularity are the worse choice
        worse = ~within(chain, q, ROOM) | (found.singular_value.reshape(n, k) < SINGULAR)
    else:  # the controller goes where it goes
        worse = np.zeros((n, k), dtype=bool)
    near = 0.5 * (lower + upper) if home is None else home
    wrong = np.zeros((n, k)) if quadrants is None else _misplaced(q, quadrants)
    chosen = np.empty(n, dtype=int)
    for i in range(n):
        far = np.abs(q[i] - near).max(axis=-1) + 1e2 * worse[i] + 1e3 * wrong[i] + 1e6 * ~good[i]
        chosen[i] = int(np.argmin(far))
        if good[i, chosen[i]]:
            near = q[i, chosen[i]]
    pick = np.arange(n), chosen
    return Inverse(q[pick], good[pick], found.singular_value.reshape(n, k)[pick])


def wrapped(chain: Chain, q: Floats) -> Floats:
    """Joint readings (…, j) turned by whole turns of the reading into the limits where they have such a place."""
    q = q.copy()
    for i, joint in enumerate(chain.joints):
        if joint.kind == "revolute" and np.isfinite([joint.lower, joint.upper]).all():
            middle = 0.5 * (joint.lower + joint.upper)
            q[..., i] -= 2.0 * np.pi * np.round((q[..., i] - middle) / (2.0 * np.pi))
    return q


def within(chain: Chain, q: Floats, room: float = 0.0) -> NDArray[np.bool_]:
    """(…,) whether joint readings (…, j) lie within the limits, by ``room`` [rad, m]."""
    lower, upper = (np.array([getattr(joint, end) for joint in chain.joints]) for end in ("lower", "upper"))
    return np.asarray(((q >= lower + room) & (q <= upper - room)).all(axis=-1))


def _sampled_range(chain: Chain) -> tuple[Floats, Floats]:
    """The limits; a turning joint without, or with more than a turn, is sampled over one."""
    middle = [0.5 * (j.lower + j.upper) if np.isfinite(j.lower + j.upper) else 0.0 for j in chain.joints]
    half = [min(0.5 * (j.upper - j.lower), np.pi) for j in chain.joints]
    return np.array(middle) - half, np.array(middle) + half


def _unlike(q: Floats) -> Floats:
    """(n, N_STARTS, j) of q (n, k, j): the first, then always the one farthest from all that were taken."""
    each = np.arange(len(q))
    taken = [np.zeros(len(q), dtype=int)]
    apart_from = np.full(q.shape[:2], np.inf)
    for _ in range(N_STARTS - 1):
        last = q[each, taken[-1]][:, None]
        apart_from = np.minimum(apart_from, np.abs(q - last).max(axis=-1))
        taken.append(apart_from.argmax(axis=1))
    return np.stack([q[each, which] for which in taken], axis=1)


def _misplaced(q: Floats, quadrants: Floats) -> Floats:
    """(n, k) how many joints are in another quarter turn than they shall be."""
    wrong = np.floor(q / (0.5 * np.pi)) != quadrants[:, None]
    return np.asarray((wrong & ~np.isnan(quadrants)[:, None]).sum(axis=-1), dtype=float)


def _features(poses: Floats, oriented: bool) -> Floats:
    """Positions in LEVERs, and two axes: the distance of two poses as inverse kinematics feels it."""
    position = poses[..., :3, 3] / LEVER
    return np.concatenate([position, poses[..., :3, 2], poses[..., :3, 0]], axis=-1) if oriented else position
