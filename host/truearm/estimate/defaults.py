"""What is identified, and what is believed beforehand, where the user does not say: frames, still joints, a weak prior.

All three follow from what the data can see at the robot as described, the rig fitted to it, before anything is identified:

1. **Frames.** Parameters that only say where base and tool stand are held as far as that is a choice (``frame_choice``).
2. **Still joints.** A joint whose readings span less than STILL times a drawing's σ (20 mrad, 4 mm) does not show its axis: what
   it seems to show is the jitter of the readings. As many parameters are held as directions would be lost if it stood quite still,
   the joint's own first.
3. **Prior.** A drawing's σ (1 mm, 5 mrad, 0.001 of a gain) about the nominal value, only for the parameters of directions that
   the data tell less well than that, by the noise that they show, and not for mountings, which are on no drawing. Without it a fit creeps along such
   a direction for centimetres, though no prediction there depends on it. Where the data see everything there is no prior.

What is unseen and what is hardly seen is reported from the data alone, without this prior (``identify``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.fit import fit
from truearm.estimate.frame_choice import held_as_frames, mounting
from truearm.estimate.identifiability import identifiability, not_told, spread, suggested_free
from truearm.estimate.information import RANK_TOLERANCE, observe, with_prior
from truearm.estimate.prior import weak_prior, wide_prior
from truearm.estimate.problem import Problem, Rigs, build_problem, settled
from truearm.estimate.solution import Options
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.model.chain import Chain
from truearm.types import Defaults, Floats, ObservationTable, StillJoint
from truearm.units import UNITS

Mask = NDArray[np.bool_]

STILL = 4.0  # weak σ, from the least to the largest reading
LARGEST_MISFIT = 10.0  # the noise over the declared one
PRELIMINARY = 20  # iterations
LEAST_POSES = 300  # random ones; three times as many as any robot has parameters
MOTION = 0.5  # rad, m: of a still joint, if it moved


def choose_defaults(
    chain: Chain, rig: Rigs, table: ObservationTable, free: Mask, named: Mask, prior: bool
) -> tuple[Mask, Floats, Defaults]:
    """Return what of ``free`` (p,) to identify of the rows of a table, the σ (p,) of its prior, inf for none, and why.

    ``named`` (p,) is what the user asked for by name, which is never held; ``prior`` says whether a prior may be used.
    Raises ProblemError as ``build_problem``.
    """
    if len(table) == 0:
        return free, np.full(free.size, np.inf), Defaults()
    problem = build_problem(chain, rig, table)
    p = problem.n_robot
    rig_only = np.arange(problem.start.size) >= p
    x = fit(problem, rig_only, problem.start, Options()).x if rig_only.any() else problem.start
    unit, names = weak_prior(chain), np.array(chain.parameter_names)
    mounted = mounting(chain, x[:p])
    anywhere = _root(build_problem(chain, rig, in_any_pose(chain, table)), x, free)
    framed = held_as_frames(anywhere, mounted, free, named, unit)
    left = free & ~framed
    still = still_joints(chain, table.q)
    lost = np.zeros(p, dtype=bool)
    if still:
        lost = _seen_by_moving_only(chain, rig, table, x, left, named, [joint.joint for joint in still])
        left &= ~lost
    sigma = np.full(p, np.inf)
    if prior:
        sigma = _weak_where_needed(problem, x, left, unit, mounted.either)

    def named_by(mask: Mask) -> tuple[str, ...]:
        return tuple(names[mask].tolist())

    chosen = Defaults(
        base=named_by(framed & mounted.base),
        tool=named_by(framed & ~mounted.base),
        still=still,
        lost=named_by(lost),
        believed=named_by(np.isfinite(sigma)),
    )
    return left, sigma, chosen


def with_frames(
    chosen: Defaults, chain: Chain, rig: Rigs, table: ObservationTable, free: Mask, value: Floats
) -> Defaults:
    """Return the defaults of ``choose_defaults`` for the same ``free`` with the directions along which frames are a choice.

    They are those at the estimate, ``value`` (P,) or more: at the robot as described they would be off by what was identified.
    """
    held = {*chosen.base, *chosen.tool}
    if not held:
        return chosen
    problem = build_problem(chain, rig, in_any_pose(chain, table))
    columns = np.concatenate([free, np.ones(problem.start.size - free.size, dtype=bool)])
    names = [name for name, is_free in zip(problem.names, columns, strict=True) if is_free]
    root = _root(problem, value[: problem.start.size], free)
    found = identifiability(root, int(free.sum()), names).null_space
    return replace(chosen, frames=tuple(direction for direction in found if held & set(direction.names)))


def _weak_where_needed(problem: Problem, x: Floats, free: Mask, unit: Floats, mounted: Mask) -> Floats:
    """(p,) σ of the parameters of directions that the data, with the noise that they show, tell to no better than ``unit`` (p,).

    Where the noise is c times the declared one, by which the rows are weighed, it is ``unit``/c: else the prior would count for
    the less the smaller a σ was declared. All other parameters have none, inf.
    """
    n = int(free.sum())
    root = _root(problem, x, free)
    if not not_told(root / LARGEST_MISFIT, n, unit[free]).any():
        return np.full(free.size, np.inf)
    # A fit that cannot wander far says how large the noise is; where errors are not modelled it is many times what was declared.
    everywhere = np.concatenate(
        [np.where(mounted, np.inf, wide_prior(problem.chain)), problem.prior_sigma[free.size :]]
    )
    columns = np.concatenate([free, np.ones(problem.start.size - free.size, dtype=bool)])
    found = fit(replace(problem, prior_sigma=everywhere), columns, x, Options(PRELIMINARY))
    misfit = _usual_misfit(problem, found.x, columns)
    root = _root(problem, found.x, free) / misfit
    needed = spread(not_told(root, n, unit[free], least=RANK_TOLERANCE), free) & ~mounted
    return np.where(needed, unit / misfit, np.inf)


def in_any_pose(chain: Chain, table: ObservationTable) -> ObservationTable:
    """The rows of a table, again and again if they are few, in random poses: what could be seen with the same fixtures."""
    lower, upper = (np.array([getattr(joint, side) for joint in chain.joints]) for side in ("lower", "upper"))
    rows = np.resize(np.arange(len(table)), max(len(table), LEAST_POSES))
    q = np.random.default_rng(0).uniform(lower, upper, (rows.size, len(chain.joints)))
    return replace(table.select(rows), q=q)


def _usual_misfit(problem: Problem, x: Floats, columns: Mask) -> float:
    """By how much the median row's residual is larger than its σ lets expect, 1 to LARGEST_MISFIT; no few bad rows change it."""
    ratios = [
        np.linalg.norm(part.residual, axis=1) / np.sqrt(special.chdtri(part.residual.shape[1], 0.5))
        for part in whitened_blocks(problem, x, columns)
        if part.row is not None
    ]
    return float(np.clip(np.median(np.concatenate(ratios)), 1.0, LARGEST_MISFIT))


def still_joints(chain: Chain, q: Floats) -> tuple[StillJoint, ...]:
    """The joints whose readings (n, j) span less than STILL times the σ that a drawing has of an offset; none if all do,
    since then it is the poses that are alike."""
    spread = np.ptp(q, axis=0)
    found = tuple(
        StillJoint(joint.name, unit, float(spread[i]), float(np.median(q[:, i])))
        for i, (joint, unit) in enumerate(zip(chain.joints, chain.joint_units, strict=True))
        if spread[i] < STILL * UNITS[unit].weak_sigma
    )
    return found if len(found) < len(spread) else ()


def moved(chain: Chain, still: Sequence[StillJoint], q: Floats) -> Mask:
    """(n,) whether one of the joints that stood still is elsewhere in readings (n, j)."""
    of = {joint.name: i for i, joint in enumerate(chain.joints)}
    apart = [np.abs(q[:, of[joint.joint]] - joint.at) > STILL * UNITS[joint.unit].weak_sigma for joint in still]
    return np.any(apart, axis=0) if apart else np.zeros(len(q), dtype=bool)


def _seen_by_moving_only(
    chain: Chain, rig: Rigs, table: ObservationTable, x: Floats, free: Mask, named: Mask, still: Sequence[str]
) -> Mask:
    """(p,) what to hold: as many parameters as directions are lost where the joints ``still`` stand, and would be seen if they moved.

    Their own terms of the joint law come first.
    """
    rng = np.random.default_rng(0)
    columns = [i for i, joint in enumerate(chain.joints) if joint.name in still]
    own = np.array([parameter.joint in columns for parameter in chain.parameters])
    n = int(free.sum())
    standing, moving = table.q.copy(), table.q.copy()
    standing[:, columns] = np.median(table.q[:, columns], axis=0)
    moving[:, columns] += rng.uniform(-MOTION, MOTION, (len(table), len(columns)))
    roots = [_root(build_problem(chain, rig, replace(table, q=q)), x, free) for q in (standing, moving)]
    kept = suggested_free(roots[0], n, ((~own | named)[free]))
    told = suggested_free(roots[1], n, kept, taken=kept)
    return spread(told & ~kept, free) & ~named


def _root(problem: Problem, x: Floats, free: Mask) -> Floats:
    """What the rows and what is known of the rig say at x (P,), without a prior of the robot; the robot's columns first."""
    columns = np.concatenate([free, np.ones(problem.start.size - free.size, dtype=bool)])
    sigma = np.where(np.arange(problem.start.size) < free.size, np.inf, problem.prior_sigma)[columns]
    seen = observe(settled(problem, x), x, columns)
    return with_prior(seen, np.zeros(sigma.size), sigma).root
