"""truearm on a problem file: the fit alone (``build_problem`` and ``lm``), or ``truearm.identify`` with all its checks.

.venv/bin/python bench/workers/run_truearm.py lm|identify position|ball_bar FILE RUNS
"""

from __future__ import annotations

import sys

import numpy as np
from measure import tell, timed

from data import CHUCKS, SIGMA, SPHERES, TARGET
from truearm.estimate.fit import fit
from truearm.estimate.problem import build_problem
from truearm.kinds.table import ObservationTable
from truearm.model.chain import _folded, point_forward
from truearm.model.robot_file import builtin_robot
from truearm.types import BallBar, Device, Point, Rig
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed

ROBOTS = {"position": "ur10e", "ball_bar": "puma560"}


forget = _folded.cache_clear  # a second run at the same parameters would find its links folded


def named(prefix: str, points) -> dict[str, Point]:
    return {f"{prefix}{i}": Point(f"{prefix}{i}", xyz) for i, xyz in enumerate(points)}


def rig_and_table(kind: str, data) -> tuple[Rig, ObservationTable]:
    if kind == "position":
        cov = tuple(map(tuple, SIGMA[kind] ** 2 * np.eye(3)))
        tracker = Device("tracker", cov, (0.0, 0.0, 0.0), sigma=0.0, turn_sigma=0.0)
        rig = Rig(trackers={"tracker": tracker}, targets={"target": Point("target", TARGET)})
        return rig, ObservationTable(q=data["q"], kind=kind, xyz=data["y"])
    rig = Rig(named("c", CHUCKS), named("s", SPHERES), {"bar": BallBar("bar", 5.5, 1.0, 10.0, SIGMA[kind])})
    chuck, sphere = np.array(list(rig.chucks))[data["pair"][0]], np.array(list(rig.spheres))[data["pair"][1]]
    return rig, ObservationTable(q=data["q"], kind=kind, chuck=chuck, sphere=sphere, value=data["y"])


def held_out(kind: str, data, params: np.ndarray) -> float:
    """Root mean square error on the held-out poses [m], of a point's distance or a length."""
    chain = builtin_robot(ROBOTS[kind]).chain
    if kind == "position":
        return float(
            np.sqrt(((point_forward(chain, params, data["q_held"], TARGET) - data["y_held"]) ** 2).sum(1).mean())
        )
    chuck, sphere = data["pair_held"]
    bar = point_forward(chain, params, data["q_held"], np.array(SPHERES)[sphere]) - np.array(CHUCKS)[chuck]
    return float(np.sqrt(((np.linalg.norm(bar, axis=1) - data["y_held"]) ** 2).mean()))


def main(what: str, kind: str, path: str, runs: int) -> None:
    data = dict(np.load(path))
    robot = builtin_robot(ROBOTS[kind])
    chain = robot.chain
    free = robot.free if kind == "position" else np.ones(len(chain.parameters), dtype=bool)
    rig, table = rig_and_table(kind, data)

    def run():
        if what == "identify":
            names = [name for name, is_free in zip(chain.parameter_names, free, strict=True) if is_free]
            return identified(robot, Observed(rig, table), options=IdentifyOptions(free=tuple(names))).estimate
        problem = build_problem(chain, rig, table)
        return fit(problem, free, problem.start)

    found, seconds = timed(run, runs, forget)
    x = found.value if what == "identify" else found.x
    error = held_out(kind, data, x[: free.size])
    tell(seconds=seconds, held_out_mm=1e3 * error, iterations=found.iterations, status=found.status)


if __name__ == "__main__":
    what, kind, path, runs = sys.argv[1:]
    main(what, kind, path, int(runs))
