"""Denavit–Hartenberg chains, four constants a joint: the distal form, and the proximal one of Craig ("modified").

Distal, with Hayati's β (Renders, Rossignol, Becquet, Hanus 1991, II-A and Fig. 1)::

    T_i = Rz(θ_i)·Tz(d_i)·Tx(a_i)·Rx(α_i)·[Ry(β_i)]

Modified (J. J. Craig, Introduction to Robotics, 1986, (3.6)), with the β of W. Khalil, E. Dombre, Modeling,
Identification and Control of Robots, 2002, ch. 11, about the y axis before the twist::

    T_i = [Ry(β_i)]·Rx(α_i)·Tx(a_i)·Rz(θ_i)·Tz(d_i)

Craig writes a_{i−1}, α_{i−1} where we, as makers' tables do, put them in row i. θ of a revolute joint and d of a
prismatic one are offset + gain·q; they are called ``joint<i>.offset``.

*Why β.* If the axes of joints i and i+1 are parallel, their common normal may lie anywhere, and axes that are nearly
parallel throw it far away: a small error of the robot is no small change of (θ, d, a, α). The Jacobian tells it at once:
d_i and d_{i+1} shift along one direction, so a parameter is lost, and the tilt about y has none. β_i supplies that tilt
and d_i, which then means nothing, becomes a constant. (In the modified form the pair is joints i−1 and i.)

*How many.* A line in space has 4 parameters, so n axes, a base frame and an end frame have 4n + 6, and n gains make
5n + 6 (Goswami's (1)). Rows alone reach 5n: frame 0 must have its z on the first axis, and the last row cannot place a
general end frame. The six constants of ``base`` and of ``tool`` close that gap. They bring 12 for 6, so six parameters
must be held: with the base free, θ_1 and d_1 (modified: α_1, a_1, θ_1, d_1), with the tool free, one for each constant
of the last row (modified: θ_n and d_n). Renders freezes θ_1, d_1, α_6 by the same argument, d_2 because of β_2.
A prismatic joint has a direction but no place: a_i and the like of its neighbours stand for each other, 3 instead of 5.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from truearm.model.chain import Joint
from truearm.model.slots import Slot, six_slots

Layout = Callable[[Sequence[Joint], Collection[int], bool, bool], tuple[Slot, ...]]


def dh_slots(
    joints: Sequence[Joint], twisted: Collection[int] = (), base: bool = True, tool: bool = True
) -> tuple[Slot, ...]:
    """Distal rows, between base and tool if wanted; ``twisted`` are the indices of joints with a β."""
    rows = []
    for i, joint in enumerate(joints):
        t = f"joint{i + 1}"
        row = [*_screw(t, i, joint), Slot(f"{t}.a", "tx"), Slot(f"{t}.alpha", "rx")]
        rows += [*row, Slot(f"{t}.beta", "ry")] if i in twisted else row
    return _mounted(rows, base, tool)


def modified_dh_slots(
    joints: Sequence[Joint], twisted: Collection[int] = (), base: bool = True, tool: bool = True
) -> tuple[Slot, ...]:
    """Craig's rows, between base and tool if wanted; ``twisted`` are the indices of joints with a β."""
    rows = []
    for i, joint in enumerate(joints):
        t = f"joint{i + 1}"
        row = [Slot(f"{t}.alpha", "rx"), Slot(f"{t}.a", "tx"), *_screw(t, i, joint)]
        rows += [Slot(f"{t}.beta", "ry"), *row] if i in twisted else row
    return _mounted(rows, base, tool)


def _screw(table: str, index: int, joint: Joint) -> tuple[Slot, Slot]:
    """Rz(θ)·Tz(d), the one or the other moved by the joint."""
    if joint.kind == "prismatic":
        return Slot(f"{table}.theta", "rz"), Slot(f"{table}.offset", "tz", index)
    return Slot(f"{table}.offset", "rz", index), Slot(f"{table}.d", "tz")


def _mounted(rows: list[Slot], base: bool, tool: bool) -> tuple[Slot, ...]:
    return (*(six_slots("base") if base else ()), *rows, *(six_slots("tool") if tool else ()))
