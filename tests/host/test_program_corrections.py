"""Corrected programs, executed: the true arm goes where a perfect one would, move by move, or the program was refused.

The interpreters (``urscript_machine``, ``rapid_machine``) have nothing in common with what reads programs in truearm. They run the program as it was on a controller
whose model is true, and as it was corrected on one with the nominal model in front of the true arm.
"""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.host import correct_bench
from tests.host.controllers import Controller, ProgramFault
from tests.host.puma_bench import CHAIN, DESIGN, TRUTH
from tests.host.rapid_machine import run_rapid
from tests.host.urscript_machine import run_urscript

from truearm.correct.correction import MARGIN, MOST_TURN, ModelPair
from truearm.correct.methods import JointMoves
from truearm.correct.programs import corrected_text
from truearm.correct.programs.languages import language_of
from truearm.correct.programs.program import Form
from truearm.errors import InputError
from truearm.findings import Finding, Reason
from truearm.model.chain import forward
from truearm.model.transforms import apart
from truearm.workflows import correct_program as correct_program_module
from truearm.workflows.correct_program import CalibrationFrames, HowCorrected, correct_program
from truearm.workflows.requests import ProgramOptions

Q = correct_bench.good_poses(12)
POSES = correct_bench.nominal_poses(Q)
HERE = CalibrationFrames("base", "tool0", brought=True, own_frames=False)
TOOLS = [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.005, 0.02, 0.03, 0.0, 0.05), (0.01, 0.0, 0.03, 0.0, 0.0, 1.0)]
OBJECTS = [
    ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
    ((0.3, -0.2, 0.1, 0.0, 0.0, 0.7), (0.02, 0.01, 0.0, 0.3, 0.0, 0.0)),
    ((-0.1, 0.4, 0.05, 0.0, 0.1, -1.1), (0.0, 0.0, -0.03, 0.0, 0.2, 0.1)),
]
FEATURE = (0.1, -0.05, 0.02, 0.0, 0.0, 1.2)


def six(pose):
    numbers = (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec())
    return f"p[{', '.join(f'{value:.12f}' for value in numbers)}]"


def written(numbers):
    return f"[{', '.join(f'{value:.12f}' for value in numbers)}]"


def matrix(numbers):
    out = np.eye(4)
    out[:3, 3], out[:3, :3] = numbers[:3], Rotation.from_rotvec(numbers[3:]).as_matrix()
    return out


def program(*lines):
    return "\n".join(["def work():", *(f"  {line}" for line in lines), "end", ""])


def corrected(text, **options):
    """Return the corrected text. Raises InputError."""
    (text,) = outcome(text, **options).contents.values()
    return text.decode("latin-1")


def outcome(text, **options):
    name = "p.mod" if text.startswith("MODULE") else "p.script"
    pair = options.pop("pair", ModelPair(CHAIN, DESIGN, TRUTH))
    how = HowCorrected(pair, "newton", 1, options.pop("home", Q[0]), MARGIN)
    given = {"joint_moves": JointMoves.CORRECT, **({} if name == "p.mod" else {"tools": {"": TOOLS[0]}}), **options}
    return correct_program({name: text.encode("latin-1")}, language_of([name]), how, HERE, ProgramOptions(**given))


def driven(text):
    machine = Controller(CHAIN, DESIGN, Q[0])
    (run_rapid if text.startswith("MODULE") else run_urscript)(text, machine)
    return machine.moves


def misses(text, after):
    """Return (n, 2) [m, rad]: how far the true arm's tool ends each move from a perfect arm's."""
    return missed(driven(text), driven(after))


def missed(asked, done):
    assert [(move.kind, move.configuration) for move in asked] == [(move.kind, move.configuration) for move in done]
    q = np.array([move.q for move in done])
    turned = np.abs(q - np.array([move.q for move in asked])).max(initial=0.0)
    assert turned < MOST_TURN  # the arm is in the same configuration
    tools = np.linalg.inv(forward(CHAIN, DESIGN, q)) @ np.array([move.pose for move in done])
    error = apart(np.array([move.pose for move in asked]), forward(CHAIN, TRUTH, q) @ tools)
    return np.stack([np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)], axis=1)


def tool_point(k, tool):
    """Return the pose of a tool with the arm at the k-th good pose."""
    return POSES[k] @ matrix(TOOLS[tool])


def in_feature(pose):
    return np.linalg.inv(matrix(FEATURE)) @ pose


def feature(k):
    """Return the k-th of three features, as users' frames and object frames of a module."""
    users, own = OBJECTS[k]
    return matrix(users) @ matrix(own)


def sets(name, k, result):
    """Return a function that sets W to the k-th pose, and counts."""
    return (
        "n = 0",
        f"def {name}():",
        f"  global W = {six(POSES[k])}",
        "  global n = n + 1",
        f"  return {result}",
        "end",
    )


NEAR = f"qnear={written(Q[1])}"
FORMS = {
    "polyscope": (f"global W_p={six(POSES[1])}", f"global W_q={written(Q[1])}", '$ 2 "MoveJ"', '$ 3 "W" "breakAfter"', "movej(get_inverse_kin(W_p, qnear=W_q), a=1.4, v=1.0)"),
    "servoj": (f"servoj(get_inverse_kin({six(POSES[1])}, {NEAR}), t=0.008)",),
    "path": (f"path=[{six(POSES[1])},", f"  {six(POSES[2])}]", "i = 0", "while i < 2:", "  movej(path[i])", "  i = i + 1", "end"),
    "feature": (f"Plane = {six(matrix(FEATURE))}", f"W_p = {six(in_feature(POSES[1]))}", "movel(pose_trans(Plane, W_p))"),
    "optimove": (f"optimovej({six(POSES[1])})", f"optimovel({six(POSES[2])})"),
    "circle": (f"movej({six(POSES[1])})", f"movec({six(POSES[2])}, {six(POSES[3])})"),
    "joints": (f"movej({written(Q[1])})", f"movel({written(Q[2])})"),
    "approach": (f"W = {six(POSES[1])}", "movej(pose_trans(W, p[0,0,-0.02,0,0,0]))", "movel(W)"),
    "added": (f"movej(pose_add({six(POSES[1])}, p[0,0,0.01,0,0,0.1]))", f"movel(pose_add({six(POSES[2])}, p[0,0.01,0,0.1,0,0]))"),
    "three tools": tuple(line for k in range(3) for line in (f"set_tcp(p{written(TOOLS[k])})", f"movej({six(tool_point(k + 1, k))})", f"movel({six(tool_point(k + 4, k))})")),
    "three tools and features": tuple(line for k in range(3) for line in (f"set_tcp(p{written(TOOLS[k])})", f"global Plane_{k} = {six(feature(k))}", *(f"movej(pose_trans(Plane_{k}, {six(np.linalg.inv(feature(k)) @ tool_point(3 * k + i, k))}))" for i in range(3)))),
    "tool of its own": (f"movej(get_inverse_kin({six(tool_point(1, 2))}, {NEAR}, tcp=p{written(TOOLS[2])}))",),
    "solved under a tool before": (f"set_tcp(p{written(TOOLS[1])})", f"q = get_inverse_kin({six(tool_point(1, 1))}, {NEAR})", f"set_tcp(p{written(TOOLS[0])})", "movej(q)"),
    "tool set again on one way": (f"set_tcp(p{written(TOOLS[0])})", f"movej({six(POSES[1])})", "if random() > 0.5:", f"  set_tcp(p{written(TOOLS[1])})", f"  movej({six(tool_point(2, 1))})", f"  set_tcp(p{written(TOOLS[0])})", "end", f"movej({six(POSES[3])})"),
    "assigned twice": (f"W = {six(POSES[1])}", "movej(W)", f"W = {six(POSES[2])}", "movej(W)"),
    "branch": (f"W = {six(POSES[1])}", "if random() > 0.5:", f"  W = {six(POSES[2])}", "end", "movej(W)"),
    # conditions that run a routine, which assigns
    "elif is not reached": (f"global W = {six(POSES[1])}", *sets("f", 2, "True"), *sets("g", 3, "True"), "if f():", "  movej(W)", "elif g():", "  x = 1", "end"),
    "and is not reached": (f"global W = {six(POSES[1])}", *sets("g", 3, "True"), "if random() > 0.5 and g():", "  x = 1", "end", "movej(W)"),
    "condition after the last turn": (f"global W = {six(POSES[1])}", *sets("g", 3, "n < 2"), "while g():", f"  W = {six(POSES[2])}", "end", "movej(W)"),
}  # fmt: skip


def flipped(q):
    """The other wrist: the same pose of an arm whose last three axes meet."""
    turn = np.where(q[[3, 5]] > 0.0, -np.pi, np.pi)
    return np.array([*q[:3], q[3] + turn[0], -q[4], q[5] + turn[1]])


FROM_JOINTS = {
    "straight": (f"movej({written(flipped(Q[1]))})", f"movel({six(POSES[2])})", f"movel({six(POSES[3])})"),
    "by joints": (f"movej({written(flipped(Q[1]))})", f"movej({six(POSES[2])})"),
    "circle": (f"movej({written(flipped(Q[1]))})", f"movec({six(POSES[2])}, {six(POSES[3])})"),
    "circle after a target": (f"movej({written(Q[1])})", f"movel({six(POSES[2])})", f"movej({written(flipped(Q[1]))})", f"movec({six(POSES[3])}, {six(POSES[5])})"),
    "in functions": ("def go():", f"  movej({written(flipped(Q[1]))})", "end", "def pick():", f"  movel({six(POSES[2])})", "end", "go()", "pick()", f"movel({six(POSES[3])})"),
    "from a qnear": (f"movej(get_inverse_kin({six(POSES[1])}, qnear={written(flipped(Q[1]))}))", f"movel({six(POSES[2])})"),
    "a rough qnear": (f"movej(get_inverse_kin({six(POSES[2])}, qnear={written(np.round(flipped(Q[2])) + np.array([0.5, 0.5, -0.5, -0.5, 0.6, 0.5]))}))",),
}  # fmt: skip
# moves that need different numbers of one target, which get their own
TWO_WAYS = {
    "qnear": (f"W = {six(POSES[1])}", f"movej(get_inverse_kin(W, qnear={written(Q[1])}))", f"movej(get_inverse_kin(W, qnear={written(flipped(Q[1]))}))"),
    "joints before": (f"W = {six(POSES[1])}", f"movej({written(Q[2])})", "movel(W)", f"movej({written(flipped(Q[2]))})", "movel(W)"),
    "one point under two tools": (f"W = {six(POSES[1])}", "movej(W)", f"set_tcp(p{written(TOOLS[1])})", "movej(W)"),
    "approach": (f"W = {six(POSES[1])}", "movej(pose_trans(W, p[0,0,-0.02,0,0,0]))", "movel(W)"),
    "once more with one wrist": (f"W = {six(POSES[1])}", f"movej(get_inverse_kin(W, qnear={written(Q[1])}))", f"movej({written(Q[2])})", "movel(W)"),
    "again from itself": (f"W = {six(POSES[9])}", f"movej(get_inverse_kin(W, qnear={written(Q[9])}))", "movel(W)", f"movel({six(POSES[10])})"),
    "tool of its own": (f"W = {six(POSES[1])}", f"movej(get_inverse_kin(W, {NEAR}))", f"movej(get_inverse_kin(W, {NEAR}, tcp=p{written(TOOLS[1])}))"),
}  # fmt: skip


HOMES = ((FORMS, Q[0]), (FROM_JOINTS, None), (TWO_WAYS, Q[1]))
DRIVEN = [pytest.param(forms[name], home, id=name) for forms, home in HOMES for name in forms]


@pytest.mark.parametrize(("form", "home"), DRIVEN)
def test_the_true_arm_goes_where_a_perfect_one_would(form, home):
    """Within 1 µm of the identified arm: numbers are written to 1 nm and 1 nrad.

    Without a home, the wrist is where the joint move before has brought it, however the text is ordered.
    """
    np.testing.assert_allclose(forward(CHAIN, DESIGN, flipped(Q[1])[None])[0], POSES[1], atol=1e-12)
    text = program(*form)
    assert misses(text, text)[:, 0].max() > 5e-3
    assert misses(text, corrected(text, home=home)).max() < 1e-6


# why moves are refused, by the codes of the reasons: line of the text, code

REFUSED = {
    "round a loop": (f"movej({written(Q[2])})", "while True:", f"  movel({six(POSES[1])})", f"  movej({written(flipped(Q[2]))})", "end", {4: "other-configuration"}),
    "struct": (f"w = struct(pose={six(POSES[1])})", "movej(w.pose)", {3: "run-time"}),
    "parameter": ("def go(w):", "  movej(w)", "end", f"go({six(POSES[1])})", {3: "parameter"}),
    "inverse of a literal": (f"movej(pose_inv({six(np.linalg.inv(POSES[1]))}))", {2: "run-time"}),
    "element assigned": (f"W = {six(POSES[1])}", "W[2] = 0.5", "movej(W)", {4: "assigned"}),
    "several tools": ("if random() > 0.5:", f"  set_tcp(p{written(TOOLS[1])})", "end", f"movej({six(POSES[1])})", {5: "several-tools", 7: "several-tools"}),
    "tool in a condition that may be skipped": (f"x = True or set_tcp(p{written(TOOLS[1])})", f"movej({six(POSES[1])})", {3: "several-tools", 5: "several-tools"}),
    "tool at run time": ("set_tcp(get_actual_tcp_pose())", f"movel({six(POSES[1])})", {3: "run-time", 5: "run-time"}),
    "measured": (f"W = {six(POSES[1])}", "if random() > 0.5:", "  W = get_actual_tcp_pose()", "end", "movel(W)", {6: "run-time"}),
    "computed joints": ("movej([d2r(5), 0, 1, 0, 1, 0])", {2: "joints"}),
    "joints of a pose": (f"W = {six(POSES[1])}", f"q = {written(Q[2])}", "q[5] = W[2]", "movej(q)", {5: "assigned"}),
    "qnear at run time": (f"movej(get_inverse_kin({six(POSES[1])}, qnear=[0,1,2,3,4,random()]))", {2: "run-time"}),
    "out of reach": (f"W = {six(POSES[1] + np.eye(4, k=3) * 5.0)}", "movej(W)", "movel(W)", {3: "solution", 4: "solution"}),
    "no robot": ("movel(p[1000000,0,0,0,0,0])", {2: "range"}),
    "force": ("force_mode(p[0,0,0,0,0,0],[0,0,1,0,0,0],[0,0,1,0,0,0],2,[1,1,1,1,1,1])", {2: "aimless"}),
    "lists for poses": ("movel(pose_add([0.3,-0.2,0.3,2.2,2.1,0.1], p[0,0,0.01,0,0,0]))", f"movel(pose_trans({six(POSES[1])}, [0,0,0.01,0,0,0]))", "set_tcp([0,0,0.1,0,0,0])", f"movel({six(POSES[1])})", f"set_tcp(p{written(TOOLS[0])})", {2: "type", 3: "type", 5: "type"}),
    "passed on": (f"W = {six(POSES[1])}", "elsewhere(W)", "movel(pose_trans(W, p[0,0,0,random(),0,0]))", {4: "run-time"}),
    "recursion": ("def f():", f"  movel({six(POSES[1])})", f"  set_tcp(p{written(TOOLS[1])})", "  f()", "end", f"set_tcp(p{written(TOOLS[0])})", "f()", {3: "several-tools", 10: "several-tools"}),
    "a hundred tools": (*100 * ("if random() > 0.5:", f"  set_tcp(p{written(TOOLS[1])})", "end"), f"movej({six(POSES[1])})", {302: "several-tools", 304: "several-tools"}),
    "a thread sets the tool": ("thread t():", f"  set_tcp(p{written(TOOLS[1])})", "end", f"set_tcp(p{written(TOOLS[0])})", f"movej({six(POSES[1])})", {6: "several-tools", 8: "several-tools"}),
    "deep brackets": ("x0 = 1", *(f"x{k + 1} = {'(' * 39}x{k}{')' * 39}" for k in range(60)), "movej(p[x60,0,0,0,0,0])", {63: "deep"}),
    "itself": ("a = b", "b = a", "movel(a)", {4: "deep"}),
}  # fmt: skip


@pytest.mark.parametrize("form", REFUSED)
def test_a_move_that_is_not_certain_is_refused(form):
    """The others are corrected; ``partial`` writes them, and leaves the refused ones."""
    *lines, codes = REFUSED[form]
    text = program(*lines, f"movej({written(Q[3])})", f"movel({six(POSES[4])})")
    with pytest.raises(InputError) as caught:
        corrected(text)
    assert {move["line"]: move["reason"] for move in caught.value.finding.values["refused"]} == codes
    assert all(move["text"] for move in caught.value.finding.values["refused"])
    after = corrected(text, partial=True).splitlines()
    before = text.splitlines()
    assert after[-3] != before[-3]  # the joint move
    assert all(after[line - 1] == before[line - 1] for line in codes)


def test_moves_in_texts_are_not_corrected_in_silence():
    text = program(f"movej({six(POSES[1])})", "socket_send_string('movel(p[0.1,0.2,0.3,0,0,0])')")
    assert Finding("moves-in-texts", {"n": 1, "place": "p.script line 3"}) in outcome(text).notes


def test_quarter_turns_that_the_correction_crosses_are_written():
    """cf1 follows axis 1 over 0: the controller would stop at data that do not fit."""
    crossed = []
    for start in (-2e-5, 2e-5):
        q = np.array([start, *Q[1][1:]])
        text = module([], [f"MoveJ {robtarget_at(q)},v100,fine,t0;"])
        after = corrected(text)
        done = driven(after)[0]
        data = re.search(r"MoveJ .*\],\[(-?\d),(-?\d),(-?\d),0\]", after).groups()
        assert np.array(data, int).tolist() == np.floor(done.q[[0, 3, 5]] / (0.5 * np.pi)).tolist()
        np.testing.assert_allclose(done.pose, driven(after)[0].pose)
        crossed.append((start < 0.0) != (done.q[0] < 0.0))
    assert sorted(crossed) == [False, True]


@pytest.mark.parametrize(
    ("before", "after", "quarter", "turn"),
    [(-1e-16, -1e-3, -1, 1), (1e-16, -1e-3, -1, 1), (-1e-16, 1e-3, 0, 0), (1e-3, -1e-16, 0, 0), (-0.1, 1e-3, 0, 0)],
)
def test_an_axis_at_zero_within_rounding_has_the_data_of_where_it_goes(before, after, quarter, turn):
    """Where the axis would be before is known to rounding only; data that contradict it by more stay as they are."""
    joints = corrected_text.Joints(
        np.array([1.0, 0.1, 0.1, before, 0.5, 1.0]), np.array([1.0, 0.1, 0.1, after, 0.5, 1.0])
    )
    target = robtarget_literal(0, 0, 0)
    texts = corrected_text.configuration_texts(target, joints)
    assert texts == ([] if quarter == 0 else ["0", str(quarter), "0", "0"])
    turned = SimpleNamespace(target=SimpleNamespace(literal=SimpleNamespace(form=None)), turns=0)
    assert corrected_text.configuration_texts(turned, joints) == ([] if turn == 0 else [str(turn << 3)])


def test_a_mark_names_options_as_the_command_line_does():
    source = SimpleNamespace(line_end=lambda offset: offset)
    move = SimpleNamespace(reason=Reason("configuration", {}), place=SimpleNamespace(file=0), end=9)
    (mark,) = corrected_text.marks_of(SimpleNamespace(moves=[move], files=[source], language="urscript"))
    assert "--home" in mark.text


def robtarget_literal(*quarters):
    literal = SimpleNamespace(form=Form.ROBTARGET, numbers=(0.0,) * 7 + (*map(float, quarters), 0.0))
    return SimpleNamespace(target=SimpleNamespace(literal=literal))


def test_a_straight_move_from_a_target_out_of_reach_is_not_checked():
    far = POSES[1].copy()
    far[0, 3] += 5.0
    lines = (f"movej({six(POSES[1])})", f"movel({six(far)})", f"movel({six(POSES[2])})", f"movel({six(POSES[3])})")
    moves = outcome(program(*lines), partial=True).moves
    assert (moves.unchecked, len(moves.places)) == (1, 1)
    assert np.isfinite(moves.straight.limits).all()


def test_hundreds_of_straight_moves_are_driven(monkeypatch):
    """The longest among 601 bends most; of more than are driven the number is said."""
    near = POSES[1].copy()
    near[:3, 3] += [0.0, 0.02, 0.01]
    lines = [f"A = {six(POSES[1])}", f"B = {six(near)}", "movej(A)", *300 * ("movel(B)", "movel(A)")]
    text = program(*lines, f"movel({six(POSES[5])})")
    moves = outcome(text).moves
    assert (len(moves.places), moves.unchecked) == (601, 0)
    assert moves.places[int(np.argmax(moves.straight.deviation))] == "line 605"
    assert moves.straight.deviation[:-1].max() < moves.straight.deviation[-1]
    monkeypatch.setattr(correct_program_module, "MOST_MOVES", 600)
    assert outcome(text).moves.unchecked == 601


# programs from a grammar: each statement moves, and some cannot be corrected


@st.composite
def statements(draw):
    """Return lines of a program with names from a table of points."""
    lines = [f"W{k} = {six(POSES[k])}" for k in range(1, 5)] + [f"Plane = {six(matrix(FEATURE))}"]
    lines += [f"F{k} = {six(in_feature(POSES[k]))}" for k in (5, 6)] + [
        f"path = [{six(POSES[7])}, {six(POSES[8])}]",
        f"q9 = {written(Q[9])}",
        "i = 0",
        "q0 = get_inverse_kin(W2)",
        "h = 0.004",
        "s = struct(at=W4, all=[W3, W1])",
        "global n = 0",
        *("def f():", "  global n = n + 1", "  global W2 = W3", "  return n > 1", "end"),
        *("def c():", "  global i = 1", "  return pose_trans(W3, p[0,0,h,0,0,0])", "end"),
        *("def g():", "  global n = n + 1", "  global W1 = W2", "  return n < 3", "end"),
    ]
    certain = [
        "movej(W1)", "movel(W2)", "movec(W2, W4)", "movec(path[i], W1)", "movej(get_inverse_kin(W3))", "movel(pose_trans(Plane, F5))", "movej(pose_trans(Plane, F6))", "movej(path[i])", "movej(path[1])",
        "movej(q9)", f"movel({six(POSES[10])})", "V = W4", "movej(V)", "W1 = W2", "i = 1", f"set_tcp(p{written(TOOLS[1])})", f"set_tcp(p{written(TOOLS[0])})",
        "if random() > 0.5:\n    W2 = W3\n    movej(W1)\n  else:\n    movej(W4)\n  end",
        "k = 0\n  while k < 2:\n    movej(path[k])\n    k = k + 1\n  end",
        "if i == 0:\n    W3 = W4\n  end",
    ]  # fmt: skip
    doubtful = [
        "if f():\n    movej(W1)\n  elif g():\n    movej(W2)\n  end", "while g():\n    W2 = W4\n  end", "if i == 1 and f():\n    movej(W3)\n  end",
        "q0 = get_inverse_kin(W3)", "movej(q0)", "movel(pose_trans(get_actual_tcp_pose(), p[0,0,0.005,0,0,0]))", "W1[2] = W1[2] + 0.005", "movej(pose_trans(W3, p[0,0,0.005,0,0,0]))", "W2 = pose_trans(W2, p[0,0,0.004,0,0,0])",
        "movej(c())", "movej(s.at)", "s.at = W1", "movej(s.all[i])", f"movej(get_inverse_kin(W3, tcp=p{written(TOOLS[0])}))", "movej(get_inverse_kin(pose_trans(W4, p[0,0,h,0,0,0])))",
        "path[0] = pose_trans(path[0], p[0,0,h,0,0,0])", "if path[1][0] > W1[0]:\n    movej(path[0])\n  end", "h = W1[2] * 0.01", "h = h + path[i][0] * 0.01", "movej(pose_add(W3, p[0,0,h,0,0,0]))", "set_tcp(p[0,0,h,0,0,0])", "if W4[0] > W3[0]:\n    movej(W4)\n  end",
        "z = 0.01\n  movej(pose_trans(W4, p[0,0,z,0,0,0]))", "n = 0\n  while n < 3:\n    W4 = pose_add(W4, p[0,0,0.003,0,0,0])\n    movej(W4)\n    n = n + 1\n  end",
    ]  # fmt: skip
    body = draw(st.lists(st.sampled_from(certain + doubtful), min_size=1, max_size=7))
    return program(*lines, *body, "movej(W2)")


def generated(examples):
    return settings(max_examples=examples, deadline=None, derandomize=True)


@generated(15)
@given(statements())
def test_all_moves_that_are_not_refused_are_right(text):
    check_drawn(text)


def check_drawn(text):
    try:
        check_moves(text)
    except ProgramFault:
        reject()  # a name that has no value yet


def check_moves(text):
    """Each move of the true arm ends where it should, or its line is refused; return the lines that are."""
    run = run_rapid if text.startswith("MODULE") else run_urscript
    before, after = (Controller(CHAIN, DESIGN, Q[0]) for _ in range(2))
    try:
        done = outcome(text, partial=True)
    except InputError as refusal:
        return {move["line"] for move in refusal.finding.values["refused"]}
    lines = run(text, before).lines
    run(next(iter(done.contents.values())).decode("latin-1"), after)
    wrong = (missed(before.moves, after.moves) > 1e-6).any(axis=1)
    refused = {move["line"] for move in done.refused}
    assert {line for line, is_wrong in zip(lines, wrong, strict=True) if is_wrong} <= refused
    return refused


# RAPID

FREE = "[9E9,9E9,9E9,9E9,9E9,9E9]"


def mm(pose):
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    place = ",".join(f"{1e3 * value:.9f}" for value in pose[:3, 3])
    return f"[{place}],[{','.join(f'{value:.12f}' for value in (w, x, y, z))}]"


def robtarget(k, tool=0, work=0):
    """Return the k-th good pose of a tool in a work object, with the configuration of the controller's model."""
    users, own = (matrix(frame) for frame in OBJECTS[work])
    return robtarget_at(Q[k], np.linalg.inv(users @ own) @ tool_point(k, tool))


def robtarget_at(q, pose=None):
    """Return a pose with the configuration of joints q, without one that of the flange at q."""
    quarters = np.floor(q / (0.5 * np.pi)).astype(int)
    there = forward(CHAIN, DESIGN, q[None])[0] if pose is None else pose
    return f"[{mm(there)},[{quarters[0]},{quarters[3]},{quarters[5]},0],{FREE}]"


def jointtarget_at(q):
    return f"[[{','.join(f'{value:.12f}' for value in np.rad2deg(q))}],{FREE}]"


DATA = tuple(f"PERS tooldata t{k}:=[TRUE,[{mm(matrix(TOOLS[k]))}],[1,[0,0,1],[1,0,0,0],0,0,0]];" for k in range(3))
DATA += tuple(
    f'PERS wobjdata w{k}:=[FALSE,TRUE,"",[{mm(matrix(OBJECTS[k][0]))}],[{mm(matrix(OBJECTS[k][1]))}]];'
    for k in range(3)
)


def module(data, main, *routines):
    lines = [f"  {line}" for line in main]
    return "\r\n".join(["MODULE Work", *DATA, *data, "PROC main()", *lines, "ENDPROC", *routines, "ENDMODULE", ""])


A = f"CONST robtarget a:={robtarget(1)};"
B = f"CONST robtarget b:={robtarget(2)};"
LIST = f"CONST robtarget list{{3}}:=[{robtarget(1)},\r\n    {robtarget(2)},\r\n    {robtarget(3)}];"
RAPID_FORMS = {
    "names": ([A, B], ["MoveJ a,v100,fine,t0;", "movel B,v100,fine,T0\\WObj:=W0;"]),
    "in place": ([], [f"MoveJ {robtarget(1)},v100,fine,t0;"]),
    "three tools and work objects": ([], [f"{move} {robtarget(1 + k, tool, work)},v100,fine,t{tool}\\WObj:=w{work};" for k, (move, tool, work) in enumerate((move, tool, work) for tool in range(3) for work in range(3) for move in ("MoveJ",))]),
    "assigned": ([A, B, "VAR robtarget now;"], ["now:=a;", "MoveJ now,v100,fine,t0;", "now:=b;", "MoveJ now,v100,fine,t0;"]),
    "array": ([LIST], ["FOR i FROM 1 TO Dim(list,1) DO", "  MoveJ list{i},v100,fine,t0;", "ENDFOR", "MoveJ list{2},v100,fine,t0;"]),
    "while": ([LIST, "VAR num n:=1;"], ["WHILE n<=3 DO", "  MoveJ list{n},v100,fine,t0;", "  Incr n;", "ENDWHILE"]),
    "test": ([A, B, "VAR num n:=2;"], ["TEST n", "CASE 1,3:", "  MoveJ a,v100,fine,t0;", "DEFAULT:", "  MoveJ b,v100,fine,t0;", "ENDTEST"]),
    "if": ([A, B, "VAR robtarget now;"], ["IF DInput(di1)=1 THEN", "  now:=a;", "ELSEIF DInput(di1)=2 THEN", "  now:=a;", "ELSE", "  now:=b;", "ENDIF", "IF TRUE MoveJ now,v100,fine,t0;"]),
    "offset": ([A, B], ["MoveJ a,v100,fine,t0;", "MoveL Offs(b,0,0,20),v100,fine,t0;"]),
    "along the tool": ([A], [r"MoveJ RelTool(a,0,5,-20\Rx:=3\Ry:=-4\Rz:=10),v100,fine,t0;"]),
    "circle": ([A, B], [f"MoveJ {robtarget(3)},v100,fine,t0;", "MoveC a,b,v100,fine,t0;"]),
    "joints": ([f"CONST jointtarget home:={jointtarget_at(Q[4])};"], ["MoveAbsJ home\\NoEOffs,v100,fine,t0;"]),
    "arc": ([f"CONST robtarget a:={robtarget(1, 1, 1)};", f"CONST robtarget b:={robtarget(2, 1, 1)};"], ["MoveJ a,v100,fine,t1\\WObj:=w1;", "ArcL b,v100,sm1,wd1\\Weave:=wv1,fine,t1\\WObj:=w1;"]),
    "spot": ([A, B], ["MoveJ a,v100,fine,t0;", "SpotL b,v100,spot1\\InPos,gun1,t0;"]),
    "trigger": ([A, B], ["MoveJ a,v100,fine,t0;", "TriggL b,v100,tr1\\T2:=tr2,fine,t0;"]),
    "search": ([A, B, "VAR robtarget found;"], ["MoveJ a,v100,fine,t0;", "SearchL\\Stop,di1,found,b,v100,t0;"]),
    "bound of a loop": ([A, B, "VAR robtarget now;"], ["now:=a;", "FOR i FROM 1 TO last() DO", "  MoveJ now,v100,fine,t0;", "ENDFOR"], "FUNC num last()", "  now:=b;", "  RETURN 2;", "ENDFUNC"),
    "error handler": ([A, B], ["MoveJ a,v100,fine,t0;", "RETURN;", "ERROR", "  MoveJ b,v100,fine,t0;", "  TRYNEXT;"]),
}  # fmt: skip
EXTRA = ["sm1", "wd1", "wv1", "spot1", "gun1", "tr1", "tr2", "di1"]  # process data


@pytest.mark.parametrize("form", RAPID_FORMS)
def test_the_true_arm_goes_where_a_perfect_one_would_in_rapid(form):
    """Within 1 µm of the identified arm: numbers are written to 10 nm and 1e-10 of a quaternion."""
    data, main, *routines = RAPID_FORMS[form]
    text = module([*(f"VAR num {name}:=0;" for name in EXTRA), *data], main, *routines)
    assert misses(text, text)[:, 0].max() > 5e-3
    assert misses(text, corrected(text)).max() < 1e-6


GRIP = f"MoveJ {robtarget(1)},v10,fine,grip;"
UNUSED = [
    (program(f"movel({six(POSES[1])})"), {"tools": {"": TOOLS[0], "grip": TOOLS[1]}}),
    (program(f"movel({six(POSES[1])})"), {"works": {"table": TOOLS[1]}}),
    (module([], [f"MoveJ {robtarget(1)},v10,fine,tool0;"]), {"tools": {"": TOOLS[1]}}),
    (module([], [f"MoveJ {robtarget(1)},v10,fine,tool0;"]), {"works": {"w7": TOOLS[1]}}),
    (module([DATA[0].replace("t0", "grip")], [GRIP]), {"tools": {"Grip": TOOLS[1]}}),
    (module([], [GRIP]), {"tools": {"grip": TOOLS[1]}, "works": {"grip": TOOLS[1]}}),
    (module([DATA[0].replace("t0", "grip")], [GRIP]), {"unchanged": frozenset({"eax_a", "Gripper"})}),
]


@pytest.mark.parametrize(("text", "options"), UNUSED)
def test_a_name_that_would_not_be_used_is_refused(text, options):
    with pytest.raises(InputError) as caught:
        outcome(text, **options)
    assert caught.value.finding.code == ("given-twice" if "works" in options and "tools" in options else "no-effect")


def test_the_place_of_a_value_that_is_computed_is_named():
    with pytest.raises(InputError) as caught:
        corrected(program("W = get_actual_tcp_pose()", "V = pose_trans(W, p[0,0,0.1,0,0,0])", "movel(V)"))
    (reason,) = [move for move in caught.value.finding.values["refused"] if move["reason"] == "run-time"]
    assert reason["values"]["where"].endswith("line 2")


UNWATCHED = ["ConfL\\Off;", "ConfJ\\Off;", f"MoveAbsJ {jointtarget_at(flipped(Q[1]))}\\NoEOffs,v100,fine,t0;"]


@pytest.mark.parametrize("moves", ["MoveL R2,~\nMoveJ R3,~", "MoveC R2,R3,~"])
def test_configurations_that_are_not_watched_do_not_count(moves):
    """After ConfL\\Off and ConfJ\\Off the wrist stays as it is, whatever the data of the target say."""
    far = flipped(Q[2])
    assert (np.floor(far / (0.5 * np.pi)) != np.floor(Q[2] / (0.5 * np.pi)))[[3, 5]].all()
    moves = moves.replace("R2", robtarget(2)).replace("R3", robtarget(3)).replace("~", "v100,fine,t0;")
    text = module([], [*UNWATCHED, moves])
    assert misses(text, corrected(text, home=None)).max() < 1e-6


ROUTINES = (
    "PROC set_now() now:=list{1}; ENDPROC",
    "PROC shift(INOUT robtarget p) p.trans.y:=p.trans.y+3; ENDPROC",
    "PROC go(robtarget p) MoveJ p,v100,fine,t0; ENDPROC",
    "FUNC robtarget at(num k) IF k=1 RETURN a; RETURN now; ENDFUNC",
    "FUNC num f(robtarget p) now:=p; RETURN n; ENDFUNC",
    "PROC two(INOUT robtarget p) p:=a; MoveJ now,v100,fine,t0; ENDPROC",
    "FUNC robtarget counted() n:=n+1; RETURN Offs(now,0,0,4); ENDFUNC",
    "PROC twice() go now; now:=b; go now; ENDPROC",
)


@st.composite
def modules(draw):
    """Statements over data of a module: some move, some change what later ones go to, some cannot be corrected."""
    statements = [
        "MoveJ a,v100,fine,t0;", "MoveC b,now,v100,fine,t0;", "MoveJ now,v100,fine,t0;", "MoveJ list{n},v100,fine,t0;", "MoveJ Offs(now,0,0,x),v100,fine,t0;", "MoveJ list{1},v100,fine,now_t;",
        "MoveJ inw,v100,fine,t0\\WObj:=w1;", "MoveJ s.at,v100,fine,t0;", "now:=b;", "now:=list{2};", "a_is:=now;", "MoveJ a_is,v100,fine,t0;", "Incr n;", "n:=1;", "Add x,5;", "x:=0;",
        "now_t:=t1;", "s.at:=a;", "s.at.trans.z:=s.at.trans.z+4;", "set_now;", "shift now;", "shift list{2};", "shift s.at;", "MoveJ RelTool(at(n),0,0,-x),v100,fine,t0;",
        "w1.oframe.trans.x:=w1.oframe.trans.x+2;", "IF DInput(di1)=1 THEN\n  now:=a;\n  set_now;\nENDIF", "FOR k FROM 1 TO 2 DO\n  go list{k};\n  now:=list{k};\nENDFOR",
        "IF f(a)=1 THEN\n  MoveJ now,v100,fine,t0;\nELSEIF f(b)=1 THEN\n  MoveJ now,v100,fine,t0;\nENDIF", "two now;", "x:=a.trans.z*0.01;", "MoveJ counted(),v100,fine,t0;", "x:=x+now.trans.y*0.01;", "now_t.tframe.trans.z:=x;", "IF a.trans.x>b.trans.x THEN\n  now:=list{3};\nENDIF", "FOR k FROM 1 TO f(b) DO\n  go now;\nENDFOR",
        "WHILE n<3 DO\n  go Offs(now,0,0,n);\n  n:=n+1;\nENDWHILE\nn:=1;", "now:=CRobT(\\Tool:=t0);", "SearchL\\Stop,di1,now,b,v100,t0;", "go now;", "twice;",
    ]  # fmt: skip
    body = draw(st.lists(st.sampled_from(statements), min_size=1, max_size=7))
    data = [*(f"VAR num {name}:={number};" for name, number in (("di1", 0), ("n", 1), ("x", 0))), LIST.replace("CONST", "PERS").replace("\r\n", "\n"), DATA[0].replace("t0", "now_t", 1), "RECORD stop", "  robtarget at;", "  num wait;", "ENDRECORD", f"VAR stop s:=[{robtarget(3)},0.5];"]  # fmt: skip
    data += [f"CONST robtarget {name}:={robtarget(*k)};" for name, k in (("a", (1,)), ("b", (2,)), ("inw", (6, 0, 1)))]
    data += [f"VAR robtarget {name}:={robtarget(k)};" for name, k in (("now", 4), ("a_is", 5))]
    routines = []
    for routine in reversed(ROUTINES):  # those that are called
        name = re.findall(r"(\w+)\(", routine)[0]
        routines += [routine] * (re.search(rf"\b{name}\b", " ".join([*body, *routines])) is not None)
    return module(data, [*body, "MoveJ now,v100,fine,t0;"], *routines)


@generated(20)
@given(modules())
def test_no_move_of_a_module_is_left_uncorrected_in_silence(text):
    check_drawn(text)


# written without a look at the code: each move whose line has no R is right by an interpreter's run
BLIND_SCRIPTS = {
    "alias assigned twice": "c=a\nc=b\nmovel(c)\nmovel(a)",
    "element of a list that is read": "l=[a,b]\nk=0\nmovel(l[k]) #R\nx=a[0]\nmovel(a)",
    "tool changed in part later": "t=T1\nset_tcp(t)\nmovel(a) #R\nt[2]=0.2",
    "tool with two values": "t=T1\nset_tcp(t)\nmovel(a) #R\nt=T2\nset_tcp(t)\nmovel(b) #R",
    "tool in the second operand": "if a[0]>9 and set_tcp(T1):\nsync()\nend\nmovel(b) #R",
    "product of products": "movep(pose_trans(a,pose_trans(p[0,0,0.01,0,0,0],p[0,0.01,0,0,0,0])))",
    "function named as a point": "def a():\nreturn 1\nend\nmovel(a) #R\nmovel(b)",
    "arguments by name": "movel(a=1.2, pose=a)\nmovel(v=1, a=a[0], pose=b)",
    "function under two tools": "def f():\nmovel(b) #R\nend\ndef g():\nset_tcp(T1)\nf()\nend\nf()\ng()",
    "value printed": "textmsg(a)\nmovel(a)",
    "frame that is the point": "movel(pose_trans(a,a)) #R",
    "continue": "k=0\nwhile k<2:\nk=k+1\nset_tcp(T1)\nif k<2:\ncontinue\nend\nset_tcp(T0)\nmovel(a)\nend",
    "break with another tool": "while True:\nset_tcp(T1)\nif random()>0.1:\nbreak\nend\nset_tcp(T0)\nend\nmovel(a) #R",
    "return with another tool": "def f():\nif random()>0.1:\nset_tcp(T1)\nreturn 1\nend\nreturn 2\nend\nf()\nmovel(a) #R",
    "qnear that is printed": "q=Q2\nmovej(get_inverse_kin(b,q))\nmovej(q)\nd=q\ntextmsg(d)",
    "points exchanged": "c=a\na=b\nb=c\nmovel(a) #R\nmovel(b) #R",
    "local point of the name": "def f():\nlocal a=P5\nmovel(a)\nend\nf()\nmovel(a)",
    "given to a function that changes it": "def f(x):\nx[2]=0.1\nreturn x\nend\nd=f(a)\nmovel(a)",
    "list of lists": "l=[[a,b],[b,a]]\nmovel(l[0][1]) #R\nmovel(b)",
    "condition that moves": "def f():\nmovel(a)\nreturn True\nend\nif f() and f():\nmovel(b)\nend",
    "tool of a parameter": "def f(t):\nset_tcp(t)\nmovel(a) #R\nend\nf(T1)",
    "number by number": "d=p[a[0],a[1],a[2],a[3],a[4],a[5]]\nmovel(d) #R\nmovel(a)",
    "global of a function": "def f():\nglobal a=b\nend\nf()\nmovel(a)\nmovel(b)",
    "tool made of one step twice": "s=p[0,0,0.01,0,0,0]\nset_tcp(pose_trans(s,s))\nmovel(a)",
    "one step twice": "s=p[0,0,0.01,0,0,0.1]\nmovel(pose_trans(a,pose_trans(s,s)))",
    "offset of two names": "h=0.01\nk=h\nmovel(pose_trans(a,p[0,0,k*2,0,0,0]))",
    "offset that counts": "h=0\nwhile h<0.02:\nmovel(pose_add(a,p[0,0,h,0,0,0])) #R\nh=h+0.01\nend\nmovel(a)",
}  # fmt: skip
BLIND_MODULES = {
    "parameter by value that is changed": ("MoveJ a,~\nx:=f(a);", "FUNC num f(robtarget r)\nr.trans.x:=0;\nRETURN 1;\nENDFUNC"),
    "element by reference": ("chg list{2};\nMoveJ list{1},~ !R\nMoveJ list{2},~ !R", "PROC chg(INOUT robtarget r)\nr.trans.z:=r.trans.z+3;\nENDPROC"),
    "component by reference": ("chg v.trans;\nMoveJ v,~ !R\nMoveJ a,~", "PROC chg(INOUT pos r)\nr.z:=r.z+3;\nENDPROC"),
    "tool by reference in a condition": ("IF load(t0) THEN\nENDIF\nMoveJ a,~ !R", "FUNC bool load(PERS tooldata t)\nt.tframe.trans.z:=5;\nRETURN TRUE;\nENDFUNC"),
    "Offs of Offs": ("MoveJ Offs(Offs(a,1,0,0),0,0,1),~",),
    "RelTool of Offs of a point that is read": ("MoveJ RelTool(Offs(a,0,0,2),0,0,-2\\Ry:=9),~\nx:=a.trans.x;",),
    "upper case": ("MOVEJ A,V100,FINE,t0;\nX:=a.TRANS.z;",),
    "choice by a component": ("TEST a.trans.x\nCASE b.trans.x:\nMoveJ v,~\nDEFAULT:\nMoveJ a,~\nENDTEST",),
    "compact IF that assigns": ("IF x=0 v:=b;\nMoveJ v,~",),
    "loops in loops": ("FOR i FROM 1 TO 2 DO\nFOR j FROM 1 TO 2 DO\nMoveJ list{i},~\nENDFOR\nENDFOR",),
    "element by a sum": ("MoveJ list{1+1},~\nMoveJ list{3},~",),
    "recursion": ("again 2;", "PROC again(num k)\nMoveJ a,~\nIF k>0 again k-1;\nENDPROC"),
    "point of a function": ("MoveJ f(),~ !R\nMoveJ a,~", "FUNC robtarget f()\nRETURN a;\nENDFUNC"),
    "points exchanged": ("v:=w;\nw:=v;\nMoveJ v,~ !R",),
    "changed in a routine after the move": ("MoveJ v,~ !R\nset;\nMoveJ v,~ !R", "PROC set()\nv.trans.z:=v.trans.z+2;\nENDPROC"),
    "point of the routine": ("own;\nMoveJ a,~", "PROC own()\nVAR robtarget a:=R5;\nMoveJ a,~\nENDPROC"),
    "tool assigned after the move": ("MoveJ a,~ !R\nt0:=t1;\nMoveJ b,~ !R",),
    "work object changed after the move": ("MoveJ inw,v100,fine,t0\\WObj:=w1; !R\nw1.uframe.trans.z:=5;\nMoveJ a,~",),
    "point by value": ("go list{2};\nMoveJ list{2},~", "PROC go(robtarget r)\nMoveJ r,~ !R\nENDPROC"),
    "counted by a loop": ("x:=1;\nWHILE x<3 DO\nMoveJ list{x},~\nIncr x;\nENDWHILE",),
    "where a search ends": ("SearchL\\Stop,di1,v,b,v100,t0;\nMoveJ v,~ !R",),
    "counter named as a number": ("FOR x FROM 1 TO 3 DO\nMoveJ Offs(a,0,0,x),~ !R\nENDFOR\nMoveJ Offs(b,0,0,x),~",),
}  # fmt: skip
BLIND_DATA = [A, B, LIST.replace("CONST", "VAR").replace("\r\n", ""), f"CONST robtarget inw:={robtarget(6, 0, 1)};"]
BLIND_DATA += [f"VAR robtarget v:={robtarget(3)};", f"VAR robtarget w:={robtarget(4)};", "VAR num x:=0;", "VAR num di1:=0;"]  # fmt: skip
SHORT = {**{f"T{k}": f"p{written(tool)}" for k, tool in enumerate(TOOLS)}, "Q2": written(Q[2]), "P5": six(POSES[5]), "R5": robtarget(5), "~": "v100,fine,t0;"}  # fmt: skip


@pytest.mark.parametrize(
    "case", [*BLIND_SCRIPTS.values(), *BLIND_MODULES.values()], ids=[*BLIND_SCRIPTS, *BLIND_MODULES]
)
def test_a_program_that_was_written_blind_is_refused_or_right(case):
    main, *routines = [case] if isinstance(case, str) else case
    parts = [re.sub(r"\bT\d|Q2|P5|R5|~", lambda match: SHORT[match[0]], part).split("\n") for part in (main, *routines)]
    script = program(f"a={six(POSES[1])}", f"b={six(POSES[2])}", *parts[0])
    text = (
        script
        if isinstance(case, str)
        else module(BLIND_DATA, parts[0], *(line for part in parts[1:] for line in part))
    )
    marked = {number for number, line in enumerate(text.splitlines(), 1) if line.endswith(("#R", "!R"))}
    assert check_moves(text) == marked


@pytest.mark.soak
@generated(2000)
@given(st.one_of(statements(), modules()))
def test_many_programs(text):
    check_drawn(text)


# what was written is read again


FAULTS = {
    "a change is lost": lambda first, second: [first],
    "a digit is lost": lambda first, second: [first, second._replace(text="0.3")],
    "two are exchanged": lambda first, second: [first._replace(text=second.text), second._replace(text=first.text)],
    "a move is added": lambda first, second: [first._replace(text=f"{first.text},0,0,0,0,0])\n  movel(p[{first.text}"), second],
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_writing_is_found_before_anything_is_written(monkeypatch, fault):
    text = program(f"W = {six(POSES[1])}", "movej(W)", f"movel({six(POSES[2])})", f"movej({written(Q[3])})")
    real = corrected_text.changes_of
    monkeypatch.setattr(
        corrected_text, "changes_of", lambda *given: FAULTS[fault](*real(*given)[:2]) + real(*given)[2:]
    )
    with pytest.raises(InputError) as caught:
        corrected(text)
    assert caught.value.finding.code == "reread"


@pytest.mark.parametrize(("moves", "expected"), [(0, 1), (2, 4), (3, 5)])
def test_origins_beyond_those_that_are_tried_are_unknown(moves, expected):
    """Moves with two targets each: of more than four origins one stands for the others, None."""
    targets = [SimpleNamespace(goals=[type("Goal", (), {"argument": None})() for _ in range(2)]) for _ in range(moves)]
    origins = correct_program_module._ends(targets)
    assert (len(origins), None in origins) == (expected, expected != 4)
