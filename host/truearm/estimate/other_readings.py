"""Other interpretations of a whole table: another unit, another robot, joints in another order or with other signs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np

from truearm.errors import ProblemError
from truearm.estimate.ties import largest_first
from truearm.estimate.trial_fit import placed
from truearm.kinds.quantities import LARGEST_NOISE, Quantity
from truearm.kinds.registry import kinds, points
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.types import Floats, Mask, Rig, Rigs, thinned
from truearm.units import DEG, MM, UNITS

INCH = 0.0254  # m
FEW_ROWS = 60  # enough to rank arrangements of joints
MOST_FITTED = 4  # of the orders and signs of joints, those with the smallest residuals before the robot is fitted


class Candidate(NamedTuple):
    """Another robot that the observations may belong to: its chain and the parameters to free (p,)."""

    chain: Chain
    free: Mask


class Interpretation(NamedTuple):
    """Another interpretation of the inputs, and the message if it explains the observations.

    ``log_jacobian`` is the sum of the logarithms of the factors by which it multiplies measured numbers.
    """

    text: str
    chain: Chain
    rig: Rigs
    table: ObservationTable
    free: Mask
    log_jacobian: float = 0.0


def of_other_robots(
    chain: Chain, rig: Rigs, table: ObservationTable, robots: Mapping[str, Candidate]
) -> Iterator[Interpretation]:
    """Return the table as one of other robots with the same units of joints."""
    for name, other in robots.items():
        if name != chain.name and other.chain.joint_units == chain.joint_units:
            text = f"the observations are of robot {name}, not of {chain.name}"
            yield Interpretation(text, other.chain, rig, table, other.free)


def in_other_units(chain: Chain, rig: Rigs, table: ObservationTable, free: Mask) -> Iterator[Interpretation]:
    """Return columns and points in the other unit."""
    used = [kinds()[str(kind)] for kind in np.unique(table.kind)]
    # If nothing is measured except that the end returns, less motion gives smaller residuals, whatever the unit.
    returns = not all(any(isinstance(column, Quantity) for column in kind.needs) for kind in used)
    for unit in ("rad", "m"):
        which = np.array([of == unit for of in chain.joint_units])
        if which.any():
            for factor, are, called in in_other_unit(unit):
                if returns and factor < 1.0:
                    continue
                q = np.where(which, factor * table.q, table.q)
                rate = np.where(which, factor * table.q_rate, table.q_rate)
                text = f"the joint readings are in {are}, not in {called}"
                yield Interpretation(text, chain, rig, table.replace(q=q, q_rate=rate), free)
    for quantity in dict.fromkeys(quantity for kind in used for quantity in kind.quantities):
        if quantity.most <= LARGEST_NOISE or quantity.unit not in ("m", "rad"):
            continue
        inches = [(INCH / MM.scale, "inches", "millimetres")] * (quantity.unit == "m")
        for factor, are, called in (*in_other_unit(quantity.unit), *inches):
            text = f"the readings of {quantity.words} are in {are}, not in {called}"
            numbers = table[quantity.field]
            changed = table.replace(**{quantity.field: factor * numbers})
            yield Interpretation(text, chain, rig, changed, free, float(np.isfinite(numbers).sum() * math.log(factor)))
    for column, entry in points().items():
        for factor, are, called in in_other_unit("m"):
            scaled = _with_points(rig, entry, factor)
            if scaled is not None:
                text = f"the rig's coordinates of each {column} are in {are}, not in {called}"
                yield Interpretation(text, chain, scaled, table, free)


def in_other_unit(unit: str) -> tuple[tuple[float, str, str], ...]:
    """Return factors for numbers in another unit than m or rad: "are in the first, not in the second"."""
    scale, shown, si = (MM.scale, "millimetres", "metres") if unit == "m" else (DEG.scale, "degrees", "radians")
    return (scale, shown, si), (1.0 / scale, si, shown)


def in_each_rig(rigs: Mapping[str, Rig], change: Callable[[Rig], Rigs | None]) -> Rigs | None:
    """Return rigs, each changed if it can be; None if none can."""
    changed = {name: one for name, rig in rigs.items() if isinstance(one := change(rig), Rig)}
    return {**rigs, **changed} if changed else None


def _with_points(rig: Rigs, entry: str, factor: float) -> Rigs | None:
    """Return the rig, or rigs, with some points' coordinates multiplied; None if there are none, or they are too far."""
    if not isinstance(rig, Rig):
        return in_each_rig(rig, lambda one: _with_points(one, entry, factor))
    known = rig.named(entry)
    farthest = max((abs(v) for point in known.values() for v in point.xyz), default=0.0)
    if not 0.0 < factor * farthest <= UNITS["m"].largest:
        return None
    moved: dict[str, Any] = {
        entry: {name: replace(p, xyz=tuple(factor * v for v in p.xyz)) for name, p in known.items()}
    }
    return replace(rig, **moved)


def of_other_joints(chain: Chain, rig: Rigs, table: ObservationTable, free: Mask) -> Iterator[Interpretation]:
    """Return the orders and signs of joints with the smallest residuals before the robot is fitted."""
    names = [joint.name for joint in chain.joints]
    few = table.select(thinned(len(table), FEW_ROWS))
    scored: list[tuple[float, str, list[int], Floats]] = []
    for order, signs in _arrangements(len(names)):
        if any(chain.joint_units[i] != unit for i, unit in zip(order, chain.joint_units, strict=True)):
            continue
        try:
            with np.errstate(all="ignore"):
                least = placed(chain, rig, _with_joints(few, order, signs), worst_fitted(scored)).reduced
        except (ProblemError, np.linalg.LinAlgError):
            continue
        if np.isfinite(least):
            scored.append((least, _arranged(names, order, signs), order, signs))
    for i in largest_first([-least for least, *_ in scored])[:MOST_FITTED]:
        _, text, order, signs = scored[i]
        yield Interpretation(text, chain, rig, _with_joints(table, order, signs), free)


def worst_fitted(scored: Sequence[tuple[Any, ...]]) -> float:
    """Return χ²/ν of the last interpretation to be fitted among those ``scored``; inf if there are few."""
    return sorted(float(least) for least, *_ in scored)[MOST_FITTED - 1] if len(scored) >= MOST_FITTED else math.inf


def _with_joints(table: ObservationTable, order: Sequence[int], signs: Floats) -> ObservationTable:
    return table.replace(q=table.q[:, order] * signs, q_rate=table.q_rate[:, order] * signs)


def _arrangements(n: int) -> Iterator[tuple[list[int], Floats]]:
    """Return orders and signs of n joints: exchanges of two, cycles, the reverse; all signs."""
    same, plus = list(range(n)), np.ones(n)
    for a, b in combinations(same, 2):
        order = list(same)
        order[a], order[b] = b, a
        yield order, plus
    for shift in range(1, n):
        yield same[shift:] + same[:shift], plus
    yield same[::-1], plus
    for signs in product((1.0, -1.0), repeat=n):
        if min(signs) < 0.0:
            yield same, np.array(signs)


def _arranged(names: Sequence[str], order: Sequence[int], signs: Floats) -> str:
    turned = [name for name, sign in zip(names, signs, strict=True) if sign < 0.0]
    if turned:
        return f"the {'sign' if len(turned) == 1 else 'signs'} of {', '.join(turned)} {'is' if len(turned) == 1 else 'are'} reversed"
    moved = [(names[i], names[k]) for k, i in enumerate(order) if i != k]
    if len(moved) == 2:
        return f"the columns of {moved[0][0]} and {moved[0][1]} are exchanged"
    return f"the joints' columns are in another order: {', '.join(names[order.index(i)] for i in range(len(names)))}"
