"""The columns of a table of observations: their names, units and which joint they are of (docs/table-format.md)."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from typing import NamedTuple

from truearm.errors import TableError

UNITS = {"q": ("rad", "deg", "m", "mm"), "length": ("m", "mm"), "sigma": ("m", "mm")}
IDS = ("bar", "chuck", "sphere", "socket", "place", "shell")

_QUANTITY = re.compile(r"(q[1-9][0-9]{0,2}|length|sigma)(?:_(\w*))?")


class Column(NamedTuple):
    """A column of the file: its title, where it stands, and its unit."""

    name: str
    position: int
    unit: str  # "" for identifiers


def read_header(header: list[str], name: str) -> dict[str, Column]:
    """Columns by quantity (``kind``, ``q1``, ``length``, ``bar`` …); columns x_… and note are passed over."""
    columns: dict[str, Column] = {}
    seen: set[str] = set()
    for position, title in enumerate(header):
        where = f"{name} column {position + 1} ({shown(title)})"
        if title in seen:
            raise TableError(f"{where}: stands twice in the header; keep one")
        seen.add(title)
        if title == "note" or title.startswith("x_"):
            continue
        quantity, unit = _quantity(title, where)
        if quantity in columns:
            raise TableError(f"{where}: {quantity} is given twice, as {columns[quantity].name} too; keep one")
        columns[quantity] = Column(title, position, unit)
    if "kind" not in columns:
        raise TableError(f"{name}: has no column 'kind' (ball_bar or seat); is the first row a header?")
    return columns


def _quantity(title: str, where: str) -> tuple[str, str]:
    """Quantity and unit of a column's title, or TableError with the title that was probably meant."""
    if title == "kind" or title in IDS:
        return title, ""
    match = _QUANTITY.fullmatch(title)
    if match is None:
        raise TableError(f"{where}: is no known column; {_suggestion(title)}")
    quantity, unit = match.groups()
    known = UNITS[quantity.rstrip("0123456789")]
    if unit is None:
        raise TableError(f"{where}: has no unit; name it {' or '.join(f'{quantity}_{u}' for u in known)}")
    if unit not in known:
        raise TableError(f"{where}: unit {shown(unit)} is not known; use one of {', '.join(known)}")
    return quantity, unit


def _suggestion(title: str) -> str:
    known = ["kind", *IDS, "length_mm", "length_m", "sigma_mm", "sigma_m", *(f"q{i}_rad" for i in range(1, 8))]
    close = difflib.get_close_matches(title[:40].lower(), known, n=1)
    return f"did you mean {close[0]}?" if close else "begin its name with x_ if it is to be ignored"


def joint_columns(columns: dict[str, Column], joint_units: Sequence[str] | None, name: str) -> list[Column]:
    """The joint columns in joint order, checked against the robot."""
    numbers = sorted(int(quantity[1:]) for quantity in columns if _is_joint(quantity))
    if not numbers:
        raise TableError(f"{name}: has no joint columns; name them q1_rad, q2_rad, ... (or q1_deg, ...)")
    missing = set(range(1, numbers[-1] + 1)) - set(numbers)
    if missing:
        raise TableError(f"{name}: has columns up to q{numbers[-1]} but none for q{min(missing)}")
    joints = [columns[f"q{number}"] for number in numbers]
    if joint_units is None:
        return joints
    if len(joints) != len(joint_units):
        raise TableError(f"{name}: has {len(joints)} joint columns, the robot has {len(joint_units)} joints")
    for joint, unit in zip(joints, joint_units, strict=True):
        if base_unit(joint.unit) != unit:
            allowed = "rad or deg (it turns)" if unit == "rad" else "m or mm (it slides)"
            raise TableError(f"{name} column {joint.name}: the robot's joint is measured in {allowed}")
    return joints


def _is_joint(quantity: str) -> bool:
    return quantity[0] == "q"


def base_unit(unit: str) -> str:
    """The SI unit that a joint column is turned into."""
    return "rad" if unit in ("rad", "deg") else "m"


def shown(text: str) -> str:
    """A stranger's text in quotes and cut short, for messages."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
