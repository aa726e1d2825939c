"""Renders, Rossignol, Becquet, Hanus 1991, computed on the simulated bench of ``line_bench``.

The true robot has the errors that the paper identified, of III-E (joint offsets) and of III-F (offsets and lengths).
Where the paper's floor of some tenths of a millimetre must appear, the joints have errors like those of eccentric
gears, which no parameter describes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from truearm.estimate import recursive
from truearm.estimate.fit import fit
from truearm.estimate.information import covariance, observe, spectrum
from truearm.estimate.problem import Problem, build_problem
from truearm.estimate.solution import Options
from truearm.estimate.solvers import solver as solver_of
from truearm.estimate.uncertainty import CartesianError, tolerance_error
from truearm.model.chain import Chain, point_forward, point_jacobians
from truearm.reproduce.line_bench import ANGLE_SIGMA, MeasuredLines, line_rig, measured_lines, prior_of
from truearm.results import Figures
from truearm.types import Floats, LinePlacement, Residuals

# Identified errors and the σ printed next to them [rad, m], of III-E and of III-F, which prints its lengths as Δα2,
# Δα4, Δα6, Δα6: a2, d4, a6, d6.
PRINTED_E = {
    "joint2.offset": (0.0236, 0.0005),
    "joint3.offset": (-0.1277, 0.0007),
    "joint4.offset": (-0.0341, 0.0014),
    "joint5.offset": (0.2585, 0.0010),
    "joint6.offset": (-0.0109, 0.0148),
}
PRINTED_F = {
    "joint2.offset": (0.0049, 0.0002),
    "joint3.offset": (-0.0995, 0.0005),
    "joint4.offset": (-0.0334, 0.0010),
    "joint5.offset": (0.1760, 0.0012),
    "joint6.offset": (0.3122, 0.0122),
    "joint2.a": (-0.0022, 0.00011),
    "joint4.d": (-0.0148, 0.00034),
    "joint6.a": (0.0017, 0.00008),
    "joint6.d": (0.0166, 0.00010),
}
# Table I: α [rad], a [m], d [m] of each row
TABLE_ONE = (
    (-np.pi / 2, 0.0, 0.0),
    (0.0, 0.350, 0.0),
    (np.pi / 2, 0.0, 0.0),
    (-np.pi / 2, 0.0, 0.350),
    (np.pi / 2, 0.0, 0.0),
    (0.0, 0.0, 0.1),
)
CASE_E = {name: error for name, (error, _) in PRINTED_E.items()}
CASE_F = {name: error for name, (error, _) in PRINTED_F.items()}
N_LINES, N_POINTS = 5, 12  # III-E; the last line validates
WIDE = 0.1  # m, for a device placed by hand where a poor nominal model puts the line
GEAR = 1e-3  # rad, for an arm with a repeatability of some tenths of a millimetre


class Case(NamedTuple):
    """Mean errors [m] of one identification: on the identification lines before and after every run, and on the other
    line.

    The validation line's device is fitted again with the robot fixed, both before and after.
    """

    history: tuple[float, ...]
    validation_before: float
    validation_after: float
    runs: int
    nees: float  # of the robot's free parameters, by the solver's covariance
    error: Mapping[str, float]  # identified for each of them, relative to nominal [rad, m]
    sigma: Mapping[str, float]  # as stated by the solver


def errors_added(chain: Chain, errors: Mapping[str, float]) -> Floats:
    """Return the nominal parameters (p,) with errors added."""
    return np.array([p.nominal + errors.get(p.name, 0.0) for p in chain.parameters])


def case(
    chain: Chain,
    session: MeasuredLines,
    truth: Floats,
    free: Iterable[str],
    solver: str,
    *,
    rule: LinePlacement = LinePlacement.LEAST_SQUARES,
    runs: int = 50,
    joint_noise: bool = True,
) -> Case:
    """Identify ``free`` on all lines but the last, and validate on the last."""
    free, table, p = frozenset(free), session.table, len(chain.parameters)
    rig = line_rig(session, rule, WIDE, joint_noise)
    last = table.line == table.line[-1]
    problem = build_problem(chain, rig, table.select(~last), prior_of(chain))
    columns = np.array([name in free or name.startswith("line.") for name in problem.names])
    history = [_mean(observe(problem, problem.start, columns).residual)]
    options = Options(runs, on_step=lambda _, residual: history.append(_mean(residual)))
    found = solver_of(solver)(problem, columns, problem.start, options)
    judge = build_problem(chain, rig, table.select(last))
    before, after = (_on_other_line(judge, params) for params in (chain.params_nominal, found.x[:p]))
    error = (found.x[:p] - truth)[columns[:p]]
    claimed = found.covariance[: error.size, : error.size]
    names = [name for name, one in zip(problem.names[:p], columns[:p], strict=True) if one]
    identified = (found.x[:p] - chain.params_nominal)[columns[:p]]
    return Case(
        tuple(history),
        before,
        after,
        found.iterations,
        float(error @ np.linalg.solve(claimed, error)),
        dict(zip(names, identified.tolist(), strict=True)),
        dict(zip(names, np.sqrt(np.diag(claimed)).tolist(), strict=True)),
    )


def _on_other_line(problem: Problem, params: Floats) -> float:
    x = np.concatenate([params, problem.start[params.size :]])
    columns = np.arange(x.size) >= params.size
    return _mean(fit(problem, columns, x, Options(), 0.0).information.residual)


def before(chain: Chain, session: MeasuredLines, rule: LinePlacement) -> float:
    """Return the mean error [m] of the identification lines for the nominal robot and a placement rule."""
    table = session.table
    problem = build_problem(chain, line_rig(session, rule, WIDE), table.select(table.line != table.line[-1]))
    return _mean(observe(problem, problem.start, np.ones(problem.start.size, dtype=bool)).residual)


def drawn_case(chain: Chain, solver: str, runs: int, rng: np.random.Generator, joint_noise: bool = True) -> Case:
    """Return a case with true offsets drawn from the paper's prior, to test its covariance."""
    truth = errors_added(chain, {name: ANGLE_SIGMA * rng.standard_normal() for name in CASE_E})
    session = measured_lines(chain, truth, N_LINES, N_POINTS, rng)
    return case(chain, session, truth, CASE_E, solver, runs=runs, joint_noise=joint_noise)


def unseen(chain: Chain, a6: float, frozen: Iterable[str], rng: np.random.Generator) -> int:
    """Return how many row parameters (not ``frozen``) one point and an unplaced device cannot determine."""
    names, frozen = chain.parameter_names, frozenset(frozen)
    params = errors_added(chain, {"joint6.a": a6})
    q = rng.uniform([j.lower for j in chain.joints], [j.upper for j in chain.joints], (100, len(chain.joints)))
    jac = point_jacobians(chain, params, q, np.zeros(3))[1].reshape(-1, len(names))
    gains = {chain.parameter_names[i] for i in chain.law.gain.parameters}
    rows = [i for i, n in enumerate(names) if n.startswith("joint") and n not in frozen | gains]
    device = [i for i, n in enumerate(names) if n.startswith("base.")]
    return len(rows) - (_rank(jac[:, rows + device]) - _rank(jac[:, device]))


def _rank(jac: Floats) -> int:
    parts = spectrum(np.asarray(np.linalg.qr(jac, mode="r")))
    return int((parts.singular > 1e-10 * parts.singular[0]).sum())


class CrossSection(NamedTuple):
    """Poses of a vertical cross section of the workspace, θ1 = θ4 = θ6 = 0, elbow up (Fig. 5)."""

    x: Floats  # (n,) m
    z: Floats  # (n,)
    q: Floats  # (n, j)


def section(chain: Chain, step: float) -> CrossSection:
    """Return poses with the flange's centre on a grid of ``step`` [m], hand pointing down, within the arm's reach.

    The elbow and the wrist lie in the plane, so the joints follow from two triangles: with the wrist at w = flange + d6
    upwards, r = |w|, cos θ3' = (r² − a2² − d4²)/(2 a2 d4).
    """
    named = dict(zip(chain.parameter_names, chain.params_nominal.tolist(), strict=True))
    a2, d4, d6 = named["joint2.a"], named["joint4.d"], named["joint6.d"]
    x, z = (v.ravel() for v in np.meshgrid(np.arange(0.1, 0.8, step), np.arange(-0.6, 0.7, step)))
    up, r2 = z + d6, x**2 + (z + d6) ** 2
    cosine = (r2 - a2**2 - d4**2) / (2.0 * a2 * d4)
    inside = np.abs(cosine) < 0.98
    x, z, up, bend = x[inside], z[inside], up[inside], np.arccos(cosine[inside])
    # A link at angle φ above the horizontal is θ2 = −φ; the forearm, along z of frame 4, adds θ3 − π/2.
    shoulder = np.arctan2(up, x) + np.arctan2(d4 * np.sin(bend), a2 + d4 * np.cos(bend))
    q = np.zeros((x.size, len(chain.joints)))
    q[:, 1], q[:, 2] = -shoulder, bend + np.pi / 2.0
    q[:, 4] = np.pi - q[:, 1] - q[:, 2]
    return CrossSection(x, z, q)


def a_priori(chain: Chain, where: CrossSection) -> CartesianError:
    """Return the flange's expected error of II-D, before any measurement, from the tolerances of III-C on every row."""
    sigma = prior_of(chain)
    rows = np.array([sigma.get(n, 0.0) if n.startswith("joint") else 0.0 for n in chain.parameter_names])
    return tolerance_error(chain, rows, where.q, np.zeros(3))


def error_map(chain: Chain, where: CrossSection, errors: Mapping[str, float]) -> Floats:
    """Return (31): the distance (n,) [m] of the identified from the nominal flange."""
    apart = [point_forward(chain, errors_added(chain, e), where.q, np.zeros(3)) for e in ({}, errors)]
    return np.asarray(np.linalg.norm(apart[1] - apart[0], axis=1))


def batch_against_recursive(chain: Chain, session: MeasuredLines) -> tuple[float, float]:
    """Return the largest relative difference of (12) in one step and (18), (20) point by point, of Δ and of P."""
    rig = line_rig(session, LinePlacement.LEAST_SQUARES, WIDE)
    problem = build_problem(chain, rig, session.table, prior_of(chain))
    columns = np.array([name in CASE_E or name.startswith("line.") for name in problem.names])
    sigma = problem.prior_sigma[columns]
    rows = recursive.rows_of(problem, problem.start, columns)
    used = np.ones(len(rows.residual), dtype=bool)
    state = recursive.run(recursive.start(np.zeros(sigma.size), sigma), rows, used).filter
    data = observe(problem, problem.start, columns)
    stacked = np.concatenate([data.root, np.diag(1.0 / sigma)])
    batch = covariance(spectrum(np.asarray(np.linalg.qr(stacked, mode="r"))))
    delta = batch @ data.root.T @ data.rhs
    apart = np.abs(state.root @ state.root.T - batch).max() / np.abs(batch).max()
    return float(np.abs(state.delta - delta).max() / np.abs(delta).max()), float(apart)


def table_one(chain: Chain) -> int:
    """Return how many of the 18 numbers of Table I the robot file contains."""
    named = dict(zip(chain.parameter_names, chain.params_nominal.tolist(), strict=True)) | {"joint2.d": 0.0}
    printed = {
        f"joint{i}.{key}": value
        for i, row in enumerate(TABLE_ONE, 1)
        for key, value in zip(("alpha", "a", "d"), row, strict=True)
    }
    return sum(abs(named[name] - value) < 1e-12 for name, value in printed.items())


def with_d2(chain: Chain) -> Chain:
    """Return the chain with joint 2's constant d as a parameter besides β: all rows that Renders could have freed."""
    at = next(i for i, e in enumerate(chain.elements) if e.joint == 1) + 1
    d2 = replace(chain.elements[at], parameter=len(chain.parameters))
    extra = replace(chain.parameters[chain.parameter_names.index("joint1.d")], name="joint2.d", nominal=0.0)
    elements = (*chain.elements[:at], d2, *chain.elements[at + 1 :])
    return replace(chain, elements=elements, parameters=(*chain.parameters, extra))


def _mean(residual: Residuals) -> float:
    return Figures.of(residual["m"]).mean
