"""Candidate joint laws that the observations can determine: knots over the covered range, sag masses, and their priors.

The constants were chosen on UR10 series C (a fifth held out: curves) and on an IRB 120 with a tracker (sag), not on the
other arms of docs/explanation/real-arms.md. Knots 0.12, 0.08, 0.05 and 0.035 rad apart gave 0.176, 0.102, 0.086 and
0.082 mm on the UR10.

The coefficients of a curve have a stationary Gaussian-process prior: a sum of Matérn-5/2 kernels at octaves of length,
each with its own variance. Outside the data it returns to zero with a realistic variance, which an integrated Wiener
process does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import InputError
from truearm.estimate.solvers import LawMode
from truearm.findings import Finding
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.model.joint_terms.curve import Curve
from truearm.model.joint_terms.sag import Sag
from truearm.model.law_chain import DOWN, carries, distal_frames, with_laws
from truearm.types import CurveKnots, Floats, Law, Payload, SagMasses
from truearm.units import DEG

SPACING = 0.05  # rad between knots, at most
LENGTHS = 0.05 * 2.0 ** np.arange(7)  # rad
REACH = float(LENGTHS[0])  # rad: farther from all fitted readings, the shortest kernel and the knots know nothing
MARGIN = 0.8  # rad beyond the covered range
TURNS = 2.0 * math.pi - 0.3  # rad: a joint whose readings span more is periodic
STILL = 0.1  # rad: readings that span less do not determine a curve
CURVE_CAP = 3e-4  # rad
SAG_CAP = 3e-3  # rad per kg·m
LEAST_TORQUE = 0.02  # kg·m, standard deviation over the poses
ONE_DIRECTION = math.radians(1.0)  # permitted variation of gravity between rows: 2 % of a torque


class Gravity(NamedTuple):
    """Gravity's direction in the base frame, whether it is known, and the largest angle of a row's to it [rad]."""

    direction: tuple[float, float, float]
    known: bool
    apart: float = 0.0


def gravity_of(table: ObservationTable, of_robot: tuple[float, float, float] | None) -> Gravity:
    """Return the mean direction of the rows that have one, otherwise the robot's, otherwise -z.

    Raises InputError for a row whose gravity has length 0.
    """
    declared = table.gravity
    rows = np.flatnonzero(np.isfinite(declared).all(axis=1))
    if not rows.size:
        return Gravity(of_robot or DOWN, of_robot is not None)
    length = np.linalg.norm(declared[rows], axis=1)
    if not length.all():
        raise InputError(
            f"{table.source[rows[length == 0.0][0]]}: gravity is 0; give its direction in the base frame (gravity_x_m_s2, …)"
        )
    unit = declared[rows] / length[:, None]
    x, y, z = mean = unit.mean(axis=0) / max(float(np.linalg.norm(unit.mean(axis=0))), LEAST_TORQUE)
    return Gravity((float(x), float(y), float(z)), True, float(np.arccos(np.clip(unit @ mean, -1.0, 1.0)).max()))


def candidates(
    chain: Chain, q: Floats, mode: LawMode, gravity: Gravity, payloads: Sequence[Payload] = ()
) -> tuple[list[Law], list[Finding]]:
    """Return the laws to try for readings q (n, j), and why joints can have none.

    ``payloads`` are the different ones of the rows. A single one cannot be distinguished from the mass of the tool.
    """
    laws: list[Law] = []
    reasons: list[Finding] = []
    if mode in (LawMode.AUTO, LawMode.SAG) and gravity.apart > ONE_DIRECTION:
        reasons.append(Finding("no-sag", {"apart": {"deg": DEG.of(gravity.apart)}}))
    elif mode in (LawMode.AUTO, LawMode.SAG):
        laws += _sags(chain, q, gravity.direction, payloads)
        if not laws:
            reasons.append(Finding("no-sag"))
    if mode in (LawMode.AUTO, LawMode.CURVE):
        for i, joint in enumerate(chain.joints):
            span = float(np.ptp(q[:, i]))
            if joint.kind != "revolute":
                reasons.append(Finding("no-curve", {"joint": joint.name}))
            elif span < STILL:
                reasons.append(Finding("no-curve", {"joint": joint.name, "span": {"deg": DEG.of(span)}}))
            else:
                laws.append(knots(i, q[:, i]))
    return laws, reasons


def knots(joint: int, readings: Floats) -> CurveKnots:
    """Return knots over the range of readings (n,) [rad] plus a margin; periodic if the joint turns completely."""
    lower, upper = float(readings.min()), float(readings.max())
    if upper - lower > TURNS:
        count, covered = math.ceil(2.0 * math.pi / SPACING), _near(readings, around=True)
        return CurveKnots(joint, lower, 2.0 * math.pi / count, count, True, covered)
    count = math.ceil((upper - lower + 2.0 * MARGIN) / SPACING) + 1
    return CurveKnots(joint, lower - MARGIN, SPACING, count, False, _near(readings, around=False))


def _near(readings: Floats, around: bool) -> tuple[tuple[float, float], ...]:
    """Return the intervals within REACH of any of the readings (n,); ``around``: on a circle."""
    lowest = float(readings.min())
    different = np.unique(lowest + np.mod(readings - lowest, 2.0 * math.pi) if around else readings)
    ends = np.flatnonzero(np.diff(different) > 2.0 * REACH)
    low, high = different[np.append(0, ends + 1)] - REACH, different[np.append(ends, -1)] + REACH
    if around and high[0] - low[0] >= 2.0 * math.pi:
        return ((lowest, lowest + 2.0 * math.pi),)
    return tuple(zip(low.tolist(), high.tolist(), strict=True))


def _sags(
    chain: Chain, q: Floats, gravity: tuple[float, float, float], payloads: Sequence[Payload]
) -> Iterator[SagMasses]:
    differs = len(payloads) > 1
    heaviest = carries(chain, max(payloads)) if differs else chain
    for i, joint in enumerate(chain.joints):
        if joint.kind == "revolute":
            masses = SagMasses(i, distal_frames(chain, i), gravity, differs)
            if masses.size and float(torques(heaviest, masses, q).std(axis=1).max()) > LEAST_TORQUE:
                yield masses


def torques(chain: Chain, masses: SagMasses, q: Floats) -> Floats:
    """Return torques (m, n) [kg·m] about the joint at readings q (n, j), with gravity of length 1.

    They are those of unit masses and of the chain's payload.
    """
    sagging = with_laws(chain, [masses])
    return Sag.of_chain(sagging).by_parameters(sagging.params_nominal, q.T)


class LawPrior(NamedTuple):
    """The prior of a law's coefficients (m,): ``basis`` (m, f) times independent modes of variances v·``spectra``.

    ``spectra`` is (o, f) for o variances v, and ``cap`` is the scale of the hyperprior on each √v.
    """

    basis: Floats
    spectra: Floats
    cap: float


def law_priors(chain: Chain, laws: Sequence[Law], q: Floats) -> dict[Law, LawPrior]:
    """Return the priors of a chain's laws that are fitted to readings q (n, j).

    The mean of a curve over these is 0: it cannot be distinguished from the joint's offset. So a controller that
    ignores curves performs best, and so does a robot outside the covered range.
    """
    priors = dict[Law, LawPrior]()
    for law in laws:
        if isinstance(law, CurveKnots):
            modes, spectra = _spectra(law.count, law.spacing, law.periodic)
            mean = Curve.of_chain(with_laws(chain, [law])).mean_by_parameters(q.T)
            priors[law] = LawPrior(modes - mean @ modes, spectra, CURVE_CAP)
        else:
            priors[law] = LawPrior(np.eye(law.size), np.ones((1, law.size)), SAG_CAP)
    return priors


def acting(law: Law) -> NDArray[np.bool_]:
    """Return a mask of a law's coefficients.

    It lacks those of a curve that act at no reading within its ``covered`` ranges.
    """
    if not isinstance(law, CurveKnots):
        return np.ones(law.size, dtype=bool)
    # A coefficient acts up to two spacings away, and a spacing is at most REACH.
    near = law.first + law.spacing * np.add.outer([-1.0, 0.0, 1.0], np.arange(law.count))
    return np.asarray(law.covers(near).any(axis=0))


@lru_cache(maxsize=8)
def _spectra(count: int, spacing: float, periodic: bool) -> tuple[Floats, Floats]:
    """Return the modes (m, m − 1) of m coefficients, but the constant, and their variances at each length (o, m − 1).

    The modes are sines over the knots, on a circle or between mirrors. A Matérn-5/2 kernel has the spectral density
    (1 + (length · frequency)²/5)⁻³; the variance of a coefficient, between the mirrors, is 1.
    """
    difference = (np.eye(count) - np.roll(np.eye(count), 1, axis=0))[int(not periodic) :]
    square, modes = np.linalg.eigh(difference.T @ difference)
    frequency = 2.0 * np.arcsin(0.5 * np.sqrt(np.clip(square, 0.0, 4.0))) / spacing
    spectra = (1.0 + np.multiply.outer(LENGTHS, frequency) ** 2 / 5.0) ** -3
    spectra *= count / (spectra.sum(axis=1, keepdims=True) - (0.0 if periodic else 0.5) * spectra[:, :1])
    return modes[:, 1:], spectra[:, 1:]
