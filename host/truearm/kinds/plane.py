"""A flat that a target on the tool touches: its signed distance from the plane, 0 or the radius of a touching ball.

Predicted is n·(T(q)·s − c) − offset with a point c and a normal that the rig declares, n = exp([t₁e₁ + t₂e₂]×)·n₀. The
three unknowns of a plane are its ``offset`` along n [m] and its two tilts t₁, t₂ [rad] about e₁ and e₂, which with n₀
make a right-handed frame: e₁ is the base axis that n₀ is least along, made perpendicular to it, and e₂ = n₀ × e₁.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.kinds.group import Group
from truearm.kinds.linearised import Indices, Linearised, gather, no_columns, scatter
from truearm.model.chain import Chain, along, trace_point
from truearm.model.rotation import left_jacobian, rotation
from truearm.model.transforms import cross
from truearm.types import Floats


@dataclass(frozen=True, kw_only=True)
class PlaneRows(Group):
    """n touches; indices point into x followed by ``constants``."""

    COMPONENTS = ("m",)

    q: Floats  # (n, j)
    distance: Floats  # (n,) measured, m
    target: Indices  # (n, 3) in the end frame
    plane: Indices  # (n, 3) offset and the two tilts
    point: Floats  # (n, 3) declared point c, m
    axes: Floats  # (n, 3, 3) rows e₁, e₂, n₀

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Residuals (n,) and their derivatives at x (P,)."""
        p = len(chain.parameters)
        trace = trace_point(chain, x[:p], self.q, gather(x, self.constants, self.target))
        numbers = gather(x, self.constants, self.plane)
        tilts = self.axes[:, :2]
        tilt = np.einsum("nk,nki->ni", numbers[:, 1:], tilts)
        normal = np.einsum("nij,nj->ni", rotation(tilt), self.axes[:, 2])
        lever = trace.p_base - self.point
        derivative = along(trace, normal[None])
        by_rig = no_columns(derivative.wrenches, x.size - p)
        scatter(by_rig, self.target - p, derivative.jac_point)
        scatter(by_rig, self.plane[:, :1] - p, np.full((1, len(self.q), 1), -1.0))
        # (δφ × n)·r = (n × r)·δφ with δφ = J_l δ(tilt)
        turned = np.einsum("ni,nij,nkj->nk", cross(normal.T, lever.T).T, left_jacobian(tilt), tilts)
        scatter(by_rig, self.plane[:, 1:] - p, turned[None])
        predicted = (normal * lever).sum(axis=1) - numbers[:, 0]
        return Linearised(
            self.distance - predicted, derivative.wrenches, derivative.twists, by_rig, derivative.jac_joints
        )


def frame_of(normal: Floats) -> Floats:
    """(3, 3) rows e₁, e₂, n₀ for a normal (3,) of any length but 0."""
    n0 = np.asarray(normal) / np.linalg.norm(normal)
    e1 = np.eye(3)[np.argmin(np.abs(n0))]
    e1 = e1 - (e1 @ n0) * n0
    e1 /= np.linalg.norm(e1)
    return np.stack([e1, np.cross(n0, e1), n0])
