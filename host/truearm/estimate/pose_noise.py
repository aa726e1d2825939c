"""Noise per pose in addition to the declared noise, for whitened rows (docs/explanation/uncertainty.md):

    R = m·I + p·T Tᵀ + w·W Wᵀ + C Q Cᵀ

m is a factor on the declared variances. Likewise p [m²] and w [rad²] are those of a translation and a rotation of the
last link that all rows of a pose share. Q = diag(q_1 … q_j) [rad² or m²] are those of the joints. T, W and C are the
derivatives of the rows. All are learned by their evidence (``learned_noise``). Without them, an error shared by the
rows of a pose would count as information, and joint laws would be fitted to noise.

Of a pose of more residuals than motions [T|W|C], an orthonormal basis of these has the noise R of that many residuals.
All other directions have the noise m alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.sparse import csr_array

from truearm.estimate.circumstances import first_alike
from truearm.estimate.problem import Problem
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.kinds.group import Group
from truearm.model.chain import direct_basis, folded
from truearm.types import Floats, Indices

_geqrf, _ormqr = get_lapack_funcs(("geqrf", "ormqr"), dtype=np.float64)
ORMQR_WORK = 64_000  # numbers: LAPACK's blocks of 32 columns, of 2000
CHUNK = 400_000  # numbers per chunk of rows: 3 MB
SMALLEST_SHARE = 0.01  # of the rows kept for a part of the noise, however much the unknowns absorb
SETTLED = 1e-3  # change of a part of the noise from step to step, relative to all of it
MAX_STEPS = 30
LEAST_FACTOR = 1e-6  # on the declared variances
MOTIONS = 3  # columns of a translation, and of a rotation, of the end


class PoseNoise(NamedTuple):
    """Variances: a factor ``sensor`` on the declared ones, ``shared`` [m²], ``turned`` [rad²], ``joint`` (j,).

    The last are in rad² or m².
    """

    sensor: float
    shared: float
    turned: float
    joint: Floats

    @classmethod
    def of(cls, sensor: float, joints: int, sigma: float = 0.0) -> PoseNoise:
        """Return the noise of sensors, and of joints that all have one ``sigma``."""
        return cls(sensor, 0.0, 0.0, np.full(joints, sigma**2))

    @property
    def by_column(self) -> Floats:
        """Return the variances (6 + j,) of the columns of [T|W|C]."""
        return np.concatenate([np.repeat([self.shared, self.turned], MOTIONS), self.joint])

    def covariances(self, moved: Floats) -> Floats:
        """Return R (n, w, w) of some poses, or rows of these, with [T|W|C] (n, w, 6 + j)."""
        out = (moved * self.by_column) @ moved.swapaxes(1, 2)
        w = moved.shape[1]
        out[:, range(w), range(w)] += self.sensor
        return np.asarray(out)


class RowsOfKind(NamedTuple):
    """Rows of one kind, equally many for each of n poses, pose by pose."""

    group: Group
    row: Indices  # (n·rows a pose,) of the table; empty for knowledge
    declared: Floats  # (n·rows a pose, …) their covariances, as ``residual_noise`` has them
    place: slice  # among the residuals of a pose


class RowsByPose(NamedTuple):
    """n poses with w whitened residuals each, and equally many rows of each kind per pose."""

    kinds: tuple[RowsOfKind, ...]
    rows: Floats  # (n, w, k + 1) derivatives by the unknowns, and the residual
    moved: Floats  # (n, w, 6 + j) [T|W|C]
    basis: Floats | None = None  # (n, N, w), of w of N residuals, if the poses are projected

    def projected(self, columns: Floats) -> RowsByPose:
        """Return the poses on an orthonormal basis of ``columns`` (n, N, k), unless these are as many as residuals."""
        if columns.shape[2] >= columns.shape[1]:
            return self
        basis = np.linalg.qr(columns)[0]
        turn = basis.swapaxes(1, 2)
        return self._replace(rows=turn @ self.rows, moved=turn @ self.moved, basis=basis)

    def expanded(self, columns: Floats) -> Floats:
        """Return columns (n, N, c) of the residuals from those on the basis (n, w, c)."""
        return columns if self.basis is None else self.basis @ columns

    def own_blocks(self, matrices: Floats, beyond: float, place: slice, width: int) -> Floats:
        """Return blocks (n · rows, w, w) of single rows of ``width`` residuals, in the ``place`` of a kind.

        They are of matrices on the basis (n, q, q), which are ``beyond`` in all other directions.
        """
        n, q, count = len(matrices), matrices.shape[1], (place.stop - place.start) // width
        if self.basis is None:
            blocks = matrices[:, place, place].reshape(n, count, width, count, width)
            return np.moveaxis(np.diagonal(blocks, axis1=1, axis2=3), 3, 1).reshape(-1, width, width)
        rows = self.basis[:, place].reshape(n, count, width, q)
        turned = rows.swapaxes(2, 3)
        out = rows @ matrices[:, None] @ turned + beyond * (np.eye(width) - rows @ turned)
        return np.asarray(out.reshape(-1, width, width))

    @property
    def is_knowledge(self) -> bool:
        """Return whether these are no rows of the table: their noise is as declared."""
        return not self.kinds[0].row.size

    def covariances(self, noise: PoseNoise) -> Floats:
        """(n, w, w) R"""
        n, w = self.rows.shape[:2]
        if self.is_knowledge:
            return np.broadcast_to(np.eye(w), (n, w, w))
        return noise.covariances(self.moved)


def pose_rows(
    problem: Problem,
    x: Floats,
    columns: NDArray[np.bool_],
    pose: Indices,
    root: Floats | None = None,
    motions: bool = True,
) -> Iterator[RowsByPose]:
    """Return all poses in chunks with equally many rows of each kind per pose.

    The unknowns are x[columns], linearised at x, or these by ``root`` (k, r). ``pose`` (n_rows,) holds the numbers of
    the poses. Without ``motions``, ``moved`` has no columns.
    """
    p = problem.n_robot
    bases = folded(problem.chain, x[:p]).basis, direct_basis(p)
    by_unknowns = cache(lambda direct: _by_unknowns(bases[direct].twists, columns, root))
    for pieces in _pieces(problem.groups, pose, by_unknowns(False).shape[0]):
        ends = np.cumsum([count * group.sensor_cov.shape[1] for group, count in pieces]).tolist()
        whitened = [_whitened(problem, x, group, count, by_unknowns, motions) for group, count in pieces]
        places = (slice(first, last) for first, last in pairwise([0, *ends]))
        numbers = (np.zeros(0, dtype=np.intp) if group.row is None else group.row for group, _ in pieces)
        groups, declared = (group for group, _ in pieces), (of_group[0] for of_group in whitened)
        kinds = map(RowsOfKind, groups, numbers, declared, places)
        rows, moved = (
            np.concatenate(arrays, axis=1) for arrays in zip(*(arrays[1:] for arrays in whitened), strict=True)
        )
        yield RowsByPose(tuple(kinds), rows, moved)


def _pieces(groups: Sequence[Group], pose: Indices, width: int) -> Iterator[list[tuple[Group, int]]]:
    """Yield observations of poses with equally many rows of each kind: those of each kind, and how many a pose has."""
    yield from ([(group, 1)] for group in groups if group.row is None)
    measured = [group for group in groups if group.row is not None]
    if not measured:
        return
    orders = [np.argsort(pose[group.row], kind="stable") for group in measured]
    every_count = np.array([np.bincount(pose[group.row], minlength=int(pose.max()) + 1) for group in measured])
    used = np.flatnonzero(every_count.any(axis=0))
    counts, starts = every_count[:, used], (np.cumsum(every_count, axis=1) - every_count)[:, used]  # (groups, poses)
    example, signature_of = first_alike(counts)
    for k, signature in enumerate(counts[:, example].T.tolist()):
        alike = np.flatnonzero(signature_of == k)
        size = sum(count * group.sensor_cov.shape[1] for count, group in zip(signature, measured, strict=True))
        chunk = max(1, CHUNK // (size * width))
        for first in range(0, alike.size, chunk):
            rows = alike[first : first + chunk]
            every_kind = zip(measured, orders, starts, signature, strict=True)
            yield [
                (group.take(order[(start[rows, None] + np.arange(count)).ravel()]), count)
                for group, order, start, count in every_kind
                if count
            ]


def _whitened(
    problem: Problem, x: Floats, piece: Group, count: int, of_basis: Callable[[bool], Floats | csr_array], motions: bool
) -> tuple[Floats, Floats, Floats]:
    """Return the rows' declared covariances; of their poses the rows of ``RowsByPose``, and ``moved``."""
    lin = piece.evaluate(problem.chain, x)
    w, n, _ = lin.wrenches.shape
    by_unknowns = of_basis(lin.basis.direct)
    columns = [lin.wrenches, lin.jac_rig, lin.residual.reshape(n, w).T[..., None]]
    flat = np.concatenate([np.moveaxis(column, 2, 0) for column in columns]).reshape(-1, w * n)
    columns = [np.moveaxis((by_unknowns.T @ flat).reshape(-1, w, n), 0, 2)]
    if motions:
        end = lin.basis.end
        columns += [lin.wrenches @ np.concatenate([end[:, ::2], end[:, 1::2]], axis=1), lin.by_joints]
    stacked = np.concatenate([np.moveaxis(column, 2, 0) for column in columns])
    declared = residual_cov(piece.sensor_cov, lin.jac_joints, problem.joint_cov)
    whiten(stacked, declared)
    rows = np.ascontiguousarray(stacked.transpose(2, 1, 0)).reshape(n // count, count * w, -1)
    k = by_unknowns.shape[1]
    return declared, rows[..., :k], rows[..., k:]


def independent(rows: Iterable[RowsByPose]) -> Iterator[RowsByPose]:
    """Yield poses with at most as many residuals as motions, and their other directions as poses that nothing moves.

    The first are on a basis of [T|W|C], and each of the others has one residual.
    """
    for poses in rows:
        motions = poses.moved.shape[2]
        if poses.is_knowledge or poses.moved.shape[1] <= motions:
            yield poses
            continue
        turned = []
        for moved, whitened in zip(poses.moved, poses.rows, strict=True):
            reflectors, factors, *_ = _geqrf(moved)
            turned.append(_ormqr("L", "T", reflectors, factors, np.hstack([whitened, moved]), ORMQR_WORK)[0])
        whitened, moved = np.split(np.array(turned), [poses.rows.shape[2]], axis=2)
        yield poses._replace(rows=whitened[:, :motions], moved=moved[:, :motions])
        others = whitened[:, motions:].reshape(-1, 1, whitened.shape[2])
        yield poses._replace(rows=others, moved=np.zeros((len(others), 1, motions)))


def pose_information(rows: Iterable[RowsByPose], width: int, noise: PoseNoise) -> tuple[Floats, float]:
    """Return the information [J|f]ᵀR⁻¹[J|f] (k + 1, k + 1) of poses for this noise, log det R; ``width`` = k + 1."""
    information, logdet = np.zeros((width, width)), 0.0
    for poses in rows:
        root = np.linalg.cholesky(poses.covariances(noise))
        logdet += 2.0 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
        whitened = (poses.rows / root if root.shape[1] == 1 else np.linalg.inv(root) @ poses.rows).reshape(-1, width)
        information += whitened.T @ whitened
    return information, logdet


def _by_unknowns(twists: Floats, columns: NDArray[np.bool_], root: Floats | None) -> Floats | csr_array:
    """Return B (b + r + 1, k + 1), mostly zeros, that makes [wrenches | by rig | residual] B rows of ``RowsByPose``.

    With a ``root`` (k, r), the unknowns are these by it.
    """
    robot, rig = np.split(columns, [twists.shape[1]])
    twists = twists[:, robot]
    b, p = twists.shape
    out = np.zeros((b + rig.size + 1, p + int(rig.sum()) + 1))
    out[:b, :p] = twists
    out[b + np.flatnonzero(rig), p + np.arange(int(rig.sum()))] = 1.0
    out[-1, -1] = 1.0
    return csr_array(out) if root is None else np.column_stack([csr_array(out)[:, :-1] @ root, out[:, -1]])


class PoseSample(NamedTuple):
    """Poses with equal numbers of rows, in the form that the evidence of their noise needs."""

    residual: Floats  # (n, w) at the estimate
    spread: Floats  # (n, w, w) J P Jᵀ
    moved: Floats  # (n, w, 6 + j) [T|W|C]


def pose_samples(rows: Iterable[RowsByPose], step: Floats, posterior: Floats, stride: int) -> list[PoseSample]:
    """Return what every ``stride``-th pose says of the noise once x moved by −``step`` (k,); ``posterior`` (k, k)."""
    samples = []
    for poses in rows:
        if not poses.is_knowledge:
            rows_of_poses = poses.rows[::stride]
            n, w, width = rows_of_poses.shape
            jac = rows_of_poses[..., :-1]
            spread = (jac.reshape(n * w, width - 1) @ posterior).reshape(jac.shape) @ jac.swapaxes(1, 2)
            samples.append(PoseSample(rows_of_poses @ np.append(step, 1.0), spread, poses.moved[::stride]))
    return samples


def learned_noise(samples: Sequence[PoseSample], noise: PoseNoise, shared: bool) -> PoseNoise:
    """Return the noise at which the gradient of the evidence vanishes for a fixed posterior.

    Without ``shared`` p and w stay 0.

    With e = R⁻¹ r the gradient by the variance of a part R_k is ½ (Σ eᵀ R_k e − Σ tr R⁻¹R_k + Σ tr R⁻¹ J P Jᵀ R⁻¹ R_k).
    The last term is the share of the part's rows absorbed by the unknowns. It is kept constant while the variances are
    found (MacKay's γ): if the posterior were kept instead, a smaller R would make it exceed the number of rows.
    """
    sums = _parts(samples, noise)
    spent = np.divide(sums.spent, sums.rows, out=np.zeros(sums.rows.size), where=sums.rows > 0.0)
    for _ in range(MAX_STEPS):
        old = np.array([*noise[:3], *noise.joint])
        remaining = np.maximum((1.0 - spent) * sums.rows, SMALLEST_SHARE * sums.rows)
        new = old * np.divide(sums.gain, remaining, out=np.zeros(old.size), where=remaining > 0.0)
        noise = PoseNoise(max(float(new[0]), LEAST_FACTOR), float(new[1]) * shared, float(new[2]) * shared, new[3:])
        if np.all(np.abs(new - old) * sums.rows <= SETTLED * (old @ sums.rows)):
            break
        sums = _parts(samples, noise)
    return noise


def noise_change(samples: Sequence[PoseSample], old: PoseNoise, new: PoseNoise) -> float:
    """Return the relative change of the poses' covariances R, per row: √(Σ tr (R⁻¹ΔR)² / Σ tr 1).

    Where poses have one row, one part of the noise may grow for another one without any change of R.
    """
    square, count = 0.0, 0
    for sample in samples:
        old_cov, new_cov = (noise.covariances(sample.moved) for noise in (old, new))
        change = np.linalg.solve(new_cov, new_cov - old_cov)
        square += float((change * change.swapaxes(1, 2)).sum())
        count += sample.residual.size
    return math.sqrt(square / max(count, 1))


class _Parts(NamedTuple):
    """Of m, p, w and each q: Σ eᵀ R_k e, Σ tr R⁻¹R_k, and that of the latter absorbed by the unknowns."""

    gain: Floats
    rows: Floats
    spent: Floats


def _parts(samples: Sequence[PoseSample], noise: PoseNoise) -> _Parts:
    out = np.zeros((3, 3 + noise.joint.size))
    for sample in samples:
        inverse = np.linalg.inv(noise.covariances(sample.moved))
        e = (inverse @ sample.residual[..., None])[..., 0]
        by = inverse @ sample.moved
        along = (sample.moved * e[..., None]).sum(axis=1)
        columns = np.array(
            [(along**2).sum(axis=0), (sample.moved * by).sum(axis=(0, 1)), (by * (sample.spread @ by)).sum(axis=(0, 1))]
        )
        sensors = np.array(
            [(e**2).sum(), inverse.trace(axis1=1, axis2=2).sum(), (inverse * (sample.spread @ inverse)).sum()]
        )
        pose, joints = np.split(columns, [2 * MOTIONS], axis=1)
        out += np.column_stack([sensors, pose[:, :MOTIONS].sum(axis=1), pose[:, MOTIONS:].sum(axis=1), joints])
    return _Parts(*out)
