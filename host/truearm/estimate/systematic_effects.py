"""Systematic errors as additional parameters of a fit: items of the rig, joint readings or motions that were off.

Each row has the derivatives of its prediction by the numbers of the rig (known ones too) and by each joint reading. It
also has those by a motion of the robot's base, of the tool, or of a place of sockets. An effect is one or several of
these, times a profile over the rows: 1 where it applies; for a drift, the time or the box's temperature, scaled from −½
at the lowest to ½ at the highest. Its parameter has the unit of what is off: metres for a bar's zero, radians for a
joint.

The score test uses these derivatives. A fit with effects as parameters evaluates each row with its items displaced.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError, ProblemError
from truearm.estimate.circumstances import Circumstances
from truearm.kinds.group import Group, GroupOfOther, KindFault
from truearm.kinds.linearised import Linearised
from truearm.kinds.unknowns import Fault
from truearm.model.chain import Chain
from truearm.model.poses import pose_of, six_of
from truearm.model.rotation import left_jacobian, rotation
from truearm.model.transforms import Element
from truearm.results import Effect
from truearm.types import Floats, Indices, Mask

# First columns of ``Linearised.wrenches``: force and couple on each axis of the base frame, derivatives by its
# displacement.
BASE = (("base.x", "m"), ("base.rx", "rad"), ("base.y", "m"), ("base.ry", "rad"), ("base.z", "m"), ("base.rz", "rad"))
MOTION = (("x", "m"), ("y", "m"), ("z", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))  # of several points together
MOVED = Fault(slice(None), constant=False)  # base or tool: a constant pose error is a parameter of the robot
JUMPED = Fault(
    slice(None), constant=False, step=False, window=True, moved=True
)  # a joint's offset is a parameter of the robot


class Errors(NamedTuple):
    """Everything by which a prediction can be off to first order: names and SI units of the columns of ``error_columns``."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    bodies: Floats = np.zeros((0, 0))  # (c, t) motions of tool and places in terms of the columns before them

    def unit(self, name: str) -> str:
        """Return the SI unit of a column."""
        return self.units[self.names.index(name)]

    def indices(self, names: Sequence[str]) -> Indices:
        """Return the indices of columns. Raises ProblemError for an unknown name."""
        index = {name: i for i, name in enumerate(self.names)}
        for name in names:
            if name not in index:
                raise ProblemError(f"{name!r} is not used by these observations; use a name of the rig that they use")
        return np.array([index[name] for name in names], dtype=np.intp)


class Cause(NamedTuple):
    """An item and the ways in which it can be off: "chuck.c1" with its coordinates, "bar.b46.zero", "joint2", "base"."""

    name: str
    numbers: tuple[str, ...]
    fault: Fault


class Modelled(NamedTuple):
    """An effect that is a parameter of a problem: its name, its column, and its profile over the rows."""

    effect: Effect
    column: str
    profile: Floats  # (n,)

    def select(self, rows: Mask | Indices) -> Modelled:
        """Return the effect for some of the rows."""
        return self._replace(profile=self.profile[rows])


def modelled_effects(causes: Sequence[Cause], effects: Sequence[Effect], rows: Circumstances) -> list[Modelled]:
    """Return the effects' parameters over the rows, one for each number of the item that is off.

    Raises InputError for an item that is not among the causes, for a form that it cannot have, and for missing rows.
    """
    out = []
    for effect in effects:
        cause = next((cause for cause in causes if cause.name == effect.what), None)
        if cause is None:
            names = ", ".join(cause.name for cause in causes)
            raise InputError(
                Argument("apply"),
                f" {effect}: no systematic error of {effect.what!r} can be estimated here; name one of {names}",
            )
        # The moment at which a drifting item was correct is unknown, so it also has an offset. That of base, tool or
        # joint is a parameter of the robot already.
        drifts = effect.drifts_with is not None and effect.drifts_with.has_offset
        offset = (Effect(effect.what),) if drifts and cause.fault.constant else ()
        for term in (effect, *offset):
            out += [Modelled(term, number, profile(term, rows)) for number in cause.numbers]
    return out


def profile(effect: Effect, rows: Circumstances) -> Floats:
    """Return the change (n,) of each row's prediction for one unit of the effect.

    Raises InputError for rows that do not exist, or in which the drift's variable is unknown.
    """
    n = len(rows)
    first, last = effect.first, n if effect.last is None else effect.last
    if not 0 <= first < last <= n:
        raise InputError(Argument("apply"), f" {effect}: the table has rows 1 to {n}")
    out = np.zeros(n)
    if effect.drifts_with is None:
        out[first:last] = 1.0
        return out
    along = rows.during(effect.what, effect.drifts_with, first, last)
    if along is None:
        raise InputError(
            Argument("apply"),
            f" {effect}: rows {first + 1} to {last} have no {effect.drifts_with}, or it does not change",
        )
    out[first:last] = (along - (along.max() + along.min()) / 2.0) / np.ptp(along)
    return out


def error_columns(lin: Linearised, bodies: Floats) -> Floats:
    """Return derivatives (w, n, c + t) of the predictions of ``Group.opened`` by rig, joints, base and ``Errors.bodies`` (c, t)."""
    single = np.concatenate([lin.jac_rig, lin.by_joints, lin.wrenches[..., : len(BASE)]], axis=2)
    return np.concatenate([single, single @ bodies], axis=2) if bodies.size else single


def motion_of_body(names: Sequence[str], points: Mapping[str, Floats], about: Floats) -> Floats:
    """Return (c, 6) the columns that move some ``points`` (x, y, z by name) together, as MOTION, turned ``about`` (3,)."""
    index = {name: i for i, name in enumerate(names)}
    out = np.zeros((len(names), len(MOTION)))
    for name, point in points.items():
        rows = [index[f"{name}.{k}"] for k in "xyz"]
        out[rows, :3], out[rows, 3:] = np.eye(3), np.cross(np.eye(3), point - about).T
    return out


@dataclass(frozen=True, kw_only=True)
class EffectRows(GroupOfOther):
    """n observations of another group, with effects as the last parameters of x.

    Rows with the same items off, and by the whole effect, have one ``setting``. They are evaluated with these items
    displaced, because an item that is centimetres off changes a length by tenths of a millimetre more than its
    derivative says. Effects that are not ``whole`` (drifts, and joints, which are off by milliradians) are linear.
    """

    SHARED = ("constants", "bodies", "columns", "whole")

    bodies: Floats  # (c, t) of ``Errors``
    columns: Indices  # (e,) of ``error_columns``
    whole: NDArray[np.bool_]  # (e,)
    profile: Floats  # (n, e)
    setting: Indices  # (n,) the same for rows with the same profile of the whole effects
    held: Floats | None = None  # (n, w, e) derivatives by the linear effects, if they are not those at x

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n·w,) and their derivatives at x (P,)."""
        lin = self.opened(chain, x)
        return lin._replace(jac_rig=lin.jac_rig[:, :, : x.size - len(chain.parameters)])

    def opened(self, chain: Chain, x: Floats) -> Linearised:
        """Return the same as ``evaluate``, with derivatives by the known constants after the effects in ``jac_rig``."""
        size = x.size - self.columns.size
        lin, by_effects = self._displaced(chain, x)
        linear = ~self.whole
        if self.held is not None:
            by_effects[:, :, linear] = self.held.swapaxes(0, 1)[:, :, linear]
        unknown, fixed = np.split(lin.jac_rig, [size - len(chain.parameters)], axis=2)
        residual = lin.residual - (by_effects[:, :, linear] @ x[size:][linear]).T.ravel()
        return lin._replace(residual=residual, jac_rig=np.concatenate([unknown, by_effects, fixed], axis=2))

    def _displaced(self, chain: Chain, x: Floats) -> tuple[Linearised, Floats]:
        """Return the inner group with the items displaced by the whole effects, and derivatives (w, n, e) by all effects."""
        inside, off = np.split(x, [x.size - self.columns.size])
        pieces, row_sets = [], []
        for number in np.unique(self.setting):
            rows = np.flatnonzero(self.setting == number)
            amount = np.where(self.whole, off * self.profile[rows[0]], 0.0)
            lin, errors = _with_items_off(self.inner.take(rows), chain, inside, self.bodies, self.columns, amount)
            pieces.append((lin, errors[:, :, self.columns] * self.profile[rows]))
            row_sets.append(rows)
        if len(pieces) == 1:
            return pieces[0]
        order = np.argsort(np.concatenate(row_sets))
        wrenches, jac_rig, by_joints, by_effects = (
            np.concatenate(arrays, axis=1)[:, order]
            for arrays in zip(*((lin.wrenches, lin.jac_rig, lin.by_joints, by) for lin, by in pieces), strict=True)
        )
        residual = np.concatenate([lin.residual.reshape(lin.wrenches.shape[1], -1) for lin, _ in pieces])[order]
        return Linearised(residual.ravel(), wrenches, pieces[0][0].twists, jac_rig, by_joints), by_effects

    def hold(self, chain: Chain, x: Floats) -> EffectRows:
        """Hold the derivatives by the linear effects: ``evaluate`` neglects that they change with x."""
        return self if self.whole.all() else replace(self, held=self._displaced(chain, x)[1].swapaxes(0, 1))

    def settle(self, chain: Chain, x: Floats) -> EffectRows:
        """Settle as ``inner`` does without effects."""
        return replace(self, inner=self.inner.settle(chain, x[: x.size - self.columns.size]))

    def faults(self, chain: Chain, x: Floats) -> list[KindFault]:
        """Return those of ``inner`` without effects."""
        return self.inner.faults(chain, x[: x.size - self.columns.size])


def _with_items_off(
    group: Group, chain: Chain, x: Floats, bodies: Floats, columns: Indices, amount: Floats
) -> tuple[Linearised, Floats]:
    """Return a group with items off by an ``amount`` (e,) of some ``columns`` of its ``error_columns``; and these at it.

    The numbers of the rig are other numbers. The base is moved by a rotation vector about its origin, then displaced:
    the chain begins with that motion. Its wrenches at the origin are returned in the axes of the base before it, as the
    chain's ``twists`` need them. A motion of the tool or a place moves each of its points as its derivatives say.
    """
    p, joints = len(chain.parameters), len(chain.joints)
    rig = x.size - p + group.constants.size
    motion = np.zeros(rig + joints + len(BASE) + bodies.shape[1])
    np.add.at(motion, columns, amount)
    off = motion[:rig] + (bodies[:rig] @ motion[rig + joints + len(BASE) :] if bodies.size else 0.0)
    unknown, fixed = np.split(off, [x.size - p])
    displaced = np.concatenate([x[:p], x[p:] + unknown])
    group = replace(group, constants=group.constants + fixed) if fixed.any() else group
    base = motion[rig + joints :][: len(BASE)]
    if not base.any():
        lin = group.opened(chain, displaced)
        return lin, error_columns(lin, bodies)
    shift, turn = base[::2], base[1::2]
    lin = group.opened(replace(chain, elements=(*_moved_by(shift, turn), *chain.elements)), displaced)
    force, moment = lin.wrenches[..., : len(BASE) : 2], lin.wrenches[..., 1 : len(BASE) : 2]
    moment = moment - np.cross(shift, force)
    by_base, of_base, rot = np.empty((*force.shape[:2], 6)), lin.wrenches.copy(), rotation(turn)
    by_base[..., ::2], by_base[..., 1::2] = force, moment @ left_jacobian(turn)
    of_base[..., : len(BASE) : 2], of_base[..., 1 : len(BASE) : 2] = force @ rot, moment @ rot
    errors = error_columns(lin._replace(wrenches=by_base), bodies)
    return lin._replace(wrenches=of_base, twists=group.take(slice(0, 1)).opened(chain, displaced).twists), errors


def _moved_by(shift: Floats, turn: Floats) -> tuple[Element, ...]:
    """Return elements that turn by a rotation vector (3,), and then displace by (3,)."""
    x, y, z, yaw, pitch, roll = six_of(pose_of(shift[None], turn[None])[0])
    amounts = {"tx": x, "ty": y, "tz": z, "rz": yaw, "ry": pitch, "rx": roll}
    return tuple(Element(motion, value) for motion, value in amounts.items())


def with_effects(
    groups: Sequence[Group], bodies: Floats, columns: Indices, profiles: Floats, whole: NDArray[np.bool_]
) -> tuple[Group, ...]:
    """Return the groups with effects (n_rows, e) as further parameters; knowledge that is not a row has no effects.

    ``whole`` (e,) are those that displace items; their profiles are 0 or 1.
    """
    setting = np.unique(profiles[:, whole], axis=0, return_inverse=True)[1].ravel()
    return tuple(
        EffectRows.around(
            group,
            bodies=bodies,
            columns=columns,
            whole=whole,
            profile=np.zeros((len(group.sensor_cov), columns.size)) if group.row is None else profiles[group.row],
            setting=np.zeros(len(group.sensor_cov), dtype=np.intp) if group.row is None else setting[group.row],
        )
        for group in groups
    )
