"""Noise per pose in addition to the declared noise: R = m·I + p·T Tᵀ + q·C Cᵀ for whitened rows.

Rows are first whitened by their declared covariance, so m is a factor on it: 1 where the sensors are as declared. With
T = ∂(rows)/∂(a translation of the end) and C = ∂(rows)/∂(joint readings), p [m²] is the variance of a displacement of
the end shared by all rows of a pose, and q [rad²] that of an independent error of each joint. The three are learned by
their evidence (``learned_noise``). Without them, a model error shared by the rows of a pose would count as information,
and noise of the arm would be fitted by joint laws.

R differs from m·I only in the k columns of [T|C]. With an orthonormal basis B (N, k) of these, a pose of N > k residuals
has Bᵀ R B as its only matrix to invert; the other N − k directions have the noise m alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from truearm.estimate.information import fold
from truearm.estimate.problem import Problem
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.kinds.group import Group
from truearm.model.constant_folding import folded
from truearm.types import Floats, Indices

CHUNK = 400_000  # numbers per chunk of rows: 3 MB
SMALLEST_SHARE = 0.01  # of the rows kept for a part of the noise, however much the unknowns absorb
SETTLED = 1e-3  # relative change of the variances from step to step
MAX_STEPS = 30
LEAST_FACTOR = 1e-6  # on the declared variances
FORCE = (0, 2, 4)  # of a wrench's first six numbers, those that depend on a translation of the end


class PoseNoise(NamedTuple):
    """Variances: a factor ``sensor`` on the declared ones, ``shared`` [m²], ``joint`` [rad²]."""

    sensor: float = 1.0
    shared: float = 0.0
    joint: float = 0.0


class RowsByPose(NamedTuple):
    """n poses with w whitened residuals each, and equally many rows of the table per pose."""

    group: Group  # pose by pose; for knowledge (``row`` None) the noise is as declared
    declared: Floats  # (n·rows a pose, …) the rows' covariances, as ``residual_noise`` has them
    rows: Floats  # (n, w, b + r + 1) wrenches, by the rig's unknowns, residual
    by_joints: Floats  # (n, w, j)
    basis: Floats | None = None  # (n, N, w), of w of N residuals, if the poses are projected

    def projected(self, columns: Floats) -> RowsByPose:
        """Return the poses on an orthonormal basis of ``columns`` (n, N, k), unless these are as many as residuals."""
        if columns.shape[2] >= columns.shape[1]:
            return self
        basis = np.linalg.qr(columns)[0]
        turn = basis.swapaxes(1, 2)
        return self._replace(rows=turn @ self.rows, by_joints=turn @ self.by_joints, basis=basis)

    def split(self) -> tuple[RowsByPose, Floats]:
        """Return the poses on a basis of [T|C], and their rows beyond it (n, N, b + r + 1); N is 0 if none are."""
        shared = self.projected(np.concatenate([self.translation, self.by_joints], axis=2))
        beyond = self.rows[:, :0] if shared.basis is None else self.rows - shared.basis @ shared.rows
        return shared, beyond

    @property
    def spare(self) -> int:
        """Return the number of a pose's directions beyond the basis."""
        return 0 if self.basis is None else self.basis.shape[1] - self.basis.shape[2]

    def expanded(self, vectors: Floats) -> Floats:
        """Return vectors (n, N) of the residuals from those on the basis (n, w)."""
        return vectors if self.basis is None else (self.basis @ vectors[..., None])[..., 0]

    def diagonals(self, matrices: Floats) -> Floats:
        """Return diagonals (n, N) by residual of matrices on the basis (n, w, w)."""
        if self.basis is None:
            return np.diagonal(matrices, axis1=1, axis2=2)
        return np.asarray(((self.basis @ matrices) * self.basis).sum(axis=2))

    @property
    def translation(self) -> Floats:
        """(n, w, 3) T"""
        return self.rows[..., FORCE]

    def covariances(self, noise: PoseNoise) -> Floats:
        """(n, w, w) R"""
        n, w = self.rows.shape[:2]
        if self.group.row is None:
            return np.broadcast_to(np.eye(w), (n, w, w))
        out = noise.joint * (self.by_joints @ self.by_joints.swapaxes(1, 2))
        if noise.shared:
            out += noise.shared * (self.translation @ self.translation.swapaxes(1, 2))
        out[:, range(w), range(w)] += noise.sensor
        return np.asarray(out)


class PoseInformation(NamedTuple):
    """Rows [J|f] (m, k + 1) that hold all that the observations say, whitened by R, and the log determinant of R."""

    rows: Floats
    logdet: float


def pose_rows(problem: Problem, x: Floats, pose: Indices, every: int = 1) -> Iterator[RowsByPose]:
    """Return all poses, or every ``every``-th, linearised at x, in chunks with equally many rows per pose.

    ``pose`` (n_rows,) holds the numbers of the poses.
    """
    width = len(folded(problem.chain, x[: problem.n_robot]).twists) + len(problem.names) - problem.n_robot + 1
    for group in problem.groups:
        for piece, count in _pieces(group, pose, width, every):
            yield _whitened(problem, x, piece, count)


def _pieces(group: Group, pose: Indices, width: int, every: int) -> Iterator[tuple[Group, int]]:
    """Yield some of a group's observations, pose by pose, and the number of them per pose."""
    if group.row is None:
        yield group, 1
        return
    w = group.sensor_cov.shape[1]
    mine = pose[group.row]
    order = np.argsort(mine, kind="stable")
    _, first, size = np.unique(mine[order], return_index=True, return_counts=True)
    parts: dict[int, list[Indices]] = {}
    for start, count in zip(first[::every].tolist(), size[::every].tolist(), strict=True):
        parts.setdefault(count, []).append(order[start : start + count])
    for count, some in sorted(parts.items()):
        each = max(1, CHUNK // (count * w * width))
        for at in range(0, len(some), each):
            yield group.take(np.concatenate(some[at : at + each])), count


def _whitened(problem: Problem, x: Floats, piece: Group, count: int) -> RowsByPose:
    lin = piece.evaluate(problem.chain, x)
    w, n, _ = lin.wrenches.shape
    parts = (lin.wrenches, lin.jac_rig, lin.residual.reshape(n, w).T[..., None], lin.by_joints)
    stacked = np.concatenate([np.moveaxis(part, 2, 0) for part in parts])
    declared = residual_cov(piece.sensor_cov, lin.jac_joints, problem.joint_cov)
    whiten(stacked, declared)
    rows = np.ascontiguousarray(stacked.transpose(2, 1, 0)).reshape(n // count, count * w, -1)
    j = lin.by_joints.shape[2]
    return RowsByPose(piece, declared, rows[..., :-j], rows[..., -j:])


def pose_information(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], pose: Indices, noise: PoseNoise
) -> PoseInformation:
    """Return the observations' information on x[columns] and the residual, at x with the given noise."""
    mix = unknowns_of_rows(problem, x, columns)
    triangle, logdet = np.zeros((mix.shape[0], mix.shape[0])), 0.0
    for poses in pose_rows(problem, x, pose):
        shared, beyond = poses.split()
        root = np.linalg.cholesky(shared.covariances(noise))
        logdet += 2.0 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
        logdet += len(root) * shared.spare * math.log(noise.sensor)
        rows = shared.rows / root if root.shape[1] == 1 else np.linalg.inv(root) @ shared.rows
        for whole in (rows, beyond / math.sqrt(noise.sensor)):
            triangle = fold(triangle, whole.reshape(-1, whole.shape[2]))
    return PoseInformation(np.asarray(triangle @ mix), logdet)


def unknowns_of_rows(problem: Problem, x: Floats, columns: NDArray[np.bool_]) -> csr_array:
    """Return (b + r + 1, k + 1), nearly all zeros: ``PoseRows.rows`` times it are the derivatives by x[columns], and the residual."""
    robot, rig = columns[: problem.n_robot], columns[problem.n_robot :]
    twists = folded(problem.chain, x[: problem.n_robot]).twists[:, robot]
    b, p = twists.shape
    mix = np.zeros((b + rig.size + 1, p + int(rig.sum()) + 1))
    mix[:b, :p] = twists
    mix[b + np.flatnonzero(rig), p + np.arange(int(rig.sum()))] = 1.0
    mix[-1, -1] = 1.0
    return csr_array(mix)


def in_rows(mix: csr_array, covariance: Floats) -> Floats:
    """Return the covariance (k, k) of the unknowns in terms of ``PoseRows.rows``, with zeros for the residual."""
    unknowns = mix[:, :-1]
    return np.asarray(unknowns @ (unknowns @ covariance).T)


def spread_of(rows: Floats, posterior: Floats) -> Floats:
    """Return J P Jᵀ (n, w, w) of the rows (n, w, b) of poses, P (b, b)."""
    n, w, b = rows.shape
    return np.asarray((rows.reshape(n * w, b) @ posterior).reshape(n, w, b) @ rows.swapaxes(1, 2))


class PoseSample(NamedTuple):
    """Poses with equal numbers of rows, in the form that the evidence of their noise needs: on a basis of [T|C].

    ``beyond`` are the number of the other directions, and the sums of e² and of J P Jᵀ over them.
    """

    residual: Floats  # (n, w) at the estimate
    spread: Floats  # (n, w, w) J P Jᵀ
    translation: Floats  # (n, w, 3)
    by_joints: Floats  # (n, w, j)
    beyond: tuple[int, float, float] = (0, 0.0, 0.0)


def pose_samples(
    problem: Problem, x: Floats, pose: Indices, step: Floats, posterior: Floats, every: int
) -> list[PoseSample]:
    """Return the poses' information about the noise once x has moved by a step.

    Step and posterior are in terms of ``unknowns_of_rows``, (b + r + 1,) and (b + r + 1, b + r + 1).
    """
    out = []
    for poses in pose_rows(problem, x, pose, every):
        if poses.group.row is not None:
            shared, beyond = poses.split()
            own = (shared.rows @ step, spread_of(shared.rows, posterior), shared.translation.copy())
            square, spread = ((beyond @ step) ** 2).sum(), ((beyond @ posterior) * beyond).sum()
            sums = len(beyond) * shared.spare, float(square), float(spread)
            out.append(PoseSample(*own, shared.by_joints.copy(), sums))
    return out


def learned_noise(samples: Sequence[PoseSample], noise: PoseNoise, shared: bool) -> PoseNoise:
    """Return the noise at which the gradient of the evidence vanishes for a fixed posterior; without ``shared`` p stays 0.

    With e = R⁻¹ r the gradient by the variance of a part R_k is ½ (Σ eᵀ R_k e − Σ tr R⁻¹R_k + Σ tr R⁻¹ J P Jᵀ R⁻¹ R_k).
    The last term is the share of the part's rows absorbed by the unknowns. It is kept constant while the variances are
    found (MacKay's γ): if the posterior were kept instead, a smaller R would make it exceed the number of rows.
    """
    spent = _parts(samples, noise).spent
    for _ in range(MAX_STEPS):
        here = _parts(samples, noise)
        old = np.array(noise)
        new = old * here.gain / np.maximum((1.0 - spent) * here.rows, SMALLEST_SHARE * here.rows)
        noise = PoseNoise(max(float(new[0]), LEAST_FACTOR), float(new[1]) * shared, float(new[2]))
        if np.all(np.abs(np.array(noise) - old) <= SETTLED * old):
            break
    return noise


def noise_change(samples: Sequence[PoseSample], old: PoseNoise, new: PoseNoise) -> float:
    """Return the relative change of the poses' covariances R, per row: √(Σ tr (R⁻¹ΔR)² / Σ tr 1).

    Where poses have one row, one part of the noise may grow for another one without any change of R.
    """
    square, count = 0.0, 0
    for sample in samples:
        change = np.linalg.solve(_covariances(sample, new), _covariances(sample, PoseNoise(*np.subtract(new, old))))
        square += float((change * change.swapaxes(1, 2)).sum())
        square += sample.beyond[0] * (new.sensor / old.sensor - 1.0) ** 2
        count += sample.residual.size + sample.beyond[0]
    return math.sqrt(square / max(count, 1))


def _covariances(sample: PoseSample, noise: PoseNoise) -> Floats:
    """Return R (n, w, w) of some poses."""
    own = noise.sensor * np.eye(sample.residual.shape[1])
    return np.asarray(own + noise.shared * _square(sample.translation) + noise.joint * _square(sample.by_joints))


class _Parts(NamedTuple):
    """Of m, p and q: Σ eᵀ R_k e, Σ tr R⁻¹R_k, and the share of the latter absorbed by the unknowns."""

    gain: Floats
    rows: Floats
    spent: Floats


def _parts(samples: Sequence[PoseSample], noise: PoseNoise) -> _Parts:
    gain, rows, spent = np.zeros(3), np.zeros(3), np.zeros(3)
    for sample in samples:
        parts = (np.eye(sample.residual.shape[1])[None], _square(sample.translation), _square(sample.by_joints))
        inverse = np.linalg.inv(noise.sensor * parts[0] + noise.shared * parts[1] + noise.joint * parts[2])
        e = (inverse @ sample.residual[..., None])[..., 0]
        used = inverse @ sample.spread @ inverse
        for k, part in enumerate(parts):
            gain[k] += float((e * (part @ e[..., None])[..., 0]).sum())
            rows[k] += float((inverse * part).sum())
            spent[k] += float((used * part).sum())
        n, square, spread = sample.beyond
        gain[0] += square / noise.sensor**2
        rows[0] += n / noise.sensor
        spent[0] += spread / noise.sensor**2
    return _Parts(gain, rows, np.divide(spent, rows, out=np.zeros(3), where=rows > 0.0))


def _square(factor: Floats) -> Floats:
    return np.asarray(factor @ factor.swapaxes(1, 2))
