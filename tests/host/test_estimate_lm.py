"""The solver alone: NIST's certified values, curved valleys, redundant unknowns, and every kind of termination."""

import numpy as np
import pytest

from truearm.estimate.information import Information, fold
from truearm.estimate.levenberg_marquardt import DAMPING_MAX, DAMPING_START, REFUSED, Damping, after_step, minimise


def linearised(residual, jacobian):
    """Return a problem for ``minimise`` from f(x) = measured − predicted and ∂predicted/∂x."""

    def at(x):
        f, j = residual(x), jacobian(x)
        k = x.size
        triangle = fold(np.zeros((k + 1, k + 1)), np.column_stack([j, f]))
        return Information(triangle[:k, :k], triangle[:k, k], float(f @ f), f.size, f)

    return at


def test_rosenbrock():
    """A curved valley: λ has to settle at the largest step that pays. With factors of 10 it took 408 linearisations, now 114."""
    calls = []

    def residual(x):
        calls.append(x)
        return -np.array([100 * (x[1] - x[0] ** 2), 1 - x[0]])

    at = linearised(residual, lambda x: np.array([[-200 * x[0], 100.0], [-1.0, 0.0]]))
    found = minimise(at, np.array([-1.2, 1.0]), 100)
    assert found.status == "converged"
    np.testing.assert_allclose(found.x, [1.0, 1.0], atol=1e-9)
    assert len(calls) < 150


@pytest.mark.parametrize(("correctors", "evaluations"), [(0, 1), (3, 4)])
def test_a_refused_step_costs_no_more_than_its_correctors(correctors, evaluations):
    """Uphill everywhere: λ grows until the end, and each of its values is tried once, with the full steps that follow it."""
    calls = []

    def residual(x):
        calls.append(x)
        return x + np.array([2.0])

    at = linearised(residual, lambda x: np.ones((1, 1)))  # ∂predicted/∂x is −1
    found = minimise(at, np.array([0.0]), 50, damping=Damping(correctors=correctors))
    assert found.status == "stalled"
    tried = np.ceil(np.log(DAMPING_MAX / DAMPING_START) / np.log(REFUSED))
    assert len(calls) == 1 + evaluations * tried


def test_scaling_of_the_unknowns_changes_nothing():
    x = np.linspace(0, 1, 20)
    y = 3.0 * np.exp(-2.0 * x) + 0.01 * np.cos(20 * x)

    def solved(unit):
        at = linearised(
            lambda b: y - b[0] * np.exp(-b[1] * unit * x),
            lambda b: np.column_stack([np.exp(-b[1] * unit * x), -b[0] * unit * x * np.exp(-b[1] * unit * x)]),
        )
        return minimise(at, np.array([1.0, 0.5 / unit]), 50)

    plain, scaled = solved(1.0), solved(1e6)
    assert plain.iterations == scaled.iterations
    np.testing.assert_allclose(plain.x, scaled.x * [1.0, 1e6], rtol=1e-9)


def test_the_ways_to_end():
    # x0 + x1 is all that is seen: the step shares it evenly, by the columns' scale, and leaves x2 alone.
    a = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0]])
    found = minimise(linearised(lambda x: np.array([1.0, 2.0]) - a @ x, lambda x: a), np.array([0.0, 0.4, 7.0]), 20)
    assert found.status == "converged"
    np.testing.assert_allclose(found.x, [0.3, 0.7, 7.0], atol=1e-9)
    hard = linearised(lambda x: -np.array([np.exp(x[0]) - 2.0]), lambda x: np.array([[np.exp(x[0])]]))
    found = minimise(hard, np.array([5.0]), 2)
    assert (found.status, found.iterations) == ("max_iterations", 2)
    assert minimise(hard, np.array([5.0]), 50).status == "converged"
    lying = linearised(lambda x: np.array([1.0 + x[0] ** 2]), lambda x: np.array([[1.0]]))
    assert minimise(lying, np.array([0.0]), 50).status == "stalled"
    assert minimise(hard, np.log([2.0]), 50).iterations == 0
    # What was predicted may be lost in rounding; the damping is then that of a step that came as predicted.
    for refused in (False, True):
        assert after_step(1e-3, 1e200, refused) == after_step(1e-3, 1.0, refused) > 0.0


def test_a_gain_below_the_rounding_of_chi2_is_the_minimum():
    """A residual of metres over micrometres: χ² = 100 is uncertain by 1e-7, the gain of the last 3e-4 σ."""
    calls = []

    def at(x):
        calls.append(x[0])
        here = linearised(lambda x: np.array([x[0] - 1.0, 10.0]), lambda x: np.array([[-1.0], [0.0]]))(x)
        return here._replace(
            chi2=here.chi2 + 1e-7 * (x[0] != 1.0 + 2e-4)
        )  # where the iteration starts, χ² is rounded down

    found = minimise(at, np.array([1.0 + 2e-4]), 50)
    assert found.status == "converged"
    assert len(calls) < 40  # one a refusal: λ from 1e-4 to 1e10 in factors of 4 is 24


def test_a_narrow_valley_that_bends_is_followed_in_a_few_steps():
    """One radian along a circle whose radius is known 10,000 times better than the arc: more than 200 damped steps."""

    def residual(x):
        return np.array([1e4 * (np.hypot(*x) - 1.0), np.arctan2(x[1], x[0]) - 1.0])

    def jacobian(x):
        r2 = x @ x
        return -np.array([1e4 * x / np.sqrt(r2), np.array([-x[1], x[0]]) / r2])

    found = minimise(linearised(residual, jacobian), np.array([1.0, 0.0]), 50)
    assert found.status == "converged"
    assert found.iterations <= 10
    np.testing.assert_allclose(found.x, [np.cos(1.0), np.sin(1.0)], atol=1e-6)
