"""A problem: one robot, the rig around it and a table of observations, with every unknown named.

The parameter vector x (P,) is the robot's params followed by the rig's unknowns, in this order: ``chuck.<name>.x .y
.z``, ``sphere.<name>.x .y .z``, ``bar.<name>.zero .gain``, ``socket.<place>.<socket>.x .y .z``. Of chucks, spheres and
bars only those that a row uses, and of these only what the rig does not know exactly. Sockets are always unknown; they
start at the mean of the ball's positions that the nominal robot predicts.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from truearm.errors import ProblemError
from truearm.model.chain import Chain, point_forward
from truearm.observe import ball_bar, seat, socket_distance
from truearm.observe.ball_bar import BallBarRows
from truearm.observe.rows import Indices, Linearised, take
from truearm.observe.seat import SeatRows
from truearm.observe.socket_distance import SocketDistanceRows
from truearm.types import BallBar, Floats, ObservationTable, Point, Rig, Strings

BLOCK = 2048  # observations evaluated at once: a Jacobian of 54 columns fills 1 MB, about the second-level cache
XYZ = ("x", "y", "z")
Group = BallBarRows | SeatRows | SocketDistanceRows


@dataclass(frozen=True)
class Problem:
    """Observations compiled against x; ``prior_sigma`` is inf where x has no prior, whose mean is ``start``."""

    chain: Chain
    names: tuple[str, ...]  # P
    units: tuple[str, ...]  # P
    start: Floats  # (P,)
    prior_sigma: Floats  # (P,)
    groups: tuple[Group, ...]
    n_rows: int  # of the table

    @property
    def n_robot(self) -> int:
        return len(self.chain.parameters)


class _Unknown(NamedTuple):
    """A number of the rig: known exactly (sigma 0), with a prior, or without (inf)."""

    name: str
    unit: str
    value: float
    sigma: float


class _Used(NamedTuple):
    """What a set of rows uses: the distinct things and, a row, which of them."""

    values: list[list[_Unknown]]  # one inner list a thing
    which: Indices  # (n,)


def build_problem(
    chain: Chain, rig: Rig, table: ObservationTable, prior_sigma: Mapping[str, float] | Floats | None = None
) -> Problem:
    """Compile a table. ``prior_sigma``: σ of robot parameters by name, or (p,) with inf for none.

    Raises ProblemError for joint readings that do not fit the robot, for unknown kinds, chucks, spheres or bars (naming
    the row), for missing lengths and for σ that are not positive.
    """
    _check_joints(chain, table)
    bars = np.flatnonzero(table.kind == "ball_bar")
    seats = np.flatnonzero(table.kind == "seat")
    if len(bars) + len(seats) < len(table):
        row = int(np.flatnonzero(~np.isin(table.kind, ("ball_bar", "seat")))[0])
        raise ProblemError(f"{table.source[row]}: kind {str(table.kind[row])!r} is not known; use ball_bar or seat")
    chucks = _use(table, bars, table.chuck, rig.chucks, "chuck")
    spheres = _use(table, bars, table.sphere, rig.spheres, "sphere")
    balls = _use(table, seats, table.sphere, rig.spheres or {"": Point("", (0.0, 0.0, 0.0))}, "sphere")
    scales = _use(table, bars, table.bar, rig.bars, "bar")
    sockets = _sockets(chain, table, seats, balls)
    layout = _Layout(len(chain.parameters), [chucks, spheres, balls, scales, sockets])
    groups: list[Group] = []
    if bars.size:
        groups.append(_ball_bar_rows(table, rig, bars, chucks, spheres, scales, layout))
    if seats.size:
        groups.append(_seat_rows(table, rig, seats, balls, sockets, layout))
        groups += _distance_rows(rig, sockets, layout)
    free = layout.unknown
    prior = np.concatenate([robot_prior(chain, prior_sigma), [u.sigma for u in free]])
    start = np.concatenate([chain.params_nominal, [u.value for u in free]])
    names = (*chain.parameter_names, *(u.name for u in free))
    units = (*(p.unit for p in chain.parameters), *(u.unit for u in free))
    return Problem(chain, names, units, start, prior, tuple(groups), len(table))


def robot_prior(chain: Chain, prior_sigma: Mapping[str, float] | Floats | None) -> Floats:
    """(p,) standard deviations, inf for none. Raises ProblemError for unknown names or values that are not positive."""
    n = len(chain.parameters)
    if prior_sigma is None:
        return np.full(n, np.inf)
    if isinstance(prior_sigma, Mapping):
        unknown = sorted(set(prior_sigma) - set(chain.parameter_names))
        if unknown:
            raise ProblemError(f"prior for {unknown[0]!r}, which robot {chain.name} does not have")
        out = np.array([prior_sigma.get(name, np.inf) for name in chain.parameter_names], dtype=float)
    else:
        out = np.asarray(prior_sigma, dtype=float)
    if out.shape != (n,) or not (out > 0.0).all():
        raise ProblemError(
            f"prior σ must be {n} positive numbers, inf for no prior; to hold a parameter do not free it"
        )
    return out


def blocks(problem: Problem, size: int = BLOCK) -> Iterator[Group]:
    """The problem's observations, at most ``size`` at once."""
    for group in problem.groups:
        for at in range(0, len(group.sigma), size):
            yield take(group, slice(at, at + size))


def evaluate(problem: Problem, group: Group, x: Floats) -> Linearised:
    """Residuals and derivatives of a block at x."""
    if isinstance(group, BallBarRows):
        return ball_bar.evaluate(problem.chain, group, x)
    if isinstance(group, SeatRows):
        return seat.evaluate(problem.chain, group, x)
    return socket_distance.evaluate(problem.chain, group, x)


def settled(problem: Problem, x: Floats) -> Problem:
    """The problem with its seats settled (``seat.settle``), to count what its observations can see at x."""
    groups = (seat.settle(problem.chain, g, x) if isinstance(g, SeatRows) else g for g in problem.groups)
    return replace(problem, groups=tuple(groups))


class _Layout:
    """Where each number of the rig stands: unknowns follow the robot's p, constants follow the unknowns."""

    def __init__(self, n_robot: int, used: Sequence[_Used]) -> None:
        every = {u.name: u for group in used for thing in group.values for u in thing}
        self.unknown = [u for u in every.values() if u.sigma > 0.0]
        known = [u for u in every.values() if u.sigma == 0.0]
        self.constants = np.array([u.value for u in known])
        self._at = {u.name: n_robot + i for i, u in enumerate([*self.unknown, *known])}

    def index(self, used: _Used) -> Indices:
        """(n, c) indices of what each row uses."""
        table = np.array([[self._at[u.name] for u in thing] for thing in used.values], dtype=np.intp)
        return np.asarray(table[used.which])


def _check_joints(chain: Chain, table: ObservationTable) -> None:
    if table.q.shape[1] != len(chain.joints):
        raise ProblemError(f"the table has {table.q.shape[1]} joints, robot {chain.name} has {len(chain.joints)}")
    bad = np.flatnonzero(~np.isfinite(table.q).all(axis=1))
    if bad.size:
        raise ProblemError(f"{table.source[bad[0]]}: a joint reading is not a finite number")


def _number(labels: Sequence[Hashable]) -> tuple[list[Hashable], Indices]:
    """Distinct labels in order of appearance, and which of them each row has."""
    order: dict[Hashable, int] = {}
    which = np.array([order.setdefault(label, len(order)) for label in labels], dtype=np.intp)
    return list(order), which


def _use(
    table: ObservationTable,
    rows: Indices,
    column: Strings,
    known: Mapping[str, Point] | Mapping[str, BallBar],
    what: str,
) -> _Used:
    """Look a column's names up in the rig; an empty name means the only one there is."""
    names, which = _number(column[rows].tolist())
    values = []
    for i, name in enumerate(names):
        found: Point | BallBar | None = known.get(str(name))
        if found is None and not name and len(known) == 1:
            (found,) = known.values()
        if found is None:
            source = table.source[rows[int(np.argmax(which == i))]]
            have = ", ".join(sorted(known)) or "none"
            raise ProblemError(f"{source}: {what} {str(name)!r} is not in the rig, which has {have}")
        values.append(_bar(found) if isinstance(found, BallBar) else _point(found, what))
    return _Used(values, which)


def _point(point: Point, what: str) -> list[_Unknown]:
    sigma = np.inf if point.sigma is None else point.sigma
    return [_Unknown(f"{what}.{point.name}.{k}", "m", v, sigma) for k, v in zip(XYZ, point.xyz, strict=True)]


def _bar(bar: BallBar) -> list[_Unknown]:
    return [
        _Unknown(f"bar.{bar.name}.zero", "m", bar.zero, bar.zero_sigma),
        _Unknown(f"bar.{bar.name}.gain", "1", bar.gain, bar.gain_sigma),
    ]


def _sockets(chain: Chain, table: ObservationTable, rows: Indices, balls: _Used) -> _Used:
    """The sockets of the seat rows, each at the mean of the ball's predicted positions."""
    labels = list(zip(table.place[rows].tolist(), table.socket[rows].tolist(), strict=True))
    names, which = _number(labels)
    if not labels:
        return _Used([], which)
    p_end_ball = np.array([[u.value for u in ball] for ball in balls.values])[balls.which]
    p_base_ball = point_forward(chain, chain.params_nominal, table.q[rows], p_end_ball)
    total = np.zeros((len(names), 3))
    np.add.at(total, which, p_base_ball)
    mean = total / np.bincount(which)[:, None]
    values = []
    for label, xyz in zip(dict.fromkeys(labels), mean, strict=True):
        name = ".".join(("socket", *(part for part in label if part)))
        values.append([_Unknown(f"{name}.{k}", "m", float(v), np.inf) for k, v in zip(XYZ, xyz, strict=True)])
    return _Used(values, which)


def _ball_bar_rows(
    table: ObservationTable, rig: Rig, rows: Indices, chucks: _Used, spheres: _Used, scales: _Used, layout: _Layout
) -> BallBarRows:
    length = table.value[rows]
    bad = np.flatnonzero(~np.isfinite(length))
    if bad.size:
        raise ProblemError(f"{table.source[rows[bad[0]]]}: a ball_bar row needs a length")
    declared = np.array([[u.value for u in bar] for bar in scales.values])[scales.which]
    by_name = {f"bar.{bar.name}.zero": bar.sigma for bar in rig.bars.values()}
    sigma = np.array([by_name[bar[0].name] for bar in scales.values])[scales.which]
    return BallBarRows(
        row=rows,
        sigma=_sigma(table, rows, sigma),
        q=table.q[rows],
        length=length,
        sphere=layout.index(spheres),
        chuck=layout.index(chucks),
        scale=layout.index(scales),
        declared=declared,
        constants=layout.constants,
    )


def _seat_rows(
    table: ObservationTable, rig: Rig, rows: Indices, balls: _Used, sockets: _Used, layout: _Layout
) -> SeatRows:
    sigma = _sigma(table, rows, np.full(len(rows), rig.seat_sigma))
    return SeatRows(rows, sigma, table.q[rows], layout.index(balls), layout.index(sockets), layout.constants)


def _distance_rows(rig: Rig, sockets: _Used, layout: _Layout) -> list[SocketDistanceRows]:
    """A row for every place where both sockets of a declared distance were used."""
    names = {thing[0].name.removesuffix(".x"): i for i, thing in enumerate(sockets.values)}
    places = {name.removeprefix("socket").rpartition(".")[0] for name in names}
    pairs = []
    for known in rig.socket_distances:
        for place in sorted(places):
            a, b = (f"socket{place}.{socket}" for socket in known.sockets)
            if a in names and b in names:
                pairs.append((names[a], names[b], known.distance, known.sigma))
    if not pairs:
        return []
    first, second = (layout.index(_Used(sockets.values, np.array([p[k] for p in pairs]))) for k in (0, 1))
    distance, sigma = np.array([p[2:] for p in pairs]).T
    if not (sigma > 0.0).all():
        raise ProblemError("a socket distance needs a positive sigma")
    return [SocketDistanceRows(sigma, distance, first, second, layout.constants)]


def _sigma(table: ObservationTable, rows: Indices, default: Floats) -> Floats:
    """The rows' own σ, the rig's where they have none."""
    sigma = np.where(np.isnan(table.sigma[rows]), default, table.sigma[rows])
    bad = np.flatnonzero(~((sigma > 0.0) & np.isfinite(sigma)))
    if bad.size:
        raise ProblemError(f"{table.source[rows[bad[0]]]}: sigma must be positive, is {sigma[bad[0]]:g} m")
    return np.asarray(sigma)
