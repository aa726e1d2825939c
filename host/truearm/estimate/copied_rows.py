"""Rows that are copies of earlier ones: every joint, reading and name is the same to the last digit.

A copy is no measurement. Counted as one, it makes σ too small, and held out it is predicted by the row that it copies.

Where a device writes few digits, measurements at one commanded pose may be equal by chance, with at most the
probability of docs/explanation/estimation.md, whatever was measured. Given all earlier rows, this holds for each, so
the number of equal rows is at most Poisson distributed (Hoeffding 1956). Rows are copies if there are more than chance
gives with a probability of LEVEL. Rows of a kind without a reading, such as a seated ball, add nothing if their joints
are equal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.circumstances import first_alike
from truearm.estimate.problem import build_problem
from truearm.kinds.columns import LARGEST_NOISE, Quantity, is_label
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.types import Floats, Indices, Rigs
from truearm.units import SMALLEST, UNITS

LEVEL = 1e-3  # probability that equal measurements are taken for copies
MOST_DIGITS = 9  # of a reading, after the point
ROUNDING = 1e-4  # of a step, by arithmetic


def copied_rows(chain: Chain, rig: Rigs, table: ObservationTable) -> Indices:
    """Return for each row (n,) the first row that it is a copy of, or -1 for none. Raises ProblemError."""
    out = np.full(len(table), -1)
    first = _first_alike([table.q])
    repeats = np.flatnonzero(np.bincount(first, minlength=len(table))[first] > 1)
    if not repeats.size:
        return out
    columns = {
        name: column[repeats] for name, column in table.columns.items() if name != "source" and not is_label(name)
    }
    measured = {name: _readings(table.select(table.kind == name), name) for name in np.unique(table.kind).tolist()}
    fields = {quantity.field for quantities in measured.values() for quantity in quantities}
    equal = _first_alike(list(columns.values()))
    copies = equal < np.arange(repeats.size)
    if not copies.any():
        return out
    repeated = _first_alike([column for name, column in columns.items() if name not in fields])
    chance = np.minimum(_earlier(repeated) * _step_shares(chain, rig, table, measured)[repeats], 1.0)
    for name in measured:
        of_kind = table.kind[repeats] == name
        count, expected = int((copies & of_kind).sum()), float(chance[of_kind].sum())
        if count and special.pdtrc(count - 1, expected) < LEVEL:
            out[repeats[copies & of_kind]] = repeats[equal[copies & of_kind]]
    return out


def _readings(table: ObservationTable, kind: str) -> list[Quantity]:
    """Return the quantities that rows of a kind measure, without their noise and temperatures."""
    return [
        quantity
        for quantity in kinds()[kind].quantities
        if quantity.unit in ("m", "rad") and quantity.most > LARGEST_NOISE and np.isfinite(table[quantity.field]).any()
    ]


def _first_alike(columns: Sequence[NDArray[Any]]) -> Indices:
    """Return for each row of some columns (n, ·) the first row with equal values; NaN equals NaN."""
    first, number = first_alike(values for column in columns for values in column.reshape(len(column), -1).T)
    return np.asarray(first[number])


def _earlier(first: Indices) -> Indices:
    """Return how many earlier rows (n,) have the same ``first``."""
    order = np.argsort(first, kind="stable")
    out = np.empty(first.size, dtype=np.intp)
    out[order] = np.arange(first.size) - np.searchsorted(first[order], first[order])
    return out


def _step_shares(
    chain: Chain, rig: Rigs, table: ObservationTable, measured: Mapping[str, Sequence[Quantity]]
) -> Floats:
    """Return for each row (n,) at most the probability that its readings are given ones.

    0 for rows without readings.
    """
    out = np.zeros(len(table))
    for group in build_problem(chain, rig, table).groups:
        if group.row is None:
            continue
        name = str(table.kind[group.row[0]])
        rows = table.select(table.kind == name)
        readings = [(rows[quantity.field].reshape(len(rows), -1), quantity.unit) for quantity in measured[name]]
        step = np.array([_resolution(values, unit) for columns, unit in readings for values in columns.T])
        cov, width = group.sensor_cov, group.sensor_cov.shape[1]
        if step.size == width:
            log_det = np.log(cov).sum(axis=1) if cov.ndim == 2 else np.linalg.slogdet(cov)[1]
            log_step = np.log(step).sum() if (step > 0.0).all() else -np.inf
            out[group.row] = np.exp(np.minimum(log_step - (width * math.log(2.0 * math.pi) + log_det) / 2.0, 0.0))
        elif step.size:
            out[group.row] = 1.0  # a kind whose residuals are made of its readings in an unknown way
    return out


def _resolution(readings: Floats, unit: str) -> float:
    """Return at most the step between the readings (n,) of a device [m or rad]: few digits, or few different values."""
    differences = np.diff(np.unique(readings))
    if not differences.size:
        return 0.0
    scales = (UNITS[unit].own, UNITS[unit].scale, *UNITS[unit].others)
    steps = [unit_scale.scale * 10.0**-digits for unit_scale in scales for digits in range(MOST_DIGITS + 1)]
    decimal = [step for step in steps if np.abs(readings / step - np.round(readings / step)).max() < ROUNDING]
    return min(float(differences.min()), max(decimal, default=SMALLEST))
