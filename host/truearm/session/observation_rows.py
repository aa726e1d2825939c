"""Dwells and passes → the table of observations (hop 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from truearm.session.approach_sides import came_from
from truearm.session.dwells import Dwell
from truearm.session.joint_readings import Bins
from truearm.session.line_passes import Pass
from truearm.types import Floats, ObservationTable, Strings


def table_of(
    dwells: Sequence[Dwell], passes: Sequence[Pass], joints: int, name: str, bins: Bins | None
) -> ObservationTable:
    """A row of each dwell without a reason, then all rows of the passes; ``name`` is the session's, for ``source``.

    ``bins``: of the joints, which say from where they came to a dwell.
    """
    parts = [_of_dwells(dwells, joints, name, bins)]
    parts += [_of_pass(one, number, name) for number, one in enumerate(passes, start=1) if not one.reason]
    if len(parts) == 1:
        return parts[0]
    columns = (column.name for column in fields(ObservationTable))
    return ObservationTable(**{key: np.concatenate([getattr(part, key) for part in parts]) for key in columns})


def _of_dwells(dwells: Sequence[Dwell], joints: int, name: str, bins: Bins | None) -> ObservationTable:
    rows = [(i, dwell) for i, dwell in enumerate(dwells, start=1) if not dwell.reason]

    def words(key: str) -> Strings:
        return np.array([dwell.mounted.get(key, "") for _, dwell in rows], dtype=np.str_)

    side = np.full((len(rows), joints), np.nan)
    if bins is not None and rows:
        side[:] = [came_from(bins, dwell) for _, dwell in rows]
    table = _table(
        q=np.array([dwell.q for _, dwell in rows]).reshape(len(rows), joints),
        kind=np.array(["ball_bar"] * len(rows), dtype=np.str_),  # np.full would keep one letter
        value=np.array([dwell.value for _, dwell in rows], dtype=np.float64),
        sigma=np.array([dwell.sigma for _, dwell in rows], dtype=np.float64),
        source=np.array([f"{name} dwell {i}" for i, _ in rows], dtype=np.str_),
        words={key: words(key) for key in ("bar", "chuck", "sphere", "shell")},
    )
    return replace(table, side=np.where(side == 0.0, np.nan, side))


def _of_pass(one: Pass, number: int, name: str) -> ObservationTable:
    n = len(one.xyz)
    table = _table(
        q=one.q,
        kind=np.full(n, "line"),
        value=np.full(n, np.nan),
        sigma=np.full(n, np.nan),
        source=np.array([f"{name} pass {number}.{i}" for i in range(1, n + 1)], dtype=np.str_),
        words={"shell": np.full(n, one.group)},
    )
    line, target = (np.full(n, one.mounted.get(key, "")) for key in ("line", "target"))
    return replace(table, line=line, target=target, xyz=one.xyz, xyz_sigma=one.xyz_sigma, q_rate=one.q_rate)


def _table(
    q: Floats, kind: Strings, value: Floats, sigma: Floats, source: Strings, words: dict[str, Strings]
) -> ObservationTable:
    """A table with empty words where none are given."""
    empty = np.full(len(q), "", dtype=np.str_)
    bar, chuck, sphere, shell = (words.get(key, empty) for key in ("bar", "chuck", "sphere", "shell"))
    return ObservationTable(q, kind, value, sigma, bar, chuck, sphere, empty, empty, shell, source)
