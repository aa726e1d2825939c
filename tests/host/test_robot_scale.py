"""A wrong length in the rig scales the robot, and no residual shows it: the lengths themselves do."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import truearm
from truearm.estimate.robot_scale import LEVEL, robot_scale
from truearm.report.result_words import scale_sentences

DATA = Path(__file__).parents[1] / "data" / "mukca"
PANDA = truearm.load_robot("panda")
OPTIONS = truearm.IdentifyOptions(joint_laws="none")


def calibrated(ratio: float) -> truearm.Identification:
    """A real arm in three places, with the distance of its tool's sockets in the rig multiplied."""
    rows = truearm.read_table(DATA / "panda_3.csv", PANDA)
    rows = rows.select(np.isin(rows.place, ["backcenter", "backleft", "backright"]))
    rig = truearm.read_rig(DATA / "rig.toml")
    (known,) = rig.socket_distances
    rig = replace(rig, socket_distances=(replace(known, distance=ratio * known.distance),))
    return truearm.identify(PANDA, rows, rig, options=OPTIONS)


@pytest.fixture(scope="module")
def arm() -> truearm.Identification:
    return calibrated(1.0)


def test_a_distance_that_is_two_percent_wrong_is_said(arm):
    given = calibrated(1.02)
    assert given.estimate.chi2_reduced == pytest.approx(arm.estimate.chi2_reduced, rel=0.1)
    scale = given.document["scale"]
    assert scale["factor"] == pytest.approx(1.02, abs=4.0 * scale["sigma"])
    assert scale["chance"] < LEVEL
    (sentence,) = scale_sentences(given.document)
    assert sentence.startswith(f"The robot is {scale['factor']:.4f} times as large as described")


def test_a_correct_arm_has_no_scale(arm):
    assert arm.document["scale"] is None
    assert scale_sentences(arm.document) == []


def test_independent_tolerances_are_rarely_a_scale(arm):
    """Changes of 5 mm with no common ratio: no more of 2000 are reported than LEVEL allows (1 in a million for 12)."""
    rng, estimate = np.random.default_rng(8), arm.estimate
    size = np.where(np.array(estimate.units) == "m", 5e-3, 0.0)
    drawn = (replace(estimate, value=estimate.nominal + size * rng.standard_normal(size.size)) for _ in range(2000))
    assert sum(robot_scale(PANDA.chain, one) is not None for one in drawn) < 12


def test_heat_is_no_scale(arm):
    """30 K of aluminium: 0.7 parts in a thousand, exactly."""
    estimate = arm.estimate
    warm = replace(estimate, value=1.0007 * estimate.nominal)
    assert robot_scale(PANDA.chain, warm) is None
