"""Interpretations of table and rig other than the given one: the usual mistakes in a lab.

Each is an ``Alternative``: the table or rig transformed, and the finding to report if it explains the observations
(``inputs``). A new one is a function that yields it, in ``other_interpretations``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain as chained
from itertools import combinations, islice, permutations, product
from typing import Any

import numpy as np

from truearm.checks.labels import renamed, row_name
from truearm.checks.trial import Alternative
from truearm.estimate.problem import build_problem
from truearm.kinds.columns import LARGEST_NOISE, POINT, TURN, Quantity, identifiers
from truearm.kinds.registry import kinds, points
from truearm.model.chain import Chain
from truearm.model.transforms import pose_of, rotation, rotation_vector, six_of
from truearm.results import Effect
from truearm.types import Floats, Indices, Mask, Rig, rigs_by_name
from truearm.units import DEG, MM, UNITS

INCH = 0.0254  # m
MOST_PERMUTED = 4  # names: all permutations; of more, the exchanges of two and the cycles
MOST_RENAMINGS = 60  # of columns together
LEAST_ROWS = 5  # in which a joint is stuck
ANOTHER = -math.log(0.03)  # nats that each reversed joint beside the first costs, as a kind of fault does
RATIOS = {  # of numbers in another unit: factor, "are in the first, not in the second"
    "m": ((MM.scale, "millimetres", "metres"), (1.0 / MM.scale, "metres", "millimetres")),
    "rad": ((DEG.scale, "degrees", "radians"), (1.0 / DEG.scale, "radians", "degrees")),
}
INCHES = (INCH / MM.scale, "inches", "millimetres")

Robots = Mapping[str, tuple[Chain, Mask]]  # with their free parameters (p,), by name


def other_interpretations(inputs: Alternative, robots: Robots, allowed: Collection[str] = ()) -> list[Alternative]:
    """Return all interpretations that differ by one mistake, the most common first.

    An item that is ``allowed`` to be off is no mistake: the fit has estimated it.
    """
    return [
        *stuck(inputs),
        *units(inputs),
        *rotations(inputs),
        *shifted(inputs),
        *other_robots(inputs, robots),
        *joints(inputs),
        *mirrored(inputs),
        *names_exchanged(inputs),
        *constants(inputs, allowed),
    ]


def units(inputs: Alternative) -> Iterator[Alternative]:
    """Return joint readings, measured quantities and points of the rig in another unit."""
    table, joint_units = inputs.table, np.array(inputs.chain.joint_units)
    row_kinds = [kinds()[str(kind)] for kind in np.unique(table.kind)]
    # If nothing is measured except that the end returns, less motion gives smaller residuals, whatever the unit.
    returns = not all(any(isinstance(column, Quantity) for column in kind.needs) for kind in row_kinds)
    numbers = np.arange(joint_units.size)
    groups = [(f"the readings of {joint.name}", numbers == j) for j, joint in enumerate(inputs.chain.joints)]
    groups += [("the joint readings", joint_units == unit) for unit in RATIOS if (joint_units == unit).any()]
    for noun, columns in groups:
        for factor, are, called in RATIOS[joint_units[columns][0]]:
            if factor > 1.0 or not returns or columns.sum() == 1:
                values = {"what": noun, "are": are, "called": called}
                yield with_joints(inputs, np.where(columns, factor, 1.0), numbers, "wrong-unit", values)
    for quantity in dict.fromkeys(quantity for kind in row_kinds for quantity in kind.quantities):
        if quantity.most > LARGEST_NOISE and quantity.unit in RATIOS:
            for factor, are, called in (*RATIOS[quantity.unit], *[INCHES] * (quantity.unit == "m")):
                values = {"what": f"the readings of {quantity.words}", "are": are, "called": called}
                changed = table.replace(**{quantity.field: factor * table[quantity.field]})
                rescaled = {quantity.field: factor}
                yield replace(inputs, code="wrong-unit", values=values, table=changed, rescaled=rescaled)
    for column, entry in points().items():
        for factor, are, called in RATIOS["m"]:
            values = {"what": f"the rig's coordinates of each {column}", "are": are, "called": called}
            yield from with_points(inputs, entry, "", np.full(3, factor), "wrong-unit", values)


def joints(inputs: Alternative) -> Iterator[Alternative]:
    """Return joints in other orders and with other signs: exchanges of two, cycles, the reverse; all signs."""
    names, joint_units = [joint.name for joint in inputs.chain.joints], list(inputs.chain.joint_units)
    identity = tuple(range(len(names)))
    for order in list(dict.fromkeys([identity, *exchanges_and_cycles(identity), identity[::-1]]))[1:]:
        if [joint_units[i] for i in order] == joint_units:
            values = {"order": [names[order.index(k)] for k in identity]}
            yield with_joints(inputs, np.ones(len(names)), order, "joints-ordered", values)
    for signs in product((1.0, -1.0), repeat=len(names)):
        if min(signs) < 0.0:
            reversed_joints = [name for name, sign in zip(names, signs, strict=True) if sign < 0.0]
            values = {"joints": reversed_joints}
            alternative = with_joints(inputs, np.array(signs), identity, "joint-signs", values)
            yield replace(alternative, price=(len(reversed_joints) - 1) * ANOTHER)


def with_joints(
    inputs: Alternative, factors: Floats, order: Sequence[int] | Indices, code: str, values: Mapping[str, Any]
) -> Alternative:
    """Return the table with its joints in an ``order``, multiplied by ``factors``."""
    table = inputs.table
    changed = table.replace(q=table.q[:, order] * factors, q_rate=table.q_rate[:, order] * factors)
    return replace(inputs, code=code, values=values, table=changed)


def rotations(inputs: Alternative) -> Iterator[Alternative]:
    """Return measured rotations in other conventions."""
    turn = inputs.table.rotation
    rows = np.isfinite(turn).all(axis=1)
    if not _is_measured(inputs, TURN) or not rows.any():
        return
    v = turn[rows]
    x, y, z = (rotation(v[:, [k]] * np.eye(3)[k]) for k in range(3))
    roll_pitch_yaw = np.array([six_of(pose)[:2:-1] for pose in pose_of(np.zeros_like(v), v)])
    for are, called, changed in (
        ("roll, pitch and yaw (about fixed axes x, y, z)", "rotation vectors", rotation_vector(z @ y @ x)),
        ("angles about the moving axes x, y, z", "rotation vectors", rotation_vector(x @ y @ z)),
        ("rotation vectors taken for roll, pitch and yaw", "as measured", roll_pitch_yaw),
        ("of the device in the tool's axes", "of the tool in the device's", -v),
    ):
        turns = turn.copy()
        turns[rows] = changed
        values = {"are": are, "called": called}
        yield replace(inputs, code="other-rotations", values=values, table=inputs.table.replace(rotation=turns))


def mirrored(inputs: Alternative) -> Iterator[Alternative]:
    """Return readings of a device, and points of the rig, with the sign of one coordinate reversed."""
    table, turned = inputs.table, _is_measured(inputs, TURN)
    flips = [np.where(np.arange(3) == k, -1.0, 1.0) for k in range(3)]
    for flip in flips if _is_measured(inputs, POINT) else ():
        changed = table.replace(xyz=table.xyz * flip)
        yield replace(inputs, code="left-handed-readings", table=changed)
        if turned:
            both = changed.replace(rotation=table.rotation * -flip)
            yield replace(inputs, code="left-handed-readings", values={"rotations": True}, table=both)
    for column, entry in points().items():
        names = inputs.rig.named(entry) if isinstance(inputs.rig, Rig) else ()
        for axis, flip in zip("xyz", flips, strict=True):
            for name in ("", *names):
                noun = f"{column} {name}" if name else f"each {column}"
                yield from with_points(inputs, entry, name, flip, "left-handed-rig", {"axis": axis, "what": noun})


def with_points(
    inputs: Alternative, entry: str, name: str, factors: Floats, code: str, values: Mapping[str, Any]
) -> Iterator[Alternative]:
    """Return the rigs with coordinates of one point, or of all of a type, multiplied; nothing if that changes none."""
    rigs, changed = rigs_by_name(inputs.rig), {}
    for key, rig in rigs.items():
        points = {label: point for label, point in rig.named(entry).items() if name in ("", label)}
        xyz = {label: tuple(np.multiply(point.xyz, factors).tolist()) for label, point in points.items()}
        differs = any(xyz[label] != tuple(point.xyz) for label, point in points.items())
        if differs and np.abs(list(xyz.values())).max() <= UNITS["m"].largest:
            moved = {label: replace(point, xyz=xyz[label]) for label, point in points.items()}
            changed[key] = rig.with_named(entry, {**rig.named(entry), **moved})
    if changed:
        yield replace(inputs, code=code, values=values, rig={**rigs, **changed})


def _is_measured(inputs: Alternative, quantity: Quantity) -> bool:
    row_kinds = (kinds()[str(kind)] for kind in np.unique(inputs.table.kind))
    fields = {measure.field for kind in row_kinds for measure in kind.quantities}
    return quantity.field in fields and bool(np.isfinite(inputs.table[quantity.field]).any())


def shifted(inputs: Alternative) -> Iterator[Alternative]:
    """Return rows with the joint readings of the row before, or after."""
    table = inputs.table
    for by, side in ((1, "after"), (-1, "before")):
        source = inputs.rows - by
        q, rate = (np.roll(column, by, axis=0) for column in (table.q, table.q_rate))
        rows = inputs.rows[(source >= 0) & (source < len(table))]
        values = {"side": side}
        yield replace(inputs, code="shifted-rows", values=values, table=table.replace(q=q, q_rate=rate), rows=rows)


def names_exchanged(inputs: Alternative) -> Iterator[Alternative]:
    """Return the names of one column that operators confuse, or of two, permuted in all rows of a rig."""
    table = inputs.table
    columns = [column for column in identifiers() if any(column in kind.labels for kind in kinds().values())]
    for rig in np.unique(table.rig):
        in_rig = table.rig == rig
        changes = []
        for column in columns:
            names = sorted(set(table[column][in_rig]) - {""})
            is_short = len(names) <= MOST_PERMUTED
            orders = list(permutations(names))[1:] if is_short else exchanges_and_cycles(names)
            changes.append([{column: dict(zip(names, order, strict=True))} for order in orders])
        pairs = (first | second for a, b in combinations(changes, 2) for first, second in product(a, b))
        for change in islice(chained(*changes, pairs), MOST_RENAMINGS):
            changed = {
                column: np.where(in_rig, [new.get(name, name) for name in table[column]], table[column])
                for column, new in change.items()
            }
            renamings = [(column, *pair) for column, new in change.items() for pair in new.items()]
            texts = [f"{column} {old} is {name}" for column, old, name in renamings if old != name]
            values = {"names": texts, "bar": "bar" in change}
            yield replace(inputs, code="names-exchanged", values=values, table=renamed(inputs.rig, table, changed))


def exchanges_and_cycles(items: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Return other orders of some items: two of them exchanged, and cycles."""
    exchanges = [tuple(b if k == a else a if k == b else k for k in items) for a, b in combinations(items, 2)]
    return exchanges + [(*items[shift:], *items[:shift]) for shift in range(1, len(items))]


def stuck(inputs: Alternative) -> Iterator[Alternative]:
    """Return the rows without a run in which one joint alone reads the same."""
    q = inputs.table.q[inputs.rows]
    for joint in range(q.shape[1]):
        edges = np.concatenate([[0], np.flatnonzero(np.diff(q[:, joint])) + 1, [len(q)]])
        longest = int(np.argmax(np.diff(edges)))
        first, last = edges[longest : longest + 2].tolist()
        if LEAST_ROWS <= last - first < len(q) and np.delete(np.ptp(q[first:last], axis=0), joint).any():
            name = inputs.chain.joints[joint].name
            rows = inputs.rows[first:last]
            ends = {"first": row_name(inputs.table, rows[0]), "last": row_name(inputs.table, rows[-1])}
            values = {"joint": name, "n": rows.size, "others": inputs.rows.size - rows.size, **ends}
            values["leave_out"] = [f"{rows[0] + 1}:{rows[-1] + 1}"]
            remaining = np.delete(inputs.rows, np.arange(first, last))
            yield replace(inputs, code="stuck-joint", values=values, rows=remaining)


def other_robots(inputs: Alternative, robots: Robots) -> Iterator[Alternative]:
    """Return the table as one of other robots with the same units of joints."""
    for name, (chain, free) in robots.items():
        if name != inputs.chain.name and chain.joint_units == inputs.chain.joint_units:
            values = {"robot": name, "other": inputs.chain.name}
            yield replace(inputs, code="wrong-robot", values=values, chain=chain, free=free)


def constants(inputs: Alternative, allowed: Collection[str]) -> Iterator[Alternative]:
    """Return items of the rig that are elsewhere than it says, in all rows: their numbers become parameters."""
    problem = build_problem(inputs.chain, inputs.rig, inputs.table.select(inputs.rows))
    vague = {name for name, sigma in zip(problem.names, problem.prior_sigma, strict=True) if np.isinf(sigma)}
    for cause in problem.causes:
        if cause.fault.constant and cause.name not in allowed and not vague.issuperset(cause.numbers):
            values = {"item": cause.name, "apply": cause.name}
            yield replace(inputs, code="wrong-constant", values=values, effects=(*inputs.effects, Effect(cause.name)))
