"""A robot and what it is bolted to, told apart: the gauge in which a calibration leaves the rig it was measured with.

A calibration lies between the frames of its rig: T_i(q) leads from the base frame (the chuck fixture, say) to the end
frame (the sphere fixture). What precedes the first joint and what follows the last is rigid, so its errors cannot be
told from the errors of how the robot and the tool were bolted on. Both are taken for mountings:

    T_i(q) = B · R(q) · E ,

where R(q) leads from the robot's own base frame to its own flange frame, which lie to the first and the last joint as the
nominal robot says. With L_0 and L_j the constants before the first and after the last joint (offsets of these joints
included), identified (i) and nominal (n): B = L_0i · L_0n⁻¹ and E = L_jn⁻¹ · L_ji. This is exact for every q.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.model.chain import Chain, Element
from truearm.model.constant_folding import folded
from truearm.model.poses import inverted
from truearm.model.transforms import elementary
from truearm.types import Floats


class Mountings(NamedTuple):
    """Rigid motions (4, 4): of the robot's base in the base frame, of the end frame in the robot's flange."""

    base: Floats
    tool: Floats


NONE = Mountings(np.eye(4), np.eye(4))


def mountings(chain: Chain, nominal: Floats, identified: Floats) -> Mountings:
    """What of the identified parameters (p,) is mounting, the nominal ones (p,) having none."""
    first, last = chain.movers[0], chain.movers[-1]
    links_n, links_i = folded(chain, nominal).transforms, folded(chain, identified).transforms
    turned = _offset(first, identified, nominal) if len(chain.movers) > 1 else np.eye(4)
    base = links_i[0] @ turned @ inverted(links_n[0])
    return Mountings(base, inverted(links_n[-1]) @ _offset(last, identified, nominal) @ links_i[-1])


def own_links(chain: Chain, nominal: Floats, identified: Floats) -> tuple[Floats, Floats]:
    """Links (j + 1, 4, 4) and joint offsets (j,) of R(q): the identified ones without the mountings."""
    links = folded(chain, identified).transforms.copy()
    offsets = np.array([offset_of(m, identified) for m in chain.movers])
    ends = folded(chain, nominal).transforms
    links[0], links[-1] = ends[0], ends[-1]
    offsets[0] = offset_of(chain.movers[0], nominal)
    offsets[-1] = offset_of(chain.movers[-1], nominal)
    return links, offsets


def offset_of(mover: Element, params: Floats) -> float:
    """A joint's offset [rad or m]."""
    return float(mover.value if mover.parameter is None else params[mover.parameter])


def gain_of(mover: Element, params: Floats) -> float:
    """A joint's gain."""
    return float(1.0 if mover.gain is None else params[mover.gain])


def _offset(mover: Element, identified: Floats, nominal: Floats) -> Floats:
    return elementary(mover.motion, offset_of(mover, identified) - offset_of(mover, nominal))
