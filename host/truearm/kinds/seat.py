"""A ball on the end seated in a socket at an unknown position: the same point for all seats of one socket.

The prediction is the position of the ball relative to its socket, T(q)·s − c; the measured value is zero. The socket's
position c is unknown, three parameters per place and socket, so only the spread of the predicted ball about its socket
contains information about the robot.

The measured distance of two sockets is the same at every place: an observation of the sockets alone. The block with the
sockets is rigid, so its true distance is one unknown of the rig, ``socket_distance.<a>.<b>``. The measurement is its
prior: one measurement has one error, however many places the block was used at. Each place then adds a row
‖c_a − c_b‖ − distance = 0. It provides the scale for an identification by seats, which otherwise has none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from truearm.errors import ProblemError, TableError
from truearm.findings import Finding
from truearm.kinds.group import (
    Fault,
    Group,
    Linearised,
    RigNumber,
    Used,
    enumerate_labels,
    gather,
    linearised,
    point_numbers,
)
from truearm.kinds.kind import ORIGIN, Kind, RigUse, Scope, nominal_points, sigmas, use_points
from truearm.kinds.proposals import NEW, Proposal, about_one_point, trial_rows
from truearm.kinds.rig_entries import POINT, SPHERE
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, PointDerivatives, along, folded, point_forward, trace_point
from truearm.schema import IDENTIFIER, Entries, Key, List, SchemaError, Table, keys_of
from truearm.types import Floats, Indices, Point, Rig, SocketDistance
from truearm.units import MM, UNITS

FAR = 5.0  # times another distance: not by an error of the robot
RIGID = 1e-5  # m: how equal the distance is at all places; a printed block of 50 mm expands as much in 3 K


@dataclass(frozen=True, kw_only=True)
class SocketDistanceRows(Group):
    """n places where both sockets were used; indices refer to x followed by ``constants``."""

    COMPONENTS = ("m",)

    distance: Indices  # (n, 1)
    first: Indices  # (n, 3)
    second: Indices  # (n, 3)

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n,) and their derivatives at x (P,). The derivatives by the robot's parameters are zero."""
        vector = gather(x, self.constants, self.first) - gather(x, self.constants, self.second)
        d = np.linalg.norm(vector, axis=1)
        u = np.divide(vector, d[:, None], out=np.zeros_like(vector), where=d[:, None] > 0.0)
        basis = folded(chain, x[: len(chain.parameters)]).basis
        shape = 1, d.size
        nothing = (np.zeros((*shape, size)) for size in (len(chain.joints), 3))
        derivative = PointDerivatives(np.zeros((*shape, len(basis.twists))), basis, *nothing)
        points = (self.first, u[None]), (self.second, -u[None])
        residual = gather(x, self.constants, self.distance)[:, 0] - d
        return linearised(residual, derivative, x, *points, (self.distance, np.full((*shape, 1), -1.0)))


def use_distances(prefix: str, rig: Rig, sockets: Used) -> RigUse:
    """Return the declared distances, and a row for every place where both sockets of one were used.

    Raises ProblemError for a distance that is declared twice.
    """
    pairs = [".".join(sorted(measured.sockets)) for measured in rig.socket_distances]
    if len({*pairs}) < len(pairs):
        twice = max(pairs, key=pairs.count)
        raise ProblemError("given-twice", place="rig", what=f"the distance of sockets {twice}")
    index = {label: i for i, label in enumerate(sockets.labels)}
    places = dict.fromkeys(label[0] for label in sockets.labels if isinstance(label, tuple))
    rows = [
        (measured, index[place, a], index[place, b])
        for measured, (a, b) in ((measured, measured.sockets) for measured in rig.socket_distances)
        for place in places
        if index.keys() >= {(place, a), (place, b)}
    ]
    if not rows:
        return RigUse((), lambda _: [])
    measurements = list(dict.fromkeys(measured for measured, *_ in rows))
    numbers = [
        [RigNumber(f"{prefix}socket_distance.{'.'.join(measured.sockets)}", "m", measured.distance, measured.sigma)]
        for measured in measurements
    ]
    which = np.array([measurements.index(measured) for measured, *_ in rows], dtype=np.intp)
    distances = Used([*measurements], numbers, which, (Fault(slice(None), step=False),))
    first, second = (sockets._replace(which=which) for which in np.array([ends for _, *ends in rows], dtype=np.intp).T)
    return RigUse(
        (distances,),
        lambda layout: [
            SocketDistanceRows(
                row=None,
                sensor_cov=np.full((len(rows), 1), RIGID**2),
                distance=layout.index(distances),
                first=layout.index(first),
                second=layout.index(second),
                constants=layout.constants,
            )
        ],
    )


def other_lengths(seats: ObservationTable, rig: Rig, chain: Chain) -> list[Finding]:
    """Return a warning for each declared distance that is far from that by the nominal robot."""
    balls = [rig.spheres.get(name) or next(iter(rig.spheres.values()), ORIGIN[""]) for name in seats.sphere.tolist()]
    points = point_forward(chain, chain.params_nominal, seats.q, np.array([ball.xyz for ball in balls]).reshape(-1, 3))
    findings = []
    for measured in rig.socket_distances:
        lengths = []
        for place in np.unique(seats.place):
            ends = [points[(seats.place == place) & (seats.socket == socket)] for socket in measured.sockets]
            lengths += [np.linalg.norm(np.subtract(*(end.mean(axis=0) for end in ends)))] if all(map(len, ends)) else []
        by_joints = float(np.median(lengths)) if lengths else measured.distance
        if not measured.distance / FAR < by_joints < measured.distance * FAR:
            sizes = {"declared": {"mm": MM.of(measured.distance)}, "nominal": {"mm": MM.of(by_joints)}}
            findings.append(Finding("other-distance", {"sockets": list(measured.sockets), **sizes}))
    return findings


@dataclass(frozen=True, kw_only=True)
class SeatRows(Group):
    """n seats; indices refer to x followed by ``constants``."""

    COMPONENTS = ("m", "m", "m")

    q: Floats  # (n, j)
    sphere: Indices  # (n, 3) the ball, in the end frame
    socket: Indices  # (n, 3) in the base frame

    def beside_base(self) -> Indices:
        """Return the sockets."""
        return self.socket

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (3n,) and their derivatives at x (P,)."""
        p = len(chain.parameters)
        trace = trace_point(chain, x[:p], self.q, gather(x, self.constants, self.sphere))
        residual = gather(x, self.constants, self.socket) - trace.p_base
        axes = np.broadcast_to(np.eye(3)[:, None], (3, *residual.shape))
        derivative = along(trace, axes)
        return linearised(residual, derivative, x, (self.sphere, derivative.jac_point), (self.socket, -axes))

    def settle(self, chain: Chain, x: Floats) -> SeatRows:
        """Return the seats with joint readings moved, as little as possible, until every ball is in its socket at x.

        A rank test needs this. Rotating the base and all sockets together changes no spread, but the Jacobian's column
        for that rotation is −ω × residual. Only where the residuals vanish does the Jacobian have the null space of the
        model. Takes three Newton steps. A seat whose joints cannot move the ball in some direction (1e-3 of the best
        one) keeps that residual.
        """
        rows = self
        for _ in range(3):
            lin = rows.evaluate(chain, x)
            inverse = np.linalg.pinv(lin.jac_joints.reshape(-1, 3, len(chain.joints)), rcond=1e-3)
            rows = replace(rows, q=rows.q + (inverse @ lin.residual.reshape(-1, 3, 1))[..., 0])
        return rows


def use_rig(scope: Scope, rows: Indices) -> RigUse:
    """Return what the rows use of the rig: balls, sockets, and known distances between these sockets."""
    rig = scope.rig
    balls = use_points(scope, rows, "sphere", rig.spheres)
    sockets = _sockets(scope, rows, balls)
    distances = use_distances(scope.prefix, rig, sockets)
    variance = sigmas(scope, rows, np.full((len(rows), 3), rig.seat_sigma)) ** 2
    seats = RigUse.of(SeatRows, scope, rows, variance, sphere=balls, socket=sockets)
    used = (*seats.used, *distances.used)
    return RigUse(used, lambda layout: [*seats.make(layout), *distances.make(layout)], _places(scope, sockets))


def _places(scope: Scope, sockets: Used) -> dict[str, tuple[str, ...]]:
    """Return the places with several sockets that the rig places, with the names of these sockets."""
    bodies: dict[str, tuple[str, ...]] = {}
    for label, numbers in zip(sockets.labels, sockets.numbers, strict=True):
        if isinstance(label, tuple) and label in scope.rig.sockets and np.isfinite(numbers[0].sigma):
            place = scope.prefix + ".".join(filter(None, ("place", label[0])))
            bodies[place] = (*bodies.get(place, ()), numbers[0].name.rpartition(".")[0])
    return {place: names for place, names in bodies.items() if len(names) > 1}


def _sockets(scope: Scope, rows: Indices, balls: Used) -> Used:
    """Return the sockets of the seat rows by (place, socket): the rig's, or unknown, at the mean predicted ball."""
    table = scope.table
    labels, which = enumerate_labels(list(zip(table.place[rows].tolist(), table.socket[rows].tolist(), strict=True)))
    pairs = [label for label in labels if isinstance(label, tuple)]
    names = [".".join(("socket", *filter(None, pair))) for pair in pairs]
    if len(set(names)) < len(names):
        raise ProblemError(f"two sockets would both be called {max(names, key=names.count)}; rename places or sockets")
    total = np.zeros((len(names), 3))
    np.add.at(total, which, nominal_points(scope, rows, balls))
    mean = total / np.bincount(which)[:, None]
    is_near = (np.abs(mean) <= UNITS["m"].largest).all(axis=1)
    if not is_near.all():
        raise ProblemError(
            f"{names[int(np.argmin(is_near))]}: the nominal robot has its seats more than {UNITS['m'].largest:g} m from the base; "
            "correct the unit of the joints, the robot's lengths or the rig's spheres"
        )
    points = [
        scope.rig.sockets.get(pair, Point(name, tuple(xyz), None))
        for pair, name, xyz in zip(pairs, names, mean.tolist(), strict=True)
    ]
    numbers = [point_numbers(f"{scope.prefix}{name}", point) for name, point in zip(names, points, strict=True)]
    return Used(labels, numbers, which)


def check(table: ObservationTable, rig: Rig) -> None:
    """Raise TableError for a socket or socket distance of the rig that no seat uses: it would be silently ignored."""
    seats = table.kind == "seat"
    seated = set(zip(table.place[seats].tolist(), table.socket[seats].tolist(), strict=True))
    for place, socket in rig.sockets:
        if (place, socket) not in seated:
            raise TableError(
                f"the rig's socket {socket} at place {place!r} is unused: no row is seated in it; correct its name or place, or remove it from the rig"
            )
    for distance in rig.socket_distances:
        if not any({(place, socket) for socket in distance.sockets} <= seated for place, _ in seated):
            sockets = ", ".join(sorted({socket for _, socket in seated})[:12])
            raise TableError(
                f"the rig's socket distance {' to '.join(distance.sockets)} is unused: "
                f"seats are in socket{'s' * (',' in sockets)} {sockets}, and no place has seats in both {' and '.join(distance.sockets)}; correct its names, measure both sockets at one place, or remove it (then its length no longer sets the scale)"
            )


def proposals(chain: Chain, rig: Rig, table: ObservationTable, rng: np.random.Generator) -> Iterator[Proposal]:
    """Propose one more place to seat the ball at."""
    ball = next(iter(rig.spheres.values()), ORIGIN[""])
    q = about_one_point(chain, table.q[len(table) // 2], np.array(ball.xyz), rng, reach=0.0)
    if len(q):
        yield Proposal(
            "place",
            "measure seats of a ball of the end in sockets at a new place",
            rig,
            trial_rows(q, "seat", sphere=ball.name, place=NEW),
        )


class Socket(NamedTuple):
    """A socket and the place where it is."""

    point: Point
    place: str = ""


def _socket(place: str = "", **point: Any) -> Socket:
    return Socket(Point(**point), place)


def _socket_distance(sockets: tuple[str, str], distance: float, sigma: float) -> SocketDistance:
    if sockets[0] == sockets[1]:
        raise SchemaError(f"sockets: both are {sockets[0]!r}; name two different sockets")
    return SocketDistance(sockets, distance, sigma)


SOCKET = Entries(
    "socket",
    Table(
        (Key("place", IDENTIFIER, optional=True), *POINT.keys),
        _socket,
        lambda socket: {"place": socket.place, **vars(socket.point)},
    ),
    "sockets",
    lambda socket: (socket.place, socket.point.name),
)
SOCKET_DISTANCE = Entries(
    "socket_distance",
    Table((Key("sockets", List(IDENTIFIER, 2)), *keys_of(SocketDistance)), _socket_distance),
    "socket_distances",
)
KIND = Kind(
    group=SeatRows,
    doubts=other_lengths,
    use_rig=use_rig,
    needs=("place", "socket"),
    may=("sphere",),
    entries=(SPHERE, SOCKET, SOCKET_DISTANCE),
    point="sphere",
    labels=("socket",),
    grouped_by=("place",),
    drawn_from=("socket",),
    name="ball-in-socket",
    residual={"m": "distance of the ball's predicted centre from its socket"},
    proposals=proposals,
    check=check,
)
