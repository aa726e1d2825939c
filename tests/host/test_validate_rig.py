"""``truearm.validate`` with the rig held as identified, and with joints that did not move during the identification."""

from dataclasses import replace

import device_bench
import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import ROBOT, SIGMA, TRUTH, random_poses
from tests.host.findings_bench import listed

import truearm
from truearm.estimate.validation import consistency, judge
from truearm.model.chain import point_forward
from truearm.model.transforms import rotation
from truearm.types import Device, Point, Rig
from truearm.workflows.calibration import covariance_of, unseen_of

SENSOR = tuple(tuple(SIGMA**2 * (i == k) for k in range(3)) for i in range(3))
RIG = Rig(targets={"ball": Point("ball", (0.0, 0.0, 0.1), None)}, trackers={"t": Device("t", SENSOR)})
POSE = np.array([1.5, 0.2, 0.5, 0.1, 0.2, 0.3])


def session(rng, n=100, moved=0.0, tracker="t", joint1=None):
    """Positions by a tracker that nobody measured, of a target that nobody measured; the tracker ``moved`` along x."""
    q = random_poses(n, rng)
    if joint1 is not None:
        q[:, 0] = joint1
    points = point_forward(ROBOT.chain, TRUTH, q, np.array(device_bench.TARGETS["ball"].xyz))
    xyz = (points - POSE[:3] - [moved, 0.0, 0.0]) @ rotation(POSE[3:])
    xyz = xyz + SIGMA * rng.normal(size=xyz.shape)
    return device_bench.rows("position", q, xyz=xyz, tracker=tracker, target="ball")


@pytest.fixture(scope="module")
def result():
    return truearm.identify(ROBOT, session(np.random.default_rng(0), 200), RIG)


def test_a_tracker_that_stayed_may_be_kept_and_one_that_moved_shows(result):
    rows = session(np.random.default_rng(1))
    settled, kept = (truearm.validate(result, rows, RIG, keep_rig=keep) for keep in (False, True))
    assert (settled.document["settled"], settled.document["kept"]) == (9, 0)
    assert (kept.document["settled"], kept.document["kept"]) == (0, 9)
    assert settled.document["consistent"]
    assert kept.document["consistent"]
    # What is settled on a hundred rows takes 9 of their 300 degrees of freedom, and is as uncertain again.
    assert kept.document["chi2_freedom"] == settled.document["chi2_freedom"] + 9
    (unknowns,) = (finding.values for finding in kept.findings if finding.code == "rig-unknowns")
    assert unknowns["n"] == 9
    rows = session(np.random.default_rng(2), moved=1e-3)
    assert truearm.validate(result, rows, RIG).document["consistent"]
    kept = truearm.validate(result, rows, RIG, keep_rig=True)
    assert not kept.document["consistent"]
    assert kept.after["m"].rms == pytest.approx(1e-3, rel=0.1)
    rig = replace(RIG, trackers={"u": Device("u", SENSOR)}, targets={"ball": Point("ball", (0.0, 0.0, 0.1))})
    with pytest.raises(truearm.InputError, match="keep_rig:"):
        truearm.validate(result, session(np.random.default_rng(3), tracker="u"), rig, keep_rig=True)


def test_rows_that_the_unknowns_can_fit_show_no_fault(result):
    """Four or five positions that err by 0.3 mm; nine unknowns of the rig and what the calibration leaves fit them."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        for n in (4, 5):
            rows = session(rng, n)
            rows = rows.replace(xyz=rows.xyz + 0.3e-3 * rng.normal(size=(n, 3)))
            faults = truearm.validate(result, rows, RIG).document["faults"]
            assert not faults, (seed, n)


def test_the_kept_rigs_covariance_counts():
    """χ² of judged sessions, robot, tracker and target kept: the mean of 12 values of 90 degrees of freedom, ± 4 σ.

    Twenty poses to identify from: without the covariance of tracker and target the errors would be far above the noise.
    """
    rng, found = np.random.default_rng(4), []
    for _ in range(12):
        result = truearm.identify(ROBOT, session(rng, 20), RIG)
        values = {name: of.value for name, of in result.parameters.items() if of.of == "rig"}
        rows = session(rng, 30)
        judgement = judge(ROBOT.chain, RIG, rows, result.identified, values)
        matrices = (of(result.stored, judgement.identified) for of in (covariance_of, unseen_of))
        found.append(consistency(judgement, *matrices))
    assert {of.freedom for of in found} == {90}
    assert np.mean([of.chi2 for of in found]) == pytest.approx(90.0, abs=4.0 * np.sqrt(180.0 / 12))


def test_a_joint_that_stood_still_is_unseen_where_it_moves():
    """Joint 1 was held by its brake: what its axis is, those rows did not tell."""
    rng = np.random.default_rng(5)
    still = truearm.identify(ROBOT, session(rng, 150, joint1=0.3), RIG)
    assert still.document["defaults"]["still"][0]["joint"] == "joint1"
    assert still.document["defaults"]["still"][0]["at"] == pytest.approx(0.3)
    there = truearm.validate(still, session(rng, 60, joint1=0.301), RIG)
    assert there.n_unseen == 0
    assert there.document["consistent"]
    elsewhere = truearm.validate(still, session(rng, 60, joint1=-0.5), RIG)
    assert elsewhere.n_unseen == 60
    assert "rows-unseen" in listed(elsewhere.document)


def test_a_bars_zero_that_was_allowed_is_kept():
    """A bar that the rig calls known is 0.3 mm wrong in both sessions: kept, it is not an error of the judged one."""
    plan, rng = worlds.plan(), np.random.default_rng(6)
    first, second = (worlds.wrong_bar(plan, rng).select(np.arange(start, 360, 2)) for start in (0, 1))
    options = truearm.IdentifyOptions(apply=("bar.bar46.zero",))
    result = truearm.identify(ROBOT, first, worlds.RIG, options=options)
    kept, left = (truearm.validate(result, second, worlds.RIG, keep_rig=keep) for keep in (True, False))
    assert (kept.document["kept"], left.document["kept"]) == (1, 0)
    assert kept.document["consistent"]
    assert not left.document["consistent"]
    # The other bar is another thing: nothing of it is known, so nothing of the rig can be kept.
    slipped = truearm.identify(
        ROBOT, first, worlds.RIG, options=truearm.IdentifyOptions(apply=("bar.bar46.zero.drift",))
    )
    assert truearm.validate(slipped, second, worlds.RIG, keep_rig=True).document["kept"] == 0
