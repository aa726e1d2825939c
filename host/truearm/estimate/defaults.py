"""Defaults for what is free and what has a prior: frame choices, joints at rest and the weak prior.

They follow from what the data determine at the nominal robot, with the rig fitted to it, before anything is identified:

1. **Frames.** Parameters that only define the pose of base and tool are fixed as far as that is a choice
   (``frame_choice``).
2. **Still joints.** A joint whose readings span less than STILL times a drawing's standard deviation (20 mrad, 4 mm)
   does not determine its axis. As many parameters are fixed as there would be null directions if it did not move, its
   own first.
3. **Prior.** The standard deviation of a drawing (1 mm, 5 mrad, 0.001 of a gain), for parameters of directions that the
   data determine less well. Mountings have none. Also for the robot's lengths if nothing measures a length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from truearm.estimate.fit import fit
from truearm.estimate.frame_choice import held_as_frames, mounting
from truearm.estimate.identifiability import (
    SMALL_PART,
    identifiability,
    null_basis,
    rank_columns,
    spread,
    suggested_free,
    weakly_identifiable,
)
from truearm.estimate.information import RANK_TOLERANCE, Information, of_rows
from truearm.estimate.levenberg_marquardt import Damping, Ends
from truearm.estimate.outliers import gross_rows
from truearm.estimate.problem import Problem, build_problem, settled
from truearm.estimate.solution import Options
from truearm.estimate.solvers import Loss
from truearm.estimate.uncertainty import weak_prior, wide_prior
from truearm.estimate.whitened_rows import only, whitened_blocks
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Defaults, Effect, StillJoint
from truearm.types import Floats, Indices, Mask, Rigs, thinned
from truearm.units import UNITS

STILL = 4.0  # weak σ, largest minus smallest reading
LARGEST_MISFIT = 10.0  # ratio of the observed noise to the declared one
HEAVY = 1.4  # RMS of the rows over that of the usual one; it is 1 for normal errors
PRELIMINARY = 20  # iterations
LEAST_POSES = 300  # random ones; three times the number of parameters of any robot
INVARIANT = 1e-6  # of the gradient: in a null direction in which χ² is the same
MOTION = 0.5  # rad, m: assumed motion of a still joint
MANY = 10_000  # rows: of more, so many stand for all, unless some unknown is seen by others only


def choose_defaults(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: Mask,
    named: Mask,
    prior: bool,
    effects: Sequence[Effect] = (),
    fitted: Mask | None = None,
) -> tuple[Mask, Floats, Defaults]:
    """Return which of ``free`` (p,) to identify from a table's rows, the σ (p,) of the prior (inf for none), and why.

    ``named`` (p,) are the parameters that the user asked for by name; these are never fixed. ``prior`` is whether a
    prior may be used. ``effects`` are the systematic errors that the identification estimates too: what they explain is
    not noise. ``fitted`` (n,) are the rows; None: all. Raises ProblemError for the same reasons as ``build_problem``.
    """
    rows = np.arange(len(table)) if fitted is None else np.flatnonzero(fitted)
    if not rows.size:
        return free, np.full(free.size, np.inf), Defaults()
    still, n_rows = still_joints(chain, table.q[rows]), rows.size
    problem, rows = _enough(chain, rig, table, rows, effects)
    table = table.select(rows)
    p, rig_only = problem.n_robot, problem.of_rig
    x = fit(problem, rig_only, problem.start, Options()).x
    gross, x = gross_rows(problem, rig_only, x)
    unit, names = weak_prior(chain), np.array(chain.parameter_names)
    mounted = mounting(chain, x[:p])
    anywhere = _root(build_problem(chain, rig, in_any_pose(chain, table)), x, free)
    framed = held_as_frames(anywhere, mounted, free, named, unit)
    remaining = free & ~framed
    lost = np.zeros(p, dtype=bool)
    if still:
        lost = _seen_by_moving_only(chain, rig, table, x, remaining, named, [joint.joint for joint in still])
        remaining &= ~lost
    sigma = np.full(p, np.inf)
    if prior:
        times = math.sqrt(n_rows / len(table))
        sigma = _weak_where_needed(only(problem, ~gross), x, remaining, unit * times, mounted.either) / times

    def named_by(mask: Mask) -> tuple[str, ...]:
        return tuple(names[mask].tolist())

    chosen = Defaults(
        base=named_by(framed & mounted.base),
        tool=named_by(framed & ~mounted.base),
        still=still,
        lost=named_by(lost),
        believed=named_by(np.isfinite(sigma)),
    )
    return remaining, sigma, chosen


def _enough(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: Indices, effects: Sequence[Effect] = ()
) -> tuple[Problem, Indices]:
    """Return MANY of some rows of a table if they have all unknowns, otherwise all, with their problem."""
    problem, selection = build_problem(chain, rig, table, None, effects, rows), rows[thinned(rows.size, MANY)]
    if selection.size < rows.size:
        thin_problem = build_problem(chain, rig, table, None, effects, selection)
        if thin_problem.names == problem.names:
            return thin_problem, selection
    return problem, rows


def with_frames(
    chosen: Defaults, chain: Chain, rig: Rigs, table: ObservationTable, free: Mask, value: Floats
) -> Defaults:
    """Return the defaults of ``choose_defaults`` for the same ``free``, with the directions that are a choice of frame.

    The directions are those at the estimate, ``value`` (at least P values). At the nominal robot they would be off by
    the identified corrections.
    """
    held = {*chosen.base, *chosen.tool}
    if not held:
        return chosen
    _, rows = _enough(chain, rig, table, np.arange(len(table)))
    problem = build_problem(chain, rig, in_any_pose(chain, table.select(rows)))
    columns = np.concatenate([free, np.ones(problem.start.size - free.size, dtype=bool)])
    names = [name for name, is_free in zip(problem.names, columns, strict=True) if is_free]
    root = _root(problem, value, free)
    null_space = identifiability(root, int(free.sum()), names).null_space
    return replace(chosen, frames=tuple(direction for direction in null_space if held & set(direction.names)))


def _weak_where_needed(problem: Problem, x: Floats, free: Mask, unit: Floats, mounted: Mask) -> Floats:
    """Return σ (p,) for parameters of directions that the data, at their actual noise, see no better than ``unit``.

    If the noise is c times the declared one, by which the rows are weighted, σ is ``unit``/c. Otherwise the prior would
    have less weight the smaller the declared σ. All other parameters have no prior, inf.
    """
    n = int(free.sum())
    root = _root(problem, x, free)
    if not weakly_identifiable(root / LARGEST_MISFIT, n, unit[free]).any():
        return np.full(free.size, np.inf)
    # A strongly constrained fit estimates the noise level; with unmodelled errors it is many times the declared one.
    everywhere = np.concatenate(
        [np.where(mounted, np.inf, wide_prior(problem.chain)), problem.prior_sigma[free.size :]]
    )
    columns = problem.columns(free)
    wide = replace(problem, prior_sigma=everywhere)
    _, x = gross_rows(
        wide,
        columns,
        fit(
            wide, columns, x, Options(PRELIMINARY, damping=Damping(correctors=0), ends=Ends(steps=1, predicted=1e-4))
        ).x,
    )
    misfit, rms = _misfit(problem, x)
    if rms > HEAVY * misfit:  # many bad rows bend the fit, so that the others err too
        x = fit(wide, columns, x, Options(loss=Loss.CAUCHY)).x
        misfit, _ = _misfit(problem, x)
    data = of_rows(problem, x, columns)
    root = data.root if settled(problem, x) is problem else _root(problem, x, free)
    weak = weakly_identifiable(root / misfit, n, unit[free], least=RANK_TOLERANCE)
    needed = spread(weak, free) | _shrinking(problem.chain, data, root, free)
    return np.where(needed & ~mounted, unit / misfit, np.inf)


def _shrinking(chain: Chain, data: Information, root: Floats, free: Mask) -> Mask:
    """Return the parameters (p,) of null directions along which χ² falls although no prediction depends on them.

    They change the robot's size if nothing measures a length, such as seats in sockets of unknown places and distances:
    the residuals are in proportion to the robot, so the best fit to noise is a robot without extent. ``root`` is that
    of the settled rows.
    """
    scaled, scale = rank_columns(root)
    _, unseen = null_basis(scaled)
    gradient = (data.root.T @ data.rhs) / scale
    along = unseen @ (unseen.T @ gradient)
    if np.linalg.norm(along) <= INVARIANT * np.linalg.norm(gradient):
        return np.zeros(free.size, dtype=bool)
    step = np.abs(along / scale)[: int(free.sum())] / weak_prior(chain)[free]
    return spread(step > SMALL_PART * step.max(), free)


def in_any_pose(chain: Chain, table: ObservationTable) -> ObservationTable:
    """Return the rows of a table, repeated if there are few, in random poses: what the same fixtures could determine.

    The poses lie within the joints' limits; a joint without limits turns once.
    """
    rows = np.resize(np.arange(len(table)), max(len(table), LEAST_POSES))
    lower, upper = np.nan_to_num(chain.limits, neginf=-np.pi, posinf=np.pi)
    q = np.random.default_rng(0).uniform(lower, upper, (rows.size, len(chain.joints)))
    return table.select(rows).replace(q=q)


def _misfit(problem: Problem, x: Floats) -> tuple[float, float]:
    """Return how many times as large as expected the residuals are: in the median (1 to LARGEST_MISFIT), and in RMS."""
    ratios, squares = [], []
    for block in whitened_blocks(problem, x, np.zeros(x.size, dtype=bool)):
        if block.row is not None:
            length, width = np.linalg.norm(block.residual, axis=1), block.residual.shape[1]
            ratios.append(length / np.sqrt(special.chdtri(width, 0.5)))
            squares.append(length**2 / width)
    usual = float(np.clip(np.median(np.concatenate(ratios)), 1.0, LARGEST_MISFIT))
    return usual, math.sqrt(float(np.concatenate(squares).mean()))


def still_joints(chain: Chain, q: Floats) -> tuple[StillJoint, ...]:
    """Return the joints whose readings (n, j) span less than STILL times a drawing's σ of an offset.

    None if all do, since then the poses themselves are alike.
    """
    spread = np.ptp(q, axis=0)
    joints = tuple(
        StillJoint(joint.name, unit, float(spread[i]), float(np.median(q[:, i])))
        for i, (joint, unit) in enumerate(zip(chain.joints, chain.joint_units, strict=True))
        if spread[i] < STILL * UNITS[unit].weak_sigma
    )
    return joints if len(joints) < len(spread) else ()


def moved(chain: Chain, still: Sequence[StillJoint], q: Floats) -> Mask:
    """Return a mask (n,) of readings (n, j) in which one of the still joints is at another position."""
    index = {joint.name: i for i, joint in enumerate(chain.joints)}
    displaced = [np.abs(q[:, index[joint.joint]] - joint.at) > STILL * UNITS[joint.unit].weak_sigma for joint in still]
    return np.any(displaced, axis=0) if displaced else np.zeros(len(q), dtype=bool)


def _seen_by_moving_only(
    chain: Chain, rig: Rigs, table: ObservationTable, x: Floats, free: Mask, named: Mask, still: Sequence[str]
) -> Mask:
    """Return the parameters to fix (p,): one for each direction that needs the joints ``still`` to move to be seen.

    Their own terms of the joint law come first.
    """
    rng = np.random.default_rng(0)
    columns = [i for i, joint in enumerate(chain.joints) if joint.name in still]
    is_own = np.array([parameter.joint in columns for parameter in chain.parameters])
    n = int(free.sum())
    standing, moving = table.q.copy(), table.q.copy()
    standing[:, columns] = np.median(table.q[:, columns], axis=0)
    moving[:, columns] += rng.uniform(-MOTION, MOTION, (len(table), len(columns)))
    roots = [_root(build_problem(chain, rig, table.replace(q=q)), x, free) for q in (standing, moving)]
    distinct = suggested_free(roots[0], n, ((~is_own | named)[free]))
    distinct_moving = suggested_free(roots[1], n, distinct, taken=distinct)
    return spread(distinct_moving & ~distinct, free) & ~named


def _root(problem: Problem, x: Floats, free: Mask) -> Floats:
    """Return the information of rows and rig at x, without a prior of the robot; the robot's columns come first.

    Of x, only the P values of the problem are used.
    """
    x = x[: problem.start.size]
    return of_rows(settled(problem, x), x, problem.columns(free)).root
