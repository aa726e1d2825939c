"""Fits of other rows than the estimate's: of all rows where outliers were left out, and without bad rows that were not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.bad_rows import WithoutBad
from truearm.estimate.information import half, spectrum
from truearm.estimate.prediction import moves
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Solution, of_data
from truearm.estimate.uncertainty import goodness, prior_shares
from truearm.model.chain import Chain
from truearm.results import Figures, OtherFit
from truearm.types import Floats


def with_all_rows(problem: Problem, columns: NDArray[np.bool_], every: Solution, found: Solution) -> OtherFit:
    """Return the fit of all rows, to compare with the one without outliers."""
    shares = prior_shares(half(spectrum(every.information.root)), every.prior_sigma)
    chi2 = goodness(*of_data(problem, columns, every), shares).reduced
    rms = {unit: of.rms for unit, of in Figures.by_unit(every.information.residual).items()}
    return OtherFit(int((found.weight == 0.0).sum()), every.x, rms, chi2)


def without_bad(bad: WithoutBad, chain: Chain, x: Floats, q: Floats) -> OtherFit:
    """Return the fit without the bad rows; x (P,) is the fit with them, and q (n, j) are the poses."""
    rms = {unit: of.rms for unit, of in Figures.by_unit(bad.solution.information.residual, ~bad.bad).items()}
    apart = moves(chain, x, bad.solution.x, q)
    return OtherFit(int(bad.bad.sum()), bad.solution.x, rms, bad.quality.reduced, apart)
