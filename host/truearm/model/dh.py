"""Denavit–Hartenberg chains with four constants per joint: the distal form, and Craig's proximal ("modified") form.

Distal, with Hayati's β (Renders, Rossignol, Becquet, Hanus 1991, II-A and Fig. 1)::

    T_i = Rz(θ_i)·Tz(d_i)·Tx(a_i)·Rx(α_i)·[Ry(β_i)]

Modified (J. J. Craig, Introduction to Robotics, 1986, (3.6)), with the β of W. Khalil, E. Dombre, Modeling,
Identification and Control of Robots, 2002, ch. 11, about the y axis before the twist::

    T_i = [Ry(β_i)]·Rx(α_i)·Tx(a_i)·Rz(θ_i)·Tz(d_i)

Craig writes a_{i−1}, α_{i−1} where truearm, like manufacturers' tables, puts them in row i. θ of a revolute joint and d
of a prismatic one are offset + gain·q; they are called ``joint<i>.offset``.

*Why β.* If the axes of joints i and i+1 are parallel, the position of their common normal is arbitrary, and if they are
nearly parallel it may be far away: a small error of the robot is not a small change of (θ, d, a, α). The Jacobian shows
this directly: d_i and d_{i+1} shift along one direction, so one parameter is lost, and no parameter describes the tilt
about y. β_i describes that tilt, and d_i, which then has no meaning, becomes a constant. (In the modified form the pair
is joints i−1 and i.)

*How many.* A line in space has 4 parameters, so n axes, a base frame and an end frame have 4n + 6, and n gains make 5n
+ 6 (Goswami's (1)). Rows alone give 5n: frame 0 must have its z on the first axis, and the last row cannot place a
general end frame. The six constants of ``base`` and of ``tool`` close that gap. They add 12 for 6, so six parameters
must be fixed: with the base free, θ_1 and d_1 (modified: α_1, a_1, θ_1, d_1), with the tool free, one for each constant
of the last row (modified: θ_n and d_n). Renders fixes θ_1, d_1, α_6 by the same argument, and d_2 because of β_2. A
prismatic joint has a direction but no position: a_i and similar constants of its neighbours are equivalent, so it has 3
parameters instead of 5.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from truearm.model.chain import Joint
from truearm.model.elementary_transforms import Slot, six_slots

Layout = Callable[[Sequence[Joint], Collection[int], bool, bool], tuple[Slot, ...]]


def dh_slots(
    joints: Sequence[Joint], twisted: Collection[int] = (), base: bool = True, tool: bool = True
) -> tuple[Slot, ...]:
    """Return distal rows, optionally between base and tool; ``twisted`` are the indices of joints with a β."""
    rows = []
    for i, joint in enumerate(joints):
        t = f"joint{i + 1}"
        row = [*_screw(t, i, joint), Slot(f"{t}.a", "tx"), Slot(f"{t}.alpha", "rx")]
        rows += [*row, Slot(f"{t}.beta", "ry")] if i in twisted else row
    return _mounted(rows, base, tool)


def modified_dh_slots(
    joints: Sequence[Joint], twisted: Collection[int] = (), base: bool = True, tool: bool = True
) -> tuple[Slot, ...]:
    """Return Craig's rows, optionally between base and tool; ``twisted`` are the indices of joints with a β."""
    rows = []
    for i, joint in enumerate(joints):
        t = f"joint{i + 1}"
        row = [Slot(f"{t}.alpha", "rx"), Slot(f"{t}.a", "tx"), *_screw(t, i, joint)]
        rows += [Slot(f"{t}.beta", "ry"), *row] if i in twisted else row
    return _mounted(rows, base, tool)


def _screw(table: str, index: int, joint: Joint) -> tuple[Slot, Slot]:
    """Return Rz(θ)·Tz(d), one of which is moved by the joint."""
    if joint.kind == "prismatic":
        return Slot(f"{table}.theta", "rz"), Slot(f"{table}.offset", "tz", index)
    return Slot(f"{table}.offset", "rz", index), Slot(f"{table}.d", "tz")


def _mounted(rows: list[Slot], base: bool, tool: bool) -> tuple[Slot, ...]:
    return (*(six_slots("base") if base else ()), *rows, *(six_slots("tool") if tool else ()))
