"""Sheth–Uicker chains: six constants a link, two a joint (Goswami, Quaid, Peshkin 1993, (2) and (3)).

``T = T1L·T1J·T2L·…·TjJ·T(j+1)L`` with links ``Trans(x, y, z)·Rz(α)·Ry(β)·Rx(γ)`` (α is about z, γ about x) and joints
``Rz(offset + gain·q)``, or ``Trans along z`` for a prismatic one. The model has 8j + 6 parameters; 5 n_r + 3 n_p + 6 of
them are independent (the paper's (1)).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.errors import RobotError
from truearm.model.chain import Chain, Element, Joint, Parameter
from truearm.types import Floats

LINK = (("x", "tx"), ("y", "ty"), ("z", "tz"), ("alpha", "rz"), ("beta", "ry"), ("gamma", "rx"))


def parameter_units(joints: Sequence[Joint]) -> tuple[tuple[str, str], ...]:
    """(name, unit) of every parameter in the paper's order: link1.x … link1.gamma, joint1.offset, joint1.gain, …"""
    out: list[tuple[str, str]] = []
    for i in range(len(joints) + 1):
        out += [(f"link{i + 1}.{key}", "m" if motion[0] == "t" else "rad") for key, motion in LINK]
        if i < len(joints):
            out += [(f"joint{i + 1}.offset", "m" if joints[i].kind == "prismatic" else "rad")]
            out += [(f"joint{i + 1}.gain", "1")]
    return tuple(out)


def chain_from_sheth_uicker(
    name: str, joints: Sequence[Joint], nominal: Floats, base_frame: str = "base", end_frame: str = "end"
) -> Chain:
    """The chain of the joints with ``nominal`` (8j + 6,) [m, rad, 1] in the order of ``parameter_units``.

    Raises RobotError if nominal has another length or is not finite.
    """
    named = parameter_units(joints)
    nominal = np.asarray(nominal, dtype=float)
    if nominal.shape != (len(named),):
        raise RobotError(f"robot {name}: {len(named)} parameters are needed, got {nominal.shape}")
    if not np.isfinite(nominal).all():
        raise RobotError(f"robot {name}: parameter {named[int(np.argmin(np.isfinite(nominal)))][0]} is not finite")
    elements: list[Element] = []
    for i in range(len(joints) + 1):
        at = 8 * i
        elements += [Element(motion, parameter=at + k) for k, (_, motion) in enumerate(LINK)]
        if i < len(joints):
            motion = "tz" if joints[i].kind == "prismatic" else "rz"
            elements.append(Element(motion, parameter=at + 6, joint=i, gain=at + 7))
    parameters = tuple(Parameter(n, u, float(v)) for (n, u), v in zip(named, nominal, strict=True))
    return Chain(name, tuple(elements), parameters, tuple(joints), base_frame, end_frame)
