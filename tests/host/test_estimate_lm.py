"""The solver alone: redundant unknowns, rounding, and every kind of termination; curved valleys are test_estimate_degenerate.py's."""

import numpy as np

from truearm.estimate.information import Information, fold
from truearm.estimate.levenberg_marquardt import after_step, minimise


def linearised(residual, jacobian):
    """Return a problem for ``minimise`` from f(x) = measured − predicted and ∂predicted/∂x."""

    def at(x):
        f, j = residual(x), jacobian(x)
        k = x.size
        triangle = fold(np.zeros((k + 1, k + 1)), np.column_stack([j, f]))
        return Information(triangle[:k, :k], triangle[:k, k], float(f @ f), f.size, f)

    return at


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
