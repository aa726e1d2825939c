"""The known distance between two sockets of one place: an observation of the sockets alone.

Predicted is ‖c_a − c_b‖. It carries the scale into an identification by seats, which otherwise have none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.kinds.linearised import Indices, Linearised, gather, no_columns, scatter
from truearm.model.chain import Chain
from truearm.model.constant_folding import folded
from truearm.types import Floats

WIDTH = 1  # scalar residuals an observation


@dataclass(frozen=True)
class SocketDistanceRows:
    """n places where both sockets were used; indices point into x followed by ``constants``."""

    sensor_cov: Floats  # (n, 1) m²
    distance: Floats  # (n,) measured, m
    first: Indices  # (n, 3)
    second: Indices  # (n, 3)
    constants: Floats


def evaluate(chain: Chain, rows: SocketDistanceRows, x: Floats) -> Linearised:
    """Residuals (n,) and their derivatives at x (P,); those by the robot are zero."""
    apart = gather(x, rows.constants, rows.first) - gather(x, rows.constants, rows.second)
    d = np.linalg.norm(apart, axis=1)
    u = np.divide(apart, d[:, None], out=np.zeros_like(apart), where=d[:, None] > 0.0)
    p = len(chain.parameters)
    twists = folded(chain, x[:p]).twists
    wrenches = np.zeros((WIDTH, d.size, len(twists)))
    by_rig = no_columns(wrenches, x.size - p)
    scatter(by_rig, rows.first - p, u[None])
    scatter(by_rig, rows.second - p, -u[None])
    return Linearised(rows.distance - d, wrenches, twists, by_rig, np.zeros((WIDTH, d.size, len(chain.joints))))
