"""The rows of a finished fit, whitened by the declared noise, and their derivatives by everything that can be off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.frame_choice import mounting
from truearm.estimate.measured_order import Measured
from truearm.estimate.problem import Problem
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.estimate.systematic_effects import Cause, Errors, error_columns
from truearm.estimate.whitened_rows import only
from truearm.kinds.group import Group, KindFault
from truearm.model.chain import forward
from truearm.types import Floats, Indices, Mask
from truearm.units import UNITS

MOST_ROWS = 1000  # of a longer table, an evenly spaced selection is examined


@dataclass(frozen=True)
class WhitenedFit:
    """m scalar residuals of n rows in the order of measurement, and k free parameters.

    To first order, residual = jac δ + (columns of whatever is off) β + noise of unit variance. ``known_*`` are further
    rows: what the rig says of its numbers, and distances between sockets. The robot's prior stands apart, because a
    false one would be reported as a fault of the rig.
    """

    row: Indices  # (m,) from 0 to n − 1
    component: Indices  # (m,) numbers: scalar residuals of one kind and unit
    jac: Floats  # (m, k)
    residual: Floats  # (m,)
    knowledge_jac: Floats  # (κ, k)
    knowledge_residual: Floats  # (κ,)
    prior_jac: Floats  # (π, k) of the robot
    prior_residual: Floats  # (π,)
    leeway: Floats  # (l, k) how far an arm can be from the fit: a wide prior of the robot about it
    fault_jac: Floats  # (m, c) by everything in ``errors``
    errors: Errors  # names and SI units of these c columns
    causes: tuple[Cause, ...]  # items with the numbers that are off together
    fitted: frozenset[str]  # numbers that the fit estimates about a wide prior or none: no offset of theirs is a fault
    kind_faults: tuple[KindFault, ...]  # of the kinds, with whitened columns (m, d)
    axes: Floats  # (n, 3, 3) of the end in the base frame
    robot: Mask  # (k,) its own parameters, without those of joint laws
    names: tuple[str, ...]  # k
    units: tuple[str, ...]  # k
    values: Floats  # (k,)
    how: Measured  # the circumstances of the n rows

    @property
    def n(self) -> int:
        return int(self.how.row.size)


def whitened_fit(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], how: Measured, laws: range = range(0)
) -> WhitenedFit:
    """Return the whitened rows of a fit of x[columns] that ended at x (P,); rows left out are not in ``problem``.

    ``how`` describes the rows of the problem's table. The prior of the coefficients of joint ``laws`` is knowledge: it
    follows from the rows themselves, and without it they would explain anything.
    """
    rows_used = np.unique(np.concatenate([group.row for group in problem.groups if group.row is not None]))
    kept = rows_used[:: -(-rows_used.size // MOST_ROWS)]
    problem = only(problem, np.isin(np.arange(problem.n_rows), kept))
    how = how.take(kept)
    place = np.zeros(problem.n_rows, dtype=np.intp)
    place[kept] = np.arange(kept.size)
    pieces: list[tuple[Indices, Indices, Floats]] = []
    faults: list[tuple[int, KindFault]] = []
    knowledge_parts: list[Floats] = []
    start = components = 0
    for group in problem.groups:
        stacked, kind_faults = _whitened_group(group, problem, x, columns)
        width = len(group.COMPONENTS)
        if group.row is None:
            knowledge_parts.append(stacked[:, [*range(int(columns.sum())), -1]])
            continue
        row = np.repeat(place[group.row], width)
        pieces.append((row, np.tile(np.arange(components, components + width), len(group.row)), stacked))
        faults += [(start, fault) for fault in kind_faults]
        start, components = start + row.size, components + width
    row, component, whole = (np.concatenate(piece) for piece in zip(*pieces, strict=True))
    order = np.argsort(row, kind="stable")
    k, sigma = int(columns.sum()), problem.prior_sigma[columns]
    robot = ~problem.of_rig
    robot[laws] = False
    robot = robot[columns]
    error = (problem.start - x)[columns]
    rig, of_robot = (np.flatnonzero(np.isfinite(sigma) & mask) for mask in (~robot, robot))
    wide = np.array([UNITS[unit].wide_sigma for unit in problem.units])
    vague = np.array([UNITS[unit].vague_sigma for unit in problem.units])
    is_mounting = np.zeros(wide.size, dtype=bool)
    is_mounting[: problem.n_robot] = mounting(problem.chain, x[: problem.n_robot]).either
    leeway = np.where(is_mounting, vague, wide)[columns]
    knowledge = np.concatenate([*knowledge_parts, np.zeros((0, k + 1))])
    return WhitenedFit(
        row=row[order],
        component=component[order],
        jac=whole[order, :k],
        residual=whole[order, -1],
        knowledge_jac=np.concatenate([knowledge[:, :-1], np.eye(k)[rig] / sigma[rig, None]]),
        knowledge_residual=np.concatenate([knowledge[:, -1], error[rig] / sigma[rig]]),
        prior_jac=np.eye(k)[of_robot] / sigma[of_robot, None],
        prior_residual=error[of_robot] / sigma[of_robot],
        leeway=np.eye(k)[robot] / leeway[robot, None],
        fault_jac=whole[order, k:-1],
        errors=problem.errors,
        causes=problem.causes,
        fitted=frozenset(np.array(problem.names)[problem.prior_sigma >= wide].tolist()),
        kind_faults=_merged(faults, row.size, order),
        axes=forward(problem.chain, x[: problem.n_robot], how.table.q[how.row])[:, :3, :3],
        robot=robot,
        names=tuple(problem.names_of(columns)),
        units=tuple(unit for unit, is_free in zip(problem.units, columns, strict=True) if is_free),
        values=x[columns],
        how=how,
    )


def _whitened_group(
    group: Group, problem: Problem, x: Floats, columns: NDArray[np.bool_]
) -> tuple[Floats, list[KindFault]]:
    """Return (n·w, k + c + 1) derivatives by x[columns] and by ``problem.errors``, and residuals; all whitened.

    Also the faults that the kind declares, whitened.
    """
    p = problem.n_robot
    lin = group.opened(problem.chain, x)
    by_robot, by_rig = lin.wrenches @ lin.twists[:, columns[:p]], lin.jac_rig[:, :, : x.size - p][:, :, columns[p:]]
    residual = lin.residual.reshape(len(group.sensor_cov), -1).T[:, :, None]
    faults = group.faults(problem.chain, x)
    derivatives = [
        by_robot,
        by_rig,
        error_columns(lin, problem.errors.bodies),
        *(fault.columns for fault in faults),
        residual,
    ]
    stacked = np.concatenate([np.moveaxis(part, 2, 0) for part in derivatives])
    whiten(stacked, residual_cov(group.sensor_cov, lin.jac_joints, problem.joint_cov))
    whole = stacked.transpose(2, 1, 0).reshape(-1, len(stacked))
    first = sum(part.shape[2] for part in derivatives[:3])
    ends = np.cumsum([first, *(fault.columns.shape[2] for fault in faults)])
    kind_faults = [fault._replace(columns=whole[:, a:b]) for fault, a, b in zip(faults, ends, ends[1:], strict=False)]
    return np.concatenate([whole[:, :first], whole[:, -1:]], axis=1), kind_faults


def _merged(faults: list[tuple[int, KindFault]], m: int, order: Indices) -> tuple[KindFault, ...]:
    """Return the kinds' faults with columns (m, d) over all rows; a fault of several groups is one."""
    out: dict[tuple[str, str], KindFault] = {}
    for start, fault in faults:
        whole = out.get((fault.item, fault.form), fault._replace(columns=np.zeros((m, fault.columns.shape[1]))))
        whole.columns[start : start + len(fault.columns)] = fault.columns
        out[fault.item, fault.form] = whole
    return tuple(fault._replace(columns=fault.columns[order]) for fault in out.values())
