"""Updates a second of the recursive filter: 54 + 6 unknowns, one scalar row an observation.

.venv/bin/python bench/workers/run_recursive.py update rows N RUNS
"""

from __future__ import annotations

import sys

import numpy as np
from measure import tell, timed

from truearm.estimate.recursive import Filter, update

UNKNOWNS = 54 + 6


def main(_: str, __: str, count: str, runs: int) -> None:
    rng = np.random.default_rng(30)
    n = int(count)
    jac, residual = rng.normal(size=(n, 1, UNKNOWNS)), rng.normal(size=(n, 1))

    def run() -> Filter:
        state = Filter(np.zeros(UNKNOWNS), 10.0 * np.eye(UNKNOWNS))
        for j, r in zip(jac, residual, strict=True):
            state, _, _ = update(state, j, r)
        return state

    _, seconds = timed(run, runs)
    tell(seconds=seconds, held_out_mm=None, iterations=n, status="")


if __name__ == "__main__":
    what, kind, path, runs = sys.argv[1:]
    main(what, kind, path, int(runs))
