"""Systematic errors as additional parameters of a fit: items of the rig, joint readings or motions that were off.

Each row has the derivatives of its prediction by the numbers of the rig (known ones too) and by each joint reading. It
also has those by a motion of the robot's base, of the tool, or of a place of sockets. An effect is one or several of
these, times a profile over the rows: 1 where it applies; for a drift, the time or the box's temperature, scaled from −½
at the lowest to ½ at the highest. Its parameter has the unit of what is off: metres for a bar's zero, radians for a
joint.

The score test uses these derivatives. A fit with effects as parameters evaluates each row with its items displaced.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError, ProblemError
from truearm.estimate.circumstances import Circumstances
from truearm.kinds.group import Fault, Group, GroupOfOther, KindFault, Linearised
from truearm.model.chain import Chain
from truearm.model.law_chain import carries
from truearm.model.transforms import Element, left_jacobian, pose_of, six_of
from truearm.results import Effect
from truearm.types import Floats, Indices, Mask, Payload

# First columns of ``Linearised.wrenches``: force and couple on each axis of the base frame, derivatives by its
# displacement.
BASE = (("base.x", "m"), ("base.rx", "rad"), ("base.y", "m"), ("base.ry", "rad"), ("base.z", "m"), ("base.rz", "rad"))
MOTION = (("x", "m"), ("y", "m"), ("z", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))  # of several points together
MOVED = Fault(slice(None), constant=False)  # base, tool or joint: a constant error is a parameter of the robot


class Errors(NamedTuple):
    """What a prediction can be off by to first order: names and SI units of the columns of ``error_columns``."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    bodies: Floats = np.zeros((0, 0))  # (c, t) motions of tool and places in terms of the columns before them

    def indices(self, names: Sequence[str]) -> Indices:
        """Return the indices of columns. Raises ProblemError for an unknown name."""
        index = {name: i for i, name in enumerate(self.names)}
        for name in names:
            if name not in index:
                raise ProblemError(f"{name!r} is not used by these observations; use a name of the rig that they use")
        return np.array([index[name] for name in names], dtype=np.intp)


class Cause(NamedTuple):
    """An item and how it can be off: "chuck.c1" with its coordinates, "bar.b46.zero", "joint2", "base"."""

    name: str
    numbers: tuple[str, ...]
    fault: Fault
    is_joint: bool = False


class Modelled(NamedTuple):
    """An effect that is a parameter of a problem: its name, its column, and its profile over the rows."""

    effect: Effect
    column: str
    profile: Floats  # (n,)

    def select(self, rows: Mask | Indices | slice) -> Modelled:
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
    """Return derivatives (w, n, c + t) of the predictions of ``Group.opened``.

    They are by rig, joints, base and ``Errors.bodies`` (c, t).
    """
    single = np.concatenate([lin.jac_rig, lin.by_joints, lin.wrenches[..., : len(BASE)]], axis=2)
    return np.concatenate([single, single @ bodies], axis=2) if bodies.size else single


def motion_of_body(names: Sequence[str], points: Mapping[str, Floats], about: Floats) -> Floats:
    """Return the columns (c, 6) that move ``points`` (x, y, z by name) together, as MOTION, turned ``about`` (3,)."""
    index = {name: i for i, name in enumerate(names)}
    out = np.zeros((len(names), len(MOTION)))
    for name, point in points.items():
        rows = [index[f"{name}.{k}"] for k in "xyz"]
        out[rows, :3], out[rows, 3:] = np.eye(3), np.cross(np.eye(3), point - about).T
    return out


@dataclass(frozen=True, kw_only=True)
class EffectRows(GroupOfOther):
    """n observations of another group under one payload, with effects as the last parameters of x.

    They are evaluated with their items displaced by the ``whole`` effects, because an item that is centimetres off
    changes a length by tenths of a millimetre more than its derivative says. All rows have these to the same extent.
    The other effects (drifts, and joints, which are off by milliradians) are linear.
    """

    SHARED = ("constants", "payload", "bodies", "columns", "whole")

    payload: Payload | None = None  # None: that of the chain
    bodies: Floats  # (c, t) of ``Errors``
    columns: Indices  # (e,) of ``error_columns``
    whole: NDArray[np.bool_]  # (e,)
    profile: Floats  # (n, e)
    held: Floats | None = None  # (n, w, e) derivatives by the linear effects, if they are not those at x

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n·w,) and their derivatives at x (P,)."""
        if not self.columns.size:
            return self.inner.evaluate(self._loaded(chain), x)
        lin = self.opened(chain, x)
        return lin._replace(jac_rig=lin.jac_rig[:, :, : x.size - len(chain.parameters)])

    def opened(self, chain: Chain, x: Floats) -> Linearised:
        """Return the same as ``evaluate``, with derivatives by the known constants after the effects in ``jac_rig``."""
        if not self.columns.size:
            return self.inner.opened(self._loaded(chain), x)
        lin, by_effects = self._displaced(chain, x)
        size, linear = x.size - self.columns.size, ~self.whole
        if self.held is not None:
            by_effects[:, :, linear] = self.held.swapaxes(0, 1)[:, :, linear]
        unknown, fixed = np.split(lin.jac_rig, [size - len(chain.parameters)], axis=2)
        residual = lin.residual - (by_effects[:, :, linear] @ x[size:][linear]).T.ravel()
        return lin._replace(residual=residual, jac_rig=np.concatenate([unknown, by_effects, fixed], axis=2))

    def _displaced(self, chain: Chain, x: Floats) -> tuple[Linearised, Floats]:
        """Return the inner group, its items displaced by whole effects, and derivatives (w, n, e) by all effects."""
        inside, off = np.split(x, [x.size - self.columns.size])
        amount = np.where(self.whole, off * self.profile[0], 0.0)
        lin, errors = _with_items_off(self.inner, self._loaded(chain), inside, self.bodies, self.columns, amount)
        return lin, errors[:, :, self.columns] * self.profile

    def _loaded(self, chain: Chain) -> Chain:
        return chain if self.payload is None else carries(chain, self.payload)

    def hold(self, chain: Chain, x: Floats) -> EffectRows:
        """Hold the derivatives by the linear effects: ``evaluate`` neglects that they change with x."""
        return self if self.whole.all() else replace(self, held=self._displaced(chain, x)[1].swapaxes(0, 1))

    def settle(self, chain: Chain, x: Floats) -> EffectRows:
        """Settle as ``inner`` does without effects."""
        return replace(self, inner=self.inner.settle(self._loaded(chain), x[: x.size - self.columns.size]))

    def faults(self, chain: Chain, x: Floats) -> list[KindFault]:
        """Return those of ``inner`` without effects."""
        return self.inner.faults(self._loaded(chain), x[: x.size - self.columns.size])


def _with_items_off(
    group: Group, chain: Chain, x: Floats, bodies: Floats, columns: Indices, amount: Floats
) -> tuple[Linearised, Floats]:
    """Return a group with items off by an ``amount`` (e,) of some ``columns`` of its ``error_columns``, and these then.

    The numbers of the rig are other numbers. The base is moved by a rotation vector about its origin, then displaced:
    the chain begins with that motion. A motion of the tool or a place moves each of its points as its derivatives say.
    """
    p, joints = len(chain.parameters), len(chain.joints)
    rig = x.size - p + group.constants.size
    motion = np.zeros(rig + joints + len(BASE) + bodies.shape[1])
    np.add.at(motion, columns, amount)
    off = motion[:rig] + (bodies[:rig] @ motion[rig + joints + len(BASE) :] if bodies.size else 0.0)
    unknown, fixed = np.split(off, [x.size - p])
    displaced = np.concatenate([x[:p], x[p:] + unknown])
    group = replace(group, constants=group.constants + fixed) if fixed.any() else group
    shift, turn = motion[rig + joints :][: len(BASE)].reshape(-1, 2).T
    if shift.any() or turn.any():
        chain = replace(chain, elements=(*_moved_by(shift, turn), *chain.elements))
    lin = group.opened(chain, displaced)
    by_base = lin.wrenches[..., : len(BASE)].copy()
    force, moment = by_base[..., ::2], by_base[..., 1::2]
    by_base[..., 1::2] = (moment - np.cross(shift, force)) @ left_jacobian(turn)
    return lin, error_columns(lin._replace(wrenches=by_base), bodies)


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
    effects: Mapping[str, Any] = {"bodies": bodies, "columns": columns, "whole": whole}
    setting = np.unique(profiles[:, whole], axis=0, return_inverse=True)[1].ravel()
    return tuple(
        replace(group, profile=profiles[group.row], **effects)
        if isinstance(group, EffectRows)
        else EffectRows.around(
            group,
            profile=np.zeros((len(group.sensor_cov), columns.size)) if group.row is None else profiles[group.row],
            **effects,
        )
        for group in _split(groups, setting)
    )


def with_payloads(groups: Sequence[Group], payloads: Sequence[Payload]) -> tuple[Group, ...]:
    """Return the groups under the payloads of their rows (n_rows,); knowledge that is not a row has none."""
    nothing: Mapping[str, Any] = {
        "bodies": np.zeros((0, 0)),
        "columns": np.zeros(0, np.intp),
        "whole": np.zeros(0, bool),
    }
    different = {payload: k for k, payload in enumerate(dict.fromkeys(payloads))}
    number = np.array([different[payload] for payload in payloads], dtype=np.intp)
    return tuple(
        group
        if group.row is None
        else EffectRows.around(group, payload=payloads[group.row[0]], profile=np.zeros((len(group.row), 0)), **nothing)
        for group in _split(groups, number)
    )


def _split(groups: Sequence[Group], number: Indices) -> Iterator[Group]:
    """Return the groups split by the numbers (n_rows,) of their rows."""
    for group in groups:
        numbers = np.zeros(len(group.sensor_cov), dtype=np.intp) if group.row is None else number[group.row]
        for k in np.unique(numbers):
            yield group.take(numbers == k)
