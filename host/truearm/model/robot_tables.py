"""The tables of a robot file, checked and turned into joints, slots and numbers in SI.

A parameter is written as a table of named values, ``{ design = 0.35, held = true }``, a constant that nobody identifies
as a plain number. Units stand in the keys: ``_m _cm _mm`` for lengths, ``_rad _deg`` for angles, none for a gain. The
file may come from a stranger: everything unknown, missing, doubled or absurd raises RobotError in one line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from truearm.errors import RobotError
from truearm.model import joint_law
from truearm.model.chain import Joint
from truearm.model.dh import Layout, dh_slots, modified_dh_slots
from truearm.model.joint_terms.offset import Offset
from truearm.model.sheth_uicker import sheth_uicker_slots
from truearm.model.slots import Slot, law_name
from truearm.model.transforms import MOTIONS
from truearm.units import suffixes

HEAD = ("name", "convention", "nominal", "base_frame", "end_frame")
OPTIONAL = {"source", "branch", "capsule"}  # keys and tables that a file of any convention may have
MAX_JOINTS = 64
MAX_TRANSFORMS = 1000
MAX_NAME = 100  # characters
SUFFIXES = ("m", "cm", "mm", "rad", "deg", "")
LARGEST = {"m": 100.0, "rad": 1e4, "1": 1e6}  # larger than any arm; millimetres written as metres are caught by it
NAME = re.compile(rf"[A-Za-z0-9_.-]{{1,{MAX_NAME}}}")


class Amount(NamedTuple):
    """What a file says of one number [SI]: a constant, or a parameter's value in each named set."""

    constant: float | None
    values: Mapping[str, float]
    held: bool


class Description(NamedTuple):
    """A robot file without its head: slots in order, and the amount of every slot and joint law by name."""

    joints: tuple[Joint, ...]
    slots: tuple[Slot, ...]
    amounts: Mapping[str, Amount]


def read_description(doc: Mapping[str, Any], convention: str) -> Description:
    """The joints and numbers of a parsed robot file in one of the CONVENTIONS. Raises RobotError."""
    if convention not in CONVENTIONS:
        raise RobotError(f"robot file: convention {shown(convention)} is not known; use {', '.join(CONVENTIONS)}")
    return CONVENTIONS[convention](doc)


def _read_sheth_uicker(doc: Mapping[str, Any]) -> Description:
    count = _count_joints(doc)
    _check_tables(doc, [f"link{i + 1}" for i in range(count + 1)])
    joints, used = _joints(doc, count)
    return _described(doc, joints, sheth_uicker_slots(joints), used)


def _read_dh(doc: Mapping[str, Any]) -> Description:
    return _read_rows(doc, dh_slots)


def _read_modified_dh(doc: Mapping[str, Any]) -> Description:
    return _read_rows(doc, modified_dh_slots)


def _read_rows(doc: Mapping[str, Any], layout: Layout) -> Description:
    """Rows of four constants; ``base``, ``tool`` and the β of a row are there if they are written."""
    count = _count_joints(doc)
    _check_tables(doc, [key for key in ("base", "tool") if key in doc])
    joints, used = _joints(doc, count)
    twisted = [i for i in range(count) if any(key.startswith("beta_") for key in doc[f"joint{i + 1}"])]
    return _described(doc, joints, layout(joints, twisted, "base" in doc, "tool" in doc), used)


def _read_elementary(doc: Mapping[str, Any]) -> Description:
    """``[[transform]]`` by ``[[transform]]``: a joint, a parameter with a name, or a constant without."""
    for key in sorted((set(doc) - OPTIONAL) ^ {*HEAD, "transform"}):
        raise RobotError(f"robot file: {'unknown' if key in doc else 'missing'} table or key {shown(key)}")
    entries = doc["transform"]
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_TRANSFORMS:
        raise RobotError(f"robot file: transform must be 1 to {MAX_TRANSFORMS} tables, [[transform]] each")
    joints: list[Joint] = []
    slots: list[Slot] = []
    amounts: dict[str, Amount] = {}
    for i, entry in enumerate(entries):
        slot, joint, more = _transform(f"transform {i + 1}", entry, len(joints))
        twice = sorted(set(more) & set(amounts))
        if twice:
            raise RobotError(f"robot file: transform {i + 1}: {twice[0]} is the name of an earlier one")
        slots.append(slot)
        amounts |= more
        joints += [joint] if joint else []
    if not 1 <= len(joints) <= MAX_JOINTS:
        raise RobotError(f"robot file has {len(joints)} joints; 1 to {MAX_JOINTS} are possible")
    return Description(tuple(joints), tuple(slots), amounts)


CONVENTIONS: Mapping[str, Callable[[Mapping[str, Any]], Description]] = {
    "sheth_uicker": _read_sheth_uicker,
    "dh": _read_dh,
    "modified_dh": _read_modified_dh,
    "elementary": _read_elementary,
}


def _transform(where: str, entry: Any, number: int) -> tuple[Slot, Joint | None, dict[str, Amount]]:
    table = as_table(entry, where)
    motion = table.get("motion")
    if motion not in MOTIONS:
        raise RobotError(f"robot file: {where}: motion must be one of {', '.join(MOTIONS)}")
    if "joint" in table:
        return _moving(where, table, motion, number)
    slot = Slot(where if "name" not in table else _name(table, "name", where), motion)
    used = {"motion", "name"} & set(table)
    amount = _amount(table, where, "amount", slot.unit, used)
    if (amount.constant is None) != ("name" in table):
        raise RobotError(f"robot file: {where}: a parameter needs a name and a table of values, a constant neither")
    check_unknown(table, where, used)
    return slot, None, {slot.name: amount}


def _moving(
    where: str, table: Mapping[str, Any], motion: str, number: int
) -> tuple[Slot, Joint | None, dict[str, Amount]]:
    name = _name(table, "joint", where)
    slot = Slot(f"{name}.offset", motion, number)
    used = {"motion", "joint"}
    lower, upper = _limits(table, where, slot.unit, used)
    amounts = {slot.name: Amount(0.0, {}, False)}
    if any(key.startswith("offset") for key in table):
        amounts[slot.name] = _amount(table, where, "offset", slot.unit, used)
    amounts |= _law(table, where, slot, used)
    check_unknown(table, where, used)
    return slot, Joint(name, "prismatic" if motion[0] == "t" else "revolute", lower, upper), amounts


def _count_joints(doc: Mapping[str, Any]) -> int:
    count = sum(1 for key in doc if key.startswith("joint"))
    if not 1 <= count <= MAX_JOINTS:
        raise RobotError(f"robot file has {count} joints; 1 to {MAX_JOINTS} are possible")
    return count


def _check_tables(doc: Mapping[str, Any], more: Sequence[str]) -> None:
    """The keys of the file are the head, joint1 … and ``more``; a source may be named."""
    expected = {*HEAD, *more, *(f"joint{i + 1}" for i in range(_count_joints(doc)))}
    for key in sorted((set(doc) - OPTIONAL) ^ expected):
        raise RobotError(f"robot file: {'unknown' if key in doc else 'missing'} table or key {shown(key)}")
    for key in expected - set(HEAD):
        as_table(doc[key], key)


def _joints(doc: Mapping[str, Any], count: int) -> tuple[tuple[Joint, ...], dict[str, set[str]]]:
    """The joints, and by table the keys that they used up."""
    used: dict[str, set[str]] = {f"joint{i + 1}": {"kind"} for i in range(count)}
    return tuple(_joint(name, doc[name], seen) for name, seen in used.items()), used


def _joint(name: str, table: Mapping[str, Any], used: set[str]) -> Joint:
    kind = table.get("kind")
    if kind not in ("revolute", "prismatic"):
        raise RobotError(f"robot file: {name}.kind must be revolute or prismatic")
    return Joint(name, kind, *_limits(table, name, "rad" if kind == "revolute" else "m", used))


def _limits(table: Mapping[str, Any], where: str, unit: str, used: set[str]) -> tuple[float, float]:
    lower, upper = (read_quantity(table, where, key, unit, used) for key in ("lower", "upper"))
    if lower >= upper:
        raise RobotError(f"robot file: {where}'s lower limit is not below its upper limit")
    return lower, upper


def _described(
    doc: Mapping[str, Any], joints: tuple[Joint, ...], slots: tuple[Slot, ...], used: dict[str, set[str]]
) -> Description:
    """The amounts of all slots and joint laws; every key of every table must have been of use."""
    amounts: dict[str, Amount] = {}
    for slot in slots:
        table_name, key = slot.name.split(".")
        table, seen = doc[table_name], used.setdefault(table_name, set())
        amounts[slot.name] = _amount(table, table_name, key, slot.unit, seen)
        if slot.joint is not None:
            amounts |= _law(table, table_name, slot, seen)
    for table_name, seen in used.items():
        check_unknown(doc[table_name], table_name, seen)
    return Description(joints, slots, amounts)


def _law(table: Mapping[str, Any], where: str, slot: Slot, used: set[str]) -> dict[str, Amount]:
    """What the table has of the joint's law beside its offset; a term that it does not name says nothing."""
    amounts = {}
    for term in joint_law.TERMS:
        unit = term.unit_of("prismatic" if slot.motion[0] == "t" else "revolute")
        if term is Offset or not set(_keys(term.name, unit)) & set(table):
            continue
        amount = _amount(table, where, term.name, unit, used)
        if amount.constant is not None or (term.nonzero and 0.0 in amount.values.values()):
            rule = ", none of them 0" * term.nonzero
            raise RobotError(
                f"robot file: {where}.{term.name} must be a table of values{rule}; left out it is {term.neutral:g}"
            )
        amounts[law_name(slot, term.name)] = amount
    return amounts


def _amount(table: Mapping[str, Any], where: str, key: str, unit: str, used: set[str]) -> Amount:
    found, scale = _find(table, where, key, unit)
    used.add(found)
    entry = table[found]
    if not isinstance(entry, Mapping):
        return Amount(read_number(entry, f"{where}.{found}", unit, scale), {}, False)
    held = entry.get("held", False)
    if not isinstance(held, bool):
        raise RobotError(f"robot file: {where}.{found}.held must be true or false")
    values = {k: read_number(v, f"{where}.{found}.{shown(k)}", unit, scale) for k, v in entry.items() if k != "held"}
    return Amount(None, values, held)


def read_quantity(table: Mapping[str, Any], where: str, key: str, unit: str, used: set[str]) -> float:
    found, scale = _find(table, where, key, unit)
    used.add(found)
    return read_number(table[found], f"{where}.{found}", unit, scale)


def read_quantities(
    table: Mapping[str, Any], where: str, key: str, unit: str, count: int, used: set[str]
) -> list[float]:
    """A list of ``count`` numbers [SI]."""
    found, scale = _find(table, where, key, unit)
    used.add(found)
    values = table[found]
    if not isinstance(values, list) or len(values) != count:
        raise RobotError(f"robot file: {where}.{found} must be a list of {count} numbers")
    return [read_number(value, f"{where}.{found}", unit, scale) for value in values]


def _find(table: Mapping[str, Any], where: str, key: str, unit: str) -> tuple[str, float]:
    """The key with its unit suffix as it stands in the table, and the factor to SI."""
    candidates = _keys(key, unit)
    found = [name for name in candidates if name in table]
    if len(found) != 1:
        raise RobotError(f"robot file: {where} needs exactly one of {', '.join(candidates)}")
    return found[0], candidates[found[0]]


def _keys(key: str, unit: str) -> dict[str, float]:
    """The forms of a key with a unit's suffixes, and the factor to SI of each."""
    return {f"{key}_{suffix}" if suffix else key: scale for suffix, scale in suffixes(unit, SUFFIXES).items()}


def read_number(value: Any, where: str, unit: str, scale: float) -> float:
    # the comparison holds for integers too large for a float, and fails for nan
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not -1e300 < value < 1e300:
        raise RobotError(f"robot file: {where} must be a finite number, or a table as {{ design = 0.0 }}")
    if not abs(value * scale) <= LARGEST[unit]:
        raise RobotError(f"robot file: {where} is {value:g}, more than any robot has; is the unit right?")
    return float(value) * scale


def check_unknown(table: Mapping[str, Any], where: str, used: set[str]) -> None:
    for key in sorted(set(table) - used):
        raise RobotError(f"robot file: unknown key {where}.{shown(key)}")


def as_table(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise RobotError(f"robot file: {where} must be a table")
    return value


def _name(table: Mapping[str, Any], key: str, where: str) -> str:
    value = table[key]
    if not isinstance(value, str) or not NAME.fullmatch(value):
        raise RobotError(f"robot file: {where}: {key} must be a name of letters, digits, _ . - (at most {MAX_NAME})")
    return value


def shown(text: str) -> str:
    """A stranger's text as it may stand in a one-line message."""
    return text if text.isprintable() and len(text) <= MAX_NAME else repr(text[:MAX_NAME])
