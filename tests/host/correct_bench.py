"""The paper's PUMA identified from 600 noisy lengths, and targets on the measured shells."""

from pathlib import Path

import numpy as np
from tests.host.puma_bench import CHAIN, CHUCKS, DESIGN, FREE, RIG, SIGMA, SPHERES, TRUTH, shell_poses, shell_table

from truearm.estimate.identify import identify
from truearm.estimate.result_document import result_of
from truearm.estimate.result_file import RobotFrames, write_result
from truearm.kinds.table_file import concatenate
from truearm.model.chain import forward
from truearm.model.inverse import singular_value
from truearm.results import Estimate

# One configuration of the arm (elbow up, wrist not flipped), away from its singularities, as in hil_sim's planner.
LOWER = np.deg2rad([-155.0, -170.0, 100.0, -105.0, 20.0, -180.0])
UPPER = np.deg2rad([155.0, 35.0, 205.0, 165.0, 95.0, 180.0])


def identified(seed: int = 1) -> Estimate:
    rng = np.random.default_rng(seed)
    lengths = [shell_table(300, radius, rng, SIGMA, bar) for radius, bar in ((0.46, "short"), (0.61, "long"))]
    return identify(CHAIN, RIG, concatenate(lengths), free=FREE)


def write(path: Path, estimate: Estimate) -> Path:
    frames = RobotFrames(CHAIN.name, CHAIN.base_frame, CHAIN.end_frame, ("rad",) * 6)
    table = shell_table(300, 0.46, np.random.default_rng(0))
    write_result(path, result_of(estimate, concatenate([table, table]), frames))
    return path


def good_poses(n: int, seed: int = 2) -> np.ndarray:
    """Return joint vectors (n, 6) on the calibrated shells, far from limits and singularities, in order of a visit."""
    rng = np.random.default_rng(seed)
    parts = [
        shell_poses(CHUCKS[f"c{i}"], SPHERES[f"s{i}"], 0.46 + 0.15 * (i % 2), max(400, 10 * n), rng) for i in range(3)
    ]
    q = np.concatenate(parts)
    q = q[((q > LOWER) & (q < UPPER)).all(axis=1)]
    q = q[(singular_value(CHAIN, DESIGN, q) > 0.08) & (singular_value(CHAIN, TRUTH, q) > 0.08)]
    assert len(q) >= n
    return visited(q)[:n]


def visited(q: np.ndarray) -> np.ndarray:
    """Return them in an order with small steps, as in a program: a controller chooses the nearest solution."""
    order = [0]
    while len(order) < len(q):
        far = np.abs(q - q[order[-1]]).max(axis=1)
        far[order] = np.inf
        order.append(int(far.argmin()))
    return q[order]


def nominal_poses(q: np.ndarray) -> np.ndarray:
    return forward(CHAIN, DESIGN, q)
