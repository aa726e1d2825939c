"""The least that any least-squares step over n rows of 54 columns needs: JᵀJ by one dsyrk, J already in memory.

    .venv/bin/python bench/workers/run_floor.py - dsyrk N RUNS

Beside it one linearisation of ours at the same n (``observe``: everything for 54 + 1 columns computed, weighed, folded by
QR), and what residuals and derivatives alone take of it.
"""

from __future__ import annotations

import sys

import numpy as np
from measure import tell, timed
from run_truearm import ROBOTS, forget, rig_and_table
from scipy.linalg import blas

from truearm.estimate.information import observe
from truearm.estimate.problem import Problem, blocks, build_problem
from truearm.model.robot_file import builtin_robot


def evaluate(problem: Problem) -> None:
    for block in blocks(problem):
        block.evaluate(problem.chain, problem.start)


def main(_: str, kind: str, path: str, runs: int) -> None:
    data = dict(np.load(path))
    chain = builtin_robot(ROBOTS[kind]).chain
    problem = build_problem(chain, *rig_and_table(kind, data))
    every = np.ones(len(problem.start), dtype=bool)
    jac = np.asfortranarray(np.random.default_rng(0).normal(size=(len(data["q"]), 54)))
    floor = ours = evaluation = float("inf")
    for _ in range(runs):  # in turn, so that a busy machine hits both alike
        floor = min(floor, timed(lambda: blas.dsyrk(1.0, jac, trans=1))[1])
        ours = min(ours, timed(lambda: observe(problem, problem.start, every), afresh=forget)[1])
        evaluation = min(evaluation, timed(lambda: evaluate(problem), afresh=forget)[1])
    tell(seconds=ours, floor=floor, evaluation=evaluation, held_out_mm=None, iterations=1, status="")


if __name__ == "__main__":
    what, kind, path, runs = sys.argv[1:]
    main(what, kind, path, int(runs))
