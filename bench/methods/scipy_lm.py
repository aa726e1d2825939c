"""scipy's least_squares with the analytic Jacobian of truearm's geometry; base and target are unknown too."""

import numpy as np
from method import run
from scipy.linalg import qr
from scipy.optimize import least_squares

from truearm.model.chain import forward, point_forward, point_jacobians
from truearm.model.robot_file import load_robot


def fit(data):
    robot = load_robot(str(data["robot"]), None, None)
    chain, q, n = robot.chain, data["q"], len(robot.free)
    start = np.concatenate([chain.params_nominal, data["target"]])

    def jacobian(x, columns):
        _, by_params, _ = point_jacobians(chain, x[:n], q, x[n:])
        by_target = forward(chain, x[:n], q)[:, :3, :3]
        return np.concatenate([by_params, by_target], axis=-1)[..., columns].reshape(-1, len(columns))

    def at(values):
        x = start.copy()
        x[columns] = values
        return x

    columns = np.flatnonzero(np.append(robot.free, [True] * 3))
    triangle, order = qr(jacobian(start, columns), mode="r", pivoting=True)  # a point does not determine all of them
    seen = np.abs(np.diag(triangle)) > 1e-9 * abs(triangle[0, 0])
    columns = columns[np.sort(order[seen])]
    found = least_squares(
        lambda values: (point_forward(chain, at(values)[:n], q, at(values)[n:]) - data["y"]).ravel(),
        start[columns],
        lambda values: jacobian(at(values), columns),
        method="lm",
    )
    return lambda q: point_forward(chain, at(found.x)[:n], q, at(found.x)[n:])


run("scipy", fit)
