"""Outlying rows beside joint laws, which geometry alone cannot name: without the laws, most rows are beyond their noise.

Bad rows bend the geometry and hide the laws, and the laws that were not fitted widen the gate for bad rows. Two rounds
break this circle. First, the geometry is fitted without the rows beyond the gate that its own misfit widens
(``outliers``), and laws are fitted to the others. Then every row is compared with its prediction by the laws under the
learned noise. Rows beyond that gate are left out if they ``matter``, and rows within it return, until the set no longer
changes. Where no law is kept without those rows, none is left out, and the fit is that of the geometry to all rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from truearm.estimate.law_choice import LawChoice
from truearm.estimate.law_fit import LawProblem
from truearm.estimate.outliers import matter, misfit, single, within
from truearm.estimate.row_errors import RowErrors
from truearm.estimate.scatter import scatter_of
from truearm.estimate.whitened_rows import gate
from truearm.model.chain import Chain
from truearm.results import Estimate
from truearm.types import Mask

MAX_ROUNDS = 6  # of fits with laws


class WithLaws(NamedTuple):
    """The robot with its laws, the estimate with their parameters, how they were chosen, and the problem with them.

    The last two are None if no law is kept.
    """

    chain: Chain
    estimate: Estimate
    choice: LawChoice | None = None
    problem: LawProblem | None = None


def outlying_beside_laws(rows: RowErrors, used: Mask) -> Mask:
    """Return which rows (n,) to leave out next, after a fit with laws of the ``used`` rows (n,)."""
    square = np.nan_to_num(rows.distance) ** 2
    staying = within(square, gate(rows.width) * misfit(square, rows.width, used), used)
    out, leaving = ~used & ~staying, used & ~staying
    return out | leaving if matter(np.where(used, square, 0.0), leaving) else out


def fitted_without_outliers(
    geometry: Estimate,
    without: Callable[[Mask], Estimate],
    with_laws: Callable[[Estimate, LawChoice | None], WithLaws],
) -> WithLaws:
    """Return the result of ``with_laws`` for the geometry without outlying rows.

    ``without`` fits the geometry without some rows (n,) of the table. ``with_laws`` is given the choice of laws of the
    round before: a few rows more or less only drop laws.
    """
    first = geometry
    if not np.array_equal(geometry.outlying, geometry.weight == 0.0):
        first = without(geometry.outlying)
    best = with_laws(first, None)
    if first is not geometry and best.choice is None:
        return with_laws(geometry, None)
    seen = {geometry.outlying.tobytes()}
    for _ in range(MAX_ROUNDS):
        following = best.estimate.outlying
        if best.choice is None or following.tobytes() in seen or not single(following[geometry.fitted]):
            break
        seen.add(following.tobytes())
        further = with_laws(without(following), best.choice)
        if further.choice is None:
            break
        best = further
    if best.problem is None or best.choice is None:
        return best
    return best._replace(estimate=replace(best.estimate, scatter=scatter_of(best.problem, best.choice.learned)))
