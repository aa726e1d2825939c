"""How far a session has come: what is mounted, what was taken, what comes next and whether something has to be changed for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from truearm.types import BAR_MOUNTED, LINE_MOUNTED, Floats, Move

MOUNTABLE = (*BAR_MOUNTED, "shell", *LINE_MOUNTED)
CHANGED = (*BAR_MOUNTED, *LINE_MOUNTED)  # by hand; a shell is a place of the robot
TOLERANCE = np.pi / 180.0  # rad or m, as sync.dwell has it


@dataclass
class SessionProgress:
    """``rows`` is the plan as ``/plan`` has it, [] without one; ``mounted`` what is mounted as far as anybody said or the plan begins.

    ``confirmed``: whether anybody said it. ``done``: rows whose dwell was taken; ``unplanned``: dwells that are not in the plan, or without one. ``next``: the row that is awaited.
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
        """Dwells, each pose of the plan once."""
        return len(self.done) if self._dwells else self.unplanned

    @property
    def planned(self) -> int:
        """Dwells of the plan."""
        return len(self._dwells)

    @property
    def planned_lines(self) -> int:
        """Lines of the plan."""
        return sum(row.get("move") == "line" for row in self.rows)

    @property
    def complete(self) -> bool:
        """Whether all of a plan was taken."""
        return bool(self.rows) and len(self.done) == self.planned and self.lines >= self.planned_lines

    def pairings(self) -> list[dict[str, str]]:
        """All pairings of the plan in their order, each once."""
        found: list[dict[str, str]] = []
        for row in self.rows:
            pairing = pairing_of(row)
            if pairing and pairing not in found:
                found.append(pairing)
        return found

    def wanted(self) -> dict[str, str] | None:
        """What the next row needs mounted; None at the plan's end and without one."""
        return next((p for row in self.rows[self.next :] if (p := pairing_of(row))), None)

    def change(self) -> dict[str, str] | None:
        """What has to be mounted now, None if that is so already."""
        wanted = self.wanted()
        if wanted is None or all(self.mounted.get(key) == name for key, name in wanted.items()):
            return None
        return wanted

    def mount(self, pairing: Mapping[str, str]) -> None:
        """It is said to be mounted from now on; a bar and a line exclude each other."""
        self.confirmed = True
        other = LINE_MOUNTED if "bar" in pairing else BAR_MOUNTED if "line" in pairing else ()
        self.mounted = {k: v for k, v in self.mounted.items() if k not in other} | dict(pairing)

    def visit(self, q: Floats | None) -> int | None:
        """A dwell was taken at joints ``q`` (None: nobody knows); the plan's row that it is, None if it is none."""
        row = self._row(q)
        if row is None:
            self.unplanned += 1
        else:
            self.done.add(row)
            self.next = row + 1
        return row

    def drive(self, q: Floats | None) -> int | None:
        """A line was driven, to joints ``q`` (None: nobody knows); the plan's row that it is, None if it is none."""
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
    """What a row of the plan needs mounted."""
    return {key: str(row[key]) for key in CHANGED if row.get(key)}


def words_of(pairing: Mapping[str, str]) -> str:
    """A pairing on one line."""
    return ", ".join(f"{key} {name}" for key, name in pairing.items()) or "nothing said"
