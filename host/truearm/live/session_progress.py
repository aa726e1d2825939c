"""Progress of a session: what is mounted, what was taken, what comes next and whether a part must be changed for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from truearm.errors import Argument, InputError
from truearm.types import BAR_MOUNTED, LINE_MOUNTED, MOUNTED, Floats, Move, Rig

MOUNTABLE = (*BAR_MOUNTED, "shell", *LINE_MOUNTED)
TOLERANCE = np.pi / 180.0  # rad or m, as in session.dwells


@dataclass
class SessionProgress:
    """Progress through the plan.

    ``rows`` is the plan as in ``/plan``, [] without one. ``mounted`` is what is mounted according to the operator or
    the beginning of the plan. ``confirmed``: the operator stated it. ``done``: rows that were taken. ``unplanned``:
    number of dwells and lines that are not in the plan, or without a plan. ``next``: the expected row. ``planned``: the rows by
    kind of move.
    """

    rows: Sequence[Mapping[str, Any]] = ()
    mounted: dict[str, str] = field(default_factory=dict)
    done: set[int] = field(default_factory=set)
    unplanned: Counter[str] = field(default_factory=Counter)
    next: int = 0

    def __post_init__(self) -> None:
        self.confirmed = bool(self.mounted)
        self.mounted = self.mounted or self.wanted() or {}
        self._q = np.array([row["q"] for row in self.rows])
        self._place: set[int] = set()  # rows at the last planned joints
        moves = [row.get("move", Move.DWELL) for row in self.rows]
        self.planned: dict[str, list[int]] = {move: [k for k, m in enumerate(moves) if m == move] for move in Move}

    def taken(self, move: str) -> int:
        """Return the number of dwells or lines, each row of the plan counted once."""
        rows = self.planned[move]
        return len(self.done.intersection(rows)) if rows else self.unplanned[move]

    @property
    def complete(self) -> bool:
        """Whether all of the plan has been taken."""
        return bool(self.rows) and self.done.issuperset(self.planned[Move.DWELL] + self.planned[Move.LINE])

    def wanted(self) -> dict[str, str] | None:
        """Return what the next row needs mounted; None at the plan's end and without a plan."""
        return next((p for row in self.rows[self.next :] if (p := pairing_of(row))), None)

    def change(self) -> dict[str, str] | None:
        """Return what must be mounted now, None if it already is."""
        pairing = self.wanted()
        return None if pairing is None or pairing.items() <= self.mounted.items() else pairing

    def mount(self, pairing: Mapping[str, str]) -> None:
        """Note that a part is mounted from now on; a bar and a line exclude each other."""
        self.confirmed = True
        excluded = LINE_MOUNTED if "bar" in pairing else BAR_MOUNTED if "line" in pairing else ()
        self.mounted = {k: v for k, v in self.mounted.items() if k not in excluded} | dict(pairing)

    def visit(self, q: Floats | None) -> int | None:
        """Note a dwell at joints ``q`` (None: unknown); return its row of the plan, None if it is not in the plan."""
        rows_in_reach = None if q is None else self._near(q)
        rows = [k for k in self.planned[Move.DWELL] if rows_in_reach is None or k in rows_in_reach]
        row = next((k for k in rows if k >= self.next), rows[-1] if rows and q is not None else None)
        self.note(Move.DWELL, row)
        return row

    def note(self, move: str, row: int | None) -> None:
        """Note a dwell or a line of this row of the plan, None if it is not in the plan."""
        if row is None:
            self.unplanned[move] += 1
        else:
            self.done.add(row)
            self.next = row + 1

    def arrive(self, q: Floats) -> int | None:
        """Note joints ``q``; return the line of the plan that ends there, if the arm came from its beginning."""
        rows_in_reach = self._near(q) if self.planned[Move.LINE] else set()
        if not rows_in_reach or rows_in_reach == self._place:
            return None
        row = next((k for k in self.planned[Move.LINE] if k in rows_in_reach and k - 1 in self._place), None)
        self._place = rows_in_reach
        if row is not None:
            self.note(Move.LINE, row)
        return row

    def _near(self, q: Floats) -> set[int]:
        """Return the rows of the plan at joints ``q``."""
        if self._q.shape[1:] != q.shape:
            return set()
        return {*np.flatnonzero(np.max(np.abs(self._q - q), axis=1) <= TOLERANCE).tolist()}


def pairing_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Return what a row of the plan needs mounted."""
    return {key: str(row[key]) for key in MOUNTED if row.get(key)}  # a shell is a position of the robot


def words_of(pairing: Mapping[str, str]) -> str:
    """Format a pairing on one line."""
    return ", ".join(f"{key} {name}" for key, name in pairing.items()) or "nothing confirmed"


def parse_mounted(text: str) -> dict[str, str]:
    """Parse ``bar=bar46,chuck=c1`` into a mapping. Raises InputError."""
    mounting: dict[str, str] = {}
    for entry in text.split(","):
        key, separator, name = (word.strip() for word in entry.partition("="))
        if key not in MOUNTABLE or not separator or not name:
            form = f"KEY=NAME, such as bar=bar46; KEY is one of {', '.join(MOUNTABLE)}"
            raise InputError("wrong-value", place=Argument("mounted"), value=entry[:40], form=form)
        if key in mounting:
            raise InputError("given-twice", place=Argument("mounted"), what=key)
        mounting[key] = name
    return mounting


def check_mounted(mounting: Mapping[str, str], rig: Rig) -> None:
    """Raise InputError for a part that the rig does not have; a rig without lines accepts any."""
    for key, names in rig.mounted().items():
        if key in mounting and (names or key in BAR_MOUNTED) and mounting[key] not in names:
            where, name = Argument("mounted"), mounting[key][:40]
            raise InputError("not-in-rig", place=where, what=key, name=name, names=sorted(names))
