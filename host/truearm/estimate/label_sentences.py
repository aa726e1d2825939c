"""What is said about rows with a wrong label: names exchanged in all rows, otherwise the rows of each wrong label."""

from __future__ import annotations

import re
from collections.abc import Sequence

from truearm.kinds.table import ObservationTable
from truearm.results import Relabelling


def label_sentences(found: Sequence[Relabelling], table: ObservationTable) -> list[str]:
    """Return sentences about wrong labels: names exchanged throughout, otherwise the rows of each wrong label."""
    exchanged = _exchanged(found, table)
    if exchanged:
        return exchanged
    rows: dict[str, list[int]] = {}
    for one in found:
        pairs = [of for of in zip(one.columns, one.was, one.fits, strict=True) if of[1] != of[2]]
        change = "name {} but fit {}".format(*(" and ".join(f"{of[0]} {of[k]}" for of in pairs) for k in (1, 2)))
        rows.setdefault(change, []).extend(one.rows)
    sentences = []
    for change, mine in rows.items():
        first, last = (named_row(table, mine[i]) for i in (0, -1))
        which = first if len(mine) == 1 else f"{len(mine)} rows from {first} to {last}"
        sentences.append(f"{which} {change}")
    return sentences


def named_row(table: ObservationTable, row: int) -> str:
    """Return where a row comes from, without the folder, which would reveal somebody's paths."""
    return re.split(r"[\\/]", str(table.source[row]))[-1]


def _exchanged(found: Sequence[Relabelling], table: ObservationTable) -> list[str]:
    """Return the names of one column that are exchanged in all rows that have them; empty if there are none."""
    sentences = []
    for column in dict.fromkeys(column for one in found for column in one.columns):
        renamed: dict[str, set[str]] = {}
        count: dict[str, int] = {}
        for one in found:
            for of, was, fits in zip(one.columns, one.was, one.fits, strict=True):
                if of == column and was != fits:
                    renamed.setdefault(was, set()).add(fits)
                    count[was] = count.get(was, 0) + len(one.rows)
                elif of == column:
                    renamed.setdefault(was, set())
        changed = {was: next(iter(fits)) for was, fits in renamed.items() if len(fits) == 1}
        if any(len(fits) > 1 for fits in renamed.values()):
            return []
        if not changed:
            continue
        have = table[column]
        if set(changed) != set(changed.values()) or any(count[was] != int((have == was).sum()) for was in changed):
            return []
        if len(changed) == 2:
            a, b = changed
            sentences.append(f"the names of {column} {a} and {b} are exchanged in all rows")
        else:
            pairs = ", ".join(f"{was} is {fits}" for was, fits in changed.items())
            sentences.append(f"the names of the {column}s are permuted in all rows: {pairs}")
    return sentences
