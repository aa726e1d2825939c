"""A group of observations, compiled against a parameter vector x: an estimator's only view of a kind of observation.

The parameter vector x (P,) of a problem is the robot's params (p,) followed by the rig's unknowns: coordinates of
chucks, spheres and sockets, zero and gain of bars. A row refers to a number by its index into *x followed by the
problem's known constants*. Knowledge and unknowns are therefore read in the same way, and only the unknown ones (index
below P) have a column in the Jacobian.

The Jacobian is kept as the product ``wrenches @ twists`` for the robot's params (model/chain.py), as it is computed. An
estimator folds only the wrenches, which have fewer columns. Arrays (w, n, c) are stored component by component: all
poses of one column are contiguous.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.model.chain import Basis, Chain, PointDerivatives
from truearm.types import Floats, Indices, Mask, Point
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

    ``constant``: by an offset in all rows; ``step``: by an offset from some row on, or to another.
    """

    numbers: slice  # of the item's list
    constant: bool = True
    step: bool = True


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


class Linearised(NamedTuple):
    """Residuals and derivatives of n observations with w scalar residuals each; m = n·w, grouped by observation."""

    residual: Floats  # (m,) measured − predicted, in the units of the group's components
    wrenches: Floats  # (w, n, b)
    basis: Basis  # of the b columns
    jac_rig: Floats  # (w, n, P − p) ∂predicted/∂(the rig's unknowns)
    by_joints: Floats  # (w, n, j) ∂predicted/∂(joint readings)

    @property
    def jac_params(self) -> Floats:
        """(m, P) ∂predicted/∂x."""
        return self.jac_by(np.ones(self.basis.twists.shape[1] + self.jac_rig.shape[2], dtype=bool))

    def jac_by(self, columns: Mask) -> Floats:
        """Return (m, k) ∂predicted/∂x[columns]."""
        return _by_observation(self.by_columns(columns))

    def by_columns(self, columns: Mask) -> Floats:
        """Return the same as ``jac_by``, (w, n, k); what ``jac_rig`` has beyond the mask is left out."""
        robot, rig = np.split(columns, [self.basis.twists.shape[1]])
        by_rig = self.jac_rig[:, :, np.flatnonzero(rig)]
        return np.concatenate([self.wrenches @ self.basis.twists[:, robot], by_rig], axis=2)

    @property
    def jac_joints(self) -> Floats:
        """(m, j) ∂predicted/∂(joint readings)."""
        return _by_observation(self.by_joints)


def linearised(
    residual: Floats, derivative: PointDerivatives, x: Floats, *columns: tuple[Indices, Floats]
) -> Linearised:
    """Return residuals (m,) or (n, w) with the derivatives of their predictions by the robot and by the rig at x (P,).

    Each of the ``columns`` are the indices (n, c) of some of the rig's numbers and the derivatives (w, n, c) by these.
    """
    p = derivative.basis.twists.shape[1]
    jac_rig = zero_columns(derivative.wrenches, x.size - p)
    w, n = derivative.wrenches.shape[:2]
    if residual.size != w * n:
        raise ValueError(f"residuals have the shape {residual.shape}, derivatives that of {n} rows with {w} residuals")
    for index, values in columns:
        if values.shape != (w, *index.shape):
            raise ValueError(
                f"derivatives by the rig have the shape {values.shape}, and not (w, n, c) = {(w, *index.shape)}"
            )
        scatter(jac_rig, index - p, values)
    return Linearised(residual.ravel(), derivative.wrenches, derivative.basis, jac_rig, derivative.jac_joints)


def gather(x: Floats, constants: Floats, index: Indices) -> Floats:
    """Return the values at ``index`` (n, c) of x followed by constants; each of the c is contiguous in memory."""
    return np.concatenate([x, constants]).take(index.T).T


def zero_columns(wrenches: Floats, count: int) -> Floats:
    """Return zeros (w, n, count) to go with wrenches (w, n, b), for ``scatter`` to write to."""
    return np.zeros((count, *wrenches.shape[:2]), wrenches.dtype).transpose(1, 2, 0)


def scatter(jac_rig: Floats, index: Indices, values: Floats) -> None:
    """Add ``values`` (w, n, c) to the columns ``index`` (n, c) of jac_rig (w, n, r) in place.

    ``index`` counts from the rig's first unknown; constants, from r on, have no column.
    """
    unknown = index < jac_rig.shape[2]
    for k in np.flatnonzero(unknown.any(axis=0)):
        if (index[:, k] == index[0, k]).all():  # usually one device
            jac_rig[:, :, index[0, k]] += values[:, :, k]
            continue
        rows = np.flatnonzero(unknown[:, k])
        jac_rig[:, rows, index[rows, k]] += values[:, rows, k]


def _by_observation(derivatives: Floats) -> Floats:
    """Reshape (w, n, c) to (n·w, c)."""
    width, n, count = derivatives.shape
    return np.swapaxes(derivatives, 0, 1).reshape(n * width, count)


class KindFault(NamedTuple):
    """A way in which the readings of a kind can be off that is no number of the rig: "bar" "azimuth".

    ``columns`` (w, n, d) is the change of the predictions by each of d numbers, in the SI ``unit`` of these.
    """

    item: str
    form: str
    unit: str
    columns: Floats


@dataclass(frozen=True, kw_only=True)
class Group(ABC):
    """n observations of one kind.

    Indices refer to x followed by ``constants``; fields that are not ``SHARED`` have n rows.

    ``row`` is None for knowledge that is not a row of the table, such as a known distance between two sockets.
    """

    COMPONENTS: ClassVar[tuple[str, ...]]  # the SI unit of each of the w scalar residuals of an observation
    SHARED: ClassVar[tuple[str, ...]] = ("constants",)  # fields that do not have a row for each observation

    row: Indices | None  # (n,) rows of the table
    sensor_cov: Floats  # (n, w) variances or (n, w, w), in the squared units of the components
    constants: Floats

    @abstractmethod
    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n·w,), measured − predicted, and their derivatives at x (P,)."""

    def opened(self, chain: Chain, x: Floats) -> Linearised:
        """Return the same as ``evaluate``, but with the derivatives by the known constants appended to ``jac_rig``."""
        return replace(self, constants=np.zeros(0)).evaluate(chain, np.concatenate([x, self.constants]))

    def settle(self, chain: Chain, x: Floats) -> Self:
        """Return the group as a rank test at x needs it (``SeatRows.settle``)."""
        return self

    def hold(self, chain: Chain, x: Floats) -> Self:
        """Return the group with all values held at x that ``evaluate`` takes as constant in its derivatives."""
        return self

    def faults(self, chain: Chain, x: Floats) -> list[KindFault]:
        """Return the ways in which readings of this kind can be off beside numbers of the rig, at x (P,)."""
        return []

    def orientations(self) -> Indices:
        """Return the indices (r, 3) of rotation vectors, known and repeated ones too.

        An estimator rotates these instead of adding to them.
        """
        return np.zeros((0, 3), dtype=np.intp)

    def beside_base(self) -> Indices:
        """Return the indices (r, 3) of points beside the robot, in its base frame, known and repeated ones too."""
        return np.zeros((0, 3), dtype=np.intp)

    def take(self, which: slice | NDArray[Any]) -> Self:
        """Return some of the observations."""
        names = [field.name for field in fields(self) if field.name not in self.SHARED]
        values: dict[str, Any] = {name: _rows(getattr(self, name), which) for name in names}
        return replace(self, **values)

    def by_unit(self, residual: Floats) -> dict[str, Floats]:
        """Return the residuals (n·w,) as figures (n,) by unit, which are never pooled.

        The components of one unit give one figure per observation: the signed residual if there is one, or their norm.
        """
        components = residual.reshape(len(self.sensor_cov), -1)
        return {unit: _figure(components[:, columns]) for unit, columns in unit_columns(self.COMPONENTS).items()}


@dataclass(frozen=True, kw_only=True)
class GroupOfOther(Group):
    """The n observations of another group, ``inner``, evaluated under further circumstances."""

    COMPONENTS = ()  # those of ``inner``, set per instance

    inner: Group

    def __post_init__(self) -> None:
        object.__setattr__(self, "COMPONENTS", self.inner.COMPONENTS)

    @classmethod
    def around(cls, inner: Group, **circumstances: Any) -> Self:
        """Return another group under further circumstances, the fields of the class."""
        return cls(row=inner.row, sensor_cov=inner.sensor_cov, constants=np.zeros(0), inner=inner, **circumstances)

    def faults(self, chain: Chain, x: Floats) -> list[KindFault]:
        """Return those of ``inner``."""
        return self.inner.faults(chain, x)

    def orientations(self) -> Indices:
        """Return those of ``inner``."""
        return self.inner.orientations()

    def beside_base(self) -> Indices:
        """Return those of ``inner``."""
        return self.inner.beside_base()


def unit_columns(components: Sequence[str]) -> dict[str, list[int]]:
    """Return which of the components have each unit."""
    return {
        unit: [i for i, component_unit in enumerate(components) if component_unit == unit]
        for unit in dict.fromkeys(components)
    }


def _rows(values: Group | Floats | None, which: slice | NDArray[Any]) -> Group | Floats | None:
    if isinstance(values, Group):
        return values.take(which)
    return None if values is None else values[which]


def _figure(components: Floats) -> Floats:
    return components[:, 0] if components.shape[1] == 1 else np.asarray(np.linalg.norm(components, axis=1))
