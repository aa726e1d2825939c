"""scipy's least_squares with the analytic Jacobian of truearm's own model, in the same blocks of poses.

    .venv/bin/python bench/workers/run_scipy.py lm|trf ball_bar FILE RUNS

``lm`` is MINPACK's, which scales columns itself; ``trf`` gets x_scale="jac" for the same. Both stop by scipy's own defaults.
"""

from __future__ import annotations

import sys

import numpy as np
from measure import tell, timed
from run_truearm import forget, held_out
from scipy.optimize import least_squares

from data import CHUCKS, SPHERES
from truearm.estimate.problem import BLOCK
from truearm.model.chain import point_forward, point_jacobians
from truearm.model.robot_file import builtin_robot


def main(method: str, kind: str, path: str, runs: int) -> None:
    data = dict(np.load(path))
    chain = builtin_robot("puma560").chain
    chuck, sphere = np.array(CHUCKS)[data["pair"][0]], np.array(SPHERES)[data["pair"][1]]
    q, measured = data["q"], data["y"]

    def residual(params):
        out = np.empty_like(measured)
        for at in range(0, len(q), BLOCK):
            some = slice(at, at + BLOCK)
            bar = point_forward(chain, params, q[some], sphere[some]) - chuck[some]
            out[some] = np.sqrt((bar * bar).sum(axis=1)) - measured[some]
        return out

    def jacobian(params):
        out = np.empty((len(q), params.size))
        for at in range(0, len(q), BLOCK):
            some = slice(at, at + BLOCK)
            point, by_params, _ = point_jacobians(chain, params, q[some], sphere[some])
            bar = point - chuck[some]
            out[some] = np.einsum("ni,nip->np", bar / np.sqrt((bar * bar).sum(axis=1))[:, None], by_params)
        return out

    scale = {} if method == "lm" else {"x_scale": "jac"}
    found, seconds = timed(
        lambda: least_squares(residual, chain.params_nominal, jacobian, method=method, **scale), runs, forget
    )
    error = held_out(kind, data, found.x)
    tell(seconds=seconds, held_out_mm=1e3 * error, iterations=found.nfev, status=found.message)


if __name__ == "__main__":
    what, kind, path, runs = sys.argv[1:]
    main(what, kind, path, int(runs))
