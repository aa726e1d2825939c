"""pybotics on the position problem, the way its calibration example does it: OptimizationHandler, optimize_accuracy, least_squares.

    build/bench-venv/pybotics/bin/python bench/workers/run_pybotics.py fit|tight position FILE RUNS

Units are millimetres, as in its predefined models. Free is what a point can tell of this arm in modified Denavit–
Hartenberg form: 25 parameters, none of which stands in for another, the world frame and the target included. ``tight`` asks least_squares for
1e-12 instead of its default 1e-8, at which the fit of distances seems to stop before the minimum; at 100 poses it had not ended after
a minute, so identification.py does not run it.
"""

from __future__ import annotations

import sys

import numpy as np
from measure import tell, timed
from pybotics.geometry import vector_2_matrix
from pybotics.kinematic_chain import MDHKinematicChain
from pybotics.optimization import OptimizationHandler, compute_absolute_errors, optimize_accuracy
from pybotics.robot import Robot
from pybotics.tool import Tool
from scipy.optimize import least_squares

#                alpha a      theta  d      of the modified form, one row a joint
FREE = np.array([[False, False, False, False],  # the world frame's
                 [True, True, True, False],
                 [True, True, True, False],  # axes 2, 3 and 4 are parallel: one d for three
                 [True, True, True, True],
                 [True, True, True, True],
                 [True, True, False, False]])  # fmt: skip  # theta and d are the tool's


def robot_of(dh: np.ndarray, target: np.ndarray) -> Robot:
    """(6, 4) offset, d, a, alpha of the standard form, [rad] and [m], as modified rows and a tool."""
    offset, d, a, alpha = dh.T
    before = lambda column: np.concatenate([[0.0], column[:-1]])  # noqa: E731
    chain = MDHKinematicChain(np.stack([before(alpha), 1e3 * before(a), offset, 1e3 * d], axis=1).ravel())
    turn = vector_2_matrix(np.array([0.0, 0.0, 0.0, alpha[-1], 0.0, 0.0]))
    tool = np.eye(4)
    tool[:3, 3] = np.array([1e3 * a[-1], 0.0, 0.0]) + turn[:3, :3] @ (1e3 * target)
    return Robot(chain, Tool(tool))


def main(what: str, kind: str, path: str, runs: int) -> None:
    data = dict(np.load(path))
    ends = dict.fromkeys(("ftol", "xtol", "gtol"), 1e-12) if what == "tight" else {}

    def run():
        handler = OptimizationHandler(
            robot_of(data["dh"], data["target"]),
            kinematic_chain_mask=FREE.ravel(),
            tool_mask=[True, True, True, False, False, False],
            world_mask=[True] * 6,
        )
        found = least_squares(
            optimize_accuracy,
            handler.generate_optimization_vector(),
            args=(handler, data["q"], 1e3 * data["y"]),
            **ends,
        )
        handler.apply_optimization_vector(found.x)
        return handler.robot, found

    (robot, found), seconds = timed(run, runs)
    errors = compute_absolute_errors(data["q_held"], 1e3 * data["y_held"], robot)
    error = np.sqrt((errors**2).mean())
    mean = float(np.mean(errors))
    tell(seconds=seconds, held_out_mm=float(error), mean_mm=mean, iterations=found.nfev, status=found.message)


if __name__ == "__main__":
    what, kind, path, runs = sys.argv[1:]
    main(what, kind, path, int(runs))
