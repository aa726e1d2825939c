"""Backlash of joints: each link lags its encoder by half the backlash, on the side that the joint came from.

Where the side s_j = ±1 is known, the link is at q_j − ½ b_j s_j, and only the uncertainty of b_j remains. Treating ½
b_j as noise of either sign in every row would overestimate it. From pose to pose the bar keeps about the same length, Σ
J_j Δq_j ≈ 0. The effects of the sides (the signs of Δq_j) of several joints therefore partly cancel
(docs/decisions/0017-dwells-and-noise.md). Where the side is unknown, ½ b_j is treated as noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.errors import ProblemError
from truearm.kinds.table import ObservationTable
from truearm.types import Floats, Rig

ROUNDING = 1e-9  # relative to joint_cov, which contains ½ b_j squared


class Backlash(NamedTuple):
    """``width`` (j,): b [rad, m]; ``cov_of_known_sides`` (j, j): covariance of a joint reading whose side is known."""

    width: Floats
    cov_of_known_sides: Floats

    @classmethod
    def of(cls, rig: Rig, joint_cov: Floats | None) -> Backlash | None:
        """Return the backlash of a rig with this ``joint_cov``, or None if it has none.

        Raises ProblemError if the two are inconsistent.
        """
        if not rig.backlash:
            return None
        width, sigma = np.array(rig.backlash), np.array(rig.backlash_sigma)
        if joint_cov is None or width.shape != joint_cov.shape[:1] or sigma.shape != width.shape:
            raise ProblemError("backlash needs joint_cov; backlash and backlash_sigma need one value for each joint")
        left = np.diag(joint_cov) - 0.25 * width**2
        if (left < -ROUNDING * np.diag(joint_cov)).any():
            raise ProblemError("joint_cov must include the backlash: a joint's sigma must be at least half of it")
        cov = joint_cov.copy()
        np.fill_diagonal(cov, np.maximum(left, 0.0) + 0.25 * sigma**2)
        return cls(width, cov)

    def links(self, table: ObservationTable) -> Floats:
        """Return the joint positions of the links (n, j), corrected where the side is known."""
        return np.asarray(table.q - 0.5 * self.width * np.nan_to_num(table.side, nan=0.0))

    def unknown(self, table: ObservationTable) -> Floats:
        """Return the remaining standard deviation of the links (n, j): half the backlash where the side is unknown."""
        return np.where(np.isnan(table.side), 0.5 * np.abs(self.width), 0.0)
