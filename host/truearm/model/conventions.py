"""The conventions of chains: Denavit–Hartenberg's distal rows, Craig's proximal ("modified") ones, and Sheth–Uicker links.

Distal, with Hayati's β (Renders, Rossignol, Becquet, Hanus 1991, II-A and Fig. 1)::

    T_i = Rz(θ_i)·Tz(d_i)·Tx(a_i)·Rx(α_i)·[Ry(β_i)]

Modified (J. J. Craig, Introduction to Robotics, 1986, (3.6)), with the β of W. Khalil, E. Dombre, Modeling,
Identification and Control of Robots, 2002, ch. 11::

    T_i = [Ry(β_i)]·Rx(α_i)·Tx(a_i)·Rz(θ_i)·Tz(d_i)

Craig's a_{i−1}, α_{i−1} stand in row i. θ of a revolute joint and d of a prismatic one are offset + gain·q,
``joint<i>.offset``.

Parallel axes have no definite common normal: d_i and d_{i+1} have one effect, and nothing describes the tilt about y.
Here β_i does, and d_i becomes a constant. docs/reference/robot-format.md says which parameters to fix.

Sheth–Uicker chains have six constants per link and two per joint (Goswami, Quaid, Peshkin 1993, (2) and (3)):
``T = T1L·T1J·T2L·…·TjJ·T(j+1)L`` with links ``Trans(x, y, z)·Rz(α)·Ry(β)·Rx(γ)`` (α is about z, γ about x) and joints
``Rz(offset + gain·q)``, or ``Trans along z``. Of 8j + 6 parameters, 5 n_r + 3 n_p + 6 are independent (the paper's (1)).
"""

from __future__ import annotations

from collections.abc import Sequence

from truearm.model.chain_structure import Joint
from truearm.model.elementary_transforms import Slot, six_slots

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
