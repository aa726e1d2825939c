"""Planning's parts: distances, ways, branches, programs."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.host import plan_bench as bench

from truearm.errors import PlanError
from truearm.model.robot import builtin_robot
from truearm.plan.ballbar import all_pairings
from truearm.plan.branches import BRANCHES, branch_of
from truearm.plan.programs import Signals, program
from truearm.plan.route import Stop, plain
from truearm.plan.shapes import segment_distance
from truearm.plan.shells import candidates
from truearm.plan.site import Pairing, allowed, bar_vectors
from truearm.plan.way import onto_shell, samples, way_with_bar, way_without_bar

coordinate = st.floats(-1.0, 1.0).map(lambda v: round(v, 3))
ends = st.tuples(*(st.tuples(coordinate, coordinate, coordinate) for _ in range(4)))


@settings(max_examples=150, deadline=None)
@given(ends)
def test_segment_distance_is_that_of_the_nearest_points(points):
    a0, a1, b0, b1 = map(np.array, points)
    share = np.linspace(0.0, 1.0, 101)[:, None]
    a, b = a0 + share * (a1 - a0), b0 + share * (b1 - b0)
    apart = np.linalg.norm(a[:, None] - b[None], axis=2).min()
    exact = segment_distance(a0, a1, b0, b1)
    # points a hundredth of a segment apart miss the nearest by at most half of that on either
    half_step = 0.005 * (np.linalg.norm(a1 - a0) + np.linalg.norm(b1 - b0))
    assert exact <= apart + 1e-9
    assert exact >= apart - half_step - 1e-9


def test_a_way_comes_back_onto_the_shell():
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q
    middle = onto_shell(site, 0.5 * (q[0] + q[-1]), pairing)
    bar, mounted = pairing.of(site.rig)
    assert abs(np.linalg.norm(bar_vectors(site, middle[None], mounted)[0]) - bar.zero) < 1e-9
    assert way_with_bar(site, q[0], q[0], pairing).shape == (0, 6)


def test_no_way_is_none_and_never_a_bad_one():
    """A pose on the other side of the wrist's singularity cannot be gone to with the bar on."""
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q[0]
    flipped = q + np.array([0, 0, 0, -np.pi, -2.0 * q[4], np.pi])
    assert way_with_bar(site, q, flipped, pairing) is None


def test_a_move_without_a_bar_goes_round_what_is_in_its_way():
    site = bench.site("irb120")
    q = candidates(site, all_pairings(site.rig, ["bar25"]), 27).q
    low = [q[i] for i in np.argsort(q[:, 0])[[0, -1]]]
    via = way_without_bar(site, *low)
    assert via is not None
    stops = [low[0], *via, low[1]]
    for a, b in pairwise(stops):
        assert allowed(site, samples(a, b), None).all()


@pytest.mark.parametrize("name", sorted(BRANCHES))
def test_branches_lie_inside_the_joints_limits(name):
    chain = builtin_robot(name).chain
    branch = branch_of(chain)
    assert (branch.lower >= [j.lower for j in chain.joints]).all()
    assert (branch.upper <= [j.upper for j in chain.joints]).all()


@pytest.mark.parametrize("text", ["", "1:2", ",".join(["0:1"] * 5), ",".join(["1:0"] * 6), ",".join(["a:b"] * 6),
                                  ",".join(["0:nan"] * 6), ",".join(["0:9999"] * 6)])  # fmt: skip
def test_branches_that_are_none_are_refused(text):
    with pytest.raises(PlanError, match="--branch"):
        branch_of(builtin_robot("puma560").chain, text)


def test_robots_without_a_known_branch_are_told_so():
    with pytest.raises(PlanError, match="--branch LOW:HIGH"):
        branch_of(builtin_robot("ulb").chain)
    assert branch_of(builtin_robot("ulb").chain, ",".join(["-10:10"] * 6)).upper[0] == pytest.approx(np.deg2rad(10))


STOPS = [
    Stop(np.full(6, 0.1), 0.0, "bar b1 from c1 to s1", 0),
    Stop(np.full(6, 0.2), 1.5, "", -1),
    Stop(np.full(6, -0.3), 2.25, "", 1),
]


def test_a_ur_program_moves_says_rest_waits_and_takes_it_back():
    text = program(STOPS, 2.0, ".script", "my plan", Signals(3, 1))
    joints = [tuple(map(float, m.split(","))) for m in re.findall(r"movej\(\[([^\]]*)\]", text)]
    np.testing.assert_allclose(joints, [stop.q for stop in STOPS], atol=1e-6)
    assert re.findall(r"t=([\d.]+)\)", text) == ["1.500", "2.250"]
    assert "a=0.2, v=0.2)" in text.splitlines()[3]  # the first, from wherever the arm stands
    said = re.findall(r"set_standard_digital_out\(3, (\w+)\)|sleep\((2\.000)\)|in\(1\) != (\w+) and", text)
    once = [("True", "", ""), ("", "", "True"), ("", "2.000", ""), ("False", "", ""), ("", "", "False")]
    assert said == [("False", "", ""), *once, *once]
    assert text.startswith("def my_plan():\n")
    assert text.endswith("end\nmy_plan()\n")
    assert text.count("  end\n") == text.count("while")


def test_a_rapid_program_does_the_same_in_degrees():
    text = program(STOPS, 2.0, ".mod", "1plan", Signals(0, 1))
    joints = [tuple(map(float, m.split(","))) for m in re.findall(r"MoveAbsJ \[\[([^\]]*)\]", text)]
    np.testing.assert_allclose(np.deg2rad(joints), [stop.q for stop in STOPS], atol=1e-7)
    assert re.findall(r"\\T:=([\d.]+)", text) == ["1.500", "2.250"]
    said = re.findall(r"SetDO doTruearm, (\d)|WaitTime (2\.000)|WaitDI diTruearm, (\d)", text)
    once = [("1", "", ""), ("", "", "1"), ("", "2.000", ""), ("0", "", ""), ("", "", "0")]
    assert said == [("0", "", ""), *once, *once]
    assert text.startswith("MODULE p_1plan\n  VAR bool late;\n")
    assert all(line.endswith((";", "()")) or line.split()[0] in ("MODULE", "ENDPROC", "ENDMODULE", "!")
               for line in text.splitlines())  # fmt: skip


def test_a_csv_program_has_every_stop_to_the_last_bit():
    text = program(STOPS, 2.0, ".csv", "x")
    rows = [line.split(",") for line in text.splitlines()]
    assert rows[0][:5] == ["stop", "pose", "mount", "move_s", "dwell_s"]
    assert [row[1] for row in rows[1:]] == ["0", "", "1"]
    assert [row[4] for row in rows[1:]] == ["2", "0", "2"]
    np.testing.assert_array_equal([[float(v) for v in row[5:]] for row in rows[1:]], [stop.q for stop in STOPS])


def test_names_cannot_break_out_of_a_program():
    assert re.fullmatch(r"[\w: .-]*", plain('b"1\n; Stop, ä\\'), re.ASCII)


def test_what_is_no_program_is_said():
    with pytest.raises(PlanError, match=r"no program is written as '\.txt'"):
        program(STOPS, 2.0, ".txt", "x")
    five = [replace_q(stop, 5) for stop in STOPS]
    with pytest.raises(PlanError, match="six joints, the robot has 5"):
        program(five, 2.0, ".script", "x")
    assert program(five, 2.0, ".csv", "x")


def replace_q(stop, n):
    return stop._replace(q=stop.q[:n])


def test_every_limit_is_looked_at():
    """A good pose is refused as soon as any one limit is drawn past it."""
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q[:1]
    assert allowed(site, q, pairing).all()
    for change in (
        {"joint_margin": 1.5},
        {"singular_value": 0.9},
        {"reserve": 0.0376},
        {"chuck_angle": 0.01},
        {"sphere_angle": 0.01},
    ):
        assert not allowed(site, q, pairing, replace(site.limits, **change)).any()
    for change in ({"table": 2.0}, {"link": 0.5}, {"post": 0.6}):
        sizes = replace(site.shapes.sizes, **change)
        assert not allowed(replace(site, shapes=site.shapes._replace(sizes=sizes)), q, pairing).any()
