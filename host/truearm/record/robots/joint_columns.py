"""Joint readings in columns, live or in a file: the header says what each column is, and its unit stands in its name.

``t_s`` (or _ms, _us, _ns) is the controller's time, ``q1_rad`` (_deg, _m, _mm) … the measured joints; optional are ``q1_cmd_rad`` …
commanded, ``qd1_rad_s`` … velocities, ``seq`` a count of the readings, ``inputs`` digital inputs as a number. ``note`` and ``x_…`` are passed over.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from truearm.errors import InputError
from truearm.files.csv_cells import NUMBER
from truearm.schema import quoted
from truearm.session.joint_readings import MAX_JOINTS, format_reading
from truearm.units import SUFFIXES

# to divide by: 1e-9 is no exact number
PER_SECOND = {unit: round(SUFFIXES[unit].factor) for unit in ("s", "ms", "us", "ns")}
MAX_COLUMNS = 200
EXAMPLE = "t_s,seq,q1_rad,q2_rad,... (units: rad, deg, m, mm; commanded joints are q1_cmd_rad, ...)"

_TIME = re.compile(r"t_(s|ms|us|ns)")
_JOINT = re.compile(r"(q|qd)([1-9]\d?)(_cmd)?_(rad|deg|m|mm)(_s)?")
_WHOLE = re.compile(r"[+-]?\d{1,18}", re.ASCII)

Place = tuple[int, float]  # where a column stands, and the factor that makes its numbers SI


@dataclass(frozen=True)
class Columns:
    """Where things stand in a row."""

    width: int
    t: tuple[int, int]  # where it stands, and how many of its unit are a second
    q: tuple[Place, ...]
    q_cmd: tuple[Place, ...]
    qd: tuple[Place, ...]
    seq: int | None
    inputs: int | None

    def line(self, cells: Sequence[str], **more: object) -> bytes | None:
        """The reading of a row as a line of a session, with ``more`` beside it; None if the row is none."""
        if len(cells) != self.width:
            return None
        try:
            t = _number(cells[self.t[0]]) / self.t[1]
            q, q_cmd, qd = ([_scaled(cells, place) for place in part] or None for part in (self.q, self.q_cmd, self.qd))
            seq, inputs = (None if at is None else _whole(cells[at]) for at in (self.seq, self.inputs))
        except ValueError:
            return None
        return format_reading(t, seq, q or [], q_cmd=q_cmd, qd=qd, inputs=inputs, **more)


NUMBERED = "{}"  # stands for the number of a joint
SEPARATORS = ",;\t"


def separator_of(header: str) -> str:
    """Return what separates the cells of a table with this header: a comma, a semicolon or a tab, whichever there is most of."""
    return max(SEPARATORS, key=header.count)


def with_point(cell: str) -> str:
    """Return a number's decimal comma as a point; of other cells nothing changes. For tables that no comma separates."""
    return cell.replace(",", ".") if cell.count(",") == 1 and "." not in cell else cell


def parse_renames(text: str) -> tuple[tuple[str, str], ...]:
    """The pairs (ours, theirs) of OURS=THEIRS,…; in both {} stands for a joint's number. Raises InputError."""
    pairs = tuple(
        (ours.strip(), theirs.strip()) for ours, _, theirs in (part.partition("=") for part in text.split(","))
    )
    for ours, theirs in pairs:
        if not theirs or not ours or (NUMBERED in ours) != (NUMBERED in theirs) or theirs.count(NUMBERED) > 1:
            raise InputError(
                f"{quoted(f'{ours}={theirs}')}: write OURS=THEIRS, as t_s=timestamp or q{NUMBERED}_rad=actual_q_{NUMBERED}, "
                f"with {NUMBERED} for a joint's number on both sides or none"
            )
    return pairs


def renamed(titles: Sequence[str], renames: Sequence[tuple[str, str]]) -> list[str]:
    """A table's titles in our words; what is not among the renames is passed over. Joints count from the lowest number that is there.

    Raises InputError for a column that is not there.
    """
    out = [f"x_{k}" for k in range(len(titles))]
    for ours, theirs in renames:
        pattern = re.compile(r"(\d{1,2})".join(map(re.escape, theirs.split(NUMBERED))))
        places = [(k, found) for k, title in enumerate(titles) if (found := pattern.fullmatch(title))]
        if not places:
            known = ", ".join(map(quoted, titles[:8]))
            raise InputError(f"no column {quoted(theirs)}; the table begins with {known}")
        first = min(int(found[1]) for _, found in places) if NUMBERED in theirs else 0
        for k, found in places:
            number = int(found[1]) - first + 1 if NUMBERED in theirs else ""
            out[k] = ours.replace(NUMBERED, str(number))
    return out


def read_columns(titles: Sequence[str]) -> Columns:
    """The columns that a header names. Raises InputError."""
    if len(titles) > MAX_COLUMNS:
        raise InputError(f"{len(titles)} columns; the most is {MAX_COLUMNS}")
    single: dict[str, Place] = {}
    joints: dict[str, dict[int, Place]] = {"q": {}, "q_cmd": {}, "qd": {}}
    for position, title in enumerate(titles):
        if title == "note" or title.startswith("x_"):
            continue
        quantity, number, scale = _quantity(title)
        known: dict[str, Place] | dict[int, Place] = joints[quantity] if number else single
        key = number or quantity
        if key in known:
            raise InputError(f"column {quoted(title)}: {quantity}{number or ''} is given twice; keep one")
        known[key] = (position, scale)  # type: ignore[index]
    if "t" not in single:
        raise InputError(f"no column t_s of the controller's time; expected is a header such as {EXAMPLE}")
    q, q_cmd, qd = (_in_order(quantity, joints[quantity], len(joints["q"])) for quantity in joints)
    places = {name: single[name][0] if name in single else None for name in ("seq", "inputs")}
    t = (single["t"][0], int(single["t"][1]))
    return Columns(len(titles), t, q, q_cmd, qd, places["seq"], places["inputs"])


def _quantity(title: str) -> tuple[str, int, float]:
    """Quantity, number of the joint (0: it is of none) and factor of a column's title."""
    if title in ("seq", "inputs"):
        return title, 0, 1.0
    if found := _TIME.fullmatch(title):
        return "t", 0, PER_SECOND[found[1]]
    found = _JOINT.fullmatch(title)
    if found is None or (found[1] == "qd") != bool(found[5]) or (found[1] == "qd" and found[3]):
        raise InputError(
            f"column {quoted(title)} is not known; expected is a header such as {EXAMPLE}; x_... is passed over"
        )
    return found[1] + (found[3] or ""), int(found[2]), SUFFIXES[found[4]].scale


def _in_order(quantity: str, places: dict[int, Place], n: int) -> tuple[Place, ...]:
    """The places of a quantity in joint order: of all n joints, or (unless it is q) of none."""
    if ((places or quantity == "q") and sorted(places) != list(range(1, n + 1))) or (
        quantity == "q" and not 1 <= n <= MAX_JOINTS
    ):
        raise InputError(f"columns of {quantity} are needed for joints 1, 2, ... without a gap; expected is {EXAMPLE}")
    return tuple(places[number] for number in sorted(places))


def _scaled(cells: Sequence[str], place: Place) -> float:
    return _number(cells[place[0]]) * place[1]


def _number(cell: str) -> float:
    """A finite decimal number. float() would take "1_000", "nan" and digits of other scripts. Raises ValueError."""
    if len(cell) > 40 or not NUMBER.fullmatch(cell):
        raise ValueError(cell[:40])
    return float(cell)


def _whole(cell: str) -> int:
    if not _WHOLE.fullmatch(cell):
        raise ValueError(cell[:40])
    return int(cell)
