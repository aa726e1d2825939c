"""Determine what a hold-out would remove from the fit, and propose one that leaves enough of everything."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.measured_order import poses
from truearm.kinds.registry import ANYWHERE, identifiers
from truearm.kinds.table import ObservationTable
from truearm.types import Mask
from truearm.workflows.selection import held_out_rows, numbered

FRACTIONS = (0.2, 0.1)
SEEDS = 8  # number of seeds tried
LEFT = 0.5  # at least this share of the rows of each combination


class HoldOutProposal(NamedTuple):
    """A share of the rows, drawn by a seed.

    It holds out ``rows`` rows and leaves at least half of each of the ``combinations`` of names.
    """

    fraction: float
    seed: int
    rows: int
    combinations: int


def proposed_hold_out(table: ObservationTable, unused: Mask | None = None) -> HoldOutProposal | None:
    """Return the first share of the rows that leaves enough of everything to fit; None if there are too few poses.

    ``unused`` (n,) are rows that are not judged, such as copies.
    """
    of_row = _combinations(table)
    size, n_poses = np.bincount(of_row), np.unique(poses(table)).size
    for fraction in FRACTIONS:
        if round(fraction * n_poses) < 1:  # poses are drawn, not rows
            break
        for seed in range(SEEDS):
            held = held_out_rows(table, [str(fraction)], seed)
            if held is not None and np.all(np.bincount(of_row[~held], minlength=size.size) >= LEFT * size):
                return HoldOutProposal(
                    fraction, seed, int((held if unused is None else held & ~unused).sum()), size.size
                )
    return None


def named_columns(table: ObservationTable) -> list[str]:
    """Return the columns that name what is mounted, as far as rows have names: bar, chuck and sphere, or socket and
    target.
    """
    return [name for name in identifiers() if name not in ANYWHERE[1:] and np.any(table[name] != "")]


def all_held_out(table: ObservationTable, held: Mask) -> list[str]:
    """Return the names without any row left in the fit: ``sphere=s1``."""
    found = []
    for column in named_columns(table):
        names = table[column]
        gone = np.setdiff1d(names[held], names[~held])
        found += [f"{column}={name}" for name in gone.tolist() if name]
    return found


def _combinations(table: ObservationTable) -> NDArray[np.intp]:
    """Return (n,) the number of each row's combination of kind, names and rig."""
    return numbered([table.kind, *(table[name] for name in (*named_columns(table), "rig"))])
