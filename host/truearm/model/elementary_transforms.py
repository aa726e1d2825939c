"""Slots: a convention is a sequence of named elementary transforms in the order in which they are multiplied.

Sheth–Uicker, Denavit–Hartenberg, modified Denavit–Hartenberg and transforms listed by hand differ only in this
sequence. ``chain_from_slots`` fills it with numbers and builds the chain. A slot with a number becomes a parameter, or
a constant if it is listed as fixed. A joint's slot is its offset, followed by the other terms of its law that have
numbers.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from truearm.model import joint_law
from truearm.model.chain import Chain
from truearm.model.chain_structure import Joint, Parameter
from truearm.model.transforms import Element

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

    amounts : a finite number [SI] for every slot, by name, and for each further parameter of the joints' laws; a joint without
        any has gain 1 and no further term.
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
