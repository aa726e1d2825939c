"""A wrong length in the rig scales the robot, and no residual shows it: the lengths themselves do."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import truearm
from truearm.estimate.robot_scale import LEVEL, robot_scale, with_scale
from truearm.report.result_findings import verdict
from truearm.results import Unusable

DATA = Path(__file__).parents[1] / "data" / "mukca"
PANDA = truearm.load_robot("panda")
OPTIONS = truearm.IdentifyOptions(joint_laws="none")


def calibrated(ratio: float, robot: truearm.Robot = PANDA) -> truearm.Identification:
    """A real arm in three places, with the distance of its tool's sockets in the rig multiplied."""
    rows = truearm.read_table(DATA / "panda_3.csv", robot)
    rows = rows.select(np.isin(rows.place, ["backcenter", "backleft", "backright"]))
    rig = truearm.read_rig(DATA / "rig.toml")
    (known,) = rig.socket_distances
    rig = replace(rig, socket_distances=(replace(known, distance=ratio * known.distance),))
    return truearm.identify(robot, rows, rig, options=OPTIONS)


@pytest.fixture(scope="module")
def arm() -> truearm.Identification:
    return calibrated(1.0)


def test_a_wrong_distance_is_said_and_a_correct_arm_has_no_scale(arm):
    given = calibrated(1.02)
    assert given.estimate.chi2_reduced == pytest.approx(arm.estimate.chi2_reduced, rel=0.1)
    scale = given.document["scale"]
    assert scale["factor"] == pytest.approx(1.02, abs=4.0 * scale["sigma"])
    assert scale["chance"] < LEVEL
    assert verdict(given.document).code == "robot-scale"
    assert f"{scale['factor']:.4f} times" in verdict(given.document).text()
    assert (given.document["usable"], given.document["unusable_because"]) == (False, "robot scale")
    assert given.document["faults"] == []
    assert arm.document["scale"] is None
    assert arm.document["usable"]


@pytest.mark.parametrize(
    ("factor", "unit"), [(0.001, "metres and millimetres"), (25.4, "inches and millimetres"), (1.02, None)]
)
def test_a_ratio_of_units_is_named(factor, unit):
    scale = {"factor": factor, "sigma": 1e-4, "n": 6, "chance": 1e-9}
    found = verdict({"unusable_because": "robot scale", "scale": scale, "mean_change": None})
    assert bool(found.values["unit"]) == (unit is not None)
    assert unit is None or unit in found.text()


@pytest.mark.parametrize("state", [{"status": "max_iterations"}, {"unusable": Unusable.WRONG_INPUTS}])
def test_a_fit_that_is_not_usable_has_no_scale(arm, state):
    twice = replace(arm.estimate, value=2.0 * arm.estimate.nominal)
    assert robot_scale(PANDA.chain, twice) is not None
    assert robot_scale(PANDA.chain, replace(twice, **state)) is None


def test_independent_tolerances_are_rarely_a_scale(arm):
    """Changes of 5 mm with no common ratio: no more of 2000 are reported than LEVEL allows (1 in a million for 12)."""
    rng, estimate = np.random.default_rng(8), arm.estimate
    size = np.where(np.array(estimate.units) == "m", 5e-3, 0.0)
    drawn = (replace(estimate, value=estimate.nominal + size * rng.standard_normal(size.size)) for _ in range(2000))
    assert sum(robot_scale(PANDA.chain, one) is not None for one in drawn) < 12


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_lengths_are_a_scale_beyond_any_tolerance(arm, n):
    """An arm of four or five axes has two or three; independent errors of 5 mm stay below LEVEL, a tenth of 0.3 m does not."""
    estimate = arm.estimate
    lengths = [
        i for i, value in enumerate(estimate.nominal) if estimate.free[i] and estimate.units[i] == "m" and value > 0.05
    ]
    free = estimate.free & np.isin(np.arange(estimate.free.size), lengths[:n])
    few = replace(estimate, free=free)
    assert robot_scale(PANDA.chain, replace(few, value=1.1 * estimate.nominal)).n == n
    rng = np.random.default_rng(10)
    drawn = (replace(few, value=estimate.nominal + 5e-3 * free * rng.standard_normal(free.size)) for _ in range(2000))
    assert sum(robot_scale(PANDA.chain, one) is not None for one in drawn) < 12


def test_small_scales_and_heat_are_left_to_the_faults(arm):
    # A sphere that is 2 mm off scales an arm by half a percent.
    for factor, is_scale in ((1.01, False), (1.2, True)):
        scaled = replace(arm.estimate, value=factor * arm.estimate.nominal, faults=(None,))
        found = with_scale(PANDA.chain, scaled)
        assert (found.unusable is Unusable.SCALE) == is_scale
        assert (not found.faults) == is_scale
        assert with_scale(PANDA.chain, replace(scaled, faults=())).unusable is Unusable.SCALE
    # 30 K of aluminium: 0.7 parts in a thousand, exactly.
    estimate = arm.estimate
    warm = replace(estimate, value=1.0007 * estimate.nominal)
    assert robot_scale(PANDA.chain, warm) is None


@pytest.fixture(scope="module")
def urdf_arm() -> truearm.Robot:
    """The arm of the same rows, from a URDF file: only sums of its lengths are identifiable."""
    return truearm.load_robot(str(DATA / "panda.urdf"), tip="ball_link")


@pytest.mark.parametrize("ratio", [1.1, 1.4])
def test_a_wrong_distance_is_said_where_only_sums_of_lengths_are_identifiable(urdf_arm, ratio):
    """1.4 is a distance entered as 70 mm instead of 50.

    The robot is as large as the distance that calliper and drawing agree on, each weighted by its variance: one
    measurement of 50 mm to 0.05 mm weighs seven times as much as the drawing's lengths to 1 mm.
    """
    estimate = calibrated(ratio, urdf_arm).estimate
    assert estimate.scale is not None
    index = estimate.parameter_names.index("socket_distance.0.1")
    distance, variance = estimate.value[index], estimate.covariance[index, index]
    (measured,) = truearm.read_rig(DATA / "rig.toml").socket_distances
    share = (distance / measured.distance - 1.0) / (ratio - 1.0)
    assert share == pytest.approx(variance / measured.sigma**2, abs=0.01)
    assert estimate.scale.factor == pytest.approx(distance / measured.distance, abs=0.03 * (ratio - 1.0))


def test_one_wrong_length_or_independent_tolerances_are_no_scale(urdf_arm, tmp_path):
    text = (DATA / "panda.urdf").read_text()
    assert text.count("0.384") == 1
    (tmp_path / "panda.urdf").write_text(text.replace("0.384", "0.404"))
    assert calibrated(1.0, truearm.load_robot(str(tmp_path / "panda.urdf"), tip="ball_link")).estimate.scale is None
    assert calibrated(1.0, urdf_arm).estimate.scale is None
    rng, estimate = np.random.default_rng(9), calibrated(1.0, urdf_arm).estimate
    size = np.where(np.array(estimate.units) == "m", 5e-3, 0.0)
    drawn = (replace(estimate, value=estimate.nominal + size * rng.standard_normal(size.size)) for _ in range(2000))
    assert sum(robot_scale(urdf_arm.chain, one) is not None for one in drawn) < 12
