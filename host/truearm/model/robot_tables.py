"""The tables of a robot file: conventions, joints, slots and numbers in SI.

A convention is a sequence of slots: named elementary transforms in the order in which they are multiplied.
Sheth–Uicker, Denavit–Hartenberg, modified Denavit–Hartenberg and transforms listed by hand differ only in this
sequence. ``chain_from_slots`` fills it with numbers and builds the chain.

A parameter is written as a table of named values, ``{ design = 0.35, held = true }``, and a constant that is never
identified as a plain number. Units are part of the keys: ``_m _cm _mm`` for lengths, ``_rad _deg`` for angles, none for
a gain. The keys of a table depend on the convention's slots and the terms of the joint law.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from truearm.model import joint_law
from truearm.model.chain import Chain
from truearm.model.chain_structure import Joint, Parameter
from truearm.model.joint_terms.term import Offset, Term
from truearm.model.transforms import MOTIONS, Element
from truearm.schema import Choice, Key, List, Number, SchemaError, Table, Text, Value, as_table, at, quoted
from truearm.units import suffixes

SIX = (("x", "tx"), ("y", "ty"), ("z", "tz"), ("alpha", "rz"), ("beta", "ry"), ("gamma", "rx"))


class Slot(NamedTuple):
    """One elementary transform of a convention; ``joint`` is the index of the joint that moves along or about it.

    ``optional``: a robot file need not have it.
    """

    name: str  # "joint2.alpha"
    motion: str
    joint: int | None = None
    optional: bool = False

    @property
    def unit(self) -> str:
        return "m" if self.motion[0] == "t" else "rad"


def six_slots(table: str, optional: bool = False) -> list[Slot]:
    """Return Trans(x, y, z)·Rz(alpha)·Ry(beta)·Rx(gamma), a general transform; alpha is about z, gamma about x."""
    return [Slot(f"{table}.{key}", motion, optional=optional) for key, motion in SIX]


def law_name(slot: Slot, term: str) -> str:
    """Return the name of a joint's parameter for a term of its law other than the offset."""
    return f"{slot.name.rpartition('.')[0]}.{term}"


def chain_from_slots(
    name: str,
    joints: Sequence[Joint],
    slots: Sequence[Slot],
    amounts: Mapping[str, float],
    fixed: Collection[str] = (),
    base_frame: str = "base",
    end_frame: str = "end",
) -> Chain:
    """Return the chain of the slots.

    A slot with a number becomes a parameter, or a constant if it is listed as fixed. A joint's slot is its offset,
    followed by the other terms of its law that have numbers.

    amounts : a finite number [SI] for every slot, by name, and for each further parameter of the joints' laws; a joint
        without any has gain 1 and no further term.
    fixed : names of slots that are constants rather than parameters.

    Raises RobotError for two parameters of one name.
    """
    elements: list[Element] = []
    parameters: list[Parameter] = []
    for slot in slots:
        value = float(amounts[slot.name])
        if slot.joint is not None:
            for term in joint_law.terms():
                key = law_name(slot, term.name)
                if key in amounts and key not in fixed:
                    unit = term.unit_of(joints[slot.joint].kind)
                    parameters.append(Parameter(key, unit, float(amounts[key]), term.name, slot.joint))
            elements.append(Element(slot.motion, value, joint=slot.joint))
        elif slot.name in fixed:
            elements.append(Element(slot.motion, value))
        else:
            elements.append(Element(slot.motion, parameter=len(parameters)))
            parameters.append(Parameter(slot.name, slot.unit, value))
    return Chain(name, tuple(elements), tuple(parameters), tuple(joints), base_frame, end_frame)


# ---------------------------------------------------------------------------------------------------------- conventions
#
# Distal, with Hayati's β (Renders, Rossignol, Becquet, Hanus 1991, II-A and Fig. 1):
#
#     T_i = Rz(θ_i)·Tz(d_i)·Tx(a_i)·Rx(α_i)·[Ry(β_i)]
#
# Modified (J. J. Craig, Introduction to Robotics, 1986, (3.6)), with the β of W. Khalil, E. Dombre, Modeling,
# Identification and Control of Robots, 2002, ch. 11:
#
#     T_i = [Ry(β_i)]·Rx(α_i)·Tx(a_i)·Rz(θ_i)·Tz(d_i)
#
# Craig's a_{i−1}, α_{i−1} stand in row i. θ of a revolute joint and d of a prismatic one are offset + gain·q,
# joint<i>.offset.
#
# Parallel axes have no definite common normal: d_i and d_{i+1} have one effect, and nothing describes the tilt about y.
# Here β_i does, and d_i becomes a constant. docs/reference/robot-format.md says which parameters to fix.
#
# Sheth–Uicker chains have six constants per link and two per joint (Goswami, Quaid, Peshkin 1993, (2) and (3)):
# T = T1L·T1J·T2L·…·TjJ·T(j+1)L with links Trans(x, y, z)·Rz(α)·Ry(β)·Rx(γ) (α is about z, γ about x) and joints
# Rz(offset + gain·q), or Trans along z. Of 8j + 6 parameters, 5 n_r + 3 n_p + 6 are independent (the paper's (1)).

CONSTANTS = {"a": "tx", "alpha": "rx", "beta": "ry"}  # of a row beside the screw of its joint


def dh_slots(joints: Sequence[Joint]) -> list[Slot]:
    """Return distal rows between base and tool; base, tool and each row's β are optional."""
    return _rows(joints, "screw", "a", "alpha", "beta")


def modified_dh_slots(joints: Sequence[Joint]) -> list[Slot]:
    """Return Craig's rows between base and tool; base, tool and each row's β are optional."""
    return _rows(joints, "beta", "alpha", "a", "screw")


def _rows(joints: Sequence[Joint], *keys: str) -> list[Slot]:
    slots = six_slots("base", optional=True)
    for index, joint in enumerate(joints):
        table = f"joint{index + 1}"
        screw = [Slot(f"{table}.offset", "rz", index), Slot(f"{table}.d", "tz")]
        if joint.kind == "prismatic":
            screw = [Slot(f"{table}.theta", "rz"), Slot(f"{table}.offset", "tz", index)]
        for key in keys:
            constant = [] if key == "screw" else [Slot(f"{table}.{key}", CONSTANTS[key], optional=key == "beta")]
            slots += constant or screw
    return slots + six_slots("tool", optional=True)


def sheth_uicker_slots(joints: Sequence[Joint]) -> list[Slot]:
    """Return link1.x … link1.gamma, joint1.offset, link2.x, …, in the paper's order."""
    slots = six_slots("link1")
    for i, joint in enumerate(joints):
        motion = "tz" if joint.kind == "prismatic" else "rz"
        slots += [Slot(f"joint{i + 1}.offset", motion, i), *six_slots(f"link{i + 2}")]
    return slots


# --------------------------------------------------------------------------------------------------------------- tables

MAX_JOINTS = 64
MAX_TRANSFORMS = 1000
MAX_NAME = 100  # characters
LARGEST = {"rad": 1e4, "1": 1e6}  # larger than for any arm; for other units, see UNITS
LARGEST_D = 1e9  # m, of a row between nearly parallel axes, where d of the rows cancel (export.toml_tables)
KIND = Choice(("revolute", "prismatic"))
MOTION = Choice(tuple(MOTIONS))
NAME = Text(
    pattern=re.compile(rf"[A-Za-z0-9_.-]{{1,{MAX_NAME}}}"), wanted=f"a name of up to {MAX_NAME} letters, digits, _ . -"
)


class Amount(NamedTuple):
    """One number of a file [SI]: a constant, or the values of a parameter in each named set."""

    constant: float | None
    values: Mapping[str, float] = {}
    held: bool = False


class Description(NamedTuple):
    """A robot file without its head: slots in order, and the amount of every slot and joint law by name."""

    joints: tuple[Joint, ...]
    slots: tuple[Slot, ...]
    amounts: Mapping[str, Amount]


@dataclass(frozen=True)
class AmountValue(Value):
    """An Amount; for a ``term`` of the joint law it is always a parameter, never a constant."""

    number: Number
    term: type[Term] | None = None

    @property
    def suffixes(self) -> Sequence[str]:
        return self.number.suffixes

    def parse(self, raw: Any, suffix: str = "") -> Amount:
        """Return the amount of a number, or of a table of the values in named sets, in the unit of a key's suffix."""
        if isinstance(raw, dict):
            amount = Amount(None, *self._sets(raw, suffix))
        elif isinstance(raw, int | float):
            amount = Amount(self.number.parse(raw, suffix))
        else:
            raise SchemaError(f"{quoted(raw)} is neither a number nor a table such as {{ design = 0.0 }}")
        if self.term and (amount.constant is not None or (self.term.nonzero and 0.0 in amount.values.values())):
            rule = ", none of them 0" * self.term.nonzero
            raise SchemaError(f"must be a table of values{rule}; left out it is {self.term.neutral:g}")
        return amount

    def _sets(self, raw: Mapping[str, Any], suffix: str) -> tuple[dict[str, float], bool]:
        with at("held"):
            held = Choice((True, False)).parse(raw.get("held", False))
        values: dict[str, Any] = {}
        for name in raw.keys() - {"held"}:
            with at(name if NAME.matches(name) else quoted(name)):
                values[name] = self.number.parse(raw[name], suffix)
        return values, held


def robot_number(unit: str, most: float | None = None) -> Number:
    """Return the schema of a number of a robot file, in an SI unit; ``most`` replaces the unit's usual limit."""
    return Number(unit, most=most or LARGEST.get(unit), spelled=tuple(suffixes(unit, ("m", "cm", "mm", "rad", "deg"))))


def _amount(name: str, unit: str, *, optional: bool = False) -> Key:
    return Key(name, AmountValue(robot_number(unit, LARGEST_D if name == "d" else None)), optional)


def _moving_keys(kind: str) -> tuple[Key, ...]:
    """Return the keys of a joint's table other than its slots: its limits, and the given terms of its law."""
    limit = robot_number(_unit(kind))
    terms = (term for term in joint_law.terms() if term is not Offset and not term.learned)
    return (
        *(Key(name, limit, optional=kind != "prismatic") for name in ("lower", "upper")),
        *(Key(term.name, AmountValue(robot_number(term.unit_of(kind)), term), optional=True) for term in terms),
    )


def _unit(kind: str) -> str:
    return "m" if kind == "prismatic" else "rad"


def _joint(name: str, kind: str, values: Mapping[str, Any]) -> Joint:
    """Return a joint; one whose table has no limits has none."""
    lower, upper = values.get("lower", -math.inf), values.get("upper", math.inf)
    if math.isfinite(lower) != math.isfinite(upper):
        raise SchemaError(f"{name}: has only one limit; give lower and upper, or neither")
    if lower >= upper:
        raise SchemaError(f"{name}: its lower limit is not below its upper limit; correct them")
    return Joint(name, kind, lower, upper)


def read_tables(doc: Mapping[str, Any], head: Sequence[Key]) -> tuple[Mapping[str, Any], Description]:
    """Return the values of the ``head`` keys of a parsed robot file, and the content of its convention's tables.

    Raises SchemaError.
    """
    if "convention" not in doc:
        raise SchemaError(f"needs convention, one of {', '.join(CONVENTIONS)}; is this the file of a robot?")
    with at("convention"):
        convention = Choice(tuple(CONVENTIONS)).parse(doc.get("convention"))
    return CONVENTIONS[convention](doc, head)


def _read_slots(
    layout: Callable[[Sequence[Joint]], list[Slot]], doc: Mapping[str, Any], head: Sequence[Key]
) -> tuple[Mapping[str, Any], Description]:
    """Read a table for each joint, and for each other item named by the convention's slots."""
    count = sum(key.startswith("joint") for key in doc)
    _check_count(count)
    kinds = {f"joint{i + 1}": _kind(doc, f"joint{i + 1}") for i in range(count)}
    slots = layout([Joint(name, kind, 0.0, 0.0) for name, kind in kinds.items()])
    slots = [slot for slot in slots if not slot.optional or _has(doc, *slot.name.split("."))]
    keys: dict[str, list[Key]] = {name: [Key("kind", KIND), *_moving_keys(kind)] for name, kind in kinds.items()}
    for slot in slots:
        table, name = slot.name.split(".")
        keys.setdefault(table, []).append(_amount(name, slot.unit))
    tables = (Key(name, Table(tuple(table_keys), dict)) for name, table_keys in keys.items())
    values: dict[str, Any] = Table((*head, *tables), dict).parse(doc)
    amounts: dict[str, Amount] = {}
    for slot in slots:
        table, name = slot.name.split(".")
        amounts[slot.name] = values[table][name]
        if slot.joint is not None:
            amounts |= _law(slot, values[table])
    joints = tuple(_joint(name, kind, values[name]) for name, kind in kinds.items())
    return values, Description(joints, tuple(slots), amounts)


def _has(doc: Mapping[str, Any], table: str, key: str) -> bool:
    """Return whether a file has a table or, if it is that of a joint, the number ``key`` in it, in any unit."""
    content = doc.get(table, {})
    is_joint = table.startswith("joint") and isinstance(content, dict)
    return any(name.startswith(f"{key}_") for name in content) if is_joint else table in doc


def _check_count(joints: int) -> None:
    if not 1 <= joints <= MAX_JOINTS:
        raise SchemaError(f"has {joints} joints; 1 to {MAX_JOINTS} are possible")


def _kind(doc: Mapping[str, Any], name: str) -> str:
    """Return the kind of a joint, which determines the units in its table; a missing table is reported later."""
    table = doc.get(name)
    if not isinstance(table, dict):
        return str(KIND.options[0])
    with at(f"{name}: kind"):
        return str(KIND.parse(table.get("kind")))


def _law(slot: Slot, values: Mapping[str, Any]) -> dict[str, Amount]:
    """Return the terms of a joint's law other than the offset; a missing term is not returned."""
    return {law_name(slot, t.name): values[t.name] for t in joint_law.terms() if t is not Offset and t.name in values}


class _Transform(NamedTuple):
    """A ``[[transform]]``: of a joint (with its limits), a parameter (with a name), or a constant (without one)."""

    motion: str
    amount: Amount
    name: str = ""
    joint: Joint | None = None
    law: Mapping[str, Any] = {}


class _TransformValue(Value):
    """A transform, with keys that depend on its motion and on whether a joint moves it."""

    def parse(self, raw: Any, suffix: str = "") -> _Transform:
        table = as_table(raw)
        with at("motion"):
            motion = MOTION.parse(table.get("motion"))
        kind = "prismatic" if motion[0] == "t" else "revolute"
        if "joint" in table:
            offset = _amount("offset", _unit(kind), optional=True)
            keys = (Key("motion", MOTION), Key("joint", NAME), offset, *_moving_keys(kind))
            values: dict[str, Any] = Table(keys, dict).parse(table)
            joint = _joint(values["joint"], kind, values)
            return _Transform(motion, values.get("offset", Amount(0.0)), joint=joint, law=values)
        keys = (Key("motion", MOTION), Key("name", NAME, optional=True), _amount("amount", _unit(kind)))
        transform = Table(keys, _Transform).parse(table)
        if (transform.amount.constant is None) != bool(transform.name):
            raise SchemaError(
                "a constant has an amount and no name; a parameter needs both a name and an amount that is a table of values"
            )
        return transform


def _read_elementary(doc: Mapping[str, Any], head: Sequence[Key]) -> tuple[Mapping[str, Any], Description]:
    """Read each ``[[transform]]`` in turn."""
    key = Key("transform", List(_TransformValue(), most=MAX_TRANSFORMS))
    values: dict[str, Any] = Table((*head, key), dict).parse(doc)
    joints: list[Joint] = []
    slots: list[Slot] = []
    amounts: dict[str, Amount] = {}
    for i, transform in enumerate(values["transform"], start=1):
        if transform.joint is None:
            slot, law = Slot(transform.name or f"transform {i}", transform.motion), {}
        else:
            slot = Slot(f"{transform.joint.name}.offset", transform.motion, len(joints))
            law = _law(slot, transform.law)
            joints.append(transform.joint)
        law[slot.name] = transform.amount
        twice = sorted(set(law) & set(amounts))
        if twice:
            raise SchemaError(f"transform: item {i}: {twice[0]} is the name of an earlier one")
        slots.append(slot)
        amounts |= law
    _check_count(len(joints))
    return values, Description(tuple(joints), tuple(slots), amounts)


CONVENTIONS: Mapping[str, Callable[[Mapping[str, Any], Sequence[Key]], tuple[Mapping[str, Any], Description]]] = {
    "sheth_uicker": partial(_read_slots, sheth_uicker_slots),
    "dh": partial(_read_slots, dh_slots),
    "modified_dh": partial(_read_slots, modified_dh_slots),
    "elementary": _read_elementary,
}
