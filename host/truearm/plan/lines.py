"""A plan of lines: where to put a line device, and the points to stop at along it.

A line is a middle posture, drawn by chance, and a direction; from its middle outwards the tool is driven along it by the
smallest changes of joints. It is kept if the whole way keeps to the limits and the target stays within the transverse
sensors' range, the bulge of joint moves between two points and twice the a-priori straightness together (Renders 1991, II-C:
15 mm). By what is known of the robot's tolerances (II-D) the error at each line is computed, and the half with the larger one
stays: where the error is large, measurement errors weigh less (III-G, 4). Of these the lines are chosen like poses of a
ball-bar, each a block of rows with the six unknowns of its own device fitted away.

A device is taken to be set up by hand as planned, to BY_HAND about each axis. Without that its roll would be told by no more than
the tenths of a millimetre by which the true arm leaves the line, and what the lines tell of the arm would depend on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from truearm.errors import PlanError
from truearm.estimate.information import observe, with_prior
from truearm.estimate.prior import weak_prior
from truearm.estimate.problem import settled
from truearm.estimate.rows import whitened_blocks
from truearm.estimate.uncertainty import tolerance_error
from truearm.model.chain import point_forward, point_jacobians
from truearm.observe.rotation import rotation_vector
from truearm.plan.choose import as_blocks, choose, condensed
from truearm.plan.forecast import Aim, Forecast, Known, compiled, forecast, planned_table, prior_unit, region_root
from truearm.plan.programs import csv_of
from truearm.plan.region import Region, around, poses_in
from truearm.plan.site import Site, all_allowed, smallest_singular_value
from truearm.plan.stops import Stop, plain
from truearm.plan.way import Pace, move_seconds, samples, way_without_bar
from truearm.types import Device, Floats, ObservationTable

STEPS = 8  # of Newton's method from one point to the next
ON_LINE = 1e-8  # m
ROUNDS = 40  # of draws
SETUP = 180.0  # s to place the device
BY_HAND = 0.052  # rad about each axis to which a device is set up as planned (Renders III-C)


class LinesWanted(NamedTuple):
    """Lengths [m]: of a line, of the transverse sensors' full range."""

    n_lines: int = 6
    n_points: int = 12
    length: float = 0.5
    transverse: float = 0.015
    n_candidates: int = 120
    criterion: str = "I"
    seed: int = 0


class LinePlan(NamedTuple):
    """Lines in the order of their visits: joints (l, n, j), points (l, n, 3), and the a-priori error (l,) [m] at each."""

    q: Floats
    p_base: Floats
    error: Floats
    devices: dict[str, Device]  # as they are to be set up, by line
    stops: list[Stop]
    forecast: Forecast
    minutes: float
    n_candidates: int


def plan_lines(
    site: Site, known: Known, wanted: LinesWanted, pace: Pace, region: Region | None = None, target: str = ""
) -> LinePlan:
    """Candidates, choice, order and forecast. ``target``: the rig's point that is measured, "" the end's origin.

    Raises PlanError where too few lines fit into the workspace, and what the parts raise.
    """
    point = np.array(known.rig.targets[target].xyz) if target else np.zeros(3)
    q = candidate_lines(site, wanted, point, region)
    error = a_priori(site, q, point)
    far = np.sort(np.argsort(-error, kind="stable")[: max(-(-len(q) // 2), wanted.n_lines)])
    q, error = q[far], error[far]
    places = point_forward(known.chain, known.params, q, point)
    aim = Aim(
        poses_in(site, region or around(places.reshape(-1, 3)), point, seed=wanted.seed), (target,) * bool(target)
    )
    chosen = np.array(_chosen(known, q, wanted, aim, target, point))
    chosen = chosen[_order(q[chosen])]
    q, error, places = q[chosen], error[chosen], places[chosen]
    stops = _stops(site, q, pace, point)
    rest = q[..., 0].size * pace.dwell + len(q) * SETUP
    table, devices = line_rows(known, q, target, point)
    told = forecast(_with_lines(known, devices), table, aim)
    minutes = (sum(stop.seconds for stop in stops) + rest) / 60.0
    return LinePlan(q, places, error, devices, stops, told, minutes, len(far))


def candidate_lines(site: Site, wanted: LinesWanted, point: Floats, region: Region | None) -> Floats:
    """(c, n, j) lines inside the workspace, at least ``n_lines``. Raises PlanError for fewer."""
    rng = np.random.default_rng([wanted.seed, 0x11E5])
    branch, kept = site.arm.branch, list[Floats]()
    for _ in range(ROUNDS):
        middle = rng.uniform(branch.lower, branch.upper, (100, len(branch.lower)))
        along = rng.normal(size=(100, 3))
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        p_middle = point_forward(site.arm.chain, site.arm.params, middle, point)
        if region is not None:
            there = ((p_middle >= region.lower) & (p_middle <= region.upper)).all(axis=1)
            middle, along, p_middle = middle[there], along[there], p_middle[there]
        if not len(middle):
            continue
        shares = np.linspace(-0.5, 0.5, wanted.n_points) * wanted.length
        lines = driven_lines(site, middle, p_middle, along, shares, point)
        kept += [q for q, a, p in zip(lines, along, p_middle, strict=True) if _fits(site, q, p, a, wanted, point)]
        if len(kept) >= wanted.n_candidates:
            break
    if len(kept) < wanted.n_lines:
        raise PlanError(
            f"only {len(kept)} lines of {1e3 * wanted.length:g} mm fit where the arm reaches; make them shorter or fewer"
        )
    return np.array(kept[: wanted.n_candidates])


def driven_lines(site: Site, q: Floats, p_middle: Floats, along: Floats, shares: Floats, point: Floats) -> Floats:
    """(m, n, j) joints that keep a point on lines through p_middle (m, 3) along unit vectors (m, 3); NaN where they fail."""
    out = np.empty((len(q), len(shares), q.shape[1]))
    for side in (shares >= 0.0, shares < 0.0):
        here = q
        where = np.flatnonzero(side)
        for k in where[np.argsort(np.abs(shares[where]))]:
            goal = p_middle + shares[k] * along
            for _ in range(STEPS):
                p, _, jac = point_jacobians(site.arm.chain, site.arm.params, here, point)
                step = (np.linalg.pinv(jac, rcond=1e-2) @ (goal - p)[..., None])[..., 0]
                here = here + np.clip(step, -0.3, 0.3)
            out[:, k] = here
    there = point_forward(site.arm.chain, site.arm.params, out, point)
    away = np.linalg.norm(there - p_middle[:, None] - shares[:, None] * along[:, None], axis=2).max(axis=1)
    return np.where((away < ON_LINE)[:, None, None], out, np.nan)


def _fits(site: Site, q: Floats, p_middle: Floats, along: Floats, wanted: LinesWanted, point: Floats) -> bool:
    """Whether a line (n, j) can be driven from end to end beside its device."""
    if np.isnan(q).any():
        return False
    way = np.concatenate([samples(a, b) for a, b in pairwise(q)])
    limits = site.limits.tightened()
    if not all_allowed(site, way, None, limits) or (smallest_singular_value(site, way) < limits.singular_value).any():
        return False
    off = point_forward(site.arm.chain, site.arm.params, way, point) - p_middle
    bulge = np.linalg.norm(off - (off @ along)[:, None] * along, axis=1).max()
    return bool(bulge + 2.0 * straightness(site, q, along, point) < 0.5 * wanted.transverse)


def straightness(site: Site, q: Floats, along: Floats, point: Floats) -> float:
    """Expected transverse distance [m] of a line's points from the best straight line, at its worst point.

    From the tolerances of ``weak_prior``: what a maker's drawing allows.
    """
    p, jac, _ = point_jacobians(site.arm.chain, site.arm.params, q, point)
    across = jac - along[:, None] * np.einsum("i,nip->np", along, jac)[:, None]
    y = (p - p.mean(axis=0)) @ along
    basis, _ = np.linalg.qr(np.stack([np.ones_like(y), y], axis=1))
    bent = across - np.einsum("nk,mk,mip->nip", basis, basis, across)
    return float(np.sqrt(((bent * weak_prior(site.arm.chain)) ** 2).sum(axis=(1, 2)).max()))


def a_priori(site: Site, q: Floats, point: Floats) -> Floats:
    """(c,) [m] error to be expected on lines (c, n, j), RMS over their points, by the tolerances of ``weak_prior``."""
    chain = site.arm.chain
    rms = tolerance_error(chain, weak_prior(chain), q.reshape(-1, q.shape[2]), point).rms
    return np.asarray(np.sqrt((rms.reshape(q.shape[:2]) ** 2).mean(axis=1)))


def line_rows(known: Known, q: Floats, target: str, point: Floats) -> tuple[ObservationTable, dict[str, Device]]:
    """Lines (l, n, j) as rows that would be read if the model were true, and their devices, placed by these rows."""
    names = [f"plan{i + 1}" for i in range(len(q))]
    cov = tuple(tuple(s**2 * (i == k) for k in range(3)) for i, s in enumerate(known.rig.line_sigma))
    p = point_forward(known.chain, known.params, q, point)
    xyz = np.concatenate([(line - line.mean(axis=0)) @ _axes(line) for line in p])
    flat = q.reshape(-1, q.shape[2])
    labels = {"line": np.repeat(names, q.shape[1]), "target": np.full(len(flat), target)}
    devices = {}
    for name, line in zip(names, p, strict=True):
        rx, ry, rz = rotation_vector(_axes(line)).tolist()
        devices[name] = Device(name, cov, None, (rx, ry, rz), None, BY_HAND)
    return planned_table(flat, "line", xyz=xyz, **labels), devices


def _axes(line: Floats) -> Floats:
    """(3, 3) of a device along points (n, 3): y from the first to the last."""
    y = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _with_lines(known: Known, devices: dict[str, Device]) -> Known:
    """With the planned devices beside those that were measured with."""
    old = known.rig.lines
    if known.measured is not None and not old:
        cov = next(iter(devices.values())).sensor_cov
        old = {str(name): Device(str(name), cov) for name in np.unique(known.measured.line) if name}
    return replace(known, rig=replace(known.rig, lines={**old, **devices}))


def _chosen(known: Known, q: Floats, wanted: LinesWanted, aim: Aim, target: str, point: Floats) -> list[int]:
    """Lines (c, n, j) that are chosen; unknowns of their own devices are fitted away."""
    parts = []
    for line in q:
        table, devices = line_rows(known, line[None], target, point)
        alone = _with_lines(replace(known, measured=None), devices)
        problem, x, columns = compiled(alone, table)
        (block,) = whitened_blocks(problem, x, columns)
        own = np.array([name.startswith("line.") for name in problem.names])[columns]
        jac = block.jac.reshape(-1, own.size)
        unit = prior_unit(alone, problem, columns)[~own]
        parts.append(condensed(jac[:, ~own] * unit, jac[:, own]))
    root = region_root(alone, table, aim)[:, ~own]
    chosen = choose(as_blocks(parts), _information(known, parts[0].shape[1]), wanted.n_lines, wanted.criterion, root)
    return [int(i) for i in chosen]


def _information(known: Known, k: int) -> Floats:
    """(k, k) of the prior and of what was measured, for the columns of the robot, rows' own unknowns fitted away."""
    information = np.eye(k)
    if known.measured is None:
        return information
    problem, x, columns = compiled(replace(known, measured=None), known.measured)
    n_robot, unit = int(known.free.sum()), prior_unit(known, problem, columns)
    prior = problem.prior_sigma[columns]
    prior[:n_robot] = np.inf
    root = with_prior(observe(settled(problem, x), x, columns), np.zeros(prior.size), prior).root * unit
    seen = condensed(root[:, :n_robot], root[:, n_robot:]) if unit.size > n_robot else root
    information[:n_robot, :n_robot] += seen.T @ seen
    return information


def _order(q: Floats) -> list[int]:
    """Lines (l, n, j) so that each begins near where the last one ended."""
    left, out = list(range(1, len(q))), [0]
    while left:
        out.append(min(left, key=lambda i: float(np.abs(q[i, 0] - q[out[-1], -1]).max())))
        left.remove(out[-1])
    return out


def _stops(site: Site, q: Floats, pace: Pace, point: Floats) -> list[Stop]:
    """Every point of every line, and via points between lines."""
    stops: list[Stop] = []
    for number, line in enumerate(q):
        for k, here in enumerate(line):
            via: Sequence[Floats] = ()
            if stops and k == 0:
                found = way_without_bar(site, stops[-1].q, here, seed=number)
                if found is None:
                    raise PlanError(f"no way to line {number + 1} is free; try --seed")
                via = list(found)
            for q_via in via:
                stops.append(Stop(q_via, move_seconds(site, stops[-1].q, q_via, point, pace), "via"))
            seconds = move_seconds(site, stops[-1].q, here, point, pace) if stops else 0.0
            what = plain(f"line device along line plan{number + 1}") if k == 0 else ""
            stops.append(Stop(here, seconds, "dwell", "", what))
    return stops


def lines_csv(planned: LinePlan) -> str:
    """Every point a row: its line, where the target will be [mm, base frame], joints [rad]."""
    rows = [["pose", "line", "x_mm", "y_mm", "z_mm", *(f"q{i + 1}_rad" for i in range(planned.q.shape[2]))]]
    for number, (line, places) in enumerate(zip(planned.q, planned.p_base, strict=True)):
        for k, (q, p) in enumerate(zip(line, places, strict=True)):
            at = [f"{1e3 * v:.3f}" for v in p]
            rows.append([str(number * len(line) + k), f"plan{number + 1}", *at, *map(repr, q.tolist())])
    return csv_of(rows)
