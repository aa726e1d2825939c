"""robotkinecal: products of exponentials, four parameters per joint and the target, by its own iteration."""

import numpy as np
import roboticstoolbox as rtb
from method import run
from robotkinecal import SerialRobotKineCal
from scipy.spatial.transform import Rotation
from spatialmath import SE3


def row(offset, d, a, alpha):
    ends = np.cos(offset), np.sin(offset), np.cos(alpha), np.sin(alpha)
    c, s, ca, sa = ends
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])


def fit(data):
    here, joints = np.eye(4), []
    for numbers in data["dh"]:
        joints.append(rtb.PoERevolute(here[:3, 2], here[:3, 3]))
        here = here @ row(*numbers)
    here[:3, 3] += here[:3, :3] @ data["target"]
    calibration = SerialRobotKineCal(rtb.PoERobot(joints, SE3(here, check=False)))
    calibration.joint_screw_axis = calibration.joint_screw_axis[1:-1]  # version 0.1.0 counts base and end as joints
    calibration.N_JOINTS = len(calibration.joint_screw_axis)
    calibration.set_observations(list(data["q"]), list(data["y"]))
    found = calibration.solve()
    screws, home = np.array(found.get_screw_axes()), found.get_zero_conf_EE_pose().t

    def predict(q):
        points = np.tile(home, (len(q), 1))
        for (*v, wx, wy, wz), angle in reversed(list(zip(screws.reshape(-1, 6), q.T, strict=True))):
            axis = np.array([wx, wy, wz])
            centre = np.cross(axis, v)
            turn = Rotation.from_rotvec(angle[:, None] * axis)
            points = turn.apply(points - centre) + centre
        return points

    return predict


run("robotkinecal", fit)
