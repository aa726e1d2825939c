"""Systematic errors that a fit can hold as additional parameters: what stood, read or turned otherwise than described.

An effect adds to what is predicted. The derivatives of a prediction by the numbers of the rig, known ones too, by each joint
reading and by a motion of the robot's base are at hand in every row, and so is that by a motion of the tool with all its points; an effect is one or several of them, times a
profile over the rows: 1 in the rows that it concerns; for a drift their time or the box's temperature, from −½ at the least to ½ at
the most. So the parameter of an effect is in the unit of what is off: metres of a bar's zero, a chuck's coordinates, the radians of a joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.kinds.group import Group
from truearm.kinds.linearised import Indices, Linearised
from truearm.kinds.unknowns import Fault
from truearm.model.chain import Chain
from truearm.types import DriftWith, Effect, Floats, ObservationTable

# As ``Linearised.wrenches`` begins: force and couple on each axis of the base frame, the derivatives by its displacement.
BASE = (("base.x", "m"), ("base.rx", "rad"), ("base.y", "m"), ("base.ry", "rad"), ("base.z", "m"), ("base.rz", "rad"))
TOOL = (("tool.x", "m"), ("tool.y", "m"), ("tool.z", "m"), ("tool.rx", "rad"), ("tool.ry", "rad"), ("tool.rz", "rad"))
MOVED = Fault(slice(None), constant=False)  # base or tool: where they always were is a parameter of the robot
JUMPED = Fault(slice(None), constant=False, step=False, window=True)  # a joint's offset is a parameter of the robot


class Errors(NamedTuple):
    """Everything by which a prediction can be off to first order: names and SI units of the columns of ``error_columns``."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    tool: Floats = np.zeros((0, 0))  # (c, t) its motion, by the columns before it

    def unit(self, name: str) -> str:
        """The SI unit of a column."""
        return self.units[self.names.index(name)]

    def indices(self, names: Sequence[str]) -> Indices:
        """Where columns stand. Raises ProblemError for a name that is none of them."""
        at = {name: i for i, name in enumerate(self.names)}
        for name in names:
            if name not in at:
                raise ProblemError(f"{name!r} is nothing that these observations use")
        return np.array([at[name] for name in names], dtype=np.intp)


class Cause(NamedTuple):
    """A thing, and how it can be off: "chuck.c1" with its coordinates, "bar.b46.zero", "joint2", "base"."""

    name: str
    numbers: tuple[str, ...]
    fault: Fault


class Circumstances(NamedTuple):
    """In what n rows were measured: times [s] and temperatures [°C] (n,), NaN where nobody knows."""

    time: Floats
    temperature: Floats

    @classmethod
    def of(cls, table: ObservationTable) -> Circumstances:
        """Those of a table's rows."""
        return cls(table.time, table.temperature)

    def __len__(self) -> int:
        return int(self.time.size)

    def during(self, drift: DriftWith, first: int, last: int) -> Floats | None:
        """What a drift is linear in, of some rows; None where that is not known, or does not change.

        The order of the rows stands for times that are not known.
        """
        match drift:
            case DriftWith.TIME:
                along = self.time[first:last]
                if not np.isfinite(along).all():
                    along = np.arange(float(last - first))
            case DriftWith.TEMPERATURE:
                along = self.temperature[first:last]
            case never:
                assert_never(never)
        return along if np.isfinite(along).all() and np.ptp(along) > 0.0 else None


class Modelled(NamedTuple):
    """An effect that is a parameter of a problem: its name, its column, and its profile over the rows."""

    effect: Effect
    column: str
    profile: Floats  # (n,)

    def select(self, rows: NDArray[np.bool_]) -> Modelled:
        """For some of the rows."""
        return self._replace(profile=self.profile[rows])


def modelled_effects(causes: Sequence[Cause], effects: Sequence[Effect], rows: Circumstances) -> list[Modelled]:
    """The effects' parameters, one for each number of the thing that is off, over the rows.

    Raises ProblemError for a thing that is none of the causes, for a form that it cannot have and for rows that there are not.
    """
    out = []
    for effect in effects:
        known = [cause for cause in causes if cause.name == effect.what]
        if not known:
            names = ", ".join(cause.name for cause in causes)
            raise ProblemError(f"{effect.what!r} cannot be off here; these can: {names}")
        # What drifts was right at some moment that nobody knows: it is off by an offset too.
        for part in (effect, Effect(effect.what)) if effect.drifts_with else (effect,):
            out += [Modelled(part, number, profile(part, rows)) for number in known[0].numbers]
    return out


def profile(effect: Effect, rows: Circumstances) -> Floats:
    """(n,) by what a row's prediction is off for one unit of the effect.

    Raises ProblemError for rows that there are not, or in which nothing is known that a drift could be linear in.
    """
    n = len(rows)
    first, last = effect.first, n if effect.last is None else effect.last
    if not 0 <= first < last <= n:
        raise ProblemError(f"{effect}: there are rows 1 to {n}")
    out = np.zeros(n)
    if effect.drifts_with is None:
        out[first:last] = 1.0
        return out
    along = rows.during(effect.drifts_with, first, last)
    if along is None:
        raise ProblemError(f"{effect}: rows {first + 1} to {last} have no {effect.drifts_with}, or it does not change")
    out[first:last] = (along - (along.max() + along.min()) / 2.0) / np.ptp(along)
    return out


def error_columns(lin: Linearised, tool: Floats) -> Floats:
    """(w, n, c + t) derivatives of the predictions by the rig, the joints, the base and the tool (c, t), of ``Group.opened``."""
    single = np.concatenate([lin.jac_rig, lin.by_joints, lin.wrenches[..., : len(BASE)]], axis=2)
    return np.concatenate([single, single @ tool], axis=2) if tool.size else single


def motion_of_tool(names: Sequence[str], points: Mapping[str, Floats]) -> Floats:
    """(c, 6) what moves where the end, and with it all its ``points`` (x, y, z by name), moves in its own axes (TOOL)."""
    at = {name: i for i, name in enumerate(names)}
    out = np.zeros((len(names), len(TOOL)))
    for name, p_end in points.items():
        rows = [at[f"{name}.{k}"] for k in "xyz"]
        out[rows, :3], out[rows, 3:] = np.eye(3), np.cross(np.eye(3), p_end).T
    return out


@dataclass(frozen=True, kw_only=True)
class EffectRows(Group):
    """n observations of another group, with effects as the last parameters of x."""

    COMPONENTS = ()  # those of ``inner``, an instance's own

    inner: Group
    tool: Floats  # (c, t) of ``Errors``
    columns: Indices  # (e,) of ``error_columns``
    profile: Floats  # (n, e)

    def __post_init__(self) -> None:
        object.__setattr__(self, "COMPONENTS", self.inner.COMPONENTS)

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Residuals (n·w,) and their derivatives at x (P,), those by the effects at effects of zero."""
        lin = self.opened(chain, x)
        return lin._replace(jac_rig=lin.jac_rig[:, :, : x.size - len(chain.parameters)])

    def opened(self, chain: Chain, x: Floats) -> Linearised:
        """As ``evaluate``, with ``jac_rig`` by the known constants too, after the effects."""
        size = x.size - self.columns.size
        lin = self.inner.opened(chain, x[:size])
        by_effects = error_columns(lin, self.tool)[:, :, self.columns] * self.profile
        unknown, known = np.split(lin.jac_rig, [size - len(chain.parameters)], axis=2)
        residual = lin.residual - (by_effects @ x[size:]).T.ravel()
        return lin._replace(residual=residual, jac_rig=np.concatenate([unknown, by_effects, known], axis=2))

    def settle(self, chain: Chain, x: Floats) -> EffectRows:
        """As ``inner`` does without effects."""
        return replace(self, inner=self.inner.settle(chain, x[: x.size - self.columns.size]))

    def orientations(self) -> Indices:
        """Those of ``inner``."""
        return self.inner.orientations()

    def take(self, which: slice | NDArray[np.bool_] | NDArray[np.intp]) -> EffectRows:
        """Some of the observations."""
        row = None if self.row is None else self.row[which]
        inner = self.inner.take(which)
        return replace(self, row=row, sensor_cov=self.sensor_cov[which], inner=inner, profile=self.profile[which])


def with_effects(groups: Sequence[Group], tool: Floats, columns: Indices, profiles: Floats) -> tuple[Group, ...]:
    """The groups with effects (n_rows, e) beside their parameters; knowledge that is no row has none of them."""
    return tuple(
        EffectRows(
            row=group.row,
            sensor_cov=group.sensor_cov,
            constants=np.zeros(0),
            inner=group,
            tool=tool,
            columns=columns,
            profile=np.zeros((len(group.sensor_cov), columns.size)) if group.row is None else profiles[group.row],
        )
        for group in groups
    )
