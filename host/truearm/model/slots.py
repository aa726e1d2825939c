"""A convention is a row of slots: named elementary transforms in the order in which they are multiplied.

Sheth–Uicker, Denavit–Hartenberg, modified Denavit–Hartenberg and transforms listed by hand differ in nothing but this
row. ``chain_from_slots`` fills it with numbers and makes the one chain of it: a slot with a number becomes a parameter,
or a constant where it is named as fixed; a joint's slot is its offset, and the joint's gain follows it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from truearm.errors import RobotError
from truearm.model.chain import Chain, Element, Joint, Parameter

SIX = (("x", "tx"), ("y", "ty"), ("z", "tz"), ("alpha", "rz"), ("beta", "ry"), ("gamma", "rx"))


class Slot(NamedTuple):
    """One elementary transform of a convention; ``joint`` is the index of the joint that moves along or about it."""

    name: str  # "joint2.alpha"
    motion: str
    joint: int | None = None

    @property
    def unit(self) -> str:
        return "m" if self.motion[0] == "t" else "rad"


def six_slots(table: str) -> tuple[Slot, ...]:
    """Trans(x, y, z)·Rz(alpha)·Ry(beta)·Rx(gamma), a general transform; alpha is about z, gamma about x."""
    return tuple(Slot(f"{table}.{key}", motion) for key, motion in SIX)


def gain_name(slot: Slot) -> str:
    """The name of the gain beside a joint's offset."""
    return slot.name.rpartition(".")[0] + ".gain"


def chain_from_slots(
    name: str,
    joints: Sequence[Joint],
    slots: Sequence[Slot],
    amounts: Mapping[str, float],
    fixed: Collection[str] = (),
    base_frame: str = "base",
    end_frame: str = "end",
) -> Chain:
    """The chain of the slots.

    amounts : a number [m or rad] for every slot, by name, and for the gains that are parameters; a joint without has
        gain 1.
    fixed : names of slots that are constants and not parameters.

    Raises RobotError for numbers that are missing or not finite, and what ``Chain`` raises.
    """
    elements: list[Element] = []
    parameters: list[Parameter] = []

    def number(key: str) -> float:
        if key not in amounts:
            raise RobotError(f"robot {name}: {key} has no value")
        if not math.isfinite(amounts[key]):
            raise RobotError(f"robot {name}: parameter {key} is not finite")
        return float(amounts[key])

    def parameter(key: str, unit: str) -> int:
        parameters.append(Parameter(key, unit, number(key)))
        return len(parameters) - 1

    for slot in slots:
        at = None if slot.name in fixed else parameter(slot.name, slot.unit)
        value = number(slot.name) if at is None else 0.0
        has_gain = slot.joint is not None and gain_name(slot) in amounts
        gain = parameter(gain_name(slot), "1") if has_gain else None
        elements.append(Element(slot.motion, value, at, slot.joint, gain))
    return Chain(name, tuple(elements), tuple(parameters), tuple(joints), base_frame, end_frame)
