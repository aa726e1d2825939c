"""pybotics as its calibration example does it: distances, its OptimizationHandler, scipy's least_squares with defaults."""

import numpy as np
from method import run
from pybotics.optimization import OptimizationHandler, optimize_accuracy
from run_pybotics import FREE, robot_of
from scipy.optimize import least_squares


def fit(data):
    robot = robot_of(data["dh"], data["target"])
    handler = OptimizationHandler(robot, FREE.ravel(), tool_mask=[True] * 3 + [False] * 3, world_mask=[True] * 6)
    start = handler.generate_optimization_vector()
    found = least_squares(optimize_accuracy, start, args=(handler, data["q"], 1e3 * data["y"]))
    handler.apply_optimization_vector(found.x)
    return lambda q: 1e-3 * np.array([handler.robot.fk(row)[:3, 3] for row in q])


run("pybotics", fit)
