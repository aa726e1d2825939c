"""False targets: the controller keeps its nominal model and is given another target (Renders 1991, IV-B).

The controller moves the joints to q = f_n⁻¹(x_m) and thereby the end to f_i(q). Given the desired target x_d, the end
arrives at x_n = f_i(f_n⁻¹(x_d)). The target is therefore shifted by the opposite of that error:

    x_m = x_d + (x_d − x_n)                                   (32)

One step leaves an error of second order. Since x_m = f_n(q) always holds, it is repeated as x_m ← f_n(q) + (x_d −
f_i(q)). Differences of orientations are rotation vectors in base axes: rotations are composed, not added.
"""

from __future__ import annotations

import numpy as np

from truearm.correct.inverse import inverse
from truearm.correct.model_pair import ModelPair, believed, reached
from truearm.model.poses import apart, moved
from truearm.types import Floats


def false_target(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (32): return the joint readings (n, j) that the controller uses for the false targets.

    targets : (n, 4, 4) x_d. q : (n, j) where the controller goes for the current targets, initially f_n⁻¹(x_d). NaN
        where the nominal robot does not reach the false target.
    """
    commanded = moved(believed(pair, q), apart(targets, reached(pair, q)))
    found = inverse(pair.chain, pair.nominal, commanded, q, oriented)
    return np.where(found.reached[:, None], found.q, np.nan)
