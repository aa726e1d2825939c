"""A group of observations, compiled against a parameter vector x: an estimator's only view of a kind of observation.

Each scalar residual of an observation has a unit (``COMPONENTS``). Those of one unit give one figure per observation:
the signed residual if there is one, otherwise their norm. Figures of different units are never pooled.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from truearm.kinds.linearised import Linearised
from truearm.model.chain import Chain
from truearm.types import Floats, Indices


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
    """n observations of one kind. Indices refer to x followed by ``constants``; fields that are not ``SHARED`` have n rows.

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
        """Return the indices (r, 3) of rotation vectors, known and repeated ones too. An estimator rotates these instead of adding to them."""
        return np.zeros((0, 3), dtype=np.intp)

    def beside_base(self) -> Indices:
        """Return the indices (r, 3) of points that stand beside the robot, in its base frame, known and repeated ones too."""
        return np.zeros((0, 3), dtype=np.intp)

    def take(self, which: slice | NDArray[Any]) -> Self:
        """Return some of the observations."""
        names = [field.name for field in fields(self) if field.name not in self.SHARED]
        values: dict[str, Any] = {name: _rows(getattr(self, name), which) for name in names}
        return replace(self, **values)

    def by_unit(self, residual: Floats) -> dict[str, Floats]:
        """Return the residuals (n·w,) as figures (n,) by unit."""
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
