"""Systematic errors as additional parameters of a fit: items of the rig, joint readings or motions that were off.

An effect adds to the prediction. Each row already has the derivatives of its prediction by the numbers of the rig
(including known ones), by each joint reading, by a motion of the robot's base and by a motion of the tool with all its
points. An effect is one or several of these derivatives, times a profile over the rows: 1 in the rows that it concerns;
for a drift, the time or the box's temperature, scaled from −½ at the lowest to ½ at the highest. The parameter of an
effect therefore has the unit of what is off: metres for a bar's zero or a chuck's coordinates, radians for a joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError, ProblemError
from truearm.kinds.group import Group
from truearm.kinds.linearised import Indices, Linearised
from truearm.kinds.unknowns import Fault
from truearm.model.chain import Chain
from truearm.results import DriftWith, Effect
from truearm.types import Floats, ObservationTable

# First columns of ``Linearised.wrenches``: force and couple on each axis of the base frame, derivatives by its
# displacement.
BASE = (("base.x", "m"), ("base.rx", "rad"), ("base.y", "m"), ("base.ry", "rad"), ("base.z", "m"), ("base.rz", "rad"))
TOOL = (("tool.x", "m"), ("tool.y", "m"), ("tool.z", "m"), ("tool.rx", "rad"), ("tool.ry", "rad"), ("tool.rz", "rad"))
MOVED = Fault(slice(None), constant=False)  # base or tool: a constant pose error is a parameter of the robot
JUMPED = Fault(slice(None), constant=False, step=False, window=True)  # a joint's offset is a parameter of the robot


class Errors(NamedTuple):
    """Everything by which a prediction can be off to first order: names and SI units of the columns of ``error_columns``."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    tool: Floats = np.zeros((0, 0))  # (c, t) motion of the tool in terms of the columns before it

    def unit(self, name: str) -> str:
        """Return the SI unit of a column."""
        return self.units[self.names.index(name)]

    def indices(self, names: Sequence[str]) -> Indices:
        """Return the indices of columns. Raises ProblemError for an unknown name."""
        at = {name: i for i, name in enumerate(self.names)}
        for name in names:
            if name not in at:
                raise ProblemError(f"{name!r} is not used by these observations; use a name of the rig that they use")
        return np.array([at[name] for name in names], dtype=np.intp)


class Cause(NamedTuple):
    """An item and the ways in which it can be off: "chuck.c1" with its coordinates, "bar.b46.zero", "joint2", "base"."""

    name: str
    numbers: tuple[str, ...]
    fault: Fault


class Circumstances(NamedTuple):
    """Circumstances in which n rows were measured: times [s] and temperatures [°C] (n,), NaN where unknown."""

    time: Floats
    temperature: Floats

    @classmethod
    def of(cls, table: ObservationTable) -> Circumstances:
        """Return those of a table's rows."""
        return cls(table.time, table.temperature)

    def __len__(self) -> int:
        return int(self.time.size)

    def during(self, drift: DriftWith, first: int, last: int) -> Floats | None:
        """Return the variable that a drift is linear in, for some rows; None if it is unknown or does not change.

        If the times are unknown, the order of the rows is used.
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
        """Return the effect for some of the rows."""
        return self._replace(profile=self.profile[rows])


def modelled_effects(causes: Sequence[Cause], effects: Sequence[Effect], rows: Circumstances) -> list[Modelled]:
    """Return the effects' parameters over the rows, one for each number of the item that is off.

    Raises InputError for an item that is not among the causes, for a form that it cannot have, and for missing rows.
    """
    out = []
    for effect in effects:
        known = [cause for cause in causes if cause.name == effect.what]
        if not known:
            names = ", ".join(cause.name for cause in causes)
            raise InputError(
                Argument("allow"),
                f" {effect}: no systematic error of {effect.what!r} can be estimated here; name one of {names}",
            )
        # The moment at which a drifting item was correct is unknown, so it also has an offset.
        for part in (effect, Effect(effect.what)) if effect.drifts_with else (effect,):
            out += [Modelled(part, number, profile(part, rows)) for number in known[0].numbers]
    return out


def profile(effect: Effect, rows: Circumstances) -> Floats:
    """Return the change (n,) of each row's prediction for one unit of the effect.

    Raises InputError for rows that do not exist, or in which the drift's variable is unknown.
    """
    n = len(rows)
    first, last = effect.first, n if effect.last is None else effect.last
    if not 0 <= first < last <= n:
        raise InputError(Argument("allow"), f" {effect}: the table has rows 1 to {n}")
    out = np.zeros(n)
    if effect.drifts_with is None:
        out[first:last] = 1.0
        return out
    along = rows.during(effect.drifts_with, first, last)
    if along is None:
        raise InputError(
            Argument("allow"),
            f" {effect}: rows {first + 1} to {last} have no {effect.drifts_with}, or it does not change",
        )
    out[first:last] = (along - (along.max() + along.min()) / 2.0) / np.ptp(along)
    return out


def error_columns(lin: Linearised, tool: Floats) -> Floats:
    """Return derivatives (w, n, c + t) of the predictions of ``Group.opened`` by rig, joints, base and tool (c, t)."""
    single = np.concatenate([lin.jac_rig, lin.by_joints, lin.wrenches[..., : len(BASE)]], axis=2)
    return np.concatenate([single, single @ tool], axis=2) if tool.size else single


def motion_of_tool(names: Sequence[str], points: Mapping[str, Floats]) -> Floats:
    """Return (c, 6) the columns that move the end, with all its ``points`` (x, y, z by name), in its own axes (TOOL)."""
    at = {name: i for i, name in enumerate(names)}
    out = np.zeros((len(names), len(TOOL)))
    for name, p_end in points.items():
        rows = [at[f"{name}.{k}"] for k in "xyz"]
        out[rows, :3], out[rows, 3:] = np.eye(3), np.cross(np.eye(3), p_end).T
    return out


@dataclass(frozen=True, kw_only=True)
class EffectRows(Group):
    """n observations of another group, with effects as the last parameters of x."""

    COMPONENTS = ()  # those of ``inner``, set per instance

    inner: Group
    tool: Floats  # (c, t) of ``Errors``
    columns: Indices  # (e,) of ``error_columns``
    profile: Floats  # (n, e)
    held: Floats | None = None  # (w, n, e) derivatives by the effects, if they are not those at x

    def __post_init__(self) -> None:
        object.__setattr__(self, "COMPONENTS", self.inner.COMPONENTS)

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n·w,) and their derivatives at x (P,), with derivatives by the effects taken at zero effects."""
        lin = self.opened(chain, x)
        return lin._replace(jac_rig=lin.jac_rig[:, :, : x.size - len(chain.parameters)])

    def opened(self, chain: Chain, x: Floats) -> Linearised:
        """Return the same as ``evaluate``, with derivatives by the known constants after the effects in ``jac_rig``."""
        size = x.size - self.columns.size
        lin = self.inner.opened(chain, x[:size])
        by_effects = self._by_effects(lin) if self.held is None else self.held
        unknown, known = np.split(lin.jac_rig, [size - len(chain.parameters)], axis=2)
        residual = lin.residual - (by_effects @ x[size:]).T.ravel()
        return lin._replace(residual=residual, jac_rig=np.concatenate([unknown, by_effects, known], axis=2))

    def _by_effects(self, lin: Linearised) -> Floats:
        """Return the derivatives (w, n, e) of the inner group's predictions by the effects."""
        return np.asarray(error_columns(lin, self.tool)[:, :, self.columns] * self.profile)

    def hold(self, chain: Chain, x: Floats) -> EffectRows:
        """Hold the derivatives by the effects: ``evaluate`` neglects that they change with x."""
        return replace(self, held=self._by_effects(self.inner.opened(chain, x[: x.size - self.columns.size])))

    def settle(self, chain: Chain, x: Floats) -> EffectRows:
        """Settle as ``inner`` does without effects."""
        return replace(self, inner=self.inner.settle(chain, x[: x.size - self.columns.size]))

    def orientations(self) -> Indices:
        """Return those of ``inner``."""
        return self.inner.orientations()

    def take(self, which: slice | NDArray[np.bool_] | NDArray[np.intp]) -> EffectRows:
        """Return some of the observations."""
        row = None if self.row is None else self.row[which]
        held = None if self.held is None else self.held[:, which]
        return replace(
            self,
            row=row,
            sensor_cov=self.sensor_cov[which],
            inner=self.inner.take(which),
            profile=self.profile[which],
            held=held,
        )


def with_effects(groups: Sequence[Group], tool: Floats, columns: Indices, profiles: Floats) -> tuple[Group, ...]:
    """Return the groups with effects (n_rows, e) as further parameters; knowledge that is not a row has no effects."""
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
