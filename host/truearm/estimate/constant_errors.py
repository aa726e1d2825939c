"""One item of the rig that is off in all rows, found by refits: it explains what several errors seem to.

The score test (``systematic``) is of first order about a fit that the error distorts. A chuck that is 2 mm off moves base
and arm by several millimetres along directions that the rows hardly determine, and then steps of other items explain the
residuals as well. So where the test finds something and the declared noise does not explain χ², each item that can be off
in all rows is made a parameter in a fit of its own. If one alone explains as much as all findings together, it is the
finding. Its figures are those of this fit, without linearisation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.problem import Problem, build_problem, modelled_of
from truearm.estimate.solution import Options, Solution, of_data
from truearm.estimate.systematic_candidates import AS_LIKELY, in_all_rows, largest_errors
from truearm.estimate.systematic_effects import Cause
from truearm.estimate.systematic_score import FitChi2, log_chance
from truearm.estimate.ties import largest_first
from truearm.estimate.whitened_rows import only
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Effect, OffBy, SystematicError, SystematicErrors
from truearm.types import Floats, Rigs, thinned

MOST_ROWS = 400  # of a fit that ranks the items
FITS = Options(max_iterations=20)


class Fitting(NamedTuple):
    """What a fit was made of: its problem, its columns (P,), where it ended, x (P,), and the rows that it used.

    ``fitted`` (N,) are the n rows of the ``table`` that were given to the fit, ``used`` (n,) those of them that are no
    outliers. ``prior_sigma`` and ``effects`` as in ``identify``.
    """

    chain: Chain
    rig: Rigs
    table: ObservationTable
    fitted: NDArray[np.bool_]
    problem: Problem
    columns: NDArray[np.bool_]
    x: Floats
    used: NDArray[np.bool_]
    prior_sigma: Mapping[str, float] | Floats | None
    effects: Sequence[Effect]

    def refit(self, cause: Cause, rows: NDArray[np.bool_]) -> tuple[Problem, NDArray[np.bool_], Solution]:
        """Return the fit of some ``rows`` (n,) with an item off in all of them, its problem and its columns."""
        effects = [*self.effects, Effect(cause.name)]
        every = modelled_of(self.chain, self.rig, self.table, effects)
        modelled = [one.select(self.fitted) for one in every]
        problem = build_problem(self.chain, self.rig, self.table.select(self.fitted), self.prior_sigma, modelled)
        known = dict(zip(self.problem.names, self.x, strict=True))
        x = problem.at(known)
        columns = np.concatenate([self.columns, np.ones(x.size - self.x.size, dtype=bool)])
        return problem, columns, fit(only(problem, rows), columns, x, FITS)


def one_constant(of: Fitting, found: SystematicErrors, state: FitChi2) -> SystematicErrors | None:
    """Return the item that explains as much as all that was ``found`` in a fit; None if there is none.

    ``state`` is χ² of the fit. ``moves`` of what is returned is not known yet.
    """
    few = np.zeros(of.used.size, dtype=bool)
    few[np.flatnonzero(of.used)[thinned(int(of.used.sum()), MOST_ROWS)]] = True
    tried = [(_chi2(of, cause, few), cause) for cause in in_all_rows(of.problem)]
    ranked = [tried[i] for i in largest_first([-chi2 for chi2, _ in tried])]
    if not ranked or not math.isfinite(ranked[0][0]):
        return None
    least, cause = ranked[0]
    problem, columns, best = of.refit(cause, of.used)
    chi2, d = of_data(problem, columns, best)[0], len(cause.numbers)
    freedom = state.freedom - d
    most = max(found.chi2_reduced, 1.0) * (freedom + 2.0 * AS_LIKELY)
    if best.status != "converged" or freedom < 1.0 or chi2 > most:
        return None
    near = least + 2.0 * AS_LIKELY * max(chi2 / freedom, 1.0)
    rivals = tuple(other.name for value, other in ranked[1:] if value < near)
    drop = state.chi2 - chi2
    log_p = float(log_chance(np.array([drop]), np.array([d]), state)[0]) + math.log(len(ranked))
    at = np.array([problem.names.index(number) for number in cause.numbers])
    off = (best.x - problem.start)[at]
    units = [problem.units[i] for i in at]
    if (np.abs(off) > largest_errors(units)).any():
        return None
    scale = 1.0 if chi2 <= state.limit * freedom else chi2 / freedom
    fitted = np.cumsum(columns)[at] - 1
    covariance = scale * best.covariance[np.ix_(fitted, fitted)]
    off_by = tuple(map(OffBy, cause.numbers, units, off.tolist(), np.sqrt(np.diag(covariance)).tolist()))
    size = float(np.linalg.norm(off))
    along = off / max(size, 1e-300)
    sigma = math.sqrt(float(along @ covariance @ along))
    n = of.used.size
    chance = math.exp(min(log_p, 0.0))
    error = SystematicError(
        Effect(cause.name), (0, n), ((0, 0), (n, n)), off_by, units[0], size, sigma, drop, d, chance, rivals
    )
    return SystematicErrors((error,), chi2 / freedom, best.x[: of.x.size] - of.x)


def _chi2(of: Fitting, cause: Cause, rows: NDArray[np.bool_]) -> float:
    """Return χ² of the fit of some ``rows`` (n,) with an item off in all of them; infinite if it did not converge."""
    problem, columns, found = of.refit(cause, rows)
    return of_data(problem, columns, found)[0] if found.status == "converged" else math.inf
