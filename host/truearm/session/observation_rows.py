"""Dwells and passes → the table of observations (hop 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.session.approach_sides import came_from
from truearm.session.dwells import Dwell
from truearm.session.joint_readings import Bins
from truearm.session.line_passes import Pass
from truearm.types import ObservationTable, Strings


def table_of(
    dwells: Sequence[Dwell], passes: Sequence[Pass], joints: int, name: str, bins: Bins | None
) -> ObservationTable:
    """A row of each dwell without a reason, then all rows of the passes; ``name`` is the session's, for ``source``.

    ``bins``: of the joints, which say from where they came to a dwell.
    """
    parts = [_of_dwells(dwells, joints, name, bins)]
    parts += [_of_pass(one, number, name) for number, one in enumerate(passes, start=1) if not one.reason]
    return ObservationTable.joined(parts)


def _of_dwells(dwells: Sequence[Dwell], joints: int, name: str, bins: Bins | None) -> ObservationTable:
    rows = [(i, dwell) for i, dwell in enumerate(dwells, start=1) if not dwell.reason]

    def words(key: str) -> Strings:
        return np.array([dwell.mounted.get(key, "") for _, dwell in rows], dtype=np.str_)

    side = np.full((len(rows), joints), np.nan)
    if bins is not None and rows:
        side[:] = [came_from(bins, dwell) for _, dwell in rows]
    return ObservationTable(
        q=np.array([dwell.q for _, dwell in rows]).reshape(len(rows), joints),
        kind=np.array(["ball_bar"] * len(rows), dtype=np.str_),  # np.full would keep one letter
        value=np.array([dwell.value for _, dwell in rows], dtype=np.float64),
        sigma=np.array([dwell.sigma for _, dwell in rows], dtype=np.float64),
        source=np.array([f"{name} dwell {i}" for i, _ in rows], dtype=np.str_),
        side=np.where(side == 0.0, np.nan, side),
        bar=words("bar"),
        chuck=words("chuck"),
        sphere=words("sphere"),
        shell=words("shell"),
    )


def _of_pass(one: Pass, number: int, name: str) -> ObservationTable:
    n = len(one.xyz)
    return ObservationTable(
        q=one.q,
        kind=np.full(n, "line"),
        source=np.array([f"{name} pass {number}.{i}" for i in range(1, n + 1)], dtype=np.str_),
        shell=np.full(n, one.group),
        line=np.full(n, one.mounted.get("line", "")),
        target=np.full(n, one.mounted.get("target", "")),
        xyz=one.xyz,
        xyz_sigma=one.xyz_sigma,
        q_rate=one.q_rate,
    )
