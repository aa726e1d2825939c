"""Links that lie behind their encoders by half the backlash, on the side that each joint came from.

Where the side s_j = ±1 is known the link is at q_j − ½ b_j s_j, and what is left to doubt is how well b_j is known. As noise of
either sign, ½ b_j in every row, it would be counted too large: a joint moves from pose to pose so that the bar keeps about its length,
Σ J_j Δq_j ≈ 0, and what the sides, signs of Δq_j, do to the length by several joints cancels in part (docs/decisions/0017-dwells-and-noise.md).
Where nobody knows the side ½ b_j remains as noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.errors import ProblemError
from truearm.types import Floats, ObservationTable, Rig

ROUNDING = 1e-9  # of joint_cov, which holds ½ b_j squared


class Backlash(NamedTuple):
    """``width`` (j,): b [rad, m]; ``cov_of_known_sides`` (j, j): of a joint reading whose side is known."""

    width: Floats
    cov_of_known_sides: Floats

    @classmethod
    def of(cls, rig: Rig, joint_cov: Floats | None) -> Backlash | None:
        """What a rig says, whose ``joint_cov`` this is; None for nothing. Raises ProblemError where the two do not fit each other."""
        if not rig.backlash:
            return None
        width, sigma = np.array(rig.backlash), np.array(rig.backlash_sigma)
        if joint_cov is None or width.shape != joint_cov.shape[:1] or sigma.shape != width.shape:
            raise ProblemError("backlash needs a width and a sigma for each joint, and joint_cov")
        left = np.diag(joint_cov) - 0.25 * width**2
        if (left < -ROUNDING * np.diag(joint_cov)).any():
            raise ProblemError("joint_cov must hold the backlash: a joint's sigma is half of it at least")
        cov = joint_cov.copy()
        np.fill_diagonal(cov, np.maximum(left, 0.0) + 0.25 * sigma**2)
        return cls(width, cov)

    def links(self, table: ObservationTable) -> Floats:
        """Where the links were (n, j), as far as the sides are known."""
        return np.asarray(table.q - 0.5 * self.width * np.nan_to_num(table.side, nan=0.0))

    def unknown(self, table: ObservationTable) -> Floats:
        """How far the links may be beside that (n, j), one σ: half the backlash where the side is not known."""
        return np.where(np.isnan(table.side), 0.5 * np.abs(self.width), 0.0)
