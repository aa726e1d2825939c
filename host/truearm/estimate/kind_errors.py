"""The residuals of an estimate by rig and kind of observation, for result.json and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from truearm.kinds.table import ObservationTable
from truearm.results import Estimate, Figures
from truearm.types import Mask


class KindErrors(NamedTuple):
    """The rows of one kind at one rig that were ``fitted`` (n,) or ``held_out`` (n,), and their figures by SI unit.

    ``before`` and ``after`` are those of the fitted rows, ``judged`` those of the held-out ones after the fit.
    """

    rig: str
    kind: str
    fitted: Mask
    held_out: Mask
    before: Mapping[str, Figures]
    after: Mapping[str, Figures]
    judged: Mapping[str, Figures]


def errors_by_kind(estimate: Estimate, table: ObservationTable) -> list[KindErrors]:
    """Return the errors of each rig and kind, in the order of their names; rows that were left out are in none."""
    unfitted = ~(estimate.fitted | estimate.left_out) if estimate.left_out.size else ~estimate.fitted
    errors = []
    for rig, kind in sorted(set(zip(table.rig.tolist(), table.kind.tolist(), strict=True))):
        rows = (table.rig == rig) & (table.kind == kind)
        fitted, held_out = rows & estimate.used, rows & unfitted
        before = Figures.by_unit(estimate.residual_before, fitted)
        after, judged = (Figures.by_unit(estimate.residual, chosen) for chosen in (fitted, held_out))
        errors.append(KindErrors(rig, kind, fitted, held_out, before, after, judged))
    return errors
