"""Calibration polynomials: against NumPy's, brute-force leave-one-out, Monte Carlo, and truths that were put in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial

from truearm.box.gauge import check_references, chosen, fit, fits, head_of, possible_orders
from truearm.errors import InputError
from truearm.findings import Finding

TRUTH = np.array([-4.2e-4, 3.79e-2, 2.1e-4, -3.3e-4])  # an LVDT's: zero, gain, and 0.5 % of curvature, m and V


def places(n, seed, sigma=2e-6, poly=TRUTH, low=-0.9, high=1.1):
    """Readings (n,) [V] over a travel and the references (n,) [m] of a stage that is off by ``sigma``."""
    x = np.linspace(low, high, n)
    return x, polynomial.polyval(x, poly) + sigma * np.random.default_rng(seed).standard_normal(n)


@pytest.mark.parametrize("order", range(1, 6))
def test_the_fit_is_the_least_squares_polynomial(order):
    x, y = places(12, 1)
    ours, other = fit(x, y, order), polynomial.polyfit(x, y, order)
    # both are backward stable: they agree to rounding times the condition of the powers on [-0.9, 1.1], below 1e4 at order 5
    assert np.allclose(polynomial.polyval(x, ours.poly), polynomial.polyval(x, other), rtol=0, atol=1e-15 * 1e4)
    assert np.allclose(ours.residual, y - polynomial.polyval(x, ours.poly), rtol=0, atol=1e-15 * 1e2)
    leverage = 1 - ours.residual / ours.deleted_residual
    assert leverage.sum() == pytest.approx(order + 1, rel=1e-9)  # the trace of a projector is its rank
    assert ours.sigma == pytest.approx(np.sqrt(np.sum(ours.residual**2) / (12 - order - 1)), rel=1e-12)


@settings(max_examples=60, deadline=None)
@given(st.integers(5, 14), st.integers(0, 2**31), st.floats(0.01, 100), st.floats(-50, 50), st.booleans())
def test_left_out_errors_are_those_of_fitting_without_the_point(n, seed, span, centre, twice):
    rng = np.random.default_rng(seed)
    x = centre + span * np.sort(rng.uniform(-1, 1, n))
    if twice:
        x = np.concatenate([x, x[::-1]])  # there and back
    y = rng.standard_normal(x.size)
    for order in possible_orders(x, 4):
        ours = fit(x, y, order)
        for i in range(x.size):
            others = np.delete(np.arange(x.size), i)
            series = polynomial.Polynomial.fit(x[others], y[others], order)
            # a point of leverage h is predicted through 1 / (1 − h); rounding is amplified by it, and by the fit without the point
            scale = (np.abs(y).max() + abs(ours.deleted_residual[i])) * abs(ours.deleted_residual[i] / ours.residual[i])
            assert abs((y[i] - series(x[i])) - ours.deleted_residual[i]) <= 1e-10 * scale


@pytest.mark.parametrize("n", [12, 20])
@pytest.mark.parametrize(
    "poly",
    [TRUTH, [0, 3.8e-2], [0, 3.8e-2, 1.5e-5], [0, 3.8e-2, 0, 1.2e-5], [0, 3.8e-2, 1e-4, -2e-4, 5e-5, 1e-4]],
    ids=["strong", "straight", "quadratic of 4 sigma", "cubic of 3 sigma", "quintic"],
)
def test_how_good_the_choice_is(n, poly):
    """The order found, and the error between the points against the best order in hindsight.

    300 runs find the true order in 76 to 93 % of cases, and errors 4 to 21 % larger. Of 100, a share of 0.76 is known to
    0.043, so 0.63 is three of these below it; an RMS error to some 7 %.
    """
    at = np.linspace(-0.9, 1.1, 51)
    right, taken, best = 0, 0.0, 0.0
    for seed in range(100):
        tried = fits(*places(n, seed, poly=poly))
        errors = [np.mean((polynomial.polyval(at, f.poly) - polynomial.polyval(at, poly)) ** 2) for f in tried]
        found = chosen(tried)
        right += found.order == len(poly) - 1
        taken, best = taken + errors[found.order - 1], best + min(errors)
    assert right >= 63
    assert np.sqrt(taken / best) <= 1.21 * 1.2


def test_orders_that_the_places_allow():
    assert list(possible_orders(np.array([]))) == []
    assert list(possible_orders(np.array([1.0, 2.0, 3.0]))) == []
    assert list(possible_orders(np.linspace(0, 1, 4))) == [1]
    assert list(possible_orders(np.linspace(0, 1, 11))) == list(range(1, 8))
    assert list(possible_orders(np.ones(20))) == []  # a sensor that stands still
    # a parabola through three places is not a test of it
    assert list(possible_orders(np.repeat([0.0, 0.5, 1.0], 8))) == [1]
    jitter = 1e-5 * np.random.default_rng(0).standard_normal(24)
    assert list(possible_orders(np.repeat([0.0, 0.5, 1.0], 8) + jitter)) == [1]


def test_a_magnetostrictive_head_gets_back_its_velocity_and_delay():
    """The box's own formula (SPEC §5) turned round: 9.031 µs an inch, 1200 ns."""
    velocity = 25.4e-3 / 9.031e-6
    x = np.linspace(50e-6, 400e-6, 9)
    y = velocity * (x + 4e-9 - 1200e-9)
    us_per_inch, delay_ns = head_of(fit(x, y, 1))
    assert us_per_inch == pytest.approx(9.031, rel=1e-12)
    assert delay_ns == pytest.approx(1200, abs=1e-6)  # rounding of y, 1 m, is 1e-16 m or 4e-11 ns; of x/span more
    with pytest.raises(ValueError, match="rise"):
        head_of(fit(x, -y, 1))


def test_references_that_make_no_calibration_are_refused_by_code_and_values():
    with pytest.raises(InputError) as few:
        check_references([0.0, 0.01, 0.01], [0.02], 0.1, "steps.csv")
    assert few.value.finding == Finding("few-places", {"place": "steps.csv", "distinct": 3, "least": 5})
    with pytest.raises(InputError) as apart:
        check_references([0.0, 0.01, 0.02, 0.03, 1.0], [], 0.1, "steps.csv")
    assert apart.value.finding.code == "place-beyond"
    assert apart.value.finding.values["stroke"] == "100 mm"
