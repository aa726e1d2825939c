"""Error curves and sag by evidence: the terms, the algebra, and arms with known laws and without any."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_joint_laws_monte_carlo import table_of
from tests.host.findings_bench import listed
from ur10_bench import RIG, ROBOT

from truearm.correct.correction import Configuration, ModelPair, correct
from truearm.errors import InputError, ProblemError
from truearm.estimate.frame_choice import mounting
from truearm.estimate.law_candidates import knots, law_priors
from truearm.estimate.law_curves import SampledCurve, law_readings, sampled_curves, sine_amplitudes, strongest_periods
from truearm.estimate.law_fit import ModePrior, learned, modes_at, nats_of, seen_by
from truearm.estimate.problem import build_problem
from truearm.estimate.result_file import parse_result
from truearm.export.writing import fit_to
from truearm.findings import Finding, findings_of
from truearm.kinds.position import nearest_rotation
from truearm.kinds.rig_file import format_rig, parse_rig
from truearm.kinds.table_file import format_table, parse_table
from truearm.model.chain import forward, joint_frames, point_forward, point_jacobians
from truearm.model.inverse import singular_value
from truearm.model.joint_terms.curve import Curve
from truearm.model.law_chain import carries, distal_frames, with_laws
from truearm.model.transforms import position_and_rotation
from truearm.plan.forecast import Knowledge, curve_forecasts
from truearm.report.figures import law_figures
from truearm.report.result_findings import law_findings
from truearm.text import strict_json
from truearm.types import CurveKnots, Payload, SagMasses
from truearm.workflows.calibration import calibration_of
from truearm.workflows.correct import correct_file
from truearm.workflows.export import curve_table, exported
from truearm.workflows.identify import IdentifyOptions, identified, write_page
from truearm.workflows.inputs import Observed
from truearm.workflows.map import Section, map_files, map_findings, mapped
from truearm.workflows.requests import CorrectFiles, CorrectOptions, MapFiles
from truearm.workflows.validate import validated

H = 1e-30  # of a complex step
NOISE = 3e-5  # m
DOWN = np.array([0.0, 0.0, -1.0])
POINT = np.array([0.0, 0.02, 0.109])  # m, on the flange: the tracked target


def arm_with_laws():
    """A UR10 chain under a payload, with a periodic and an open curve, and sag of every joint that can have it."""
    chain = carries(ROBOT.chain, Payload(2.5, (0.03, -0.02, 0.1)))
    sags = [SagMasses(j, frames, payload=True) for j in range(6) if (frames := distal_frames(chain, j))]
    curves = [CurveKnots(0, -np.pi, 2 * np.pi / 126, 126, True), CurveKnots(2, -2.0, 0.05, 80, False)]
    return with_laws(chain, [*curves, *sags])


def test_derivatives_of_curves_and_sag_are_those_of_a_complex_step():
    chain, rng = arm_with_laws(), np.random.default_rng(1)
    x = chain.params_nominal + rng.normal(0.0, 1e-2, len(chain.parameters))
    q, end = rng.uniform(-2.5, 2.5, (5, 6)), np.array([0.1, 0.2, 0.3])
    _, by_params, by_joints = point_jacobians(chain, x, q, end)
    for k in range(len(x)):
        there = x.astype(complex)
        there[k] += 1j * H
        np.testing.assert_allclose(by_params[..., k], point_forward(chain, there, q, end).imag / H, atol=1e-13)
    for k in range(6):
        there = q.astype(complex)
        there[:, k] += 1j * H
        np.testing.assert_allclose(by_joints[..., k], point_forward(chain, x, there, end).imag / H, atol=1e-13)


@pytest.fixture(scope="module")
def two_laws():
    """Rows J (n, 30), y (n,) of two laws of 10 and 20 modes, and what they say of these."""
    rng = np.random.default_rng(4)
    jac = rng.normal(size=(200, 30))
    y = rng.normal(size=200) + jac[:, :10] @ rng.normal(0.0, 0.3, 10)
    prior = ModePrior(np.repeat(np.eye(2), (10, 20), axis=1), np.full(2, 10.0))
    return jac, y, prior, seen_by(jac.T @ jac, jac.T @ y, prior)


def test_evidence_is_that_of_the_gaussian_it_stands_for(two_laws):
    """ln N(y; 0, I + J S Jᵀ) − ln N(y; 0, I), also without one law; the posterior is that of the normal equations."""
    jac, y, prior, data = two_laws
    sizes = np.array([0.05, 0.02]) @ prior.spectra

    def log_density(s):
        return stats.multivariate_normal.logpdf(y, np.zeros(len(y)), np.eye(len(y)) + (jac * s) @ jac.T)

    modes, second = modes_at(data, sizes), np.arange(30) >= 10
    assert modes.nats == pytest.approx(log_density(sizes) - log_density(0.0 * sizes), rel=1e-9)
    fewer = [log_density(sizes * second), log_density(sizes * ~second)]
    assert nats_of(data, sizes, second.astype(int)) == pytest.approx(log_density(sizes) - fewer)
    inverse = np.linalg.inv(jac.T @ jac + np.diag(1.0 / sizes))
    away = sizes[:, None] * modes.x.T
    np.testing.assert_allclose(np.diag(sizes) - away @ away.T, inverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sizes * modes.z, inverse @ jac.T @ y, rtol=1e-9, atol=1e-12)


def test_learned_variances_are_a_maximum_of_the_evidence_with_its_hyperprior(two_laws):
    *_, prior, data = two_laws
    best = np.array([1.0, 1.0])
    for _ in range(25):
        best = learned(data, prior, best)

    def cost(*factors):
        variances = best * factors
        return modes_at(data, variances @ prior.spectra).nats - float((variances / (2.0 * prior.cap**2)).sum())

    assert all(cost(*f) < cost(1.0, 1.0) for f in ((1.05, 1.0), (0.95, 1.0)))
    assert cost(1.0, 1.5) <= cost(1.0, 1.0) + 1e-9


@pytest.mark.parametrize("periodic", [False, True])
def test_modes_of_a_curve_have_the_covariance_of_its_kernels(periodic):
    """Of differences, which have no mean, and away from the ends: Matérn-5/2 at a length of 0.2 rad."""
    chain, q = ROBOT.chain, np.linspace(-2.6, 2.6, 400)[:, None] * np.ones(6)
    law = CurveKnots(2, -np.pi, 2.0 * np.pi / 126, 126, periodic)
    basis, spectra, _ = law_priors(chain, [law], q)[law]
    covariance = (basis * spectra[2]) @ basis.T
    distance = law.spacing * np.arange(30)
    scaled = np.sqrt(5.0) * distance / 0.2
    kernel = (1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled)
    variance = np.diag(covariance)[50:80]
    np.testing.assert_allclose(variance[0] + variance - 2.0 * covariance[50, 50:80], 2.0 * (1.0 - kernel), atol=0.02)
    curve = Curve.of_chain(with_laws(chain, [law]))
    np.testing.assert_allclose(curve.mean_by_parameters(q.T) @ basis, 0.0, atol=1e-12)


def world(rng, n, curves=True, masses=True, gravity=DOWN):
    """A UR10 with its design geometry moved, seen by a tracker; curves and masses are not drawn from the prior."""
    chain = ROBOT.chain
    truth = chain.params_nominal + ROBOT.free * rng.normal(
        0.0, [1e-3 if p.unit == "m" else 2e-3 for p in chain.parameters]
    )
    q = rng.uniform(-1.5, 1.5, (n, 6)) + np.array([0.0, -1.5, 1.5, 0.0, 1.5, 0.0])

    def true_points(q):
        true_q = q.copy()
        if curves:
            true_q[:, 0] += 4e-4 * np.sin(17.0 * q[:, 0] + 0.4)
            true_q[:, 2] += 3e-4 * np.sin(2.0 * q[:, 2] + 1.0)
        if masses:
            frames = joint_frames(chain, truth, q)
            wrist = frames[:, 3, :3, 3]
            for joint, compliance in ((1, 4e-5), (2, 6e-5)):
                axis = frames[:, joint, :3, 2]
                torque = 8.0 * np.cross(axis, wrist - frames[:, joint, :3, 3]) @ gravity
                true_q[:, joint] += compliance * torque
        return point_forward(chain, truth, true_q, POINT)

    points = true_points(q)
    return table_of(q, points + rng.normal(0.0, NOISE, points.shape), np.full(n, "reflector")), true_points


def identified_with(table, held, mode):
    return identified(ROBOT, Observed(RIG, table), held, IdentifyOptions(joint_laws=mode))


@pytest.fixture(scope="module")
def learned_arm():
    rng = np.random.default_rng(6)
    table, true_points = world(rng, 400)
    return identified_with(table, np.arange(400) >= 300, "auto"), true_points


def test_known_curves_and_sag_are_found(learned_arm):
    """300 poses at 0.03 mm: what is left of the held-out error is the noise and little more, where geometry leaves ten times that."""
    found, _ = learned_arm
    laws = found.estimate.joint_laws
    kept = {(law.joint, law.term) for law in laws.tried if law.kept}
    assert {("joint1", "curve"), ("joint3", "curve"), ("joint2", "sag")} <= kept
    first = next(law for law in laws.tried if (law.joint, law.term) == ("joint1", "curve"))
    assert abs(first.periods[0].cycles - 17.0) <= 1.0
    assert first.rms == pytest.approx(4e-4 / np.sqrt(2.0), rel=0.2)
    geometry, *_, whole = laws.steps
    floor = np.sqrt(8.0 / np.pi) * NOISE  # mean norm of the noise alone
    assert geometry.held_out.figures["m"].mean > 3.0 * floor
    assert whole.held_out.figures["m"].mean < 1.5 * floor


def test_the_covariance_covers_points_that_were_not_measured(learned_arm):
    """k = 2 of a predicted coordinate: 0.95 is due; 100 poses share their parameters, so that 0.85 is not a surprise.

    The once-a-turn error of a joint that has a curve is in the curve's covariance, and not once more a fault's.
    """
    found, true_points = learned_arm
    estimate, table = found.estimate, found.table
    held = np.flatnonzero(~estimate.fitted)
    problem = build_problem(found.chain, RIG, replace(table.select(~estimate.fitted), xyz=true_points(table.q[held])))
    lin = problem.groups[0].evaluate(found.chain, estimate.value)
    jac = lin.jac_params
    sigma = np.sqrt(np.einsum("ij,jk,ik->i", jac, estimate.covariance, jac))
    assert np.mean(np.abs(lin.residual) < 2.0 * sigma) > 0.85
    assert np.mean((lin.residual / sigma) ** 2) > 0.6


def test_a_few_poses_that_come_twice_say_nothing_of_what_rows_of_a_pose_share(learned_arm):
    found, _ = learned_arm
    rng, table = np.random.default_rng(11), found.table.select(found.estimate.fitted)
    rows = np.concatenate([np.arange(120), rng.integers(120, size=4)])
    twice = identified_with(table.select(rows), np.zeros(rows.size, dtype=bool), "sag")
    assert twice.estimate.joint_laws.kept
    assert twice.estimate.scatter.n == 0


def test_curves_are_centred_over_the_poses(learned_arm):
    """Joint 1 too, whose offset is held because the tracker can turn about the same axis: it takes the mean."""
    found, _ = learned_arm
    q = found.table.q[found.estimate.fitted]
    assert np.abs(Curve.of_chain(found.chain).value(found.identified, q.T).mean(axis=1)).max() < 1e-12
    assert not found.parameters["joint1.offset"].free


def test_the_result_file_brings_the_laws_back(learned_arm):
    found, _ = learned_arm
    text = strict_json(found.document)
    again = calibration_of(parse_result(text, "r.json"), ROBOT, "ur10", "r.json")
    assert again.chain.parameter_names == found.chain.parameter_names
    np.testing.assert_allclose(again.identified, found.identified, rtol=0.0, atol=0.0)
    np.testing.assert_allclose(again.covariance, found.covariance, rtol=1e-12)
    laws = json.loads(text)["joint_laws"]
    assert [law["term"] for law in laws["laws"]] == [
        "sag" if isinstance(law, SagMasses) else "curve" for law in found.estimate.joint_laws.kept
    ]


@pytest.mark.parametrize("mode", ["auto", "curve"])
def test_an_arm_without_laws_keeps_its_least_squares_geometry(mode):
    """``auto`` does not even try where the declared noise explains the residuals; asked for, curves are tried and dropped."""
    rng = np.random.default_rng(7)
    table, _ = world(rng, 120, curves=False, masses=False)
    held = np.zeros(120, dtype=bool)
    plain, found = (identified_with(table, held, one) for one in ("none", mode))
    tried = found.estimate.joint_laws
    assert tried is None if mode == "auto" else tried.kept == () and len(tried.tried) == 6
    np.testing.assert_array_equal(found.estimate.value, plain.estimate.value)
    np.testing.assert_array_equal(found.estimate.covariance, plain.estimate.covariance)
    assert plain.document["joint_laws"] is None


def test_too_few_rows_and_still_joints_are_said():
    rng = np.random.default_rng(8)
    table, _ = world(rng, 12)
    found = identified_with(table, np.zeros(12, dtype=bool), "curve")
    assert found.estimate.joint_laws.kept == ()
    few = identified_with(table.select(np.arange(12) < 9), np.zeros(9, dtype=bool), "auto")
    for one in (found, few):
        assert one.estimate.joint_laws.reasons[0].values.keys() == {"rows", "freedom"}
        assert [of.code for of in law_findings(one.document)][1] == "no-law"


def test_gravity_in_the_table_is_that_of_an_arm_that_stands_askew():
    """On a base that leans by 40°: with gravity along -z the torques are others. Rows of two mountings have no one direction."""
    leaning = np.array([np.sin(0.7), 0.0, -np.cos(0.7)])
    table, _ = world(np.random.default_rng(12), 160, curves=False, gravity=leaning)
    told = table.replace(gravity=np.tile(9.81 * leaning, (160, 1)))
    read = parse_table(format_table(told, ("rad",) * 6), "rows.csv", ("rad",) * 6)
    without, found = (identified_with(rows, np.arange(160) >= 110, "sag").estimate for rows in (table, read))
    assert found.joint_laws.gravity == pytest.approx(tuple(leaning))
    assert (without.joint_laws.gravity_known, found.joint_laws.gravity_known) == (False, True)
    floor = np.sqrt(8.0 / np.pi) * NOISE  # mean norm of the noise alone
    assert found.held_out.figures["m"].mean < 1.5 * floor
    assert without.held_out.figures["m"].mean > 1.5 * found.held_out.figures["m"].mean
    turned = np.where(np.arange(160)[:, None] % 2, 9.81 * leaning, (0.0, 0.0, -9.81))
    both = identified_with(table.replace(gravity=turned), np.zeros(160, dtype=bool), "sag").estimate
    assert both.joint_laws.kept == ()
    assert both.joint_laws.reasons[0].values["apart"]["deg"] == pytest.approx(20.1, abs=0.05)


HELD = np.array([0.0, 0.06, 0.12])  # m, centre of the payloads in the end frame


def loaded_world(rng, masses):
    """Rows of an arm that yields at two joints under its own links and under ``masses`` [kg] at HELD; ``true_points`` of any."""
    chain, compliance = ROBOT.chain, {1: 4e-5, 2: 6e-5}
    truth = chain.params_nominal + ROBOT.free * rng.normal(
        0.0, [1e-3 if p.unit == "m" else 2e-3 for p in chain.parameters]
    )
    q = rng.uniform(-1.5, 1.5, (len(masses), 6)) + np.array([0.0, -1.5, 1.5, 0.0, 1.5, 0.0])

    def true_points(q, masses):
        frames, out = joint_frames(chain, truth, q), q.copy()
        payload = point_forward(chain, truth, q, HELD)
        for joint, give in compliance.items():
            axis, origin = frames[:, joint, :3, 2], frames[:, joint, :3, 3]
            for at, mass in ((frames[:, 3, :3, 3], 8.0), (payload, masses)):
                out[:, joint] += give * mass * (np.cross(axis, at - origin) @ DOWN)
        return point_forward(chain, truth, out, POINT)

    points = true_points(q, masses)
    table = table_of(q, points + rng.normal(0.0, NOISE, points.shape), np.full(len(masses), "reflector"))
    return table.replace(payload=masses, payload_centre=np.tile(HELD, (len(masses), 1))), true_points


def without_payload(table):
    return table.replace(payload=None, payload_centre=None)


@pytest.fixture(scope="module")
def loaded_arm():
    """Fitted under 0 and 4 kg; the last 60 rows are held out, under 8 kg."""
    masses = np.where(np.arange(260) >= 200, 8.0, 4.0 * (np.arange(260) % 2))
    table, true_points = loaded_world(np.random.default_rng(21), masses)
    read = parse_table(format_table(table, ("rad",) * 6), "rows.csv", ("rad",) * 6)
    return identified_with(read, np.arange(260) >= 200, "auto"), table, true_points


def test_a_payload_that_was_not_measured_is_predicted(loaded_arm):
    """Twice the heaviest payload that was fitted; without the column its sag has no name, and curves cannot make up for it."""
    found, table, _ = loaded_arm
    mean = found.estimate.held_out.figures["m"].mean
    assert mean < 1.5 * np.sqrt(8.0 / np.pi) * NOISE  # the factor is the mean norm of the noise alone
    blind = identified_with(without_payload(table), ~found.estimate.fitted, "sag").estimate
    assert blind.held_out.figures["m"].mean > 3.0 * mean
    laws = found.document["joint_laws"]
    assert [one["mass_kg"] for one in laws["payloads"]] == [0.0, 4.0]
    (masses,) = [of.values["masses"] for of in law_findings(found.document) if of.code == "sag-payload"]
    assert masses == ["0", "4"]
    at = {name: i for i, name in enumerate(found.chain.parameter_names)}
    for joint, give in (("joint2", 4e-5), ("joint3", 6e-5)):
        which = at[f"{joint}.sag.payload"]
        sigma = found.estimate.sigma[which]
        assert found.estimate.value[which] == pytest.approx(give, abs=4.0 * sigma)
        assert sigma < 0.1 * give


def test_a_result_carries_the_payload_of_a_program(loaded_arm):
    found, table, true_points = loaded_arm
    again = calibration_of(parse_result(strict_json(found.document), "r.json"), ROBOT, "ur10", "r.json")
    q = table.q[:50]
    empty, full = (
        point_forward(one.chain, again.identified, q, np.array(POINT))
        for one in (again, again.carrying(6.0, tuple(HELD)))
    )
    due = true_points(q, np.full(50, 6.0)) - true_points(q, np.zeros(50))
    assert np.linalg.norm(due, axis=1).max() > 1e-4
    np.testing.assert_allclose(full - empty, due, rtol=0.0, atol=0.1 * np.abs(due).max())
    assert [finding.code for finding in again.carrying(4.0).payload_findings()] == ["sag-payload"]
    sag, beyond = again.carrying(6.0).payload_findings()
    assert beyond == Finding("payload-beyond", {"mass": "6", "masses": ["0", "4"]})
    assert beyond in exported(again.carrying(6.0), "evaluator-c").findings
    assert (sag.code, sag.values) == (
        "sag-payload",
        {"holder": "the robot", "mass": "6", "masses": ["0", "4"]},
    )
    judged = validated(again, Observed(RIG, table.select(np.arange(260) >= 200)))
    assert listed(judged.document)["sag-payload"]["holder"] == "each row"
    with pytest.raises(InputError, match="mass: -1 kg"):
        again.carrying(-1.0)


def test_sag_of_poses_with_alike_torques_is_said_to_be_extrapolated():
    law = {"joint": "joint2", "term": "sag", "nats": 60.0, "kept": True, "rms_mrad": 0.2, "range_share": 0.18}
    found = {
        "reasons": [],
        "gravity_known": True,
        "tried": [law, {**law, "joint": "joint3", "range_share": 0.9}],
        "noise": {"factor": 1.0, "shared_mm": 0.0, "turned_mrad": 0.0},
    }
    (shown,) = [of for of in law_findings({"joint_laws": found}) if of.code == "sag-extrapolated"]
    assert shown.values == {"joints": ["joint2 18%"]}


HELD_SAG = {"holder": "the calibration", "masses": ["4"], "several": False}


def test_one_payload_in_all_rows_says_nothing_of_another():
    """It passes for mass of the tool: the sag holds for it, which is said; the rig may name it as well as the table."""
    table, _ = loaded_world(np.random.default_rng(22), np.full(160, 4.0))
    none = np.zeros(160, dtype=bool)
    read = parse_rig("payload_kg = 4.0\npayload_centre_mm = [0, 60, 120]\n", "rig.toml")
    assert parse_rig(format_rig(read), "again.toml") == read
    rig = replace(RIG, payload=read.payload, payload_centre=read.payload_centre)
    by_table = identified_with(table, none, "sag")
    by_rig = identified(ROBOT, Observed(rig, without_payload(table)), none, IdentifyOptions(joint_laws="sag"))
    for found in (by_table, by_rig):
        assert found.estimate.joint_laws.payloads == (Payload(4.0, tuple(HELD)),)
        assert all(0.3 < law["range_share"] <= 1.0 for law in found.document["joint_laws"]["tried"] if law["kept"])
        assert [of.values for of in law_findings(found.document) if of.code == "sag-payload"] == [HELD_SAG]
    again = calibration_of(parse_result(strict_json(by_rig.document), "r.json"), ROBOT, "ur10", "r.json")
    assert again.payload_findings() == [Finding("sag-payload", HELD_SAG)]
    assert "other-payload" not in listed(validated(again, Observed(rig, without_payload(table))).document)
    masses = np.where(np.arange(160) < 30, 4.0, 0.0)
    light = validated(again, Observed(rig, table.replace(payload=masses)))
    assert listed(light.document)["sag-payload"] == HELD_SAG
    assert listed(light.document)["other-payload"] == {"n": 130, "rows": 160, "payload": ["0"], "masses": ["4"]}
    with pytest.raises(InputError, match="payload acts"):
        again.carrying(2.0)
    bad = table.replace(payload=-1.0)
    with pytest.raises(ProblemError, match=r"world row 1: .*-1 kg"):
        identified_with(bad, none, "sag")


def test_a_curve_is_stored_as_it_is_with_a_band_that_opens_outside(learned_arm):
    """The curve of joint 1 is 0.4 mrad·sin(17 q + 0.4), about its mean over the poses; 0.05 mrad is a sixth of it."""
    found, _ = learned_arm
    laws = found.estimate.joint_laws.kept
    curves = sampled_curves(found.chain, laws, found.identified, found.covariance)
    first = next(curve for curve in curves if curve.joint == "joint1")
    truth = 4e-4 * np.sin(17.0 * first.readings + 0.4)
    inside = first.covered
    off = first.error[inside] - truth[inside]
    assert np.sqrt(np.mean((off - off.mean()) ** 2)) < 5e-5
    assert first.sigma[~inside].max() > 3.0 * np.median(first.sigma[inside])
    rows = curve_table(curves).splitlines()
    assert rows[0] == "joint,reading_deg,error_mrad,sigma_mrad,covered"
    assert len(rows) == 1 + sum(curve.readings.size for curve in curves)
    name, reading, error, _, covered = rows[1 + int(np.argmax(inside))].split(",")
    assert (name, covered) == ("joint1", "1")
    assert float(error) == pytest.approx(1e3 * first.error[np.argmax(inside)], abs=1e-6)
    assert float(reading) == pytest.approx(np.degrees(first.readings[np.argmax(inside)]), abs=1e-4)


@pytest.fixture(scope="module")
def gap_arm():
    """Joint 1 was never measured between -0.4 and 0.4 rad."""
    table, _ = world(np.random.default_rng(13), 260)
    table = table.select(np.abs(table.q[:, 0]) > 0.4)
    return identified_with(table, np.zeros(len(table), dtype=bool), "curve")


def test_a_gap_in_the_readings_is_not_covered(gap_arm, tmp_path):
    """In the result, the table of curves, the words, the report, a correction and a map."""
    found = gap_arm
    text = strict_json(found.document)
    again = calibration_of(parse_result(text, "r.json"), ROBOT, "ur10", "r.json")
    law = next(law for law in again.stored.laws if isinstance(law, CurveKnots) and law.joint == 0)
    (_, left), (right, _) = law.covered
    near = np.abs(found.table.q[:, 0]).min()
    assert -0.4 < left < -0.3 < 0.3 < right < 0.4
    assert min(-left, right) == pytest.approx(near - 0.05, abs=1e-12)
    curve = next(
        one
        for one in sampled_curves(again.chain, again.stored.laws, again.identified, again.covariance)
        if one.joint == "joint1"
    )
    inside = np.abs(curve.readings) < 0.3
    assert inside.sum() > 60
    assert not curve.covered[inside].any()
    assert {line.rpartition(",")[2] for line in np.array(curve_table([curve]).splitlines()[1:])[inside]} == {"0"}
    gap = f"except {np.degrees(left):.0f} to {np.degrees(right):.0f} deg"
    (curve,) = [of for of in law_findings(found.document) if of.code == "law-kept" and of.values["joint"] == "joint1"]
    assert gap in curve.values["covered"]
    write_page(tmp_path / "page.html", found)
    assert gap in (tmp_path / "page.html").read_text()
    q = np.tile(found.table.q.mean(axis=0), (3, 1))
    q[:, 0] = 0.0, 0.8, 0.8 + 2.0 * np.pi
    np.testing.assert_array_equal(again.outside(q)[:, 0], [True, False, False])


def test_a_map_marks_the_cells_that_are_not_covered(gap_arm, tmp_path):
    found = gap_arm
    section = Section(at=tuple(found.table.q.mean(axis=0) * [0, 1, 1, 1, 1, 1]), cell=0.1)
    everywhere = mapped(found, section)
    reached = ~np.isnan(everywhere.error)
    assert everywhere.outside[reached].all()  # joint 1 stands in the gap
    files = MapFiles(tmp_path / "result.json", tmp_path / "map.csv", tmp_path / "map.svg")
    outside = Finding("joints-outside", {"joints": ["joint1"], "given": True})
    (said,) = (one for one in findings_of(map_files(found, files, section)) if one == outside)
    assert said.text().endswith("with at, or leave it out.")
    by_default = mapped(found, Section(cell=0.1))  # at readings next to the gap
    assert not by_default.outside[~np.isnan(by_default.error)].any()
    (said,) = (one for one in map_findings(found, Section(), everywhere) if "joints" in one.values)
    assert said.text().endswith("with at.")
    section = replace(section, at=(0.8, *section.at[1:]))
    some = mapped(found, section)
    q = (some.q[reached] + np.pi) % (2.0 * np.pi) - np.pi  # a curve repeats after a turn
    limits = np.array([found.table.q.min(axis=0), found.table.q.max(axis=0)])
    beyond = ((q < limits[0] - 0.051) | (q > limits[1] + 0.051)).any(axis=1)
    assert 0 < some.outside[reached].sum() < reached.sum()
    assert some.outside[reached][beyond].all()
    findings = findings_of(map_files(found, replace(files, force=True), section))
    assert Finding("joints-outside", {"n": some.outside[reached].sum()}) in findings
    rows = [line.rpartition(",")[2] for line in (tmp_path / "map.csv").read_text().splitlines()]
    assert rows[0] == "covered"
    assert rows[1:] == [str(int(not one)) for one in some.outside[reached]]
    assert (tmp_path / "map.svg").read_text().count('class="pale"') == some.outside[reached].sum()


def sampled(error, intervals):
    """A curve at half a degree over a turn, known in some intervals [rad]."""
    law = CurveKnots(0, -np.pi, 2.0 * np.pi / 126, 126, True, intervals)
    readings = law_readings(law)
    return SampledCurve("joint1", readings, error(readings), 0.0 * readings, law.covers(readings), intervals)


@pytest.mark.parametrize("intervals", [((-1.2, 1.2),), ((-2.0, -0.8), (-0.2, 1.2))])
def test_periods_need_two_of_them_in_the_covered_range(intervals):
    """One and two cycles a turn are slow drifts there, and a line has no period at all."""
    lowest = 2.0 * 2.0 * np.pi / max(high - low for low, high in intervals)
    slow = sampled(lambda q: 4e-4 * np.sin(q) + 1e-4 * np.sin(2.0 * q + 1.0) + 1e-3 * q, intervals)
    both = sampled(lambda q: slow.error + 2e-4 * np.sin(17.0 * q + 0.3), intervals)
    assert sine_amplitudes(slow).resolution == pytest.approx(0.5 * lowest)
    assert sine_amplitudes(slow).cycles[0] >= lowest
    assert sine_amplitudes(slow).amplitude.max() < 2e-5
    first, *others = strongest_periods(both)
    assert first.cycles == 17.0
    assert first.amplitude == pytest.approx(2e-4, rel=0.02)
    assert all(one.amplitude < 2e-5 for one in others)


def test_a_complete_turn_has_every_period_and_a_short_range_none():
    turn = sampled(lambda q: 4e-4 * np.sin(q) + 2e-4 * np.sin(2.0 * q), ((-np.pi, np.pi),))
    assert [one.cycles for one in strongest_periods(turn)[:2]] == [1.0, 2.0]
    assert sine_amplitudes(turn).resolution == pytest.approx(1.0)
    short = sampled(np.sin, ((0.0, 0.15),))
    assert strongest_periods(short) == ()
    assert np.isnan(sine_amplitudes(short).resolution)
    assert len(law_figures((short,))) == 1


@pytest.mark.parametrize("shift", [0.0, 2.0, 5.5])
def test_readings_of_a_joint_that_turns_completely_have_gaps_on_the_circle(shift):
    """Wherever the gap of 0.2 rad lies, also over several turns; without it everything is covered."""
    turn = np.arange(0.0, 2.0 * np.pi - 0.2, 0.02)
    (interval,) = knots(0, turn + shift).covered
    assert interval[1] - interval[0] == pytest.approx(turn[-1] + 0.1, abs=1e-9)
    law = knots(0, np.concatenate([turn[:100] + 2.0 * np.pi, turn[100:]]) + shift)
    at = shift + np.array([-0.1, -0.04, 0.5, 0.5 - 4.0 * np.pi, turn[-1] + 0.04, turn[-1] + 0.1])
    np.testing.assert_array_equal(law.covers(at), [False, True, True, True, True, False])
    ((low, high),) = knots(0, np.linspace(0.0, 7.0, 500) + shift).covered
    assert high - low == pytest.approx(2.0 * np.pi)


def test_a_plan_says_how_well_curves_will_be_known_and_where_they_are_not_seen():
    """Twice the poses tell more; where joint 1 never goes, within its covered range, nothing will be known."""
    table, _ = world(np.random.default_rng(9), 500)
    known = Knowledge(ROBOT.chain, RIG, ROBOT.chain.params_nominal, ROBOT.free)
    away = table.select(np.abs(table.q[:, 0]) > 0.3)
    few, many = (curve_forecasts(known, rows) for rows in (away.select(np.arange(len(away)) < 100), away))
    by_joint = [{curve["joint"]: curve for curve in curves} for curves in (few, many)]
    assert all(by_joint[1][f"joint{k}"]["sigma_mrad"] < by_joint[0][f"joint{k}"]["sigma_mrad"] for k in (1, 2, 3))
    assert any(low < -8.6 and high > 8.6 for low, high in by_joint[1]["joint1"]["unseen_deg"])
    assert not by_joint[1]["joint2"]["unseen_deg"]
    for curve in by_joint[1].values():
        sigmas = [part["sigma_mrad"] for part in curve["ranges"]]
        assert all(0.0 < part["upper_deg"] - part["lower_deg"] < 30.5 for part in curve["ranges"])
        assert min(sigmas) <= curve["sigma_mrad"] <= max(sigmas)
    unseen = by_joint[1]["joint6"]  # the point lies on its axis
    law = knots(5, away.q[:, 5])
    basis, spectra, _ = law_priors(ROBOT.chain, [law], away.q)[law]
    inside = law.covers(law.first + law.spacing * np.arange(law.count))
    prior = basis[inside] ** 2 @ spectra[1:3].sum(axis=0)
    assert unseen["sigma_mrad"] == pytest.approx(0.2 * np.sqrt(prior.mean()), rel=0.05)
    assert np.ptp(unseen["unseen_deg"]) > 167.0
    parts = by_joint[1]["joint1"]["ranges"]
    assert not any(part["lower_deg"] < 11.4 and part["upper_deg"] > -11.4 for part in parts)


@pytest.mark.parametrize("method", ["newton", "false-target", "joints"])
def test_a_correction_brings_the_true_target_to_its_place(learned_arm, method):
    """The true arm at the corrected joints, known by 300 poses of 0.03 mm alone.

    Where the base stands is the tracker's choice of frame: errors are those left by the best motion of all places as one body.
    """
    found, true_points = learned_arm
    q = found.table.q[singular_value(found.chain, found.nominal, found.table.q) > 0.2][:40]
    targets = forward(found.chain, found.nominal, q)
    pair = ModelPair(found.chain, found.nominal, found.identified)
    done = correct(pair, targets, method, 8, configuration=Configuration(q_start=q))
    assert not any(done.problem)
    place = [found.parameters[f"target.reflector.{k}"].value for k in "xyz"]
    goal = (targets @ [*place, 1.0])[:, :3]

    def error(readings):
        there = true_points(readings)
        rotation = nearest_rotation((goal - goal.mean(axis=0)).T @ (there - there.mean(axis=0)), np.eye(3))
        return np.linalg.norm((there - there.mean(axis=0)) @ rotation.T - (goal - goal.mean(axis=0)), axis=1)

    assert error(q).mean() > 1e-3
    assert error(done.q).mean() < 6e-5


def test_beyond_the_covered_range_curves_fade_to_the_geometry_and_correct_says_so(learned_arm, tmp_path):
    """Knots end 0.8 rad beyond the covered range."""
    found, _ = learned_arm
    curve, covered = Curve.of_chain(found.chain), found.table.q[found.estimate.fitted]
    far = (covered.max(axis=0) + 1.0)[:, None]
    np.testing.assert_array_equal(curve.value(found.identified, far), 0.0)
    q = np.tile(covered.mean(axis=0), (4, 1))
    q[:, 0] = covered[:, 0].mean(), *(covered[:, 0].max() + np.array([0.2, 0.4, 0.6]))
    six = position_and_rotation(forward(found.chain, found.nominal, q))
    six[:, :3], six[:, 3:] = 1e3 * six[:, :3], np.degrees(six[:, 3:])
    names = ["x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg", *(f"q{k}_deg" for k in range(1, 7))]
    rows = np.concatenate([six, np.degrees(q)], axis=1).tolist()
    lines = [",".join(names), *(",".join(map(repr, row)) for row in rows)]
    (tmp_path / "targets.csv").write_text("\n".join(lines) + "\n")
    files = CorrectFiles(tmp_path / "result.json", tmp_path / "targets.csv", tmp_path / "corrected.csv")
    done = correct_file(found, files, CorrectOptions())
    (outside,) = [entry["values"] for entry in done["findings"] if entry["code"] == "targets-outside"]
    assert (outside["curves"], outside["places"]) == (True, "rows 3, 4, 5")


def test_a_second_day_is_validated_with_the_laws(learned_arm):
    """The same truth, other poses and noise: consistent with laws, not without; "without" is the same robot for both."""
    found, true_points = learned_arm
    rng = np.random.default_rng(10)
    q = found.table.q[:60] + rng.uniform(-0.1, 0.1, (60, 6))
    xyz = true_points(q) + rng.normal(0.0, NOISE, (60, 3))
    second = replace(found.table.select(np.arange(400) < 60), q=q, xyz=xyz)
    plain = identified_with(found.table, ~found.estimate.fitted, "none")
    with_laws_, without = (validated(one, Observed(RIG, second)) for one in (found, plain))
    assert with_laws_.document["consistent"]
    assert not without.document["consistent"]
    assert with_laws_.document["placed"] == without.document["placed"]
    assert with_laws_.before["m"].rms == pytest.approx(without.before["m"].rms, rel=1e-6)
    assert with_laws_.after["m"].mean < 0.5 * without.after["m"].mean


def test_no_coefficient_of_a_law_passes_for_how_base_or_tool_are_mounted():
    """Of an open curve some coefficients act in none of the poses by which mountings are told."""
    plain, whole = (mounting(chain, chain.params_nominal).either for chain in (ROBOT.chain, arm_with_laws()))
    np.testing.assert_array_equal(whole[: plain.size], plain)
    assert not whole[plain.size :].any()


@pytest.mark.parametrize("form", ["urdf", "sheth-uicker"])
def test_exporters_say_which_laws_a_format_lacks_and_what_that_costs(learned_arm, form):
    found, _ = learned_arm
    over = found.table.q[found.estimate.fitted]
    told = exported(found, form, over)
    kept = {f"{law.joint}.{law.term}" for law in found.estimate.joint_laws.tried if law.kept}
    assert kept <= set(told.missing)
    assert told.fitted.dropped.mean() > told.fitted.left.mean() > 1e-4  # curves of 0.4 mrad at a metre, and sag
    assert "joint1.curve" in str(told)
    assert "curve.3" not in str(told)


def test_a_file_is_refitted_where_the_curves_are_known(gap_arm, monkeypatch):
    """By default, over poses within the fitted readings and outside their gaps."""
    seen = []
    monkeypatch.setattr("truearm.workflows.export.fit_to", lambda *args: seen.append(args[-1]) or fit_to(*args))
    exported(gap_arm, "urdf")
    assert not gap_arm.outside(seen[0]).any()
    assert np.ptp(seen[0], axis=0).min() > 2.5
