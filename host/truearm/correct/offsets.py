"""Correction of the encoders' zeros alone (Renders 1991, IV-C)::

    q_i = f_n⁻¹(x_d) − Δq                                     (35)

With the joint law θ = offset + gain·q the controller wants θ = offset_n + gain_n·q_n, so the reading that gives it is
(offset_n + gain_n·q_n − offset_i)/gain_i. Exact where offsets (and gains) are all that is wrong; it does nothing for lengths.
"""

from __future__ import annotations

import numpy as np

from truearm.correct.model_pair import Pair
from truearm.model.mountings import gain_of, offset_of
from truearm.types import Floats


def offsets(pair: Pair, q_nominal: Floats) -> Floats:
    """(n, j) the readings that give the joint variables which the nominal robot has at q_nominal (n, j)."""
    movers = pair.chain.movers
    offset_n, offset_i = (np.array([offset_of(m, p) for m in movers]) for p in (pair.nominal, pair.identified))
    gain_n, gain_i = (np.array([gain_of(m, p) for m in movers]) for p in (pair.nominal, pair.identified))
    return np.asarray((offset_n - offset_i + gain_n * q_nominal) / gain_i)
