"""A problem: one robot, the rig around it and a table of observations, with every unknown named.

The parameter vector x (P,) is the robot's params followed by the rig's unknowns, in this order: ``chuck.<name>.x .y
.z``, ``sphere.<name>.x .y .z``, ``bar.<name>.zero .gain``, ``socket.<place>.<socket>.x .y .z``. Of chucks, spheres and
bars only those that a row uses, and of these only what the rig does not know exactly. Sockets are always unknown; they
start at the mean of the ball's positions that the nominal robot predicts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from truearm.errors import ProblemError
from truearm.estimate.layout import Layout, Used, enumerate_labels, unknown_point, use
from truearm.estimate.prior import robot_prior
from truearm.model.chain import Chain, point_forward
from truearm.observe import ball_bar, seat, socket_distance
from truearm.observe.ball_bar import BallBarRows
from truearm.observe.rows import Indices, Linearised, take
from truearm.observe.seat import SeatRows
from truearm.observe.socket_distance import SocketDistanceRows
from truearm.types import Floats, ObservationTable, Point, Rig

BLOCK = 2048  # observations evaluated at once: a Jacobian of 54 columns fills 1 MB, about the second-level cache
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
    chucks = use(table, bars, table.chuck, rig.chucks, "chuck")
    spheres = use(table, bars, table.sphere, rig.spheres, "sphere")
    balls = use(table, seats, table.sphere, rig.spheres or {"": Point("", (0.0, 0.0, 0.0))}, "sphere")
    scales = use(table, bars, table.bar, rig.bars, "bar")
    sockets = _sockets(chain, table, seats, balls)
    layout = Layout(len(chain.parameters), [chucks, spheres, balls, scales, sockets])
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


def _check_joints(chain: Chain, table: ObservationTable) -> None:
    if table.q.shape[1] != len(chain.joints):
        raise ProblemError(f"the table has {table.q.shape[1]} joints, robot {chain.name} has {len(chain.joints)}")
    bad = np.flatnonzero(~np.isfinite(table.q).all(axis=1))
    if bad.size:
        raise ProblemError(f"{table.source[bad[0]]}: a joint reading is not a finite number")


def _sockets(chain: Chain, table: ObservationTable, rows: Indices, balls: Used) -> Used:
    """The sockets of the seat rows, by (place, socket), each at the mean of the ball's predicted positions."""
    labels, which = enumerate_labels(list(zip(table.place[rows].tolist(), table.socket[rows].tolist(), strict=True)))
    if not labels:
        return Used([], [], which)
    names = [".".join(("socket", *(part for part in label if part))) for label in labels if isinstance(label, tuple)]
    if len(set(names)) < len(names):
        raise ProblemError(f"two sockets would both be called {max(names, key=names.count)}; rename places or sockets")
    p_end_ball = np.array([[number.value for number in ball] for ball in balls.numbers])[balls.which]
    p_base_ball = point_forward(chain, chain.params_nominal, table.q[rows], p_end_ball)
    total = np.zeros((len(names), 3))
    np.add.at(total, which, p_base_ball)
    mean = total / np.bincount(which)[:, None]
    return Used(labels, [unknown_point(name, xyz) for name, xyz in zip(names, mean, strict=True)], which)


def _ball_bar_rows(
    table: ObservationTable, rig: Rig, rows: Indices, chucks: Used, spheres: Used, scales: Used, layout: Layout
) -> BallBarRows:
    length = table.value[rows]
    bad = np.flatnonzero(~np.isfinite(length))
    if bad.size:
        raise ProblemError(f"{table.source[rows[bad[0]]]}: a ball_bar row needs a length")
    declared = np.array([[number.value for number in bar] for bar in scales.numbers])[scales.which]
    sigma = np.array([rig.bars[str(label)].sigma for label in scales.labels])[scales.which]
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
    table: ObservationTable, rig: Rig, rows: Indices, balls: Used, sockets: Used, layout: Layout
) -> SeatRows:
    sigma = _sigma(table, rows, np.full(len(rows), rig.seat_sigma))
    return SeatRows(rows, sigma, table.q[rows], layout.index(balls), layout.index(sockets), layout.constants)


def _distance_rows(rig: Rig, sockets: Used, layout: Layout) -> list[SocketDistanceRows]:
    """A row for every place where both sockets of a declared distance were used."""
    at = {label: i for i, label in enumerate(sockets.labels)}
    places = dict.fromkeys(label[0] for label in sockets.labels if isinstance(label, tuple))
    pairs = []
    for known in rig.socket_distances:
        for place in places:
            first, second = ((place, socket) for socket in known.sockets)
            if first in at and second in at:
                pairs.append((at[first], at[second], known.distance, known.sigma))
    if not pairs:
        return []
    ends = [layout.index(sockets._replace(which=np.array([pair[k] for pair in pairs]))) for k in (0, 1)]
    distance, sigma = np.array([pair[2:] for pair in pairs]).T
    if not (sigma > 0.0).all():
        raise ProblemError("a socket distance needs a positive sigma")
    return [SocketDistanceRows(sigma, distance, ends[0], ends[1], layout.constants)]


def _sigma(table: ObservationTable, rows: Indices, default: Floats) -> Floats:
    """The rows' own σ, the rig's where they have none."""
    sigma = np.where(np.isnan(table.sigma[rows]), default, table.sigma[rows])
    bad = np.flatnonzero(~((sigma > 0.0) & np.isfinite(sigma)))
    if bad.size:
        raise ProblemError(f"{table.source[rows[bad[0]]]}: sigma must be positive, is {sigma[bad[0]]:g} m")
    return np.asarray(sigma)
