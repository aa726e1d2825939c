"""Where each number of the rig stands in a problem: unknowns after the robot's params, known constants after those."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from truearm.errors import ProblemError
from truearm.observe.rows import Indices
from truearm.types import BallBar, ObservationTable, Point, Strings

XYZ = ("x", "y", "z")


class Number(NamedTuple):
    """A number of the rig: known exactly (sigma 0), with a prior (finite), or without (inf)."""

    name: str
    unit: str
    value: float
    sigma: float


class Used(NamedTuple):
    """The distinct things that some rows use (chucks, bars, …), their numbers, and which of them each row uses."""

    labels: list[Hashable]
    numbers: list[list[Number]]  # one inner list a thing
    which: Indices  # (n,)


class Layout:
    """Indices of numbers into x followed by constants; a thing used in two roles has its numbers once.

    Raises ProblemError for a value that is not finite or a sigma that is negative or no number.
    """

    def __init__(self, n_robot: int, used: Sequence[Used]) -> None:
        every = {number.name: number for group in used for thing in group.numbers for number in thing}
        for number in every.values():
            if not (np.isfinite(number.value) and number.sigma >= 0.0):
                raise ProblemError(
                    f"{number.name} is {number.value:g} ± {number.sigma:g}; it must be finite, sigma ≥ 0"
                )
        self.unknown = [number for number in every.values() if number.sigma > 0.0]
        known = [number for number in every.values() if number.sigma == 0.0]
        self.constants = np.array([number.value for number in known])
        self._at = {number.name: n_robot + i for i, number in enumerate([*self.unknown, *known])}

    def index(self, used: Used) -> Indices:
        """(n, c) indices of what each row uses."""
        table = np.array([[self._at[number.name] for number in thing] for thing in used.numbers], dtype=np.intp)
        return np.asarray(table[used.which])


def enumerate_labels(labels: Sequence[Hashable]) -> tuple[list[Hashable], Indices]:
    """Distinct labels in order of appearance, and which of them each row has."""
    order: dict[Hashable, int] = {}
    which = np.array([order.setdefault(label, len(order)) for label in labels], dtype=np.intp)
    return list(order), which


def use(
    table: ObservationTable,
    rows: Indices,
    column: Strings,
    known: Mapping[str, Point] | Mapping[str, BallBar],
    what: str,
) -> Used:
    """Look a column's names up in the rig; an empty name means the only one there is.

    Raises ProblemError that names the first row of a name the rig does not have.
    """
    names, which = enumerate_labels(column[rows].tolist())
    labels: list[Hashable] = []
    for i, name in enumerate(names):
        label = next(iter(known)) if name == "" and len(known) == 1 else str(name)
        if label not in known:
            source = table.source[rows[int(np.argmax(which == i))]]
            have = ", ".join(sorted(known)) or "none"
            raise ProblemError(f"{source}: {what} {label!r} is not in the rig, which has {have}")
        labels.append(label)
    return Used(labels, [_numbers(what, str(label), known[str(label)]) for label in labels], which)


def unknown_point(name: str, xyz: Sequence[float]) -> list[Number]:
    """Three coordinates of which nothing is known but a place to start."""
    return [Number(f"{name}.{k}", "m", float(v), np.inf) for k, v in zip(XYZ, xyz, strict=True)]


def _numbers(what: str, label: str, thing: Point | BallBar) -> list[Number]:
    if isinstance(thing, BallBar):
        zero = Number(f"bar.{label}.zero", "m", thing.zero, thing.zero_sigma)
        return [zero, Number(f"bar.{label}.gain", "1", thing.gain, thing.gain_sigma)]
    sigma = np.inf if thing.sigma is None else thing.sigma
    return [Number(f"{what}.{label}.{k}", "m", v, sigma) for k, v in zip(XYZ, thing.xyz, strict=True)]
