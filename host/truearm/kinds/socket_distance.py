"""The known distance between two sockets of one place: an observation of the sockets alone.

The prediction is ‖c_a − c_b‖. It provides the scale for an identification by seats, which otherwise has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.kinds.group import Group
from truearm.kinds.linearised import Linearised, gather, scatter, zero_columns
from truearm.kinds.unknowns import Layout, Used
from truearm.model.chain import Chain
from truearm.model.constant_folding import folded
from truearm.types import Floats, Indices, Rig


@dataclass(frozen=True, kw_only=True)
class SocketDistanceRows(Group):
    """n places where both sockets were used; indices refer to x followed by ``constants``."""

    COMPONENTS = ("m",)

    distance: Floats  # (n,) measured, m
    first: Indices  # (n, 3)
    second: Indices  # (n, 3)

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n,) and their derivatives at x (P,). The derivatives by the robot's parameters are zero."""
        apart = gather(x, self.constants, self.first) - gather(x, self.constants, self.second)
        d = np.linalg.norm(apart, axis=1)
        u = np.divide(apart, d[:, None], out=np.zeros_like(apart), where=d[:, None] > 0.0)
        p = len(chain.parameters)
        twists = folded(chain, x[:p]).twists
        wrenches = np.zeros((1, d.size, len(twists)))
        jac_rig = zero_columns(wrenches, x.size - p)
        scatter(jac_rig, self.first - p, u[None])
        scatter(jac_rig, self.second - p, -u[None])
        return Linearised(self.distance - d, wrenches, twists, jac_rig, np.zeros((1, d.size, len(chain.joints))))


def known_distances(rig: Rig, sockets: Used, layout: Layout) -> list[Group]:
    """Return a row for every place where both sockets of a declared distance were used; no group if there is none."""
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
