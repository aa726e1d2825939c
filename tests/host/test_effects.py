"""Faults as parameters of a fit: derivatives, profiles over the rows, and what they leave to other parameters."""

from dataclasses import replace

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, CHUCKS, DESIGN, FREE, PAIRS, RIG, SIGMA, random_poses, random_table, table
from tests.host.findings_bench import stated
from tests.refusals import refused

from truearm.errors import InputError
from truearm.estimate.circumstances import last_motions, sessions
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.joint_laws import gravity_of, payloads_of
from truearm.estimate.law_candidates import LawMode, candidates
from truearm.estimate.prediction import predicted_point_error
from truearm.estimate.problem import build_problem
from truearm.estimate.systematic_effects import error_columns
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.model.law_chain import with_laws
from truearm.model.robot_file import builtin_robot
from truearm.model.transforms import rotation
from truearm.results import DriftWith, Effect
from truearm.types import Point
from truearm.workflows.identify import IdentifyOptions, identified, rejudged, split_causes
from truearm.workflows.inputs import Observed
from truearm.workflows.selection import parse_effect

UNMOVED = np.eye(4)
DWELL_S = 12.0


def test_derivatives_of_all_that_can_be_off_are_those_of_the_world():
    rng = np.random.default_rng(2)
    rows = table(random_poses(5, rng), np.full(5, 0.5), [PAIRS[0]] * 5)
    problem = build_problem(CHAIN, RIG, rows)
    lin = problem.groups[0].opened(CHAIN, problem.start)
    columns = dict(zip(problem.errors.names, error_columns(lin, problem.errors.bodies)[0].T, strict=True))
    h = 1e-6

    def change(chucks=CHUCKS, q_off=0.0, moved=UNMOVED):
        def of(sign):
            c = {k: np.add(CHUCKS[k].xyz, sign * np.subtract(chucks[k].xyz, CHUCKS[k].xyz)) for k in CHUCKS}
            ball = point_forward(CHAIN, DESIGN, rows.q + sign * q_off, np.array(RIG.spheres["s0"].xyz))
            move = moved if sign > 0 else np.linalg.inv(moved)
            return np.linalg.norm(ball @ move[:3, :3].T + move[:3, 3] - c["c0"], axis=1)

        return (of(1.0) - of(-1.0)) / (2.0 * h)

    shifted = {**CHUCKS, "c0": Point("c0", tuple(np.add(CHUCKS["c0"].xyz, [0.0, h, 0.0])))}
    by_joint = change(q_off=h * np.eye(6)[2])
    lifted, turned = UNMOVED.copy(), UNMOVED.copy()
    lifted[2, 3] = h
    turned[:3, :3] = rotation(np.array([h, 0.0, 0.0]))
    # Central differences of step 1e-6 m or rad: rounding 1e-16 m over it, and the third derivative times 1e-12.
    assert columns["chuck.c0.y"] == pytest.approx(change(chucks=shifted), abs=1e-8)
    assert columns[CHAIN.joints[2].name] == pytest.approx(by_joint, abs=1e-8)
    assert columns["base.z"] == pytest.approx(change(moved=lifted), abs=1e-8)
    assert columns["base.rx"] == pytest.approx(change(moved=turned), abs=1e-8)
    assert columns["bar.short.zero"] == pytest.approx(np.full(5, -1.0), abs=1e-12)


@pytest.mark.parametrize("what", ["base", "chuck.c2"])
def test_effects_of_rows_with_different_payloads_are_differentiated(what):
    rng = np.random.default_rng(3)
    rows = table(random_poses(20, rng), np.full(20, 0.5), [PAIRS[0], PAIRS[-1]] * 10)
    rows = replace(rows, payload=np.where(np.arange(20) % 2, 2.0, 0.0))
    laws, _ = candidates(
        CHAIN, rows.q, LawMode.SAG, gravity_of(rows, None), tuple(dict.fromkeys(payloads_of(RIG, rows)))
    )
    chain = with_laws(CHAIN, laws)
    problem = build_problem(chain, RIG, rows, None, (Effect(what, 10, 20),))
    effects = range(len(problem.start) - (6 if what == "base" else 3), len(problem.start))
    steps = 1e-5 * np.eye(len(problem.start))[effects]
    groups = [group for group in problem.groups if group.row is not None]
    assert len(groups) > 2  # payloads and halves
    for group in groups:
        numeric = [
            group.evaluate(chain, problem.start - h).residual - group.evaluate(chain, problem.start + h).residual
            for h in steps
        ]
        by_x = group.evaluate(chain, problem.start).jac_params[:, effects]
        # Central differences of step 1e-5: rounding 1e-16 over it, and the third derivative times 1e-10.
        np.testing.assert_allclose(by_x, np.transpose(numeric) / 2e-5, atol=1e-8)


def test_rows_are_judged_with_the_effects_of_the_fit():
    rows = random_table(120, np.random.default_rng(11), SIGMA)
    options = SolverOptions(effects=(Effect("chuck.c0", 60),))
    estimate = identify(CHAIN, RIG, rows, free=FREE, hold_out=rows.chuck == "c2", options=options)
    assert estimate.held_out.n == (rows.chuck == "c2").sum()
    # Rows 61 to 120 of a chuck that moved, some of them held out: without the effect they would err by its motion.
    rows = random_table(120, np.random.default_rng(12), SIGMA)
    rows.value[60:] += 2e-3 * (rows.chuck[60:] == "c0")
    effects = (Effect("chuck.c0", 60),)
    estimate = identify(
        CHAIN, RIG, rows, free=FREE, hold_out=np.arange(120) % 4 == 0, options=SolverOptions(effects=effects)
    )
    again = rejudged(CHAIN, RIG, rows, estimate, effects)
    assert again.held_out.figures["m"].rms == pytest.approx(estimate.held_out.figures["m"].rms, rel=1e-6)
    assert rejudged(CHAIN, RIG, rows, estimate, ()).held_out.figures["m"].rms > 2.0 * again.held_out.figures["m"].rms


def test_a_move_of_20_mm_that_is_applied_leaves_nothing():
    """The base jumps by 20 mm and 20 mrad, or a chuck slips by 20 mm (seeds 31 to 34)."""
    plan = worlds.plan()
    for seed in (31, 32):
        rng, off = np.random.default_rng(seed), np.zeros((360, 3))
        off[:60] = 20e-3 * worlds.direction(rng)
        rows = worlds.table(plan, worlds.lengths(plan, off) + SIGMA * rng.normal(size=360))
        after = worlds.identified(rows, [Effect("base", 0, 60)])
        assert after.chi2_reduced < after.chi2_band[1]
    for seed in (33, 34):
        rows, (chuck, at) = worlds.slipped(plan, np.random.default_rng(seed), 20e-3)
        after = worlds.identified(rows, [Effect(f"chuck.{chuck}", at)])
        assert after.chi2_reduced < after.chi2_band[1]


def test_a_drift_needs_what_it_is_linear_in():
    rows = worlds.clean(worlds.plan(), np.random.default_rng(0))
    with pytest.raises(InputError, match="thermal_drift: rows 1 to 360 have no temperature, or it does"):
        worlds.identified(rows, [parse_effect("bar.bar46.zero.thermal_drift")])
    still = replace(rows, temperature=np.full(len(rows), 24.5))
    with pytest.raises(InputError, match="have no temperature, or it does"):
        worlds.identified(still, [parse_effect("bar.bar46.zero.thermal_drift")])
    by_order = worlds.identified(rows, [parse_effect("bar.bar46.zero.drift")])
    timed = replace(rows, time=1e9 + DWELL_S * np.arange(len(rows)))
    np.testing.assert_allclose(
        worlds.identified(timed, [parse_effect("bar.bar46.zero.drift")]).value, by_order.value, rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("what", ["base", "joint2"])
def test_a_drift_of_base_or_joint_leaves_the_constant_to_the_robot(what):
    """A second constant, degenerate with the robot's, would add 10 mm and 3° to the uncertainty of every position."""
    plan, rng = worlds.plan(), np.random.default_rng(3)
    drift = 0.2e-3 * np.linspace(-0.5, 0.5, len(plan))
    off = {"base": {"chuck_off": np.outer(-drift, [1.0, 0.0, 0.0])}, "joint2": {"q_off": np.outer(drift, np.eye(6)[1])}}
    length = worlds.lengths(plan, **off[what])
    rows = worlds.table(plan, length + worlds.SIGMA * rng.normal(size=len(plan)))
    e = worlds.identified(rows, [parse_effect(f"{what}.drift")])
    first = e.n_robot_parameters
    assert all(name.endswith(".drift") for name in e.parameter_names[first:])
    assert abs(e.value[first] - 0.2e-3) < 3.0 * e.sigma[first] < 0.3e-3
    assert predicted_point_error(worlds.CHAIN, worlds.RIG, rows, e).rms < 0.12e-3


def test_a_sphere_that_may_be_off_is_near_its_place_for_the_predicted_error():
    """With its displacement taken for its place, the predicted error was 9 mm."""
    rows = random_table(120, np.random.default_rng(3), SIGMA)
    effects = (parse_effect("sphere.s1"),)
    e = identify(CHAIN, RIG, rows, free=FREE, options=SolverOptions(effects=effects))
    assert predicted_point_error(CHAIN, RIG, rows, e).rms < 1e-3


def test_base_and_chuck_that_only_turn_together_are_a_null_direction():
    """About the line through the other two chucks: the prior of the chuck is no measurement of it."""
    rows = random_table(120, np.random.default_rng(3), SIGMA)
    e = identify(CHAIN, RIG, rows, free=FREE, options=SolverOptions(effects=(parse_effect("chuck.c2"),)))
    predicted = predicted_point_error(CHAIN, RIG, rows, e)
    assert predicted.relative
    assert predicted.rms < 1e-3
    assert not e.identifiable[e.parameter_names.index("chuck.c2.z")]


@pytest.mark.parametrize(
    ("mode", "decimals"), [pytest.param("auto", 9, marks=pytest.mark.soak), ("auto", None), ("curve", None)]
)
def test_laws_are_not_fitted_to_rounding(mode, decimals):
    """Computed lengths, or lengths to the nanometre, with a tiny declared noise: the information was not definite."""
    plan = worlds.plan()
    bars = {name: replace(bar, sigma=1e-7) for name, bar in worlds.RIG.bars.items()}
    length = worlds.lengths(plan)
    rows = worlds.table(plan, length if decimals is None else np.round(length, decimals))
    rig = replace(worlds.RIG, bars=bars)
    robot = builtin_robot("puma560")
    options = IdentifyOptions(joint_laws=mode, apply=("chuck.c1",))
    found = identified(robot, Observed(rig, rows), (), options)
    assert found.estimate.status == "converged"
    assert not (found.estimate.joint_laws and found.estimate.joint_laws.kept)
    if decimals is None:
        shown = stated(found.document)["chi2"].values
        assert (shown["chi2"], shown["where"]) == ("0 within rounding", "below")


def test_only_things_that_are_there_can_be_off():
    rows = random_table(100, np.random.default_rng(7), SIGMA)
    with refused("invalid-input", place="apply", reason="chuck.c9: "):
        identify(CHAIN, RIG, rows, free=FREE, options=SolverOptions(effects=(Effect("chuck.c9"),)))
    with pytest.raises(Exception, match="rows 1 to 100"):
        identify(CHAIN, RIG, rows, free=FREE, options=SolverOptions(effects=(Effect("chuck.c0", 100),)))
    # Its steps and backlash are parameters of the fit, the drift of its constants is not.
    chain = replace(CHAIN, joints=(replace(CHAIN.joints[0], name="base@1"), *CHAIN.joints[1:]))
    names = ("base@1@41:80", "base@1.backlash", "base@1.offset.drift")
    effects, causes = split_causes(chain, RIG, random_table(100, np.random.default_rng(7), SIGMA), names)
    assert effects == (Effect("base@1", 40, 80), Effect("base@1", drifts_with=DriftWith.DIRECTION))
    assert causes == names[2:]


def visits(q, source, **columns):
    return ObservationTable(q=np.array(q), kind=np.full(len(q), "ball_bar"), source=np.array(source), **columns)


TURNS = [[0.0, 0.0], [0.5, 0.0], [0.5, 0.0], [0.2, 0.1], [0.3, 0.1], [0.1, 0.1]]
ROWS = [f"a.csv row {i}" for i in range(2, 6)] + ["b.csv row 2", "b.csv row 3"]


def test_directions_of_moves_and_known_sides():
    # Rows of one pose have one move; the first pose of a file has none that is known.
    np.testing.assert_allclose(
        last_motions(visits(TURNS, ROWS), sessions(visits(TURNS, ROWS)))[1],
        [[0.0, 0.0], [0.5, 0.0], [0.5, 0.0], [-0.3, 0.1], [0.0, 0.0], [-0.2, 0.0]],
    )
    np.testing.assert_array_equal(
        last_motions(visits(TURNS, ROWS), sessions(visits(TURNS, ROWS)))[0],
        [[0, 0], [1, 0], [1, 0], [-1, 1], [0, 0], [-1, 0]],
    )
    still = visits([[0.0], [0.5], [0.5 + 5e-4], [0.5]], [f"a.csv row {i}" for i in range(2, 6)])
    np.testing.assert_array_equal(last_motions(still, sessions(still))[0][:, 0], [0, 1, 1, 1])
    side = np.array([[1.0, -1.0], [np.nan, 1.0]])
    known = visits([[0.0, 0.0], [0.5, 0.5]], ["s.mcap dwell 1", "s.mcap dwell 2"], side=side)
    np.testing.assert_array_equal(last_motions(known, sessions(known))[0], [[1, -1], [0, 1]])
    rows = worlds.clean(worlds.plan(), np.random.default_rng(0))
    sorted_rows = rows.select(np.argsort(rows.q[:, 0]))
    with pytest.raises(InputError, match=r"joint1.backlash: rows 1 to 360 have no direction, or it does"):
        worlds.identified(sorted_rows, [parse_effect("joint1.backlash")])
    with pytest.raises(InputError, match="no direction"):
        worlds.identified(rows, [parse_effect("chuck.c1.backlash")])
