"""The columns of a table of observations: their names, units and joints (docs/reference/table-format.md)."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

from truearm.errors import TableError
from truearm.kinds import registry
from truearm.kinds.columns import identifiers, is_label, quantities
from truearm.model.mimic import units_of
from truearm.schema import quoted
from truearm.text import page
from truearm.units import SUFFIXES, named, suffixes

COLUMNS = page("Observations, rigs and robots as files")
LIKE = 0.65  # similarity of a title and a known one, from 0 to 1, for which the known one was probably meant
JOINTS = {
    "q": (*suffixes("rad"), *suffixes("m")),
    "qd": (*suffixes("rad/s"), *suffixes("m/s")),
}
POSITION = {named(f"m{i}3", unit): named(axis, unit) for i, axis in enumerate("xyz") for unit in suffixes("m")}


class Column(NamedTuple):
    """A column of the file: its title, its position and its unit."""

    name: str
    position: int
    unit: str  # "" for identifiers


def read_header(header: list[str], name: str) -> dict[str, Column]:
    """Return columns by quantity (``kind``, ``q1``, ``length``, ``bar`` …), and the user's own by their title.

    Columns without a title are skipped, as is note.
    """
    if not difflib.get_close_matches("kind", [title.lower() for title in header]):
        raise TableError("missing-column", place=name, column="kind", header=quoted(header[0]))
    columns: dict[str, Column] = {}
    titles: set[str] = set()
    for position, title in enumerate(header):
        place = f"{name} column {position + 1} ({quoted(title)})"
        if title and title in titles:
            raise TableError("given-twice", place=place, what="it")
        titles.add(title)
        if title in ("", "note"):
            continue
        quantity, unit = (title, "") if is_label(title) else quantity_of(POSITION.get(title, title), place)
        if quantity in columns:
            raise TableError("given-twice", place=place, what=quantity)
        columns[quantity] = Column(title, position, unit)
    if "kind" not in columns:
        raise TableError("missing-column", place=name, column="kind")
    return columns


def number_units() -> dict[str, tuple[str, ...]]:
    """Return the columns of numbers, other than joints, with the units that each title may end in."""
    sigma = tuple(suffix for unit in registry.units() for suffix in suffixes(unit))
    measured = {c: tuple(suffixes(quantity.unit)) for quantity in quantities() for c in quantity.columns}
    return {"sigma": sigma, **measured}


def quantity_of(title: str, place: str) -> tuple[str, str]:
    """Return quantity and unit of a column's title.

    Raises TableError with the title that was probably meant. A ``sigma`` in a unit other than metres is a separate
    quantity, ``sigma_rad``: a table may have both.
    """
    if title == "kind" or title in identifiers():
        return title, ""
    units = number_units() | JOINTS
    longest_first = sorted(map(re.escape, number_units()), key=len, reverse=True)
    match = re.fullmatch(rf"(qd?(?=[1-9])|{'|'.join(longest_first)})([0-9]{{0,3}})(?:_(\w*))?", title)
    if match is None or (match[2] != "") != (match[1] in JOINTS):
        raise TableError("unknown-column", place=place, remedy=_suggestion(title))
    quantity, unit, allowed = match[1] + match[2], match[3] or "", units[match[1]]
    if unit not in allowed:
        raise TableError("wrong-value", place=place, names=[named(quantity, u) for u in allowed])
    return sigma_column(SUFFIXES[unit].si) if quantity == "sigma" else quantity, unit


def sigma_column(si: str) -> str:
    """Return the name of the column of standard deviations in an SI unit."""
    return "sigma" if si == "m" else f"sigma_{si}"


def _suggestion(title: str) -> str:
    joints = [f"{quantity}{i}_{units[0]}" for quantity, units in JOINTS.items() for i in range(1, 8)]
    numbers = [named(quantity, unit) for quantity, units in number_units().items() for unit in units]
    names = ["kind", *identifiers(), *numbers, *joints, *POSITION]
    close = difflib.get_close_matches(title[:40].lower(), names, n=2, cutoff=LIKE)
    ignored = "begin its name with x_ if it is to be ignored"
    meant = f"did you mean {' or '.join(close)}? Otherwise " if close else f"for the columns, {COLUMNS}; "
    return meant + ignored


def joint_columns(
    columns: dict[str, Column], joint_units: Sequence[str] | None, name: str, mimics: Collection[int] = ()
) -> list[Column]:
    """Return the joint columns in joint order, checked against the robot; a table may be without its mimic joints."""
    joints = _numbered(columns, "q", name)
    if not joints:
        raise TableError("missing-column", place=name, column="q1_rad")
    if joint_units is None:
        return joints
    joint_units = units_of(len(joints), joint_units, mimics)
    if len(joints) != len(joint_units):
        raise TableError("other-robot", place=name, joints=len(joints), expected=len(joint_units))
    for joint, unit in zip(joints, joint_units, strict=True):
        if base_unit(joint.unit) != unit:
            allowed = "rad or deg (it turns)" if unit == "rad" else "m or mm (it slides)"
            raise TableError(f"{name} column {joint.name}: the robot's joint is measured in {allowed}")
    return joints


def rate_columns(columns: dict[str, Column], joints: list[Column], name: str) -> list[Column]:
    """Return the columns of joint velocities in joint order: none, or one for each joint."""
    rates = _numbered(columns, "qd", name)
    if rates and len(rates) != len(joints):
        raise TableError(f"{name}: has {len(joints)} joint columns but {len(rates)} of velocities; give all or none")
    for joint, rate in zip(joints, rates, strict=False):
        if base_unit(rate.unit) != base_unit(joint.unit):
            raise TableError(
                f"{name} column {rate.name}: does not fit {joint.name}; one is revolute, the other prismatic"
            )
    return rates


def _numbered(columns: dict[str, Column], letter: str, name: str) -> list[Column]:
    """Return the columns of a quantity with one column per joint, in joint order, without gaps."""
    numbers = sorted(int(q[len(letter) :]) for q in columns if q.startswith(letter) and q[len(letter) :].isdecimal())
    missing = set(range(1, max(numbers, default=0) + 1)) - set(numbers)
    if missing:
        raise TableError(
            f"{name}: has columns up to {letter}{numbers[-1]} but none for {letter}{min(missing)}; number the joints from 1 without a gap"
        )
    return [columns[f"{letter}{number}"] for number in numbers]


def base_unit(unit: str) -> str:
    """Return the SI unit to which a joint's column is converted; for a velocity, without "per second"."""
    return SUFFIXES[unit].si.removesuffix("/s")
