"""How much of the residuals the declared noise explains and how much it does not, for each unit.

For whitened rows with unit noise, least squares absorbs the part H = J P Jᵀ. The expected mean square of a row's
residual is therefore tr(L (I − H) Lᵀ), where L is the root of its declared covariance. Anything above that is
unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.problem import Problem
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.group import unit_columns
from truearm.results import ResidualParts
from truearm.types import Floats
from truearm.units import UNITS


def residual_parts(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats
) -> Mapping[str, ResidualParts]:
    """Return the RMS residual at x (P,) due to declared noise, and the rest, by SI unit; root (k, r): P = root rootᵀ."""
    squares: dict[str, list[Floats]] = {}
    for block in whitened_blocks(problem, x, columns):
        if block.row is None:
            continue
        for unit, of in unit_columns(block.components).items():
            into = block.noise_root[:, of]
            declared = (into**2).sum(axis=(1, 2)) - ((into @ (block.jac @ root)) ** 2).sum(axis=(1, 2))
            found = ((into @ block.residual[..., None]) ** 2).sum(axis=(1, 2))
            squares.setdefault(unit, []).append(np.stack([np.maximum(declared, 0.0), found]))
    means = {unit: np.concatenate(squares[unit], axis=1).mean(axis=1) for unit in UNITS if unit in squares}
    return {
        unit: ResidualParts(math.sqrt(declared), math.sqrt(max(found - declared, 0.0)))
        for unit, (declared, found) in means.items()
    }
