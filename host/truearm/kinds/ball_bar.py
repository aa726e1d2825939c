"""A ball-bar between a sphere on the endpoint and a chuck on the table: one length an observation.

d = ‖T(q)·s − c‖ (Goswami, Quaid, Peshkin 1993, Optimization). The table holds the length that the bar's declared zero
z₀ and gain k₀ make of its reading. With other zero z and gain k the same reading means d = z + k·(length − z₀)/k₀, so

    predicted length = z₀ + k₀·(d − z)/k ,

which is d itself while zero and gain are as declared. ∂d/∂x is the derivative of the sphere along the bar's direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.kinds.group import Group
from truearm.kinds.linearised import Indices, Linearised, gather, no_columns, scatter
from truearm.model.chain import Chain, along, trace_point
from truearm.types import Floats


@dataclass(frozen=True, kw_only=True)
class BallBarRows(Group):
    """n ball-bar observations; indices point into x followed by ``constants``."""

    COMPONENTS = ("m",)

    q: Floats  # (n, j)
    length: Floats  # (n,) measured, m
    sphere: Indices  # (n, 3)
    chuck: Indices  # (n, 3)
    scale: Indices  # (n, 2) zero and gain
    declared: Floats  # (n, 2) zero and gain that made ``length``

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Residuals (n,) and their derivatives at x (P,)."""
        p = len(chain.parameters)
        trace = trace_point(chain, x[:p], self.q, gather(x, self.constants, self.sphere))
        bar = trace.p_base - gather(x, self.constants, self.chuck)
        d = np.sqrt((bar * bar).sum(axis=1))
        zero, gain = gather(x, self.constants, self.scale).T
        declared_zero, declared_gain = self.declared.T
        ratio = declared_gain / gain
        predicted = declared_zero + ratio * (d - zero)
        # A sphere in the chuck's centre has no direction: such a row says nothing to first order.
        u = bar * (ratio / np.where(d > 0.0, d, 1.0))[:, None]
        derivative = along(trace, u[None])
        by_rig = no_columns(derivative.wrenches, x.size - p)
        scatter(by_rig, self.sphere - p, derivative.jac_point)
        scatter(by_rig, self.chuck - p, -u[None])
        scatter(by_rig, self.scale - p, np.stack([-ratio, -ratio * (d - zero) / gain], axis=1)[None])
        return Linearised(
            self.length - predicted, derivative.wrenches, derivative.twists, by_rig, derivative.jac_joints
        )
