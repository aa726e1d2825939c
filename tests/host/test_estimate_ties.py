"""Choices do not depend on rounding: the same with readings and derivatives that differ in the thirteenth digit."""

from dataclasses import replace

import numpy as np
import pytest

from truearm.estimate import information
from truearm.estimate.identifiability import identifiability, suggested_free
from truearm.estimate.ties import first_within, largest_first, pivots
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed

RELATIVE = 1e-13
ROUNDED = ("checksum", "seconds", "iterations", "rank_gap", "covariance")  # of a result: no choices
EQUAL = (1.0 - 2e-16, 1.0, 1.0 - 1e-13, 0.5)


def skeleton(value):
    """Everything of a document but its numbers, of which the signs of those close to 1 are kept."""
    if isinstance(value, dict):
        return {key: skeleton(of) for key, of in value.items() if key not in ROUNDED}
    if isinstance(value, (list, tuple)):
        return [skeleton(of) for of in value]
    if isinstance(value, float):
        return np.isfinite(value), float(np.sign(value)) if abs(abs(value) - 1.0) < 1e-9 else 0.0
    return value


def choices(robot, rig, table):
    return skeleton(identified(robot, Observed(rig, table), (), IdentifyOptions(joint_laws="none")).document)


def assert_same_choices(case, monkeypatch, seeds):
    expected = choices(case.robot, case.rig, case.table)
    each, which = np.unique(case.table.q, axis=0, return_inverse=True)
    fold, stacked = information.fold, information._stacked
    for seed in range(seeds):
        rng = np.random.default_rng(seed)

        def off(values, rng=rng):
            return values * (1.0 + RELATIVE * rng.standard_normal(values.shape))

        monkeypatch.setattr(information, "_stacked", lambda *args, off=off: off(stacked(*args)))
        monkeypatch.setattr(
            information, "fold", lambda triangle, rows, overwrite=False, off=off: fold(triangle, off(rows), overwrite)
        )
        table = replace(case.table, q=off(each)[which.ravel()])
        assert choices(case.robot, case.rig, table) == expected, f"seed {seed}"


REAL_ARMS = ("panda3-front", "panda1", "kuka-left", "ur5", "ur10-c-0", "ur10-a-0", "bars")
WHOLE = [pytest.param(name, 1, 50, marks=pytest.mark.soak) for name in REAL_ARMS]


@pytest.mark.parametrize(("name", "every", "seeds"), [("panda3-front", 3, 1), ("ur5", 8, 1), *WHOLE])
def test_rounding_chooses_nothing(real_arms, name, every, seeds, monkeypatch):
    """The processor decided which equivalent turn of a base is held (joint1.yaw, joint1.offset, joint2.yaw)."""
    case = dict(real_arms.cases())[name]()
    assert_same_choices(replace(case, table=case.table.select(slice(None, None, every))), monkeypatch, seeds)


def test_ties_go_to_the_first():
    assert first_within(EQUAL) == first_within(EQUAL[::-1][1:]) == 0
    assert largest_first([0.5, *EQUAL]) == [1, 2, 3, 0, 4]
    assert largest_first([-2.0, -np.inf, -1.0, -1.0 - 1e-12]) == [2, 3, 0, 1]
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.standard_normal((6, 3)))[0]
    columns = basis[:, [0, 0, 1, 2, 1]] @ np.diag([1.0, 1.0 + 1e-13, 2.0, 1.5, 2.0 + 1e-13])
    assert pivots(columns, 1e-10) == [2, 3, 0]
    assert pivots(columns, 1e-10, most=2) == [2, 3]
    assert pivots(np.zeros((6, 3))) == pivots(np.zeros((6, 0))) == []
    # b does the same as a, and c is twice as long: the first is suggested, and the direction's first weight is 1.
    a = np.random.default_rng(2).standard_normal((5, 1))
    for rounding in (-1e-13, 0.0, 1e-13):
        root = np.linalg.qr(np.hstack([a, a * (1.0 + rounding), -a]), mode="r")
        assert suggested_free(root, 3, np.zeros(3, dtype=bool)).tolist() == [True, False, False]
        pairs = [(of.names, np.sign(of.weights).tolist()) for of in identifiability(root, 3, "abc").null_space]
        assert pairs == [(("a", "c"), [1.0, 1.0]), (("b", "c"), [1.0, 1.0])]


def test_a_difference_of_long_terms_is_no_information():
    """A column of 1e-4 of the longest that only rounding tells from the rig's: scaled to 1, its rounding is 1e-9."""
    rng = np.random.default_rng(3)
    rows = rng.standard_normal((20, 2))
    for seed in range(5):
        noise = RELATIVE * np.random.default_rng(seed).standard_normal((20, 3))
        root = np.linalg.qr(np.column_stack([1e-4 * rows[:, 0], rows[:, 1], 1e-4 * rows[:, 0]]) + noise, mode="r")
        assert identifiability(root, 2, ["turn", "other", "rig"]).rank == 1
