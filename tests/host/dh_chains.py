"""Denavit–Hartenberg chains from rows of numbers, for tests that compare the conventions with products of matrices."""

import numpy as np

from truearm.model.robot_tables import SIX, chain_from_slots, dh_slots, law_name, modified_dh_slots

NO_MOUNTING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def chain_from_dh(name, joints, rows, **more):
    """Return the chain of distal ``rows`` (j, 4): θ, d, a, α [rad, m, m, rad] of each joint at zero reading; gains are
    1.

    twisted : indices of joints with a β, initially 0; the d of a revolute one becomes a constant.
    base, tool : (6,) x, y, z, alpha, beta, gamma [m, rad] of the mountings, None for a chain without.
    """
    return _from_rows(dh_slots, name, joints, rows, **more)


def chain_from_modified_dh(name, joints, rows, **more):
    """Return the chain of Craig's ``rows`` (j, 4): θ, d, a, α, the last two before the joint; see ``chain_from_dh``."""
    return _from_rows(modified_dh_slots, name, joints, rows, **more)


def _from_rows(
    layout, name, joints, rows, *, twisted=(), base=NO_MOUNTING, tool=NO_MOUNTING, base_frame="base", end_frame="end"
):
    absent = {"base": base is None, "tool": tool is None}
    absent |= {f"joint{i + 1}": i not in twisted for i in range(len(joints))}
    slots = [slot for slot in layout(joints) if not (slot.optional and absent[slot.name.partition(".")[0]])]
    amounts = {law_name(slot, "gain"): 1.0 for slot in slots if slot.joint is not None}
    for table, numbers in (("base", base), ("tool", tool)):
        if numbers is not None:
            amounts |= {f"{table}.{key}": float(value) for (key, _), value in zip(SIX, numbers, strict=True)}
    for i, (row, joint) in enumerate(zip(np.asarray(rows, dtype=float).tolist(), joints, strict=True)):
        keys = ("theta", "offset", "a", "alpha") if joint.kind == "prismatic" else ("offset", "d", "a", "alpha")
        amounts |= {f"joint{i + 1}.{key}": value for key, value in zip(keys, row, strict=True)}
        amounts[f"joint{i + 1}.beta"] = 0.0
    return chain_from_slots(name, joints, slots, amounts, {f"joint{i + 1}.d" for i in twisted}, base_frame, end_frame)
