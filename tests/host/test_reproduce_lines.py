"""Renders' III-E and III-F on the simulated bench: what three runs reach, what the covariance is worth, what unmodelled errors leave.

Medians over sets of lines, for the paper does not say where its lines lay; devices are believed to stand within 100 mm
of where least squares through the nominal robot places them (WIDE).
"""

import numpy as np
import pytest

from truearm.model.robot import builtin_robot
from truearm.reproduce.line_bench import measured_lines
from truearm.reproduce.renders import CASE_E, CASE_F, GEAR, N_LINES, N_POINTS, case, drawn_case, errors_added

CHAIN = builtin_robot("ulb").chain
DIMENSION = len(CASE_E)


def cases(errors, solver, sets, unmodelled=0.0, **how):
    truth = errors_added(CHAIN, errors)
    out = []
    for k in range(sets):
        session = measured_lines(CHAIN, truth, N_LINES, N_POINTS, np.random.default_rng([7, k]), unmodelled)
        out.append(case(CHAIN, session, truth, errors, solver, **how))
    return out


def after(found, run):
    """Mean error [m] of the identification lines after a run, of each case; one that ended stays where it is."""
    return np.array([one.history[min(run, len(one.history) - 1)] for one in found])


def held_to_three_runs(sets):
    good, recipe = (cases(CASE_E, solver, sets, runs=3) for solver in ("map", "renders-1991"))
    assert (after(good, 0) > 2e-3).all()
    assert (after(good, 3) <= 0.2e-3).all()
    assert np.median(after(recipe, 3) / after(good, 3)) > 3
    # Errors that the data know to a σ: of five parameters, 5 ± 3 standard errors of the mean of χ²(5).
    assert abs(np.mean([one.nees for one in good]) - DIMENSION) < 3 * np.sqrt(2 * DIMENSION / sets)
    assert min(one.nees for one in recipe) > 100 * DIMENSION


def held_to_ten_times(errors, sets):
    found = cases(errors, "map", sets, unmodelled=GEAR)
    factor = np.array([one.history[0] for one in found]) / after(found, -1)
    before, validated = (np.median([getattr(c, f"validation_{k}") for c in found]) for k in ("before", "after"))
    assert np.median(factor) >= 10
    # The floor is what gears of 1 mrad make at some decimetres, far above the sensors' 0.15 mm; a line that was not
    # fitted shows it too, and more of it, but stays far below what it was.
    assert 0.2e-3 < np.median(after(found, -1)) <= validated < before / 10
    assert before > 5e-3


def test_three_runs_of_map_reach_the_noise_and_the_recipe_does_not():
    held_to_three_runs(6)


@pytest.mark.parametrize("errors", [CASE_E, pytest.param(CASE_F, marks=pytest.mark.soak)], ids=["III-E", "III-F"])
def test_unmodelled_errors_leave_a_tenth_at_most(errors):
    held_to_ten_times(errors, 12)


@pytest.mark.parametrize("rule", ["least_squares", "two_point"])
def test_a_placed_line_does_not_creep(rule):
    """The roll about a line, set up by hand to 0.052 rad, starts within that prior, so a fit is done when the robot is."""
    found = cases(CASE_E, "map", 4, rule=rule)
    assert max(one.runs for one in found) <= 8


@pytest.mark.soak
def test_three_runs_over_many_sets():
    held_to_three_runs(48)


@pytest.mark.soak
@pytest.mark.parametrize("errors", [CASE_E, CASE_F], ids=["III-E", "III-F"])
def test_unmodelled_errors_over_many_sets(errors):
    held_to_ten_times(errors, 48)


@pytest.mark.soak
def test_the_covariance_of_map_over_robots_drawn_from_the_prior():
    found = [drawn_case(CHAIN, "map", 50, np.random.default_rng([8, k])) for k in range(200)]
    assert abs(np.mean([one.nees for one in found]) - DIMENSION) < 3 * np.sqrt(2 * DIMENSION / 200)
    assert np.median(after(found, 3)) <= 0.2e-3
    # Of robots that err by 0.15 rad in several joints a few take more than three runs; all arrive.
    assert (after(found, 3) <= 0.2e-3).mean() > 0.95
    assert (after(found, -1) <= 0.3e-3).all()
