"""The bench of Goswami, Quaid and Peshkin 1993, simulated: a PUMA 560, three chucks, three spheres, poses on shells.

The paper's lengths are not published. Table II's optimised values are the true robot and its design values the start.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from papers import gauss_newton, levenberg_marquardt

import truearm
from truearm.extend import along, trace_point

ROBOT = truearm.load_robot("puma560")
CHAIN, FREE = ROBOT.chain, np.array(ROBOT.free)
DESIGN, TRUTH = ROBOT.parameter_sets["design"], ROBOT.parameter_sets["optimised"]
NOISE = 0.084e-3  # m, the paper's RMS residual
BARS = {"bar46": 0.46, "bar61": 0.61}  # m
READY = np.radians([10.0, -60.0, 100.0, 20.0, 60.0, 30.0])
BASE_RADIUS = 0.109  # m, of the chucks' triangle: the radius for which the paper's "roughly four times" holds


def circle(radius: float, turn: float = 0.0) -> np.ndarray:
    """Return the corners (3, 3) of an equilateral triangle in a circle about the origin."""
    angle = turn + 2.0 * np.pi * np.arange(3) / 3.0
    return radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(3)])


def points(prefix: str, xyz: np.ndarray) -> dict[str, truearm.Point]:
    return {f"{prefix}{i}": truearm.Point(f"{prefix}{i}", tuple(row)) for i, row in enumerate(xyz.tolist())}


RIG = truearm.Rig(
    chucks=points("c", circle(BASE_RADIUS) + np.array([0.45, 0.15, 0.08])),
    spheres=points("s", circle(0.13, 0.5) + np.array([0.0, 0.0, 0.04])),
    bars={name: truearm.BallBar(name, length, 1.0, 0.075, NOISE) for name, length in BARS.items()},
)
PAIRS = tuple(itertools.product(RIG.chucks, RIG.spheres))


def lengths(table: truearm.ObservationTable, params: np.ndarray, q: np.ndarray | None = None, rig: truearm.Rig = RIG):
    """Return the distances (n,) between chucks and spheres, their derivatives (n, 54), and chuck to sphere (n, 3)."""
    sphere = np.array([rig.spheres[name].xyz for name in table.sphere])
    chuck = np.array([rig.chucks[name].xyz for name in table.chuck])
    trace = trace_point(CHAIN, params, table.q if q is None else q, sphere)
    arrow = trace.p_base - chuck
    length = np.linalg.norm(arrow, axis=1)
    return length, along(trace, arrow / length[:, None]).jac_params, arrow


def shells(count: int, rng: np.random.Generator) -> truearm.ObservationTable:
    """Return ``count`` poses with each bar, on the upper hemispheres about the chucks, as the design robot reaches them.

    Value: the true length. Newton's method leads from joints near ``READY`` to random places of a shell.
    """
    lower, upper = CHAIN.limits
    columns: dict[str, list] = {"q": [], "bar": [], "chuck": [], "sphere": []}
    for (bar, radius), (k, (chuck, sphere)) in itertools.product(BARS.items(), enumerate(PAIRS)):
        wanted = len(range(k, count, len(PAIRS)))
        q = READY + rng.uniform(-0.2, 0.2, (3 * wanted, 6))
        direction = rng.normal(size=(3 * wanted, 3))
        direction[:, 2] = np.abs(direction[:, 2])
        goal = RIG.chucks[chuck].xyz + radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        for _ in range(15):
            trace = trace_point(CHAIN, DESIGN, q, np.array(RIG.spheres[sphere].xyz))
            jac = np.moveaxis(along(trace, np.eye(3)[:, None]).jac_joints, 0, 1)
            step = np.linalg.pinv(jac, rcond=0.05) @ (goal - trace.p_base)[..., None]
            q = np.clip(q + np.clip(step[..., 0], -0.5, 0.5), lower, upper)
        q = q[np.linalg.norm(goal - trace.p_base, axis=1) < 1e-4][:wanted]
        columns["q"].append(q)
        for name, value in (("bar", bar), ("chuck", chuck), ("sphere", sphere)):
            columns[name] += [value] * len(q)
    table = truearm.ObservationTable(
        kind="ball_bar",
        sigma=NOISE,
        q=np.concatenate(columns.pop("q")),
        source=[f"pose {i}" for i in range(len(columns["bar"]))],
        **columns,
    )
    return table.replace(value=lengths(table, TRUTH)[0])


def triangles(table: truearm.ObservationTable, params: np.ndarray, rig: truearm.Rig = RIG) -> dict[tuple, np.ndarray]:
    """Return a triangle (54, 54) with the rank of the Jacobian of each pairing's poses, by pairing."""
    jac = lengths(table, params, rig=rig)[1]
    return {(c, s): np.linalg.qr(jac[(table.chuck == c) & (table.sphere == s)], mode="r") for c, s in PAIRS}


def with_spheres_on_axis() -> truearm.Rig:
    """Return the rig with all spheres on the axis of joint 6."""
    return replace(RIG, spheres=points("s", np.column_stack([np.zeros(3), np.zeros(3), [0.05, 0.1, 0.15]])))


def fit(table: truearm.ObservationTable, value: np.ndarray, start: np.ndarray = DESIGN, free=FREE, method="lm"):
    """Return all parameters (54,) fitted to lengths, and the number of steps; ``method`` "lm" or "gn"."""
    columns = np.flatnonzero(free)

    def evaluate(part):
        params = start.copy()
        params[columns] = part
        length, jac, _ = lengths(table, params)
        return (value - length) / NOISE, jac[:, columns] / NOISE

    solve = {"lm": levenberg_marquardt, "gn": gauss_newton}[method]
    params = start.copy()
    params[columns], steps = solve(evaluate, start[columns])
    return params, steps


def gear_errors(q: np.ndarray, amplitude: float, rng: np.random.Generator) -> np.ndarray:
    """Return errors (n, 6) [rad] with 3 to 12 periods a turn, as of eccentric gears, that no parameter describes."""
    return amplitude * np.sin(rng.integers(3, 13, 6) * q + rng.uniform(0.0, 2.0 * np.pi, 6))


def experiment(near, far, noise: float, gear: float, rng: np.random.Generator):
    """Return the RMS residual [m] on fitted and on other shells, the errors' square by the covariance, χ² and steps."""
    both = truearm.ObservationTable.joined([near, far])
    q = both.q + (gear_errors(both.q, gear, rng) if gear else 0.0)
    value = lengths(both, TRUTH, q)[0] + noise * rng.standard_normal(len(both))
    params, steps = fit(near, value[: len(near)])
    residual = value - lengths(both, params)[0]
    root = lengths(near, params)[1][:, FREE] @ (params - TRUTH)[FREE] / NOISE
    near_rms, far_rms = (np.sqrt(np.mean(part**2)) for part in (residual[: len(near)], residual[len(near) :]))
    return near_rms, far_rms, root @ root, np.sum(residual[: len(near)] ** 2) / NOISE**2, steps


def noise_on_other_shells(near, far) -> float:
    """Return the RMS [m] that noise alone makes on shells that are not fitted: its own and that of the parameters."""
    root = np.linalg.qr(lengths(near, TRUTH)[1][:, FREE], mode="r")
    other = lengths(far, TRUTH)[1][:, FREE] @ np.linalg.inv(root)
    return NOISE * float(np.sqrt(1.0 + np.sum(other**2) / len(far)))


def stewart_factor(base_radius: float, platform_radius: float = 0.06, leg: float = 0.46) -> float:
    """Return the RMS error of a level platform's centre in that of its six legs, each to the two nearest corners."""
    base, top = circle(base_radius), circle(platform_radius, np.pi / 3.0)
    height = np.sqrt(leg**2 - base_radius**2 - platform_radius**2 + base_radius * platform_radius)
    legs = [(i, (i + k) % 3) for i in range(3) for k in (0, 1)]
    direction = np.array([top[i] + (0.0, 0.0, height) - base[k] for i, k in legs]) / leg
    jac = np.hstack([direction, np.cross(top[[i for i, _ in legs]], direction)])
    return float(np.sqrt(np.trace(np.linalg.inv(jac.T @ jac)[:3, :3])))
