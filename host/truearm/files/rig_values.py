"""Values of a rig file: lengths and angles in the units of their keys, names, matrices; checked, in SI units.

``where`` names the file and the entry in messages.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from truearm.errors import RigError
from truearm.types import Matrix

HUGE = 1e12
LARGEST = 100.0  # m, or another SI unit; a longer length was written in mm
LARGEST_MATRIX = 64  # joints
METRES = {"m": 1.0, "mm": 1e-3}
RADIANS = {"rad": 1.0, "deg": math.pi / 180.0}

_NAME = re.compile(r"[\w-]{1,64}")


def keys(quantities: Iterable[str], units: Mapping[str, float] = METRES) -> set[str]:
    """The keys that quantities may have."""
    return {f"{quantity}_{unit}" for quantity in quantities for unit in units}


def check_keys(table: Mapping[str, Any], known: set[str], where: str) -> None:
    """A misspelt key would silently take its default."""
    for key in table:
        if key not in known:
            close = difflib.get_close_matches(key[:40], known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(sorted(known))}"
            raise RigError(f"{where}: unknown key {key[:40]!r}; {hint[:150]}")


def is_name(value: object) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def name_of(table: Mapping[str, Any], where: str) -> str:
    name = table.get("name")
    if not isinstance(name, str) or not is_name(name):
        raise RigError(f"{where}: needs a name of up to 64 letters, digits, '-' and '_', as in the table")
    return name


def length(
    table: Mapping[str, Any], quantity: str, where: str, default: float | None = None, smallest: float = -LARGEST
) -> float:
    """The length written as ``quantity_m`` or ``quantity_mm``, in metres."""
    value = in_si(table, quantity, where, METRES, default)
    return within(number(value[0], quantity, where) * value[1], smallest, quantity, where)


def in_si(
    table: Mapping[str, Any], quantity: str, where: str, units: Mapping[str, float], default: object = None
) -> tuple[Any, float]:
    """The raw value of a quantity and the factor that makes it SI; ``units`` is METRES or RADIANS."""
    (si, one), (other, factor) = ((f"{quantity}_{unit}", scale) for unit, scale in units.items())
    if si in table and other in table:
        raise RigError(f"{where}: has both {si} and {other}; keep one")
    if si in table:
        return table[si], one
    if other in table:
        return table[other], factor
    if default is None:
        raise RigError(f"{where}: needs {si} (or {other})")
    return default, 1.0


def three(
    table: Mapping[str, Any],
    quantity: str,
    where: str,
    units: Mapping[str, float] = METRES,
    default: object = None,
    smallest: float = -LARGEST,
) -> tuple[float, float, float]:
    """Three numbers of a quantity, in SI units."""
    value, scale = in_si(table, quantity, where, units, default)
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise RigError(f"{where}: {quantity} must be three numbers")
    x, y, z = (within(number(v, quantity, where) * scale, smallest, quantity, where) for v in value)
    return x, y, z


def sigma_or_unknown(
    table: Mapping[str, Any], quantity: str, where: str, default: float | str, units: Mapping[str, float] = METRES
) -> float | None:
    """A standard deviation, 0 or more, in SI units; None for "unknown"."""
    value, scale = in_si(table, quantity, where, units, default)
    if value == "unknown":
        return None
    return within(number(value, quantity, where) * scale, 0.0, quantity, where)


def square(value: object, key: str, where: str, size: int | None = None) -> Matrix:
    """A square matrix of numbers, of a given size if any."""
    rows: list[Any] = value if isinstance(value, list) else [None]
    n = len(rows) if size is None else size
    if len(rows) != n or n > LARGEST_MATRIX or not all(isinstance(row, list) and len(row) == n for row in rows):
        raise RigError(f"{where}: {key} must be {size or 'as many'} rows of {size or 'as many'} numbers")
    return tuple(tuple(number(v, key, where) for v in row) for row in rows)


def number(value: object, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        shown = repr(value[:40]) if isinstance(value, str) else f"of type {type(value).__name__}"
        raise RigError(f"{where}: {key} must be a number, is {shown}")
    if not abs(value) <= HUGE:  # NaN too; an integer of a thousand digits has no float and no text
        raise RigError(f"{where}: {key} must be a finite number of reasonable size")
    return float(value)


def within(value: float, smallest: float, key: str, where: str) -> float:
    if not smallest <= value <= LARGEST:
        raise RigError(f"{where}: {key} must lie between {smallest:g} and {LARGEST:g} (SI units), is {value:g}")
    return value


def positive(value: float, key: str, where: str) -> float:
    if value <= 0.0:
        raise RigError(f"{where}: {key} must be greater than 0, is {value:g}")
    return value
