"""Plan files: what is written comes back, what strangers write wrong is named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from truearm.errors import PlanError
from truearm.files.plan import check_against_rig, concatenate, format_plan, parse_plan, read_plan, write_plan
from truearm.types import Plan, Rig

GOOD = """\
pose,shell,bar,chuck,sphere,q1_rad,q2_rad
0,bar46-c1,bar46,c1,s1,0.1,-0.25
1,,bar46,c1,s2,1e-3,.5
"""


def plan_of(q):
    n = len(q)
    return Plan(q, *(np.array([f"{name}{i}" for i in range(n)]) for name in ("shell", "bar", "chuck", "sphere")))


def assert_same(a, b):
    assert np.array_equal(a.q, b.q)
    for name in ("shell", "bar", "chuck", "sphere"):
        assert np.array_equal(getattr(a, name), getattr(b, name))


def test_a_plan_by_hand():
    plan = parse_plan(GOOD, "plan.csv")
    assert len(plan) == 2
    assert plan.q.tolist() == [[0.1, -0.25], [1e-3, 0.5]]
    assert plan.shell.tolist() == ["bar46-c1", ""]
    assert plan.sphere.tolist() == ["s1", "s2"]
    assert parse_plan("\n" + GOOD.replace("\n", "\r\n") + "\n\n", "plan.csv").q.tolist() == plan.q.tolist()


@given(arrays(float, st.tuples(st.integers(1, 5), st.integers(1, 7)), elements=st.floats(-60.0, 60.0)))
def test_every_bit_of_a_plan_comes_back(q):
    assert_same(parse_plan(format_plan(plan_of(q)), "plan.csv"), plan_of(q))


def test_a_plan_through_a_file(tmp_path):
    plan = plan_of(np.random.default_rng(1).normal(size=(4, 6)))
    write_plan(tmp_path / "plan.csv", plan)
    assert_same(read_plan(tmp_path / "plan.csv"), plan)


def test_concatenate_and_select():
    plan = plan_of(np.arange(6.0).reshape(3, 2))
    both = concatenate(plan, plan)
    assert_same(both.select(np.arange(6) >= 3), plan)
    with pytest.raises(PlanError, match=r"\[2, 3\] joints"):
        concatenate(plan, plan_of(np.zeros((1, 3))))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (GOOD, "", "is empty"),
        ("0,bar46-c1", "", "row 2: has 6 cells, the header has 7"),
        ("q2_rad", "q2_deg", "row 1: column 'q2_rad' is wrong|row 1: column 'q2_deg' is wrong"),
        ("q1_rad,q2_rad", "", "row 1"),
        ("pose,shell", "shell,pose", "row 1: column 'shell' is wrong"),
        ("1,,bar46", "2,,bar46", "row 3: pose is '2', expected 1"),
        ("c1,s2", "c 1,s2", "row 3 column chuck: 'c 1' is no identifier"),
        ("c1,s2", ",s2", "row 3 column chuck: '' is no identifier"),
        ("-0.25", "nan", "row 2: 'nan' is not a number"),
        ("-0.25", "1_0", "row 2: '1_0' is not a number"),
        ("-0.25", "9e999", "row 2: 9e999 rad is more than ten turns"),
        ("-0.25", "90", "are the joints in degrees"),
        ("0.1,-0.25", "0.1", "row 2: has 6 cells"),
        ("bar46-c1", '"bar46', "is not CSV"),
    ],
)
def test_bad_plans_are_named(old, new, says):
    assert old in GOOD
    with pytest.raises(PlanError, match=rf"^plan\.csv.*({says})"):
        parse_plan(GOOD.replace(old, new), "plan.csv")


def test_a_header_alone_and_a_missing_file(tmp_path):
    with pytest.raises(PlanError, match="no poses"):
        parse_plan(GOOD.splitlines()[0], "plan.csv")
    with pytest.raises(PlanError, match="no such file"):
        read_plan(tmp_path / "plan.csv")


def test_shapes_that_disagree():
    with pytest.raises(PlanError, match=r"\(2, 6\)"):
        Plan(np.zeros((2, 6)), *(np.array(["a"]) for _ in range(4)))


def test_names_that_the_rig_does_not_have():
    with pytest.raises(PlanError, match=r"plan\.csv pose 0 column bar: 'bar46' is not in the rig"):
        check_against_rig(parse_plan(GOOD, "plan.csv"), Rig(), "plan.csv")
