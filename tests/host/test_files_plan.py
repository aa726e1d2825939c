"""Plan files are read back as written, and errors in them are named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.refusals import refused

from truearm.api import load_robot
from truearm.disk import kind_of
from truearm.errors import PlanError
from truearm.plan.plan_file import check_against_rig, concatenate, format_plan, parse_plan, read_plan
from truearm.types import Device, Plan, Point, Rig
from truearm.workflows.export import _poses_of

GOOD = """\
pose,shell,bar,chuck,sphere,q1_rad,q2_rad
0,bar46-c1,bar46,c1,s1,0.1,-0.25
1,,bar46,c1,s2,1e-3,.5
"""


MOVING = """\
pose,shell,bar,chuck,sphere,move,line,target,speed_mm_s,q1_rad,q2_rad
0,bar46-c1,bar46,c1,s1,,,,,0.1,-0.25
1,,bar46,c1,s1,via,,,,0.2,.5
2,,,,,via,,,,0.3,.5
3,,,,,line,left,ball,62.5,0.4,.5
4,,,,,line,left,,100,0.3,.5
"""


def plan_of(q):
    n = len(q)
    return Plan(q, *(np.array([f"{name}{i}" for i in range(n)]) for name in ("shell", "bar", "chuck", "sphere")))


def assert_same(a, b):
    for name in Plan.columns():
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_plan_by_hand():
    plan = parse_plan(GOOD, "plan.csv")
    assert len(plan) == 2
    assert plan.q.tolist() == [[0.1, -0.25], [1e-3, 0.5]]
    assert plan.shell.tolist() == ["bar46-c1", ""]
    assert plan.sphere.tolist() == ["s1", "s2"]
    assert parse_plan("\n" + GOOD.replace("\n", "\r\n") + "\n\n", "plan.csv").q.tolist() == plan.q.tolist()


@pytest.mark.parametrize("text", [GOOD, MOVING])
def test_columns_stand_in_any_order(text, tmp_path):
    """A plan is recognised by its column pose: as --over of export, and as a file of another kind than expected."""
    path, chain = tmp_path / "plan.csv", load_robot("puma560").chain
    header, *rows = text.splitlines()
    text = "\n".join([f"{header},q3_rad,q4_rad,q5_rad,q6_rad", *(f"{row},0.1,0.2,0.3,0.4" for row in rows)])
    path.write_text("\n".join(",".join(line.split(",")[::-1]) for line in text.splitlines()))
    assert_same(read_plan(path), parse_plan(text, "plan.csv"))
    assert kind_of(path) == "plan"
    np.testing.assert_array_equal(_poses_of(path, chain), read_plan(path).q)
    path.write_text("pose,kind,q1_rad\n0,seat,0.1\n")
    assert kind_of(path) != "plan"


@given(arrays(float, st.tuples(st.integers(1, 5), st.integers(1, 7)), elements=st.floats(-60.0, 60.0)))
def test_every_bit_of_a_plan_comes_back(q):
    assert_same(parse_plan(format_plan(plan_of(q)), "plan.csv"), plan_of(q))


def test_a_plan_with_via_points_and_lines_and_one_of_dwells():
    plan = parse_plan(MOVING, "plan.csv")
    assert plan.move.tolist() == ["dwell", "via", "via", "line", "line"]
    assert plan.line.tolist() == ["", "", "", "left", "left"]
    assert plan.target.tolist() == ["", "", "", "ball", ""]
    assert plan.bar.tolist() == ["bar46", "bar46", "", "", ""]
    assert plan.speed[3:].tolist() == [0.0625, 0.1]
    assert np.isnan(plan.speed[:3]).all()
    assert plan.dwells.tolist() == [True] + 4 * [False]
    assert plan.lines.tolist() == 3 * [False] + 2 * [True]
    assert_same(parse_plan(format_plan(plan), "plan.csv"), plan)
    both = concatenate(parse_plan(GOOD, "plan.csv"), plan)
    assert_same(parse_plan(format_plan(both), "plan.csv"), both)
    assert format_plan(parse_plan(GOOD, "plan.csv")).splitlines()[0] == GOOD.splitlines()[0]
    plain = MOVING.splitlines()[:2]
    assert (
        format_plan(parse_plan("\n".join(plain), "p"))
        == GOOD.splitlines(keepends=True)[0] + "0,bar46-c1,bar46,c1,s1,0.1,-0.25\n"
    )


@pytest.mark.parametrize(
    ("old", "new", "code", "place", "words"),
    [
        (",via,,,,0.2", ",fly,,,,0.2", "wrong-value", "row 3 column move", "fly"),
        ("bar46,c1,s1,via", "bar46,c1,,via", "malformed-file", "row 3 column sphere", ""),
        (",via,,,,0.2", ",via,left,,,0.2", "malformed-file", "row 3 column line", ""),
        (",via,,,,0.2", ",via,,,100,0.2", "malformed-file", "row 3 column speed_mm_s", ""),
        (",,,line,left,ball", "bar46,,,line,left,ball", "malformed-file", "row 5 column bar", ""),
        ("line,left,ball,62.5", "line,,ball,62.5", "malformed-file", "row 5 column line", ""),
        ("line,left,ball,62.5", "line,left,a b,62.5", "malformed-file", "row 5 column target", "'a b'"),
        ("ball,62.5", "ball,", "malformed-file", "row 5 column speed_mm_s", ""),
        ("ball,62.5", "ball,0", "malformed-file", "row 5 column speed_mm_s", "'0'"),
        ("ball,62.5", "ball,10001", "malformed-file", "row 5 column speed_mm_s", "'10001'"),
        ("0,bar46-c1,bar46,c1,s1,,,,,", "0,,,,,line,left,,100,", "malformed-file", "row 2", "line"),
        (",sphere,move,line,target,speed_mm_s", ",sphere,move,line,target", "malformed-file", "row 2", "11"),
        ("q2_rad\n0", "q2_deg\n0", "wrong-value", "column 7 ('q2_deg')", "q2_rad"),
        ("q1_rad,q2_rad\n0", "\n0", "malformed-file", "row 2", "7"),
        ("q2_rad\n0", "q3_rad\n0", "malformed-file", "", "q2"),
        ("pose,", "note,", "missing-column", "", "pose"),
        ("shell,bar,", "shell,target,", "malformed-file", "row 2 column bar", ""),
        ("\n0,", "\n-0,", "malformed-file", "row 2 column pose", "'-0'"),
        (GOOD, "pose,shell,bar,chuck,sphere\n0,,b,c,s\n", "missing-column", "", "q1_rad"),
        ("1,,bar46", "2,,bar46", "malformed-file", "row 3 column pose", "'2'"),
        ("c1,s2", ",s2", "malformed-file", "row 3 column chuck", ""),
        ("-0.25", "nan", "malformed-file", "row 2 column q2_rad", "nan"),
        ("-0.25", "90", "malformed-file", "row 2 column q2_rad", "'90'"),
    ],
)
def test_bad_plans_are_named(old, new, code, place, words):
    text = GOOD if old in GOOD else MOVING
    assert old in text
    with refused(code) as caught:
        parse_plan(text.replace(old, new), "plan.csv")
    values = caught.value.finding.values
    assert isinstance(caught.value, PlanError)
    assert values["place"] == f"plan.csv {place}".rstrip()
    assert all(word in str(values) for word in words.split())


def test_a_plan_that_measures_nothing_or_has_no_rows_or_no_file(tmp_path):
    text = "\n".join([MOVING.splitlines()[0], "0,,,,,via,,,,0.1,0.2"])
    with refused("malformed-file", place="plan.csv"):
        parse_plan(text, "plan.csv")
    with refused("no-rows"):
        parse_plan(GOOD.splitlines()[0], "plan.csv")
    with refused("missing-file", place=tmp_path / "plan.csv"):
        read_plan(tmp_path / "plan.csv")


def test_plans_of_several_joints_or_shapes_are_refused():
    plan = plan_of(np.arange(6.0).reshape(3, 2))
    both = concatenate(plan, plan)
    assert_same(both.select(np.arange(6) >= 3), plan)
    with refused("no-plan", reason="2 and 3"):
        concatenate(plan, plan_of(np.zeros((1, 3))))
    with pytest.raises(PlanError, match=r"\(2, 6\)"):
        Plan(np.zeros((2, 6)), *(np.array(["a"]) for _ in range(4)))


def test_what_the_rig_does_not_have():
    with refused("not-in-rig", place="plan.csv pose 0", what="bar", name="bar46"):
        check_against_rig(parse_plan(GOOD, "plan.csv"), Rig(), "plan.csv")
    plan = parse_plan(MOVING, "plan.csv").select(np.array([False, False, True, True, True]))
    ball, tip = Point("ball", (0.0, 0.0, 0.1)), Point("tip", (0.0, 0.0, 0.2))
    check_against_rig(plan, Rig(targets={"ball": ball}), "plan.csv")  # lists no lines, so takes any
    with refused("not-in-rig", place="pose 1", what="target", name="ball", names=["tip"]):
        check_against_rig(plan, Rig(targets={"tip": tip}), "plan.csv")
    with refused("not-in-rig", place="pose 2", what="target", name=""):
        check_against_rig(plan, Rig(targets={"ball": ball, "tip": tip}), "plan.csv")
    other = Device("right", ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    with refused("not-in-rig", what="line", name="left"):
        check_against_rig(plan, Rig(targets={"ball": ball}, lines={"right": other}), "plan.csv")
