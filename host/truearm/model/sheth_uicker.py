"""Sheth–Uicker chains: six constants a link, two a joint (Goswami, Quaid, Peshkin 1993, (2) and (3)).

``T = T1L·T1J·T2L·…·TjJ·T(j+1)L`` with links ``Trans(x, y, z)·Rz(α)·Ry(β)·Rx(γ)`` (α is about z, γ about x) and joints
``Rz(offset + gain·q)``, or ``Trans along z`` for a prismatic one. The model has 8j + 6 parameters; 5 n_r + 3 n_p + 6 of
them are independent (the paper's (1)).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.errors import RobotError
from truearm.model.chain import Chain, Joint
from truearm.model.slots import Slot, chain_from_slots, law_name, six_slots
from truearm.types import Floats


def sheth_uicker_slots(joints: Sequence[Joint]) -> tuple[Slot, ...]:
    """link1.x … link1.gamma, joint1.offset, link2.x, …: the paper's order."""
    out = [*six_slots("link1")]
    for i, joint in enumerate(joints):
        motion = "tz" if joint.kind == "prismatic" else "rz"
        out += [Slot(f"joint{i + 1}.offset", motion, i), *six_slots(f"link{i + 2}")]
    return tuple(out)


def chain_from_sheth_uicker(
    name: str, joints: Sequence[Joint], nominal: Floats, base_frame: str = "base", end_frame: str = "end"
) -> Chain:
    """The chain of the joints with ``nominal`` (8j + 6,) [m, rad, 1] in the paper's order, a gain after each offset.

    Raises RobotError if nominal has another length or is not finite.
    """
    slots = sheth_uicker_slots(joints)
    names = [n for s in slots for n in ((s.name,) if s.joint is None else (s.name, law_name(s, "gain")))]
    nominal = np.asarray(nominal, dtype=float)
    if nominal.shape != (len(names),):
        raise RobotError(f"robot {name}: {len(names)} parameters are needed, got {nominal.shape}")
    amounts = dict(zip(names, nominal.tolist(), strict=True))
    return chain_from_slots(name, joints, slots, amounts, (), base_frame, end_frame)
