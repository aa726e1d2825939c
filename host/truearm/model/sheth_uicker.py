"""Sheth–Uicker chains: six constants per link, two per joint (Goswami, Quaid, Peshkin 1993, (2) and (3)).

``T = T1L·T1J·T2L·…·TjJ·T(j+1)L`` with links ``Trans(x, y, z)·Rz(α)·Ry(β)·Rx(γ)`` (α is about z, γ about x) and joints
``Rz(offset + gain·q)``, or ``Trans along z`` for a prismatic one. The model has 8j + 6 parameters, of which
5 n_r + 3 n_p + 6 are independent (the paper's (1)).
"""

from __future__ import annotations

from collections.abc import Sequence

from truearm.model.chain_structure import Joint
from truearm.model.elementary_transforms import Slot, six_slots


def sheth_uicker_slots(joints: Sequence[Joint]) -> tuple[Slot, ...]:
    """Return link1.x … link1.gamma, joint1.offset, link2.x, …, in the paper's order."""
    out = [*six_slots("link1")]
    for i, joint in enumerate(joints):
        motion = "tz" if joint.kind == "prismatic" else "rz"
        out += [Slot(f"joint{i + 1}.offset", motion, i), *six_slots(f"link{i + 2}")]
    return tuple(out)
