"""truearm.identify with its defaults: geometry, joint laws by evidence, all checks."""

import sys

import numpy as np
from method import run

import truearm

SIGMA = 5e-5  # m, declared of a laser tracker


def fit(data):
    robot = truearm.load_robot(str(data["robot"]))
    noise = tuple(map(tuple, SIGMA**2 * np.eye(3)))
    tracker = truearm.Device("tracker", noise, (0.0, 0.0, 0.0), sigma=0.0, turn_sigma=0.0)
    target = truearm.Point("target", tuple(data["target"]), None)
    rig = truearm.Rig(trackers={"tracker": tracker}, targets={"target": target})
    table = truearm.ObservationTable(q=data["q"], kind="position", xyz=data["y"], tracker="tracker", target="target")
    options = truearm.IdentifyOptions(joint_laws="none" if "geometry" in sys.argv else "auto")
    result = truearm.identify(robot, table, rig, options=options)
    place = np.array([result.parameters[f"target.target.{axis}"].value for axis in "xyz"])

    def predict(q):
        ends = result.forward(q)
        return ends[:, :3, :3] @ place + ends[:, :3, 3]

    return predict


run("truearm", fit)
