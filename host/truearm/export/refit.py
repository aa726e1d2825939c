"""A calibrated robot in a format that cannot hold all of it: the adjustable parameters are fitted to the complete
robot.

Renders (1991, III-F) identifies only what the controller lets its user adjust. Here the identified robot provides the
data: the values of the adjustable parameters are those that bring the end closest to the identified robot's over given
poses. Where parameters are interchangeable, the smallest change is taken. This is least squares over four marks on the
end, LEVER apart, so that rotations of the end count as well. Parameters count in units of a drawing's tolerances.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain, point_forward, point_jacobians
from truearm.types import Floats
from truearm.units import UNITS

LEVER = 0.1  # m
MARKS = LEVER * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SINGULAR = 1e-7  # relative to the largest singular value: below this, a direction moves the end less than rounding
MAX_STEPS = 30
STEP_END = 1e-9  # in the units above: 1 pm, 5 prad


def refit(chain: Chain, identified: Floats, start: Floats, adjustable: NDArray[np.bool_], q: Floats) -> Floats:
    """Return parameters (p,), the adjustable ones (p,) fitted from ``start`` (p,) to the robot over poses q (n, j)."""
    params = np.array(start, dtype=float)
    unit = np.array([UNITS[p.unit].weak_sigma for p in chain.parameters])[adjustable]
    wanted = _marks(chain, identified, q)
    for _ in range(MAX_STEPS):
        error = (wanted - _marks(chain, params, q)).ravel()
        columns = [point_jacobians(chain, params, q, mark)[1][..., adjustable] for mark in MARKS]
        jac = np.stack(columns, axis=1).reshape(error.size, -1) * unit
        step = np.linalg.lstsq(jac, error, rcond=SINGULAR)[0]
        params[adjustable] += unit * step
        if np.abs(step).max(initial=0.0) < STEP_END:
            break
    return params


def _marks(chain: Chain, params: Floats, q: Floats) -> Floats:
    return np.stack([point_forward(chain, params, q, mark) for mark in MARKS], axis=1)
