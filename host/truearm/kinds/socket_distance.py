"""The measured distance of two sockets, which is the same at every place: an observation of the sockets alone.

The block with the sockets is rigid, so its true distance is one unknown of the rig, ``socket_distance.<a>.<b>``. The
measurement is its prior: one measurement has one error, however many places the block was used at. Each place then
adds a row ‖c_a − c_b‖ − distance = 0. It provides the scale for an identification by seats, which otherwise has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.errors import ProblemError
from truearm.findings import Finding
from truearm.kinds.group import Group
from truearm.kinds.linearised import Linearised, gather, scatter, zero_columns
from truearm.kinds.rig_references import ORIGIN
from truearm.kinds.table import ObservationTable
from truearm.kinds.unknowns import Fault, Layout, RigNumber, Used
from truearm.model.chain import Chain, folded, point_forward
from truearm.types import Floats, Indices, Rig
from truearm.units import MM

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
        p = len(chain.parameters)
        basis = folded(chain, x[:p]).basis
        wrenches = np.zeros((1, d.size, len(basis.twists)))
        jac_rig = zero_columns(wrenches, x.size - p)
        scatter(jac_rig, self.first - p, u[None])
        scatter(jac_rig, self.second - p, -u[None])
        scatter(jac_rig, self.distance - p, np.full((1, d.size, 1), -1.0))
        residual = gather(x, self.constants, self.distance)[:, 0] - d
        return Linearised(residual, wrenches, basis, jac_rig, np.zeros((1, d.size, len(chain.joints))))


def use_distances(prefix: str, rig: Rig, sockets: Used) -> tuple[Used, Indices]:
    """Return the declared distances that places use, and the sockets (n, 2) by index of each such place.

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
    measurements = list(dict.fromkeys(measured for measured, *_ in rows))
    numbers = [
        [RigNumber(f"{prefix}socket_distance.{'.'.join(measured.sockets)}", "m", measured.distance, measured.sigma)]
        for measured in measurements
    ]
    which = np.array([measurements.index(measured) for measured, *_ in rows], dtype=np.intp)
    distances = Used([*measurements], numbers, which, (Fault(slice(None), step=False),))
    return distances, np.array([ends for _, *ends in rows], dtype=np.intp).reshape(-1, 2)


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


def distance_rows(distances: Used, sockets: Used, ends: Indices, layout: Layout) -> list[Group]:
    """Return a row for every place where both sockets of a declared distance were used; no group if there is none."""
    if not len(ends):
        return []
    first, second = (layout.index(sockets._replace(which=which)) for which in ends.T)
    return [
        SocketDistanceRows(
            row=None,
            sensor_cov=np.full((len(ends), 1), RIGID**2),
            distance=layout.index(distances),
            first=first,
            second=second,
            constants=layout.constants,
        )
    ]
