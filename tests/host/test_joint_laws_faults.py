"""Joint laws and systematic errors of a ball-bar's rig: neither is reported as the other."""

import numpy as np
import pytest
from test_joint_laws_monte_carlo import MIDDLE, POINTS, rig_of, table_of, truth_of
from ur10_bench import ROBOT

from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.types import BallBar, Point, Rig
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed

NOISE = 3e-5  # m
SPHERES = np.array([[0.07, 0.04, 0.11], [-0.07, 0.04, 0.11], [0.0, -0.08, 0.11]])  # m
SLIP = np.array([1e-4, 1e-4, -1e-4])  # m, of a chuck in the middle of its session
ZERO = 1.5e-4  # m, of one bar


def world(seed, n, laws, error=""):
    """A rig and a table: lengths from three chucks, each with a bar of its own, to three spheres, mounted one after the other."""
    rng = np.random.default_rng(seed)
    params, angles = truth_of(rng, laws)
    q = MIDDLE + rng.uniform(-1.2, 1.2, (n, 6))
    mount = np.arange(n) * 9 // n
    chuck, sphere = mount // 3, mount % 3
    points = np.array([point_forward(ROBOT.chain, params, angles(q), at) for at in SPHERES])[sphere, np.arange(n)]
    places = points.mean(axis=0) + np.array([[0.6, 0.0, -0.3], [-0.4, 0.5, -0.2], [-0.3, -0.6, 0.1]])
    true = places[chuck]
    if error == "slip":
        true[(np.arange(n) >= n // 2) & (chuck == 1)] += SLIP
    length = np.linalg.norm(points - true, axis=1) + rng.normal(0.0, NOISE, n) + ZERO * (error == "zero") * (chuck == 1)
    rig = Rig(
        chucks={f"c{k}": Point(f"c{k}", tuple(place), 0.0) for k, place in enumerate(places, 1)},
        spheres={f"s{k}": Point(f"s{k}", tuple(place), 0.0) for k, place in enumerate(SPHERES, 1)},
        bars={f"b{k}": BallBar(f"b{k}", 0.7, 1.0, 10.0, NOISE) for k in (1, 2, 3)},
    )
    names = {key: np.array([f"{key[0]}{k + 1}" for k in of]) for key, of in (("chuck", chuck), ("sphere", sphere))}
    source = np.array([f"lengths.csv row {i + 2}" for i in range(n)])
    bar = np.array([f"b{k + 1}" for k in chuck])
    return rig, ObservationTable(q=q, kind=np.full(n, "ball_bar"), value=length, bar=bar, source=source, **names)


def found(rig, table, mode):
    return identified(ROBOT, Observed(rig, table), (), IdentifyOptions(joint_laws=mode)).estimate


def names_of(estimate):
    return [fault.rivals[0].name for fault in estimate.faults]


def test_a_chuck_that_slips_is_found_beside_the_laws_and_a_law_is_no_systematic_error():
    """Geometry alone blames a bar for the curves; with laws the slip is what is left, at its row, and explains the rest."""
    n = 400
    rig, table = world(1, n, laws=True, error="slip")
    estimate = found(rig, table, "auto")
    assert {law.term for law in estimate.joint_laws.tried if law.kept} >= {"curve"}
    (fault,) = estimate.faults
    cause = fault.rivals[0]
    assert cause.name == "chuck.c2.step"
    assert abs(cause.rows[0] - n // 2) <= 5
    (size,) = fault.sizes
    assert size.value == pytest.approx(float(np.linalg.norm(SLIP)), abs=4.5 * size.sigma)
    assert estimate.claim.chi2_reduced < 0.8 * estimate.chi2_reduced


@pytest.mark.soak
def test_a_chuck_that_slips_by_a_millimetre_is_named_beside_laws_and_bad_rows(monkeypatch):
    """The rows are chosen again with fewer laws beside the slip, which has columns of its own."""
    monkeypatch.setitem(world.__globals__, "SLIP", 10.0 * SLIP)
    rig, table = world(0, 300, laws=True, error="slip")
    rng = np.random.default_rng(0)
    bad = rng.choice(300, 8, replace=False)
    table.value[bad] += 3e-3 * rng.choice([-1, 1], 8) * rng.uniform(0.1, 1, 8)
    estimate = found(rig, table, "auto")
    assert "chuck.c2.step" in names_of(estimate)
    assert estimate.joint_laws.kept


def test_a_remounted_target_is_named_although_the_laws_have_more_coefficients_than_there_are_residuals():
    """A target that moves by 1 mm after row 40 of 100; without examination of the fit with laws, nothing would say so."""
    rng = np.random.default_rng(2)
    params, angles = truth_of(rng, laws=True)
    q = MIDDLE + rng.uniform(-1.8, 1.8, (100, 6))
    places = np.where(np.arange(100)[:, None] < 40, POINTS[0], POINTS[0] + [6e-4, -6e-4, 5e-4])
    points = point_forward(ROBOT.chain, params, angles(q), places)
    table = table_of(q, points + rng.normal(0.0, NOISE, points.shape), np.full(100, "t0"))
    estimate = found(rig_of(1), table, "auto")
    assert estimate.free.sum() > 3 * len(table)
    (fault,) = estimate.faults
    assert (fault.rivals[0].name, fault.rivals[0].rows) == ("target.t0.step", (40, 100))
    assert estimate.claim.shift > 1e-5


def test_laws_are_not_tried_where_a_systematic_error_explains_the_residuals():
    rig, table = world(0, 400, laws=False, error="zero")
    estimate = found(rig, table, "auto")
    assert estimate.joint_laws.kept == ()
    assert estimate.joint_laws.reasons[0].values == {"explained_by": "faults"}
    assert names_of(estimate) == ["bar.b2.zero.offset"]


@pytest.mark.parametrize("cycles", [pytest.param(1, marks=pytest.mark.soak), 2])
def test_a_curve_of_the_joint_that_the_rows_are_sorted_by_is_no_step(cycles):
    """With geometry alone, joint 1 steps at certain rows, which explains all; its curve of 0.1 mrad explains more."""
    n, rng = 300, np.random.default_rng(3)
    q = MIDDLE + rng.uniform(-1.5, 1.5, (n, 6))
    q = q[np.argsort(q[:, 0])]
    params, _ = truth_of(rng, False)
    true = q.copy()
    true[:, 0] += 1e-4 * np.sin(cycles * q[:, 0] + 0.4)
    points = point_forward(ROBOT.chain, params, true, POINTS[0])
    table = table_of(q, points + rng.normal(0.0, NOISE, points.shape), np.full(n, "t0"))
    plain, estimate = (found(rig_of(1), table, mode) for mode in ("none", "auto"))
    assert any(name.startswith("joint1.") for name in names_of(plain))
    assert names_of(estimate) == []
    kept = {(law.joint, law.term) for law in estimate.joint_laws.tried if law.kept}
    assert ("joint1", "curve") in kept
    assert estimate.chi2_reduced <= estimate.chi2_band[1]
    assert (estimate.weight == 1.0).all(), "a row that only the geometry contradicts is no outlier beside the curve"


@pytest.mark.soak
def test_arms_with_laws_alone_have_no_systematic_errors():
    """20 worlds; each has a finding with probability 0.001 at most."""
    worlds = [found(*world(seed, 300, laws=True), "auto") for seed in range(20)]
    assert sum(bool(names_of(estimate)) for estimate in worlds) <= 1
