"""Progress of a session: what is mounted, what was taken, what comes next and whether a part must be changed for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from truearm.types import BAR_MOUNTED, LINE_MOUNTED, MOUNTED, Floats, Move

MOUNTABLE = (*BAR_MOUNTED, "shell", *LINE_MOUNTED)
TOLERANCE = np.pi / 180.0  # rad or m, as in session.dwells


@dataclass
class SessionProgress:
    """Progress through the plan.

    ``rows`` is the plan as in ``/plan``, [] without one. ``mounted`` is what is mounted according to the operator or
    the beginning of the plan. ``confirmed``: the operator stated it. ``done``: rows with a dwell. ``unplanned``: number
    of dwells that are not in the plan, or without a plan. ``next``: the expected row.
    """

    rows: Sequence[Mapping[str, Any]] = ()
    mounted: dict[str, str] = field(default_factory=dict)
    done: set[int] = field(default_factory=set)
    unplanned: int = 0
    lines: int = 0
    next: int = 0
    confirmed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.confirmed = bool(self.mounted)
        self._dwells = [k for k, row in enumerate(self.rows) if row.get("move", Move.DWELL) == Move.DWELL]
        self._q = np.array([self.rows[k]["q"] for k in self._dwells])
        if not self.mounted and self.rows:
            self.mounted = self.wanted() or {}

    @property
    def taken(self) -> int:
        """Number of dwells, each pose of the plan counted once."""
        return len(self.done) if self._dwells else self.unplanned

    @property
    def planned(self) -> int:
        """Number of dwells in the plan."""
        return len(self._dwells)

    @property
    def planned_lines(self) -> int:
        """Number of lines in the plan."""
        return sum(row.get("move") == "line" for row in self.rows)

    @property
    def complete(self) -> bool:
        """Whether all of the plan has been taken."""
        return bool(self.rows) and len(self.done) == self.planned and self.lines >= self.planned_lines

    def pairings(self) -> list[dict[str, str]]:
        """Return all pairings of the plan in order, each once."""
        found: list[dict[str, str]] = []
        for row in self.rows:
            pairing = pairing_of(row)
            if pairing and pairing not in found:
                found.append(pairing)
        return found

    def wanted(self) -> dict[str, str] | None:
        """Return what the next row needs mounted; None at the plan's end and without a plan."""
        return next((p for row in self.rows[self.next :] if (p := pairing_of(row))), None)

    def change(self) -> dict[str, str] | None:
        """Return what must be mounted now, None if it already is."""
        wanted = self.wanted()
        if wanted is None or all(self.mounted.get(key) == name for key, name in wanted.items()):
            return None
        return wanted

    def mount(self, pairing: Mapping[str, str]) -> None:
        """Note that a part is mounted from now on; a bar and a line exclude each other."""
        self.confirmed = True
        other = LINE_MOUNTED if "bar" in pairing else BAR_MOUNTED if "line" in pairing else ()
        self.mounted = {k: v for k, v in self.mounted.items() if k not in other} | dict(pairing)

    def visit(self, q: Floats | None) -> int | None:
        """Note a dwell at joints ``q`` (None: unknown); return the plan's row, None if it is not in the plan."""
        row = self._row(q)
        if row is None:
            self.unplanned += 1
        else:
            self.done.add(row)
            self.next = row + 1
        return row

    def drive(self, q: Floats | None) -> int | None:
        """Note a line driven to joints ``q`` (None: unknown); return the plan's row, None if it is not in the plan."""
        rows = [k for k in range(self.next, len(self.rows)) if self.rows[k].get("move") == "line"]
        if q is not None:
            rows = [k for k in rows if len(self.rows[k]["q"]) == q.size and _near(self.rows[k]["q"], q)]
        if not rows and self.rows:
            return None
        self.lines += 1
        if not rows:
            return None
        self.next = rows[0] + 1
        return rows[0]

    def is_pose(self, q: Floats | None) -> bool:
        """Return whether joints ``q`` are those of a dwell of the plan."""
        return q is not None and self._row(q) is not None

    def _row(self, q: Floats | None) -> int | None:
        if q is None:
            return next((k for k in self._dwells if k >= self.next), None)
        if not self._dwells or self._q.shape[1] != q.shape[0]:
            return None
        near = np.flatnonzero(np.max(np.abs(self._q - q), axis=1) <= TOLERANCE)
        rows = [self._dwells[k] for k in near]
        return next((k for k in rows if k >= self.next), rows[-1] if rows else None)


def _near(planned: Sequence[float], q: Floats) -> bool:
    return bool(np.max(np.abs(np.array(planned) - q)) <= TOLERANCE)


def pairing_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Return what a row of the plan needs mounted."""
    return {key: str(row[key]) for key in MOUNTED if row.get(key)}  # a shell is a position of the robot


def words_of(pairing: Mapping[str, str]) -> str:
    """Format a pairing on one line."""
    return ", ".join(f"{key} {name}" for key, name in pairing.items()) or "nothing confirmed"
