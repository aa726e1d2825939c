"""The step of the parameters: the base moves along a screw together with the chucks beside it.

The twist of the base is taken here from finite differences of the base's transform and the motion from scipy's matrix
exponential, independently of the chain's elements.
"""

from dataclasses import replace
from itertools import takewhile

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, random_table
from scipy.linalg import expm

from truearm.estimate.parameter_update import stepper
from truearm.estimate.payload_rows import with_payloads
from truearm.estimate.problem import build_problem
from truearm.model.chain import joint_frames, point_forward
from truearm.types import Payload, Point, Rig

AT_HOME = np.zeros((1, 6))
HALF_DIFFERENCE = 1e-6


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


def base(x):
    """Return the transform (4, 4) before the first joint's motion, as the first joint's frame at its zero shows it."""
    return joint_frames(CHAIN, x[: FREE.size], AT_HOME)[0, 0]


def step_of_twist(problem, x, omega, v):
    """Return Δ (P,) that moves base and chucks with the twist to first order."""
    delta, at = np.zeros(x.size), base_parameters()
    twists = np.empty((6, len(at)))
    for k, parameter in enumerate(at):
        ahead, behind = x.copy(), x.copy()
        ahead[parameter] += HALF_DIFFERENCE
        behind[parameter] -= HALF_DIFFERENCE
        rate = (base(ahead) - base(behind)) @ np.linalg.inv(base(x)) / (2.0 * HALF_DIFFERENCE)
        twists[:, k] = [rate[2, 1], rate[0, 2], rate[1, 0], *rate[:3, 3]]
    delta[at] = np.linalg.lstsq(twists, np.append(omega, v), rcond=None)[0]
    for chuck in chucks_at(problem):
        delta[chuck] = np.cross(omega, x[chuck]) + v
    return delta


def chucks_at(problem):
    return [[problem.names.index(f"chuck.{name}.{axis}") for axis in "xyz"] for name in RIG.chucks]


def lengths(problem, x, q):
    """Return lengths (n, chucks) from each chuck to the end."""
    end = point_forward(CHAIN, x[: FREE.size], q, np.zeros(3))
    return np.stack([np.linalg.norm(end - x[chuck], axis=1) for chuck in chucks_at(problem)], axis=1)


def moved(problem, columns, x, delta):
    out = x.copy()
    out[columns] = stepper(problem, columns)(x[columns], delta[columns])
    return out


@pytest.mark.parametrize("turn", [1e-3, 0.05, 0.5])
def test_base_and_chucks_that_move_together_change_no_length(problem, columns, turn):
    """However far the step; added numbers would change the lengths by the square of the turn."""
    rng = np.random.default_rng(2)
    x, q = problem.start, rng.uniform(-2.0, 2.0, (20, 6))
    omega = rng.normal(size=3)
    omega *= turn / np.linalg.norm(omega)
    v = -np.cross(omega, [0.4, 0.1, 0.2])  # a line about half a metre beside the base
    delta = step_of_twist(problem, x, omega, v)
    there = moved(problem, columns, x, delta)
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = np.cross(omega, np.eye(3)).T, v
    assert np.abs(base(there) - expm(twist) @ base(x)).max() < 1e-8 * max(turn, 0.1)
    change = np.abs(lengths(problem, there, q) - lengths(problem, x, q)).max()
    assert change < 1e-9
    assert np.abs(lengths(problem, x + delta, q) - lengths(problem, x, q)).max() > 0.03 * turn**2


def test_any_step_is_the_sum_to_first_order(problem, columns):
    """Otherwise the derivatives, which are those of added numbers, would not be those of the step."""
    rng = np.random.default_rng(3)
    x = problem.start
    delta = np.where(columns, rng.normal(size=x.size), 0.0)
    beyond = [np.abs(moved(problem, columns, x, t * delta) - x - t * delta).max() for t in (1e-2, 5e-3, 2.5e-3)]
    assert beyond[0] > 1e-6
    assert beyond[1] / beyond[0] == pytest.approx(0.25, abs=0.03)
    assert beyond[2] / beyond[1] == pytest.approx(0.25, abs=0.03)


def test_only_base_and_chucks_deviate_from_the_sum(problem, columns):
    rng = np.random.default_rng(4)
    x, delta = problem.start, np.where(columns, 0.02 * rng.normal(size=columns.size), 0.0)
    there = moved(problem, columns, x, delta)
    others = np.setdiff1d(np.arange(x.size), [*base_parameters(), *np.ravel(chucks_at(problem))])
    assert np.array_equal(there[others], (x + delta)[others])


def test_a_base_that_is_held_in_part_is_added_to(problem, columns):
    held = columns.copy()
    held[base_parameters()[0]] = False
    x, delta = problem.start, 0.02 * np.random.default_rng(5).normal(size=columns.size)
    assert np.array_equal(moved(problem, held, x, delta)[held], (x + delta)[held])


def test_chucks_move_with_the_base_under_a_payload_too(problem, columns):
    payloads = [Payload(2.0 * (i % 2), (0.0, 0.0, 0.1)) for i in range(60)]
    loaded = replace(problem, groups=with_payloads(problem.groups, payloads))
    delta = np.where(columns, 0.02 * np.random.default_rng(5).normal(size=columns.size), 0.0)
    there = moved(loaded, columns, problem.start, delta)
    np.testing.assert_array_equal(there, moved(problem, columns, problem.start, delta))
