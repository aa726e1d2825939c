"""Bad rows beside joint laws: they are named, and what is identified is what the other rows identify."""

from dataclasses import replace

import numpy as np
import pytest
from test_joint_laws_monte_carlo import DOWN, MIDDLE, NOISE, POINTS, WIDE, rig_of, rms_error, table_of, truth_of
from ur10_bench import ROBOT

from truearm.model.chain import joint_frames, point_forward
from truearm.report.result_findings import WHY_KEPT, outliers
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed

GEAR, CYCLES = 4e-4, 17  # rad; cycles a turn
SAG = 4e-4  # rad per m of a lever, of joint 2


def world(seed, n, gear):
    """Return a table of positions to fit and one to judge by, of an arm that sags or, with ``gear``, has gear errors."""
    rng = np.random.default_rng(seed)
    params, _ = truth_of(rng, laws=False)
    phase = rng.uniform(0.0, 7.0, 3)

    def rows(count, noise):
        q = MIDDLE + rng.uniform(-WIDE, WIDE, (count, 6))
        true = q.copy()
        if gear:
            true[:, :3] += GEAR * np.sin(CYCLES * q[:, :3] + phase)
        else:
            frames = joint_frames(ROBOT.chain, params, q)
            arm = point_forward(ROBOT.chain, params, q, POINTS[0]) - frames[:, 1, :3, 3]
            true[:, 1] += SAG * (np.cross(frames[:, 1, :3, 2], arm) @ DOWN)
        points = point_forward(ROBOT.chain, params, true, POINTS[0])
        return table_of(q, points + rng.normal(0.0, noise, points.shape), np.full(count, "t0"))

    return rows(n, NOISE), rows(200, 0.0)


def with_bad_rows(table, seed, share, low, high):
    """Return the table with some rows ``low`` to ``high`` [m] off in any direction, and which."""
    rng = np.random.default_rng(seed)
    bad = np.sort(rng.permutation(len(table))[: round(share * len(table))])
    off = rng.normal(size=(bad.size, 3))
    points = table.xyz.copy()
    points[bad] += rng.uniform(low, high, (bad.size, 1)) * off / np.linalg.norm(off, axis=1, keepdims=True)
    return replace(table, xyz=points), bad


def found(table, mode):
    nothing = np.zeros(len(table), dtype=bool)
    return identified(ROBOT, Observed(rig_of(1), table), nothing, IdentifyOptions(joint_laws=mode))


def check(clean, judges, mode, seed, share, low, high):
    table, bad = with_bad_rows(clean, seed, share, low, high)
    result = found(table, mode)
    assert np.flatnonzero(result.estimate.weight == 0.0).tolist() == bad.tolist()
    assert result.estimate.joint_laws.kept
    assert result.estimate.with_outliers.n == bad.size
    others = found(clean.select(~np.isin(np.arange(len(clean)), bad)), mode)
    assert rms_error(result, judges) <= 1.05 * rms_error(others, judges)


@pytest.mark.parametrize(("low", "high"), [(2e-3, 10e-3), pytest.param(3e-4, 5e-4, marks=pytest.mark.soak)])
def test_bad_rows_are_named_beside_sag(low, high):
    """Large ones hide the sag; small ones are within what the geometry alone leaves."""
    check(*world(4, 90, gear=False), "sag", 5, 0.03, low, high)


@pytest.mark.soak  # that no clean row is named is also asserted above
def test_clean_rows_beside_sag_stay():
    estimate = found(world(6, 90, gear=False)[0], "sag").estimate
    assert estimate.joint_laws.kept
    assert (estimate.weight == 1.0).all()


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(4))
def test_bad_rows_are_named_beside_gear_errors(seed):
    check(*world(20 + seed, 300, gear=True), "auto", seed, 0.02, 2e-3, 10e-3)


@pytest.mark.parametrize("laws", WHY_KEPT)
def test_the_reason_for_a_kept_row_is_that_of_the_fit(laws):
    rows = [{"weight": weight, "source": "a.csv row 9", "distance": 6.0} for weight in (0.0, 1.0)]
    document = {
        "suspect": rows,
        "loss": "linear",
        "n_observations": 200,
        "with_outliers": None,
        "without_bad_rows": None,
        "joint_laws": {"tried": [{"kept": laws}]},
    }
    (finding,) = outliers(document)
    assert (finding.values["why"], finding.values["kept"]) == (WHY_KEPT[laws], ["a.csv row 9 (6.0 σ)"])
