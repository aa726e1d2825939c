"""The two problems of bench/identification.py as files of plain arrays, so that every program reads the same numbers.

``position``: a UR10e whose lengths stray by 1 mm and angles by 2 mrad from the design, a target on the tool, measured as
a point in the base frame with 0.05 mm of noise an axis. The errors are such that every program's geometry can hold
them: those of Denavit and Hartenberg's parameters, of the base and of the tool, but no tilt β of the parallel axes,
which the modified form cannot hold. ``ball_bar``: a PUMA 560 likewise, three chucks, three spheres, lengths at poses anywhere
within the limits with 0.084 mm of noise; all 54 parameters free, of which 36 can be seen.

Held out are 1000 further poses, without noise: their error is the model's alone.

    .venv/bin/python bench/workers/data.py position 800 out/bench/position-800.npz
"""

from __future__ import annotations

import sys

import numpy as np

from truearm.model.chain import Chain, point_forward
from truearm.model.robot_file import builtin_robot

SCATTER = {"m": 1e-3, "rad": 2e-3, "1": 1e-4}
SIGMA = {"position": 0.05e-3, "ball_bar": 0.084e-3}
TARGET = (0.05, 0.03, 0.08)
CHUCKS = ((0.55, 0.0, 0.25), (0.40, 0.0866, 0.25), (0.40, -0.0866, 0.25))
SPHERES = ((0.06, 0.0, 0.05), (-0.03, 0.052, 0.05), (-0.03, -0.052, 0.05))
HELD_OUT = 1000


def poses(chain: Chain, n: int, rng: np.random.Generator) -> np.ndarray:
    lower, upper = np.array([(j.lower, j.upper) for j in chain.joints]).T
    return rng.uniform(np.maximum(lower, -np.pi), np.minimum(upper, np.pi), (n, len(chain.joints)))


def position(n: int) -> dict[str, np.ndarray]:
    robot = builtin_robot("ur10e")
    chain = robot.chain
    rng = np.random.default_rng(10)
    strays = robot.free & np.array(
        [not name.endswith(".beta") or name == "base.beta" for name in chain.parameter_names]
    )
    sigma = np.array([SCATTER[p.unit] for p in chain.parameters])
    truth = chain.params_nominal + np.where(strays, sigma * rng.normal(size=sigma.size), 0.0)
    q = poses(chain, HELD_OUT + n, rng)
    xyz = point_forward(chain, truth, q, np.array(TARGET))
    noise = SIGMA["position"] * rng.normal(size=(n, 3))
    held = {"q_held": q[:HELD_OUT], "y_held": xyz[:HELD_OUT]}
    rows = {name: chain.params_nominal[i] for i, name in enumerate(chain.parameter_names)}
    design = np.array([[rows.get(f"joint{i}.{k}", 0.0) for k in ("offset", "d", "a", "alpha")] for i in range(1, 7)])
    return held | {"q": q[HELD_OUT:], "y": xyz[HELD_OUT:] + noise, "dh": design, "target": np.array(TARGET)}


def ball_bar(n: int) -> dict[str, np.ndarray]:
    chain = builtin_robot("puma560").chain
    rng = np.random.default_rng(20)
    sigma = np.array([SCATTER[p.unit] for p in chain.parameters])
    truth = chain.params_nominal + sigma * rng.normal(size=sigma.size)
    q = poses(chain, HELD_OUT + n, rng)
    chuck, sphere = rng.integers(0, 3, (2, HELD_OUT + n))
    length = np.linalg.norm(point_forward(chain, truth, q, np.array(SPHERES)[sphere]) - np.array(CHUCKS)[chuck], axis=1)
    held = {"q_held": q[:HELD_OUT], "y_held": length[:HELD_OUT], "pair_held": np.stack([chuck, sphere])[:, :HELD_OUT]}
    noisy = length[HELD_OUT:] + SIGMA["ball_bar"] * rng.normal(size=n)
    return held | {"q": q[HELD_OUT:], "y": noisy, "pair": np.stack([chuck, sphere])[:, HELD_OUT:]}


if __name__ == "__main__":
    kind, count, path = sys.argv[1:]
    np.savez(path, **{"position": position, "ball_bar": ball_bar}[kind](int(count)))
