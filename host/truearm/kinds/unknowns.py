"""Positions of the rig's numbers in a problem: unknowns follow the robot's params, known constants follow the unknowns."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.types import Indices, Point
from truearm.units import SMALLEST

XYZ = ("x", "y", "z")


class RigNumber(NamedTuple):
    """A number of the rig: known exactly (sigma 0), with a prior (finite), or without one (inf)."""

    name: str
    unit: str
    value: float
    sigma: float


class Fault(NamedTuple):
    """A way in which an item of the rig can differ from its description, in some of its numbers together.

    ``constant``: by an offset in all rows; ``step``: by an offset from some row on, or to another; ``moved``: in the
    direction of a joint's last move, or in proportion to it.
    """

    numbers: slice  # of the item's list
    constant: bool = True
    step: bool = True
    moved: bool = False


MOVED = (Fault(slice(None)),)  # all numbers of an item are its position


class Used(NamedTuple):
    """The distinct items that some rows use (chucks, bars, …), their numbers, and which of them each row uses."""

    labels: list[Hashable]
    numbers: list[list[RigNumber]]  # one inner list per item
    which: Indices  # (n,)
    faults: tuple[Fault, ...] = MOVED  # of each item


class Layout:
    """Indices of numbers into x followed by constants. An item used in two roles has its numbers only once.

    Raises ProblemError for a value that is not finite, or for a sigma that is negative, not a number, or implausibly
    small.
    """

    def __init__(self, n_robot: int, groups: Sequence[Used]) -> None:
        numbers = {number.name: number for group in groups for item in group.numbers for number in item}
        for number in numbers.values():
            if not (np.isfinite(number.value) and (number.sigma == 0.0 or number.sigma >= SMALLEST)):
                raise ProblemError(
                    f"{number.name} is {number.value:g} ± {number.sigma:g}; it must be finite, sigma 0 or at least {SMALLEST:g}"
                )
        self.unknown = [number for number in numbers.values() if number.sigma > 0.0]
        self.known = [number for number in numbers.values() if number.sigma == 0.0]
        self.constants = np.array([number.value for number in self.known])
        self._at = {number.name: n_robot + i for i, number in enumerate([*self.unknown, *self.known])}

    def index(self, used: Used) -> Indices:
        """Return the indices (n, c) of what each row uses."""
        table = np.array([[self._at[number.name] for number in item] for item in used.numbers], dtype=np.intp)
        return rows_of(table, used.which)


def rows_of(values: NDArray[Any], which: Indices) -> NDArray[Any]:
    """Return ``values[which]`` (n, …) of values (m, …), in the memory of one row where there is only one, as usual."""
    return np.broadcast_to(values, (which.size, *values.shape[1:])) if len(values) == 1 else values[which]


def enumerate_labels(labels: Sequence[Hashable]) -> tuple[list[Hashable], Indices]:
    """Return the distinct labels in order of appearance, and the index of each row's label."""
    order = {label: i for i, label in enumerate(dict.fromkeys(labels))}
    return list(order), np.fromiter(map(order.__getitem__, labels), dtype=np.intp, count=len(labels))


def point_numbers(name: str, point: Point) -> list[RigNumber]:
    """Return the three coordinates of a point of the rig."""
    return [RigNumber(f"{name}.{k}", "m", v, or_inf(point.sigma)) for k, v in zip(XYZ, point.xyz, strict=True)]


def or_inf(sigma: float | None) -> float:
    """Return a rig's sigma as a number: inf for None, which means unknown."""
    return np.inf if sigma is None else sigma
