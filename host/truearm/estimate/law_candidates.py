"""Which joint laws observations can show: knots over the covered range, masses whose torque varies, and their priors.

The constants were chosen on UR10 series C (a fifth held out: curves) and on an IRB 120 with a tracker (sag), not on the other arms of docs/real-arms.md. Knots
0.12, 0.08, 0.05 and 0.035 rad apart gave 0.176, 0.102, 0.086 and 0.082 mm on the UR10.

A curve's coefficients have a stationary Gaussian-process prior: a sum of Matérn-5/2 kernels at octaves of length, each with
its own variance. It returns to zero outside the data with honest variance, which an integrated Wiener process does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from truearm.estimate.evidence import PriorBlock
from truearm.estimate.solvers import LawMode
from truearm.model.chain import Chain
from truearm.model.joint_terms.sag import Sag
from truearm.model.law_chain import distal_frames, with_laws
from truearm.types import CurveKnots, Floats, Law, SagMasses
from truearm.units import DEG

SPACING = 0.05  # rad between knots, at most
LENGTHS = 0.05 * 2.0 ** np.arange(7)  # rad
MARGIN = 0.8  # rad beyond the covered range
TURNS = 2.0 * math.pi - 0.3  # rad: a joint whose readings span more turns round
STILL = 0.1  # rad: readings that span less show no curve
CURVE_CAP = 3e-4  # rad
SAG_CAP = 3e-3  # rad per kg·m
LEAST_TORQUE = 0.02  # kg·m, standard deviation over the poses
IMAGES = 8  # turns to either side that a periodic kernel is summed over: Matérn of length 3.2 rad is then 1e-11


def candidates(
    chain: Chain, q: Floats, mode: LawMode, gravity: tuple[float, float, float]
) -> tuple[list[Law], list[str]]:
    """The laws to try for readings q (n, j), and a sentence for each joint that can have none."""
    laws: list[Law] = []
    reasons: list[str] = []
    if mode in (LawMode.AUTO, LawMode.SAG):
        laws += _sags(chain, q, gravity)
        if not laws:
            reasons.append("the torque of gravity does not vary at any joint: sag cannot be seen")
    if mode in (LawMode.AUTO, LawMode.CURVE):
        for i, joint in enumerate(chain.joints):
            span = float(np.ptp(q[:, i]))
            if joint.kind != "revolute":
                reasons.append(f"{joint.name} is prismatic: it has no error curve")
            elif span < STILL:
                reasons.append(f"{joint.name} covers {DEG.text(span, '.1f')}: too little for an error curve")
            else:
                laws.append(knots(i, float(q[:, i].min()), float(q[:, i].max())))
    return laws, reasons


def knots(joint: int, lower: float, upper: float) -> CurveKnots:
    """Knots over a covered range [rad] and a margin; periodic where the joint turns round."""
    if upper - lower > TURNS:
        count = math.ceil(2.0 * math.pi / SPACING)
        return CurveKnots(joint, lower, 2.0 * math.pi / count, count, periodic=True)
    count = math.ceil((upper - lower + 2.0 * MARGIN) / SPACING) + 1
    return CurveKnots(joint, lower - MARGIN, SPACING, count, periodic=False)


def _sags(chain: Chain, q: Floats, gravity: tuple[float, float, float]) -> Iterator[SagMasses]:
    for i, joint in enumerate(chain.joints):
        frames = distal_frames(chain, i) if joint.kind == "revolute" else ()
        masses = SagMasses(i, frames, gravity)
        if frames and float(unit_torques(chain, masses, q).std(axis=1).max()) > LEAST_TORQUE:
            yield masses


def unit_torques(chain: Chain, masses: SagMasses, q: Floats) -> Floats:
    """(m, n) [kg·m] of unit masses about the joint, gravity of length 1, at readings q (n, j)."""
    own = with_laws(chain, [masses])
    return Sag.of_chain(own).by_parameters(own.params_nominal, q.T)


def prior_blocks(laws: Sequence[Law]) -> list[PriorBlock]:
    """The priors of the laws' coefficients, in their order."""
    out, at = [], 0
    for law in laws:
        if isinstance(law, CurveKnots):
            block = PriorBlock(slice(at, at + law.count), _kernels(law), CURVE_CAP)
        else:
            m = len(law.frames)
            block = PriorBlock(slice(at, at + m), np.eye(m)[None], SAG_CAP)
        out.append(block)
        at = block.columns.stop
    return out


def _kernels(law: CurveKnots) -> Floats:
    """(o, m, m) Matérn-5/2 between the centres, at each length; on a circle the sum over all turns."""
    apart = law.spacing * np.subtract.outer(np.arange(law.count), np.arange(law.count))
    turns = np.arange(-IMAGES, IMAGES + 1) if law.periodic else np.zeros(1)
    images = apart + law.count * law.spacing * turns[:, None, None]
    out = []
    for length in LENGTHS:
        a = math.sqrt(5.0) * np.abs(images) / length
        kernel = ((1.0 + a + a**2 / 3.0) * np.exp(-a)).sum(axis=0)
        out.append(kernel / kernel[0, 0])
    return np.array(out)
