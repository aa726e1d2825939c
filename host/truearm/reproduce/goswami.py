"""Goswami, Quaid, Peshkin 1993, computed: ranks, the fit on the shells, its errors, the Stewart platform.

The paper's measurements are lost and are replaced by simulated ones for the paper's own robot. Table II's optimised
values are the truth and its design values the start. Lengths are computed for poses on shells of 46 and 61 cm, with the
paper's 0.084 mm of noise. The chucks and spheres are those of the rig supplied with the poses, because the paper does
not print its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.identify import identify
from truearm.estimate.information import fold, half, observe, seen, spectrum
from truearm.estimate.problem import Problem, build_problem
from truearm.estimate.solution import Options
from truearm.estimate.uncertainty import predicted_error
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, point_forward
from truearm.model.robot import Robot
from truearm.reproduce.line_bench import gear_error
from truearm.results import Estimate, Figures
from truearm.types import Floats, Point, Rig

NOISE = 0.084e-3  # m, the paper's RMS residual
NEAR, FAR = "bar46", "bar61"
LOST = {1: 3, 2: 1, 3: 0}  # parameters that one, two, three chucks (spheres) cannot determine


class Bench(NamedTuple):
    """The paper's experiment: a robot, its rig, and poses with their pairings (``table``, lengths without noise)."""

    robot: Robot
    rig: Rig
    table: ObservationTable

    @property
    def chain(self) -> Chain:
        return self.robot.chain

    @property
    def truth(self) -> Floats:
        return self.robot.parameter_sets["optimised"]


def bench(
    robot: Robot, rig: Rig, q: Floats, bar: NDArray[np.str_], chuck: NDArray[np.str_], sphere: NDArray[np.str_]
) -> Bench:
    """Return a bench of n poses q (n, j) with the pairing that connects robot and table at each."""
    table = ObservationTable(
        q=q,
        kind="ball_bar",
        sigma=NOISE,
        bar=bar,
        chuck=chuck,
        sphere=sphere,
        source=[f"pose {i + 1}" for i in range(len(q))],
    )
    made = Bench(robot, rig, table)
    return made._replace(table=table.replace(value=lengths(made, q)))


def lengths(made: Bench, q: Floats) -> Floats:
    """Return the true centre-to-centre lengths (n,) at joints q (n, j)."""
    p_sphere = point_forward(made.chain, made.truth, q, _points(made.rig.spheres, made.table.sphere))
    return np.asarray(np.linalg.norm(p_sphere - _points(made.rig.chucks, made.table.chuck), axis=1))


def longitudes(made: Bench) -> Floats:
    """Return the longitude (n,) of the sphere about its chuck [rad]."""
    p_sphere = point_forward(made.chain, made.truth, made.table.q, _points(made.rig.spheres, made.table.sphere))
    apart = p_sphere - _points(made.rig.chucks, made.table.chuck)
    return np.arctan2(apart[:, 1], apart[:, 0])


def _points(points: Mapping[str, Point], names: NDArray[np.str_]) -> Floats:
    return np.array([points[str(name)].xyz for name in names])


class Ranks:
    """The ranks of subsets of the pairings, from one triangle per pairing, at ``params`` (p,).

    ``free`` (p,): the free parameters; None: all.
    """

    def __init__(
        self, made: Bench, params: Floats, rig: Rig | None = None, free: NDArray[np.bool_] | None = None
    ) -> None:
        self.rig = rig or made.rig
        chain = made.chain
        self.pairs = tuple(itertools.product(self.rig.chucks, self.rig.spheres))
        start = np.asarray(params)
        every = np.ones(start.size, dtype=bool)
        self.triangles = {}
        for chuck, sphere in self.pairs:
            rows = made.table.select((made.table.chuck == chuck) & (made.table.sphere == sphere))
            problem = build_problem(chain, self.rig, rows)
            self.triangles[chuck, sphere] = observe(problem, start, every if free is None else free).root

    def rank(self, pairs: Iterable[tuple[str, str]]) -> tuple[int, float]:
        """Return the rank, and the ratio of the smallest kept to the largest dropped singular value."""
        size = len(next(iter(self.triangles.values())))
        whole = fold(np.zeros((size, size)), np.concatenate([self.triangles[pair] for pair in pairs]))
        parts = spectrum(whole)
        rank = int(seen(parts).sum())
        dropped = parts.singular[rank] if rank < size else 0.0
        return rank, float(parts.singular[rank - 1] / max(dropped, np.finfo(float).tiny))

    def first(self, n_chucks: int, n_spheres: int) -> int:
        """Return the rank with the first chucks and spheres, this many of each, in all pairings."""
        return self.rank(itertools.product(list(self.rig.chucks)[:n_chucks], list(self.rig.spheres)[:n_spheres]))[0]


class SubsetLaw(NamedTuple):
    """rank = 36 − f(chucks) − f(spheres), f(1) = 3, f(2) = 1, f(3) = 0, against all subsets of the pairings."""

    subsets: int
    agree: int
    smallest_gap: float
    six_full: int  # of the subsets of six pairings, those with full rank
    six_all_involved: int  # and those that include every chuck and sphere
    smallest_full: int  # fewest pairings with full rank


def subset_law(ranks: Ranks) -> SubsetLaw:
    agree, gaps, full = 0, [], []
    subsets = [s for n in range(1, 10) for s in itertools.combinations(ranks.pairs, n)]
    top = ranks.rank(ranks.pairs)[0]
    for subset in subsets:
        rank, gap = ranks.rank(subset)
        lost = LOST[len({c for c, _ in subset})] + LOST[len({s for _, s in subset})]
        agree += rank == top - lost
        gaps.append(gap)
        if rank == top:
            full.append(subset)
    involved = [s for s in subsets if len(s) == 6 and len({c for c, _ in s}) == len({t for _, t in s}) == 3]
    six = [s for s in full if len(s) == 6]
    return SubsetLaw(len(subsets), agree, min(gaps), len(six), len(involved), min(map(len, full)))


def on_axis(made: Bench) -> Ranks:
    """Return ranks at the design values with the spheres on the axis of joint 6, at three heights."""
    heights = np.linspace(0.05, 0.15, len(made.rig.spheres))
    spheres = {name: Point(name, (0.0, 0.0, float(z))) for name, z in zip(made.rig.spheres, heights, strict=True)}
    return Ranks(made, made.robot.parameter_sets["design"], replace(made.rig, spheres=spheres))


def fitted(made: Bench, rng: np.random.Generator, free: NDArray[np.bool_] | None = None) -> Estimate:
    """Fit the near shells from the design values, validate on the far ones."""
    table = _noisy(made, made.table.value, NOISE, rng)
    return identify(
        made.chain,
        made.rig,
        table,
        free=made.robot.free if free is None else free,
        hold_out=made.table.bar == FAR,
        prefer=made.robot.free,
    )


def few_poses(made: Bench, count: int, rng: np.random.Generator) -> Estimate:
    """Fit ``count`` of the near poses, validate on the far ones: the paper's mindless curve fitting."""
    near, far = np.flatnonzero(made.table.bar == NEAR), np.flatnonzero(made.table.bar == FAR)
    chosen = near[np.linspace(0, near.size - 1, count).astype(int)]
    table = _noisy(made, made.table.value, NOISE, rng).select(np.concatenate([chosen, far]))
    held = np.arange(len(table)) >= count
    return identify(made.chain, made.rig, table, free=made.robot.free, hold_out=held)


class FitErrors(NamedTuple):
    """One fit compared with the truth; lengths in m."""

    near: float  # RMS on the fitted shells
    far: float  # RMS on the others
    nees: float
    chi2: float
    iterations: int


def run(made: Bench, noise: float, gear: float, rng: np.random.Generator) -> FitErrors:
    """Run one experiment with ``noise`` [m] on lengths and gear errors of amplitude ``gear`` [rad] in the joints."""
    value = lengths(made, made.table.q + gear_error(made.table.q, gear, rng)) if gear else made.table.value
    table = _noisy(made, value, noise, rng)
    problem = build_problem(made.chain, made.rig, table.select(table.bar == NEAR))
    far = build_problem(made.chain, made.rig, table.select(table.bar == FAR))
    free = made.robot.free
    found = fit(problem, free, problem.start, Options())
    error = found.information.root @ (found.x - made.truth)[free]
    return FitErrors(
        Figures.of(found.information.residual["m"]).rms,
        Figures.of(observe(far, found.x, free).residual["m"]).rms,
        float(error @ error),
        found.information.chi2,
        found.iterations,
    )


def with_gears(made: Bench, gear: float, seeds: Iterable[int]) -> tuple[float, float, float]:
    """Return RMS errors (near, far) and noise, all in m, with as much noise as keeps the near residual at NOISE.

    Errors of the gears and of the measurement are independent, so their squares add: first the gears alone, then with
    the remaining amount of noise.
    """
    seeds = tuple(seeds)
    alone = np.mean([run(made, 0.0, gear, np.random.default_rng(s)).near ** 2 for s in seeds]) if gear else 0.0
    n = int((made.table.bar == NEAR).sum())
    free = int(made.robot.free.sum())
    noise = float(np.sqrt(max(NOISE**2 - alone, 0.0) * n / (n - free)))
    runs = [run(made, noise, gear, np.random.default_rng(s)) for s in seeds]
    return _root_mean([r.near for r in runs]), _root_mean([r.far for r in runs]), noise


def validation_of_noise(made: Bench) -> float:
    """Return the RMS [m] that noise alone causes on the far shells: its own, and the parameters' uncertainty there."""
    free = made.robot.free
    near, far = _problem(made, NEAR), _problem(made, FAR)
    seen_there = observe(far, made.truth, free).root @ half(spectrum(observe(near, made.truth, free).root))
    return float(NOISE * np.sqrt(1.0 + np.sum(seen_there**2) / far.n_rows))


def cartesian_error(made: Bench, estimate: Estimate) -> float:
    """Return the RMS [m], predicted from the covariance, of the first sphere's position on the near shells."""
    p = estimate.n_robot_parameters
    q = made.table.q[made.table.bar == NEAR]
    sphere = np.array(next(iter(made.rig.spheres.values())).xyz)
    return Figures.of(predicted_error(made.chain, estimate.value[:p], estimate.covariance[:p, :p], q, sphere).rms).rms


def stewart_amplification(base_radius: float, platform_radius: float, leg: float) -> float:
    """Return the RMS error of a platform's centre relative to that of its six legs, with the platform level above the
    base.

    Base and platform are equilateral triangles in circles of the two radii [m], rotated by 60° relative to each other.
    Each corner is joined to the two nearest of the other, and all legs are ``leg`` [m] long. A leg's length changes by
    [u; r × u]·(v; w), where u is its direction and r its corner on the platform. Legs with independent errors of σ
    therefore give the platform's (v; w) the covariance σ² (JᵀJ)⁻¹. The result hardly depends on the platform's radius:
    it is near 0.95·leg/base_radius.
    """
    turn = np.linspace(0.0, 2.0 * np.pi, 3, endpoint=False)
    base = _circle(base_radius, turn)
    top = _circle(platform_radius, turn + np.pi / 3.0)
    across = base_radius**2 + platform_radius**2 - base_radius * platform_radius
    height = np.array([0.0, 0.0, np.sqrt(leg**2 - across)])
    joined = [(i, (i + k) % 3) for i in range(3) for k in (0, 1)]
    u = np.array([top[i] + height - base[k] for i, k in joined]) / leg
    corner = top[[i for i, _ in joined]]
    jac = np.concatenate([u, np.cross(corner, u)], axis=1)
    return float(np.sqrt(np.trace(np.linalg.inv(jac.T @ jac)[:3, :3])))


def _circle(radius: float, turn: Floats) -> Floats:
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros_like(turn)], axis=1)


def _problem(made: Bench, bar: str) -> Problem:
    return build_problem(
        made.chain, made.rig, made.table.replace(sigma=np.full(len(made.table), 1.0)).select(made.table.bar == bar)
    )


def _noisy(made: Bench, value: Floats, noise: float, rng: np.random.Generator) -> ObservationTable:
    return made.table.replace(value=value + noise * rng.standard_normal(value.size))


def _root_mean(values: list[float]) -> float:
    return Figures.of(np.array(values)).rms
