"""The step of the parameters; that the base moves along a screw is seen by the few steps of test_estimate_degenerate."""

from dataclasses import replace
from itertools import takewhile

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, random_table

from truearm.estimate.parameter_update import stepper
from truearm.estimate.problem import build_problem
from truearm.estimate.systematic_effects import with_payloads
from truearm.types import Payload, Point, Rig


@pytest.fixture(scope="module")
def problem():
    known = {name: Point(name, point.xyz, 0.01) for name, point in RIG.chucks.items()}
    return build_problem(CHAIN, Rig(known, RIG.spheres, RIG.bars), random_table(60, np.random.default_rng(1)))


@pytest.fixture(scope="module")
def columns(problem):
    return np.append(FREE, np.ones(len(problem.names) - FREE.size, dtype=bool))


def base_parameters():
    """Return the numbers of the chain's parameters before the first joint."""
    before = takewhile(lambda element: element.joint is None, CHAIN.elements)
    return [element.parameter for element in before if element.parameter is not None]


def moved(problem, columns, x, delta):
    out = x.copy()
    out[columns] = stepper(problem, columns)(x[columns], delta[columns])
    return out


def test_bases_held_in_part_and_chucks_that_move_with_the_base(problem, columns):
    held = columns.copy()
    held[base_parameters()[0]] = False
    x, delta = problem.start, 0.02 * np.random.default_rng(5).normal(size=columns.size)
    assert np.array_equal(moved(problem, held, x, delta)[held], (x + delta)[held])
    payloads = [Payload(2.0 * (i % 2), (0.0, 0.0, 0.1)) for i in range(60)]
    loaded = replace(problem, groups=with_payloads(problem.groups, payloads))
    delta = np.where(columns, 0.02 * np.random.default_rng(5).normal(size=columns.size), 0.0)
    there = moved(loaded, columns, problem.start, delta)
    np.testing.assert_array_equal(there, moved(problem, columns, problem.start, delta))
