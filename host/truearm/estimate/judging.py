"""A robot judged by observations that it was not fitted to: which rows can judge, and what they say.

What the rig does not know (a socket's place, a line's pose, a ball's) is settled on the judging rows themselves, with the
robot fixed, as nothing could be predicted there otherwise. Rows that fit such unknowns whatever they say are no judges.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.information import RANK_TOLERANCE
from truearm.estimate.lm import DAMPING_START
from truearm.estimate.problem import Problem, Rigs, build_problem, evaluate
from truearm.estimate.solution import Options
from truearm.model.chain import Chain
from truearm.observe.socket_distance import SocketDistanceRows
from truearm.types import Floats, ObservationTable

LEAST_FREEDOM = 1e-6  # share of a row's residuals that must be left to judge by; rounding leaves 1e-12


class Judgement(NamedTuple):
    """What n rows say of a robot."""

    error: Floats  # (n,) m, norm of each row's residual
    judging: NDArray[np.bool_]  # (n,) False for rows that fit whatever they say
    n_settled: int  # unknowns of the rig that were settled on these rows


def judge(chain: Chain, rig: Rigs, table: ObservationTable, params: Floats) -> Judgement:
    """Judge the robot with parameters (p,) by a table. Raises ProblemError as ``build_problem``."""
    problem = build_problem(chain, rig, table)
    # The known distance between sockets must not help to place them: the error is the spread about each socket.
    problem = replace(problem, groups=tuple(g for g in problem.groups if not isinstance(g, SocketDistanceRows)))
    x = np.concatenate([params, problem.start[problem.n_robot :]])
    rig_only = np.arange(x.size) >= problem.n_robot
    found = fit(problem, rig_only, x, Options(), DAMPING_START)
    return Judgement(np.abs(found.information.residual), has_freedom(problem, rig_only, found.x), int(rig_only.sum()))


def has_freedom(problem: Problem, columns: NDArray[np.bool_], x: Floats) -> NDArray[np.bool_]:
    """Rows (n,) that the unknowns x[columns], settled on them, could not make to fit whatever they say.

    The trace of a row's block of the hat matrix J (JᵀJ)⁺ Jᵀ is its number of residuals where they fit by construction:
    the only seat in a socket, say.
    """
    free = np.ones(problem.n_rows, dtype=bool)
    if not columns.any():
        return free
    groups = [group for group in problem.groups if not isinstance(group, SocketDistanceRows)]
    whole = [(group.row, evaluate(problem, group, x).jac_params[:, columns]) for group in groups]
    basis, weight, _ = np.linalg.svd(np.concatenate([jac for _, jac in whole]), full_matrices=False)
    hat = np.sum(basis[:, weight > RANK_TOLERANCE * weight.max(initial=0.0)] ** 2, axis=1)
    at = 0
    for row, jac in whole:
        share = hat[at : at + len(jac)].reshape(row.size, -1).mean(axis=1)
        free[row[share > 1.0 - LEAST_FREEDOM]] = False
        at += len(jac)
    return free
