"""Programs of plans, executed: the arm moves, rests, waits and prompts as planned."""

import csv
import re

import numpy as np
import pytest
from tests.host import plan_bench as bench
from tests.host.controllers import Controller, ProgramFault
from tests.host.rapid_machine import run_rapid
from tests.host.urscript_machine import run_urscript

from truearm.errors import PlanError
from truearm.plan.route import SETTLE, TIMEOUT, Signals, Stop, Task, identifier, plain
from truearm.plan.route_program import program

MACHINES = {".script": run_urscript, ".mod": run_rapid}
ROUNDING = 6e-7  # rad: programs have 1e-6 rad or 1e-5 deg
each_language = pytest.mark.parametrize("suffix", MACHINES)
each_robot = pytest.mark.parametrize("name", bench.ROBOTS)


def planned(name):
    """Return a plan with moves with the bar mounted, some with via points, and every pairing of one bar."""
    return bench.planned(name, 18, 60).route


def driven(name, stops, suffix, task, answer_s=0.015):
    known = bench.known(name)
    controller = Controller(known.chain, known.params, answer_s=answer_s)
    MACHINES[suffix](program(stops, suffix, task), controller)
    return controller


@each_robot
@each_language
def test_the_arm_goes_where_and_as_fast_as_planned(name, suffix):
    """Every pose, every via point, every duration; the moves are straight in joint space, as the plan's were looked at."""
    route = planned(name)
    moves, course = driven(name, route.stops, suffix, Task("plan")).moves, bench.Course.of(route)
    assert len(moves) == len(course.q)
    assert {move.kind for move in moves} == {"joints"}
    np.testing.assert_allclose([move.q for move in moves], course.q, atol=ROUNDING)
    seconds = np.array([move.t1 - move.t0 for move in moves])
    np.testing.assert_allclose(seconds, course.seconds, atol=5.1e-4)  # a millisecond's rounding
    # the rounding of a duration is no more than what keeps the speed under the limit: a thousandth of 0.2 s at least
    assert (seconds[1:] > 0.19).all()


@each_robot
@each_language
def test_it_rests_with_its_output_on_at_every_pose_and_nowhere_else(name, suffix):
    route = planned(name)
    for answer_s in (None, 0.015):
        signals = Signals(3, None if answer_s is None else 1)
        controller = driven(name, route.stops, suffix, Task("plan", 1.7, signals), answer_s)
        held = controller.held()
        assert len(held) == len(route.plan)
        for (t0, t1), q in zip(held, route.plan.q, strict=True):
            assert t1 - t0 >= 1.7 - 1e-6
            assert not controller.moves_within(t0, t1)
            before = [move for move in controller.moves if move.t1 <= t0]
            np.testing.assert_allclose(before[-1].q, q, atol=ROUNDING)
            assert t0 - before[-1].t1 >= SETTLE - 1e-6
    # an answer is waited for when the output comes and when it goes, at each pose: 15 ms, found by a loop of 8 ms
    waited = controller.t - len(held) * (1.7 + SETTLE) - route.seconds
    assert 2 * 0.015 * len(held) - 0.1 < waited < 2 * 0.025 * len(held)


@each_robot
@each_language
def test_the_bar_is_off_on_every_way_that_was_planned_without_it(name, suffix):
    """The operator is asked before the arm sets out, over via points too, and again where the bar goes on."""
    route = planned(name)
    controller = driven(name, route.stops, suffix, Task("plan"))
    assert len(controller.said) == 2 * route.n_mounts
    assert not any(text.startswith("Mount") for _, text in controller.said[:3:2])
    on = None
    asked = list(controller.said)
    for i in range(len(controller.moves)):
        while asked and asked[0][0] <= i:
            text = asked.pop(0)[1]
            found = re.search(r"bar (\S+) from (\S+) to (\S+)", text)
            on = (found[2], found[3], found[1]) if text.startswith("Mount") else None
        assert on == (bench.connected(route, i) if i else None)
    assert len(asked) <= 1  # what is put on at the last stop


@each_language
def test_a_box_that_never_answers_does_not_stop_the_program(suffix):
    controller = driven("puma560", STOPS, suffix, Task("plan", 2.0, Signals(0, 1)), answer_s=None)
    assert len(controller.moves) == len(STOPS)
    # each of two poses waits for an answer that does not come; that it goes again is true from the beginning
    assert controller.t == pytest.approx(2 * (SETTLE + TIMEOUT + 2.0) + 1.5 + 2.25, abs=0.1)


STOPS = [
    Stop(np.full(6, 0.1), 0.0, "dwell", "Remove the bar. Next: bar b1 from c1 to s1", "Mount bar b1 from c1 to s1"),
    Stop(np.full(6, 0.2), 1.5, "via"),
    Stop(np.full(6, -0.3), 2.25),
]


def test_the_first_move_from_wherever_the_arm_stands_is_slow():
    assert "movej([0.100000, 0.100000, 0.100000, 0.100000, 0.100000, 0.100000], a=0.2, v=0.2)" in program(
        STOPS, ".script", Task("x")
    )
    assert re.search(r"MoveAbsJ \[\[5\.72958,.*v50, fine, tool0;", program(STOPS, ".mod", Task("x")))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of pyparsing, by rapidchecker
def test_a_module_is_rapid_to_a_checker_that_others_wrote():
    """The grammar is rapidchecker's. No Python package has one for URScript."""
    from rapidchecker.check import check_format

    text = program(STOPS, ".mod", Task("x", 2.0, Signals(0, 1)))
    assert check_format(text) == []
    assert check_format(text.replace("fine, tool0", "fine tool0"))


def test_programs_have_every_stop_and_nothing_else():
    rows = list(csv.reader(program(STOPS, ".csv", Task("x", 2.0)).splitlines()))
    assert rows[0][:7] == ["pose", "move", "before", "there", "move_s", "dwell_s", "speed_mm_s"]
    assert [row[0] for row in rows[1:]] == ["0", "1", "2"]
    assert [row[1] for row in rows[1:]] == ["dwell", "via", "dwell"]
    assert [row[5] for row in rows[1:]] == ["2", "0", "2"]
    np.testing.assert_array_equal([[float(v) for v in row[7:]] for row in rows[1:]], [stop.q for stop in STOPS])
    # Text after the last ``end`` would be another program, which stops this one.
    text = program(STOPS, ".script", Task("plan"))
    assert text.startswith("def truearm_plan():\n")
    assert text.endswith("\nend\n")


@pytest.mark.parametrize("name", ["main", "end", "movej", "1", "", "Plan 7", "ä" * 40, "x" * 90, 'a"b;Stop', "module"])
@each_language
def test_any_file_name_makes_a_program_that_runs(suffix, name):
    """A procedure main in a module main, a function called end: controllers refuse them."""
    assert re.fullmatch(r"truearm[a-z0-9_]{0,25}", identifier(name))
    assert driven("puma560", STOPS, suffix, Task(name)).moves


@pytest.mark.parametrize("text", ['b"1\n; Stop, ä\\', "x" * 500])
def test_names_cannot_break_out_of_a_program(text):
    assert re.fullmatch(r"[\w: .-]{0,72}", plain(text), re.ASCII)


def test_what_is_no_program_is_said():
    with pytest.raises(PlanError, match=r"programs cannot be written as '\.txt'"):
        program(STOPS, ".txt", Task("x"))
    five = [stop._replace(q=stop.q[:5]) for stop in STOPS]
    with pytest.raises(PlanError, match="six joints"):
        program(five, ".script", Task("x"))
    assert program(five, ".csv", Task("x"))


@pytest.mark.parametrize(
    ("suffix", "good", "bad"),
    [
        (".script", "movej(", "movej["),
        (".script", "  sleep(", "sleep("),
        (".script", "True)", "on)"),
        (".script", "\nend\n", "\nend\ntruearm_x()\n"),
        (".script", "t=1.500", "t=1.500 a=1"),
        (".script", "blocking=True", "waiting=True"),
        (".mod", "fine, tool0;", "fine tool0"),
        (".mod", "SetDO doTruearm, 1;", "SetDO doTruearm 1"),
        (".mod", "ENDPROC", "ENDPROG"),
        (".mod", "MODULE truearm_x", "MODULE main"),
        (".mod", "v50", "v55"),
        (".mod", "VAR bool late;", ""),
    ],
)
def test_the_machines_of_these_tests_refuse_what_controllers_do(suffix, good, bad):
    text = program(STOPS, suffix, Task("x", 2.0, Signals(0, 1)))
    assert good in text
    with pytest.raises(ProgramFault):
        MACHINES[suffix](
            text.replace(good, bad), Controller(bench.known("puma560").chain, bench.known("puma560").params)
        )
