"""Rows that were measured with another bar than the one they name: its zero is another, so their lengths are wrong.

A length is zero + gain · extension of the bar that a row names. With zero z₀ and gain k₀ of that bar, the same reading of
a bar with z₁ and k₁ is the length z₁ + k₁·(length − z₀)/k₀.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from truearm.estimate.label_sentences import named_row
from truearm.estimate.measured_order import mountings
from truearm.estimate.other_readings import Interpretation
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.text import counted
from truearm.types import BallBar, Indices, Mask, Rig, Rigs


class OtherBar(NamedTuple):
    """An interpretation of rows with another bar, and these rows as rows to leave out: "" for all rows of a bar."""

    reading: Interpretation
    leave_out: str


def other_bars(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: Indices, some: Indices, free: Mask
) -> list[OtherBar]:
    """Return ``some`` of the ``rows`` of a table with one run of one mounting, or all rows of two bars, with the other bar."""
    found = []
    for first, end in _runs(table, rows):
        mine = rows[first:end]
        was, bars = str(table.bar[mine[0]]), _bars(rig, str(table.rig[mine[0]]))
        for name in bars:
            if was in bars and name != was:
                where = f"{named_row(table, mine[0])} to {named_row(table, mine[-1])}"
                text = (
                    f"{counted(mine.size, 'row')} from {where} were measured with bar {name}, not {was}: correct their bar "
                    "and their lengths"
                )
                changed = _with_bar(table, np.isin(np.arange(len(table)), mine), bars[was], bars[name])
                reading = Interpretation(text, chain, rig, changed.select(some), free)
                found.append(OtherBar(reading, f"{mine[0] + 1}:{mine[-1] + 1}"))
    return [*found, *_exchanged(chain, rig, table, some, free)]


def _exchanged(chain: Chain, rig: Rigs, table: ObservationTable, some: Indices, free: Mask) -> Iterator[OtherBar]:
    """Return the table with two bars exchanged in all rows of a rig."""
    for of in np.unique(table.rig).tolist():
        bars = _bars(rig, of)
        for one, other in combinations(bars, 2):
            first, second = ((table.rig == of) & (table.bar == name) for name in (one, other))
            changed = _with_bar(_with_bar(table, first, bars[one], bars[other]), second, bars[other], bars[one])
            text = f"the names of bars {one} and {other} are exchanged in all rows: correct the lengths too"
            yield OtherBar(Interpretation(text, chain, rig, changed.select(some), free), "")


def _runs(table: ObservationTable, rows: Indices) -> list[tuple[int, int]]:
    """Return the runs of ``rows`` with one bar, chuck and sphere mounted, as the first and the one after the last."""
    mounted = mountings(table.select(rows))
    edges = np.concatenate([[0], np.flatnonzero(np.diff(mounted)) + 1, [rows.size]]).tolist()
    return [(first, end) for first, end in pairwise(edges) if table.bar[rows[first]]]


def _bars(rig: Rigs, name: str) -> dict[str, BallBar]:
    return dict((rig if isinstance(rig, Rig) else rig[name]).bars)


def _with_bar(table: ObservationTable, mine: Mask, was: BallBar, now: BallBar) -> ObservationTable:
    """Return the table with the rows ``mine`` (n,) measured with bar ``now``, where they name ``was``."""
    length = now.zero + now.gain * (table.value - was.zero) / was.gain
    bar = np.where(mine, now.name, table.bar)
    return table.replace(bar=bar, value=np.where(mine, length, table.value))
