"""Rank, gap and readable null directions on matrices whose answer is known."""

import numpy as np
import pytest

from truearm.estimate.identifiability import identifiability, observability
from truearm.estimate.information import scaled_columns, seen, spectrum


def test_what_is_seen_and_what_nobody_sees():
    seen = identifiability(np.diag([3.0, 1e-6]), 2, ["a", "b"])  # a small unit is not missing information
    assert (seen.rank, seen.null_space) == (2, ())
    assert seen.identifiable.all()
    assert np.isinf(seen.gap)
    rows = np.array([[1.0, 2.0, 0.0, 0.0], [3.0, 6.0, 0.0, 1.0], [0.0, 0.0, 0.0, 5.0]])
    seen = identifiability(np.linalg.qr(np.vstack([rows, np.zeros((1, 4))]), mode="r"), 4, ["a", "b", "c", "d"])
    assert seen.rank == 2
    assert seen.identifiable.tolist() == [False, False, False, True]
    found = {d.names: d.weights for d in seen.null_space}
    assert set(found) == {("a", "b"), ("c",)}
    assert found[("a", "b")] == pytest.approx((1.0, -0.5))
    assert found[("c",)] == (1.0,)


def test_what_the_rig_explains_is_not_seen_of_the_robot():
    # Robot a, b; rig c: the column of a is that of c, so only b is left. Without the rig both are seen.
    rng = np.random.default_rng(1)
    c, b = rng.normal(size=(2, 30))
    root = np.linalg.qr(np.column_stack([2.0 * c, b, c]), mode="r")
    seen = identifiability(root, 2, ["a", "b", "c"])
    assert seen.rank == 1
    (direction,) = seen.null_space  # a alone would be seen: c must move against it
    assert dict(zip(direction.names, direction.weights, strict=True)) == pytest.approx({"a": -0.5, "c": 1.0})
    assert seen.identifiable.tolist() == [False, True, False]
    assert identifiability(root[:2, :2], 2, ["a", "b"]).rank == 2
    root = np.diag([1.0, 1.0, 0.0])
    seen = identifiability(root, 1, ["robot", "seen", "unseen"])
    assert seen.rank == 1
    assert [d.names for d in seen.null_space] == [("unseen",)]
    assert seen.identifiable.tolist() == [True, True, False]


def test_a_column_of_rounding_is_no_information():
    """Found with a single row at q = 0: a column of 1e-17 was scaled to length 1 and steered the fit."""
    root = np.diag([1.0, 2.0, 1e-15])
    scaled, scale = scaled_columns(root)
    assert np.array_equal(scaled, np.diag([1.0, 1.0, 0.0]))
    assert np.array_equal(scale, [1.0, 2.0, 1.0])
    assert seen(spectrum(root)).sum() == 2


def test_observability_by_hand_and_without_what_the_rig_explains():
    # Columns of length 6, 2 and 3 in units of 1, 2 and 1/3: singular values 6, 4, 1.
    found = observability(np.diag([6.0, 2.0, 3.0]), 3, np.ones(3, bool), np.array([1.0, 2.0, 1.0 / 3.0]), 4)
    assert found == pytest.approx((24.0 ** (1 / 3) / 2.0, 1.0 / 6.0, 1.0, 1.0 / 6.0))
    blind = np.array([[1.0, 1.0], [0.0, 0.0]])
    assert observability(blind, 2, np.ones(2, bool), np.ones(2), 4) == (0.0, 0.0, 0.0, 0.0)
    assert observability(blind, 2, np.array([True, False]), np.ones(2), 4)[1] == 1.0
    assert np.isnan(observability(np.zeros((0, 0)), 0, np.zeros(0, bool), np.zeros(0), 0)).all()
    root = np.linalg.qr(np.array([[3.0, 3.0], [4.0, 0.0]]), mode="r")  # the robot's column, then the rig's
    assert observability(root, 1, np.ones(1, bool), np.ones(1), 2)[2] == pytest.approx(4.0)
