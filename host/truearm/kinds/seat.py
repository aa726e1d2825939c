"""A ball of the endpoint seated in a socket that stands somewhere: the same point for all seats of one socket.

Predicted is the ball relative to its socket, T(q)·s − c; measured is zero. The socket's point c is unknown, three
parameters per place and socket, so only the spread of the predicted ball about its socket says something of the robot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from truearm.kinds.group import Group
from truearm.kinds.linearised import Indices, Linearised, gather, no_columns, scatter
from truearm.model.chain import Chain, along, trace_point
from truearm.types import Floats


@dataclass(frozen=True, kw_only=True)
class SeatRows(Group):
    """n seats; indices point into x followed by ``constants``."""

    COMPONENTS = ("m", "m", "m")

    q: Floats  # (n, j)
    sphere: Indices  # (n, 3) the ball, in the end frame
    socket: Indices  # (n, 3) in the base frame

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Residuals (3n,) and their derivatives at x (P,)."""
        p = len(chain.parameters)
        trace = trace_point(chain, x[:p], self.q, gather(x, self.constants, self.sphere))
        residual = gather(x, self.constants, self.socket) - trace.p_base
        axes = np.broadcast_to(np.eye(3)[:, None], (3, *residual.shape))
        derivative = along(trace, axes)
        by_rig = no_columns(derivative.wrenches, x.size - p)
        scatter(by_rig, self.sphere - p, derivative.jac_point)
        scatter(by_rig, self.socket - p, -axes)
        return Linearised(residual.ravel(), derivative.wrenches, derivative.twists, by_rig, derivative.jac_joints)

    def settle(self, chain: Chain, x: Floats) -> SeatRows:
        """The seats with joint readings moved, as little as possible, until every ball sits in its socket at x.

        A rank test needs it. Turning the base and all sockets together changes no spread, yet the Jacobian's column for
        it is −ω × residual: only where the residuals vanish does the Jacobian show the model's own null space. Three
        Newton steps; a seat whose joints cannot move the ball in some direction (1e-3 of its best one) keeps that
        residual.
        """
        rows = self
        for _ in range(3):
            lin = rows.evaluate(chain, x)
            inverse = np.linalg.pinv(lin.jac_joints.reshape(-1, 3, len(chain.joints)), rcond=1e-3)
            rows = replace(rows, q=rows.q + (inverse @ lin.residual.reshape(-1, 3, 1))[..., 0])
        return rows
