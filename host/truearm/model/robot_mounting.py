"""Separation of a robot from its mountings: the gauge of a calibration, which depends on the rig it was measured with.

T_i(q) is the pose of the end frame (such as the sphere fixture) in the base frame (such as the chuck fixture). The
transforms before the first joint and after the last are rigid, so their errors are indistinguishable from errors of
mounting. Both are treated as mountings:

    T_i(q) = B · R(q) · E ,   B = L_0i · L_0n⁻¹ ,   E = L_jn⁻¹ · L_ji

R(q) is the pose of the robot's own flange frame in its own base frame. Relative to the last and the first joint, they
are where the nominal robot has them. L_0 and L_j are the constants before the first and after the last joint, with
these joints' offsets, identified (i) and nominal (n). This is exact for every q.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.model.chain import Chain
from truearm.model.transforms import elementary, inverted
from truearm.types import Floats


class Mountings(NamedTuple):
    """Rigid motions (4, 4): of the robot's base in the base frame, and of the end frame in the robot's flange frame."""

    base: Floats
    tool: Floats


NONE = Mountings(np.eye(4), np.eye(4))


def mountings(chain: Chain, nominal: Floats, identified: Floats) -> Mountings:
    """Return the mountings in the identified parameters (p,), relative to the nominal ones (p,), which have none."""
    first, last = chain.motions[0], chain.motions[-1]
    turned = chain.law.offset.of(identified) - chain.law.offset.of(nominal)
    links_n, links_i = chain.links(nominal), chain.links(identified)
    by_first = elementary(first, turned[0]) if len(chain.joints) > 1 else np.eye(4)
    base = links_i[0] @ by_first @ inverted(links_n[0])
    return Mountings(base, inverted(links_n[-1]) @ elementary(last, turned[-1]) @ links_i[-1])


def own_links(chain: Chain, nominal: Floats, identified: Floats) -> Floats:
    """Return the links (j + 1, 4, 4) of R(q): the identified ones without the mountings."""
    links = chain.links(identified)
    ends = chain.links(nominal)
    links[0], links[-1] = ends[0], ends[-1]
    return links


def own_law(chain: Chain, nominal: Floats, identified: Floats) -> Floats:
    """Return parameters (p,) with the joint law of R(q): the identified ones, except for offsets that are mountings."""
    offset, out = chain.law.offset, identified.copy()
    at_ends = offset.parameters[np.isin(offset.joints, (0, len(chain.joints) - 1))]
    out[at_ends] = nominal[at_ends]
    return out
