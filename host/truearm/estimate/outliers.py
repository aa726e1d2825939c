"""Single bad rows: left out of a least-squares fit one after the other, by what all other rows say of them.

A bad row pushes its neighbours beyond the gate, so those beyond it in the first fit are too many. As in the recursive
solver, of the rows beyond the gate only those leave in one round that are no nearer than half the farthest; then the rest is
fitted again, and rows that have come back within the gate return. In the end the list holds the bad rows alone.

That holds for single rows. If more than MOST of all rows leave, or more than LONGEST_RUN of them that follow each other, it
is not the rows that are bad but the model: something moved, a label is wrong, or the noise is not what was declared.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.information import half, observe, spectrum
from truearm.estimate.problem import Problem
from truearm.estimate.recursive import within
from truearm.estimate.solution import Options, Solution
from truearm.estimate.whitened_rows import only, squared_distances

MOST = 0.05  # of the rows
LONGEST_RUN = 3
MAX_ROUNDS = 50


def without_outliers(
    problem: Problem, columns: NDArray[np.bool_], found: Solution, options: Options
) -> Solution | None:
    """Return the fit without bad rows, which have weight 0 in it; None where there are none, or where the model is wrong.

    ``found`` is a converged least-squares fit of all rows over x[columns].
    """
    n = problem.n_rows
    used = np.ones(n, dtype=bool)
    options = options._replace(on_step=None)
    here, seen_sets = found, set()
    for _ in range(MAX_ROUNDS):
        root = half(spectrum(here.information.root))
        square, limit = squared_distances(problem, here.x, columns, root, used.astype(float))
        chosen = within(square, limit, used)
        if np.array_equal(chosen, used):
            break
        if (~chosen).sum() > MOST * n or chosen.tobytes() in seen_sets:
            return None
        seen_sets.add(chosen.tobytes())
        used = chosen
        here = fit(only(problem, used), columns, here.x, options)
        if here.status != "converged":
            return None
    else:
        return None
    if used.all() or _longest_run(~used) > LONGEST_RUN:
        return None
    information = here.information._replace(residual=observe(problem, here.x, columns).residual)
    return here._replace(
        information=information, weight=used.astype(float), iterations=found.iterations, message=found.message
    )


def _longest_run(flags: NDArray[np.bool_]) -> int:
    """The most of them that follow each other."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))
