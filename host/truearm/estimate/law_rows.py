"""Per-row results of a fit with laws: errors of fits without a row's pose, standardised distances, declared-noise part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.law_fit import LawProblem, Posterior
from truearm.estimate.pose_noise import PoseNoise, pose_rows, spread_of
from truearm.estimate.whitened_rows import gate, in_units, noise_root
from truearm.kinds.group import unit_columns
from truearm.results import ResidualParts
from truearm.types import Floats, Indices, Residuals
from truearm.units import UNITS

LEAST_SHARE = 1e-9  # of a pose's variance that remains after fitting the unknowns: less is rounding


class LawRows(NamedTuple):
    """Results for n rows, NaN for those without a fit; errors by SI unit."""

    left_out: Residuals  # magnitude of each row's error in a fit without its pose
    distance: Floats  # (n,) from the prediction, in standard deviations of the learned noise
    beyond: NDArray[np.bool_]  # (n,) farther than one clean row in a million
    width: Indices  # (n,) residuals of a row
    parts: Mapping[str, ResidualParts]  # part of the residuals due to declared noise, and the rest


def law_rows(of: LawProblem, found: Posterior, noise: PoseNoise, fitted: bool = True) -> LawRows:
    """Evaluate the rows of a problem, which were ``fitted`` or are predicted.

    With a pose's residuals r, their noise R and J P Jᵀ, the fit without that pose leaves R (R − J P Jᵀ)⁻¹ r, to first
    order and with unchanged variances (``mean_error`` has the case R = I). The distance of a row is √(rᵀ(R − J P Jᵀ)⁻¹
    r), that of a predicted row √(rᵀ(R + J P Jᵀ)⁻¹r).
    """
    problem = of.problem
    left_out, distance = problem.no_residuals(), np.full(problem.n_rows, np.nan)
    beyond, widths = np.zeros(problem.n_rows, dtype=bool), np.ones(problem.n_rows, dtype=np.intp)
    squares: dict[str, list[Floats]] = {}
    for poses in pose_rows(problem, found.x, of.columns, of.pose):
        if poses.is_knowledge:
            continue
        poses = poses.projected(np.concatenate([poses.rows, poses.moved], axis=2))
        w = poses.rows.shape[1]
        cov, residual = poses.covariances(noise), poses.rows[..., -1]
        spread = spread_of(poses.rows, found.covariance)
        values, vectors = np.linalg.eigh(cov - spread if fitted else cov + spread)
        alone = values <= LEAST_SHARE * cov[:, range(w), range(w)].max(axis=1, keepdims=True)  # nothing contradicts it
        inverse = np.where(alone, 0.0, 1.0 / np.where(alone, 1.0, values))
        weighed = (vectors @ (vectors.swapaxes(1, 2) @ residual[..., None] * inverse[..., None]))[..., 0]
        followed = np.linalg.solve(cov, spread).astype(float)  # the fit's share of each residual, by the assumed noise
        of_poses = (
            poses.expanded((cov @ weighed[..., None])[..., 0]),
            poses.expanded(residual),
            np.maximum(1.0 - poses.diagonals(followed), 0.0),
            poses.expanded(residual) * poses.expanded(weighed),
        )
        for group, declared, at in poses.kinds:
            width, root = group.sensor_cov.shape[1], noise_root(declared)
            without, with_all, own, square = (array[:, at].reshape(-1, width) for array in of_poses)
            without, with_all = in_units(root, without), in_units(root, with_all)
            for unit, components in unit_columns(group.COMPONENTS).items():
                left_out[unit][group.row] = np.linalg.norm(without[:, components], axis=1)
                due = (root[:, components] ** 2 * own[:, None]).sum(axis=(1, 2))
                squares.setdefault(unit, []).append(np.stack([due, (with_all[:, components] ** 2).sum(axis=1)]))
            square = np.maximum(square.sum(axis=1), 0.0)
            distance[group.row], beyond[group.row] = np.sqrt(square), square > gate(width)
            widths[group.row] = width
    means = {unit: np.concatenate(squares[unit], axis=1).mean(axis=1) for unit in UNITS if unit in squares}
    parts = {u: ResidualParts(math.sqrt(due), math.sqrt(max(is_ - due, 0.0))) for u, (due, is_) in means.items()}
    return LawRows(left_out, distance, beyond, widths, parts)


def with_predicted(rows: LawRows, predicted: LawRows) -> LawRows:
    """Return the distances of fitted rows together with those of rows that were predicted."""
    here = np.isfinite(predicted.distance)
    return rows._replace(
        distance=np.where(here, predicted.distance, rows.distance),
        beyond=rows.beyond | predicted.beyond,
        width=np.where(here, predicted.width, rows.width),
    )
