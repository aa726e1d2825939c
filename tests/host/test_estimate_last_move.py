"""Errors of joint readings that follow the last move: backlash, and readings taken before the arm stood still.

The second was found in public data of an ABB IRB 120: its joints were read 0.5 mrad short for each radian of the move.
"""

from dataclasses import replace

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, SIGMA

from truearm.errors import InputError
from truearm.estimate.circumstances import last_directions, last_moves
from truearm.files.result_document import systematic_entries
from truearm.kinds.table import ObservationTable
from truearm.report.result_findings import systematic_findings
from truearm.workflows.selection import parse_effect

HALF = 0.5e-3  # rad of backlash to either side
SHORT = 0.5e-3  # rad for each rad of the move


def visits(q, source, **columns):
    return ObservationTable(q=np.array(q), kind=np.full(len(q), "ball_bar"), source=np.array(source), **columns)


TURNS = [[0.0, 0.0], [0.5, 0.0], [0.5, 0.0], [0.2, 0.1], [0.3, 0.1], [0.1, 0.1]]
ROWS = [f"a.csv row {i}" for i in range(2, 6)] + ["b.csv row 2", "b.csv row 3"]


def test_moves_are_those_since_the_pose_before_in_the_same_file():
    """Rows of one pose have one move; the first pose of a file has none that is known."""
    np.testing.assert_allclose(
        last_moves(visits(TURNS, ROWS)), [[0.0, 0.0], [0.5, 0.0], [0.5, 0.0], [-0.3, 0.1], [0.0, 0.0], [-0.2, 0.0]]
    )


def test_a_joint_that_stays_keeps_its_direction():
    np.testing.assert_array_equal(
        last_directions(visits(TURNS, ROWS)), [[0, 0], [1, 0], [1, 0], [-1, 1], [0, 0], [-1, 0]]
    )
    still = visits([[0.0], [0.5], [0.5 + 5e-4], [0.5]], [f"a.csv row {i}" for i in range(2, 6)])
    np.testing.assert_array_equal(last_directions(still)[:, 0], [0, 1, 1, 1])


def test_known_sides_come_first():
    side = np.array([[1.0, -1.0], [np.nan, 1.0]])
    known = visits([[0.0, 0.0], [0.5, 0.5]], ["s.mcap dwell 1", "s.mcap dwell 2"], side=side)
    np.testing.assert_array_equal(last_directions(known), [[1, -1], [0, 1]])


def by_last_move(joint, error, seed):
    """Return a session in which a joint is off by ``error`` of the direction and the length of its last move (n,)."""
    plan, rng = worlds.plan(), np.random.default_rng(seed)
    rows = worlds.clean(plan, rng)
    off = np.zeros(plan.q.shape)
    off[:, joint] = error(last_directions(rows)[:, joint], last_moves(rows)[:, joint])
    return replace(rows, value=worlds.lengths(plan, q_off=off) + SIGMA * rng.normal(size=len(plan)))


FORMS = {
    "backlash": (lambda direction, move: -HALF * direction, lambda moves: 2.0 * HALF),
    "settling": (lambda direction, move: SHORT * move, lambda moves: SHORT * np.ptp(moves)),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("joint", "seed"), [(1, 0), (2, 1)])
def test_an_error_that_follows_the_last_move_is_named(form, joint, seed):
    """1 mrad of backlash, and readings that are short by 0.5 mrad for each rad."""
    error, size = FORMS[form]
    rows = by_last_move(joint, error, seed)
    before = worlds.identified(rows)
    name = f"{CHAIN.joints[joint].name}.{form}"
    (found,) = [one for one in before.systematic.found if str(one.effect) == name]
    expected = size(last_moves(rows)[:, joint])
    assert found.off_by[0].value == pytest.approx(expected, abs=4.0 * found.sigma)  # its sign too
    after = worlds.identified(rows, [parse_effect(name)])
    assert after.systematic is None
    assert worlds.tool_error(after, worlds.plan()) < worlds.tool_error(before, worlds.plan())


def test_the_message_says_what_to_look_at():
    rows = by_last_move(0, FORMS["settling"][0], 0)
    error, apply = systematic_findings(systematic_entries(worlds.identified(rows).systematic, rows))
    assert (error.code, error.values["what"]) == ("systematic-settling", "joint1")
    assert apply.values["allow"] == ["joint1.settling"]
    rows = by_last_move(0, FORMS["backlash"][0], 0)
    error, *_ = systematic_findings(systematic_entries(worlds.identified(rows).systematic, rows))
    assert (error.code, error.values["what"]) == ("systematic-backlash", "joint1")


def test_without_moves_in_both_directions_nothing_can_be_estimated():
    rows = worlds.clean(worlds.plan(), np.random.default_rng(0))
    sorted_rows = rows.select(np.argsort(rows.q[:, 0]))
    with pytest.raises(InputError, match=r"joint1.backlash: rows 1 to 360 have no direction, or it does"):
        worlds.identified(sorted_rows, [parse_effect("joint1.backlash")])
    with pytest.raises(InputError, match="no direction"):
        worlds.identified(rows, [parse_effect("chuck.c1.backlash")])
