"""What the rows of each kind of observation use of the rig, and the group that they become (``KINDS``).

A draft is made before the numbers of the rig have their places in x: it names what its rows use, and once a Layout has
given every number a place it makes the group. To add a kind: a function like these and its line in KINDS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from truearm.errors import ProblemError
from truearm.estimate.unknowns import (
    XYZ,
    Layout,
    Number,
    Scope,
    Used,
    enumerate_labels,
    look_up,
    or_inf,
    point_numbers,
    use,
)
from truearm.kinds import line, plane, position
from truearm.kinds.ball_bar import BallBarRows
from truearm.kinds.group import Group
from truearm.kinds.linearised import Indices
from truearm.kinds.plane import PlaneRows
from truearm.kinds.pose import PoseRows
from truearm.kinds.position import PositionRows
from truearm.kinds.seat import SeatRows
from truearm.kinds.socket_distance import SocketDistanceRows
from truearm.model.chain import point_forward
from truearm.model.rotation import rotation, rotation_vector
from truearm.types import Device, Floats, Point, Rig, Strings

ORIGIN = {"": Point("", (0.0, 0.0, 0.0))}  # the target of a rig that names none: the end frame's origin


class Draft(NamedTuple):
    """What some rows use, and how they become groups once all numbers have their places."""

    used: tuple[Used, ...]
    make: Callable[[Layout], list[Group]]


def ball_bars(scope: Scope, rows: Indices) -> Draft:
    table, rig = scope.table, scope.rig
    chucks = use(scope, rows, table.chuck, rig.chucks, "chuck")
    spheres = use(scope, rows, table.sphere, rig.spheres, "sphere")
    scales = use(scope, rows, table.bar, rig.bars, "bar")
    length = table.value[rows]
    _refuse(scope, rows, ~np.isfinite(length), "a ball_bar row needs a length")
    declared = np.array([[number.value for number in bar] for bar in scales.numbers])[scales.which]
    sigma = np.array([rig.bars[str(label)].sigma for label in scales.labels])[scales.which]
    variance = _sigma(scope, rows, sigma[:, None]) ** 2

    def make(layout: Layout) -> list[Group]:
        return [
            BallBarRows(
                row=rows,
                sensor_cov=variance,
                q=table.q[rows],
                length=length,
                sphere=layout.index(spheres),
                chuck=layout.index(chucks),
                scale=layout.index(scales),
                declared=declared,
                constants=layout.constants,
            )
        ]

    return Draft((chucks, spheres, scales), make)


def seats(scope: Scope, rows: Indices) -> Draft:
    table, rig = scope.table, scope.rig
    balls = use(scope, rows, table.sphere, rig.spheres or ORIGIN, "sphere")
    sockets = _sockets(scope, rows, balls)
    variance = _sigma(scope, rows, np.full((len(rows), 3), rig.seat_sigma)) ** 2

    def make(layout: Layout) -> list[Group]:
        group = SeatRows(
            row=rows,
            sensor_cov=variance,
            q=table.q[rows],
            sphere=layout.index(balls),
            socket=layout.index(sockets),
            constants=layout.constants,
        )
        return [group, *_distance_rows(rig, sockets, layout)]

    return Draft((balls, sockets), make)


def lines(scope: Scope, rows: Indices) -> Draft:
    rig = scope.rig
    if rig.line_placement not in line.PLACEMENTS:
        raise ProblemError(f"line_placement {rig.line_placement!r} is not known; use {' or '.join(line.PLACEMENTS)}")
    cov = tuple(tuple(sigma**2 * (i == k) for k in range(3)) for i, sigma in enumerate(rig.line_sigma))
    known = rig.lines or {name: Device(name, cov) for name in scope.table.line[rows].tolist()}
    used, make = _measured(scope, rows, "line", scope.table.line, known)
    return Draft(used, lambda layout: [make(layout)])


def positions(scope: Scope, rows: Indices) -> Draft:
    used, make = _measured(scope, rows, "tracker", scope.table.tracker, scope.rig.trackers)
    return Draft(used, lambda layout: [make(layout)])


def poses(scope: Scope, rows: Indices) -> Draft:
    known = scope.rig.trackers
    used, make_points = _measured(scope, rows, "tracker", scope.table.tracker, known)
    labels, which = look_up(scope, rows, scope.table.tracker, known, "tracker")
    measured = scope.table.rotation[rows]
    _refuse(scope, rows, ~np.isfinite(measured).all(axis=1), "a pose row needs rx, ry and rz")
    sigma = np.array([known[str(label)].rotation_sigma or 0.0 for label in labels])[which]
    _refuse(scope, rows, ~((sigma > 0.0) & np.isfinite(sigma)), "a pose row needs a tracker with a rotation_sigma")

    def make(layout: Layout) -> list[Group]:
        points = vars(make_points(layout))
        cov = _beside(points["sensor_cov"], sigma**2)
        return [PoseRows(**{**points, "sensor_cov": cov}, rotation=measured)]

    return Draft(used, make)


def planes(scope: Scope, rows: Indices) -> Draft:
    table, rig = scope.table, scope.rig
    targets = use(scope, rows, table.target, rig.targets or ORIGIN, "target")
    flats = use(scope, rows, table.plane, rig.planes, "plane")
    known = [rig.planes[str(label)] for label in flats.labels]
    for flat in known:
        if not (np.isfinite([*flat.xyz, *flat.normal]).all() and any(flat.normal)):
            raise ProblemError(f"plane {flat.name!r}: its point and normal must be finite, its normal not zero")
    point = np.array([flat.xyz for flat in known], dtype=float)[flats.which]
    frames = np.array([plane.frame_of(np.array(flat.normal)) for flat in known])[flats.which]
    _refuse(scope, rows, np.isinf(table.value[rows]), "its distance from the plane must be finite")
    distance = np.nan_to_num(table.value[rows], nan=0.0)
    sigma = np.array([flat.sigma for flat in known])[flats.which]
    variance = _sigma(scope, rows, sigma[:, None]) ** 2
    # A flat of which only the rough direction is known starts at the mean height of its touches.
    height = ((_nominal(scope, rows, targets) - point) * frames[:, 2]).sum(axis=1) - distance
    for i, (offset, *_) in enumerate(flats.numbers):
        if np.isinf(offset.sigma):
            flats.numbers[i][0] = offset._replace(value=float(height[flats.which == i].mean()))

    def make(layout: Layout) -> list[Group]:
        return [
            PlaneRows(
                row=rows,
                sensor_cov=variance,
                q=table.q[rows],
                distance=distance,
                target=layout.index(targets),
                plane=layout.index(flats),
                point=point,
                axes=frames,
                constants=layout.constants,
            )
        ]

    return Draft((targets, flats), make)


KINDS: Mapping[str, Callable[[Scope, Indices], Draft]] = {
    "ball_bar": ball_bars,
    "seat": seats,
    "line": lines,
    "position": positions,
    "pose": poses,
    "plane": planes,
}


def _measured(
    scope: Scope, rows: Indices, what: str, column: Strings, known: Mapping[str, Device]
) -> tuple[tuple[Used, ...], Callable[[Layout], PositionRows]]:
    """Points in devices' axes: the part that lines, positions and poses share."""
    table = scope.table
    _refuse(scope, rows, ~np.isfinite(table.xyz[rows]).all(axis=1), f"a {table.kind[rows[0]]} row needs x, y and z")
    labels, which = look_up(scope, rows, column, known, what)
    devices = [known[str(label)] for label in labels]
    targets = use(scope, rows, table.target, scope.rig.targets or ORIGIN, "target")
    p_base = _nominal(scope, rows, targets)
    numbers = [
        _device_numbers(scope, (what, str(label)), device, table.xyz[rows[which == i]], p_base[which == i])
        for i, (label, device) in enumerate(zip(labels, devices, strict=True))
    ]
    placed = Used(labels, numbers, which)
    moving = _moving(scope)
    offset = Number(f"{scope.prefix}time_offset", "s", scope.rig.time_offset, or_inf(scope.rig.time_offset_sigma))
    clock = Used([""], [[offset if moving else offset._replace(sigma=0.0)]], np.zeros(len(rows), dtype=np.intp))
    declared = [rotation(np.array(d.rotation)) for d in devices]
    cov = _device_cov(scope, rows, devices, which)

    def make(layout: Layout) -> PositionRows:
        return PositionRows(
            row=rows,
            sensor_cov=cov,
            q=table.q[rows],
            q_rate=np.nan_to_num(table.q_rate[rows], nan=0.0),
            xyz=table.xyz[rows],
            target=layout.index(targets),
            device=layout.index(placed),
            reference=np.array(declared)[which],
            time_offset=layout.index(clock),
            constants=layout.constants,
        )

    return (targets, placed, clock), make


def _device_numbers(scope: Scope, called: tuple[str, str], device: Device, xyz: Floats, p_base: Floats) -> list[Number]:
    """x, y, z, rx, ry, rz of a device; where the rig gives no pose, from its readings and the nominal robot."""
    sigmas = [or_inf(device.sigma)] * 3 + [or_inf(device.turn_sigma)] * 3
    name = scope.prefix + ".".join(filter(None, called))
    if not np.isfinite(device.rotation).all():
        raise ProblemError(f"{name} has a rotation that is not finite")
    if device.xyz is not None:
        values = [*device.xyz, 0.0, 0.0, 0.0]
    elif 0.0 in sigmas:
        raise ProblemError(f"{name} has sigma 0, known exactly, but no xyz that says where it is")
    else:
        declared = rotation(np.array(device.rotation))
        if called[0] == "line":
            p, rot = line.place(xyz, p_base, declared, scope.rig.line_placement, device.turn_sigma is not None)
        else:
            p, rot = position.place(xyz, p_base, declared)
        values = [*p, *rotation_vector(rot @ declared.T)]
    units = ("m", "m", "m", "rad", "rad", "rad")
    parts = zip((*XYZ, "rx", "ry", "rz"), units, values, sigmas, strict=True)
    return [Number(f"{name}.{k}", unit, float(value), sigma) for k, unit, value, sigma in parts]


def _device_cov(scope: Scope, rows: Indices, devices: Sequence[Device], which: Indices) -> Floats:
    """(n, 3) variances, or (n, 3, 3) where a device's axes are correlated.

    A row's own sigma comes before the device's, its point's own noise on top of either.
    """
    cov = []
    for device in devices:
        matrix = np.array(device.sensor_cov, dtype=float)
        if matrix.shape != (3, 3) or not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
            raise ProblemError(f"sensor_cov of {device.name!r} must be a symmetric 3×3 matrix")
        if not (np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > 0.0):
            raise ProblemError(f"sensor_cov of {device.name!r} must be positive definite, in m²")
        cov.append(matrix)
    full = np.array(cov)[which]
    own = ~np.isnan(scope.table.sigma[rows])
    sigma = _sigma(scope, rows, np.ones((len(rows), 3)))
    full[own] = sigma[own, :1, None] ** 2 * np.eye(3)
    full += np.nan_to_num(scope.table.xyz_sigma[rows], nan=0.0)[:, :, None] ** 2 * np.eye(3)
    variances = np.diagonal(full, axis1=1, axis2=2)
    return variances.copy() if np.array_equal(full, variances[:, :, None] * np.eye(3)) else full


def _beside(cov: Floats, variance: Floats) -> Floats:
    """(n, 6) or (n, 6, 6): the covariance of a point (n, 3) or (n, 3, 3) and one variance (n,) of three angles."""
    angles = np.repeat(variance[:, None], 3, axis=1)
    if cov.ndim == 2:
        return np.concatenate([cov, angles], axis=1)
    out = np.zeros((len(cov), 6, 6))
    out[:, :3, :3] = cov
    out[:, range(3, 6), range(3, 6)] = angles
    return out


def _moving(scope: Scope) -> bool:
    """Whether any row carries joint velocities. Raises ProblemError for a row that has some and lacks others."""
    finite = np.isfinite(scope.table.q_rate)
    bad = np.flatnonzero(~(finite.all(axis=1) | np.isnan(scope.table.q_rate).all(axis=1)))
    if bad.size:
        raise ProblemError(f"{scope.table.source[bad[0]]}: needs the velocities of all joints, finite, or none")
    return bool(finite.any())


def _nominal(scope: Scope, rows: Indices, targets: Used) -> Floats:
    """(n, 3) where the nominal robot has the targets, in the base frame."""
    p_end = np.array([[number.value for number in target] for target in targets.numbers])[targets.which]
    return point_forward(scope.chain, scope.chain.params_nominal, scope.table.q[rows], p_end)


def _sockets(scope: Scope, rows: Indices, balls: Used) -> Used:
    """The sockets of the seat rows, by (place, socket): the rig's, else unknown and first at the mean of the predicted ball."""
    table = scope.table
    labels, which = enumerate_labels(list(zip(table.place[rows].tolist(), table.socket[rows].tolist(), strict=True)))
    pairs = [label for label in labels if isinstance(label, tuple)]
    names = [".".join(("socket", *(part for part in pair if part))) for pair in pairs]
    if len(set(names)) < len(names):
        raise ProblemError(f"two sockets would both be called {max(names, key=names.count)}; rename places or sockets")
    total = np.zeros((len(names), 3))
    np.add.at(total, which, _nominal(scope, rows, balls))
    mean = total / np.bincount(which)[:, None]
    points = [
        scope.rig.sockets.get(pair, Point(name, tuple(xyz), None))
        for pair, name, xyz in zip(pairs, names, mean.tolist(), strict=True)
    ]
    numbers = [point_numbers(f"{scope.prefix}{name}", point) for name, point in zip(names, points, strict=True)]
    return Used(labels, numbers, which)


def _distance_rows(rig: Rig, sockets: Used, layout: Layout) -> list[Group]:
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
    return [
        SocketDistanceRows(
            row=None,
            sensor_cov=sigma[:, None] ** 2,
            distance=distance,
            first=ends[0],
            second=ends[1],
            constants=layout.constants,
        )
    ]


def _sigma(scope: Scope, rows: Indices, default: Floats) -> Floats:
    """The rows' own σ (n, w), alike for all w residuals; the rig's ``default`` (n, w) where they have none."""
    own = scope.table.sigma[rows, None]
    sigma = np.where(np.isnan(own), default, own)
    bad = np.flatnonzero(~((sigma > 0.0) & np.isfinite(sigma)).all(axis=1))
    if bad.size:
        worst = sigma[bad[0]].min()  # NaN if any is
        raise ProblemError(f"{scope.table.source[rows[bad[0]]]}: sigma must be positive, is {worst:g} m")
    return np.asarray(sigma)


def _refuse(scope: Scope, rows: Indices, bad: Any, text: str) -> None:
    """Raise ProblemError with the first of the bad rows (n,)."""
    if bad.any():
        raise ProblemError(f"{scope.table.source[rows[int(np.argmax(bad))]]}: {text}")
