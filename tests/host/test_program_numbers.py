"""Programs that compute with the numbers of their own targets, and literals in less usual forms, executed.

Where a tool, a frame, an offset or a decision depends on a target's numbers, correcting them would change it too: such a
target is refused by its line, or the move gets separate numbers (``split``) and the target stays as it is.
"""

import re

import numpy as np
import pytest
from tests.host.puma_bench import CHAIN, DESIGN, TRUTH
from tests.host.test_program_corrections import (
    LIST,
    POSES,
    TOOLS,
    A,
    B,
    Q,
    corrected,
    matrix,
    misses,
    module,
    program,
    robtarget,
    six,
    tool_point,
    written,
)

from truearm.correct.correction import MARGIN
from truearm.correct.joint_moves import JointMoves
from truearm.correct.model_pair import ModelPair
from truearm.errors import ProgramError
from truearm.workflows.correct_program import (
    CalibrationFrames,
    HowCorrected,
    ProgramOptions,
    ProgramRefused,
    correct_program,
)

W, V = six(POSES[1]), six(POSES[2])
HEIGHT = POSES[1][2, 3]


def sum_to(there, step):
    """Return the pose that pose_add needs before ``step`` to reach a pose."""
    out = np.eye(4)
    out[:3, 3], out[:3, :3] = there[:3, 3] - step[:3, 3], there[:3, :3] @ step[:3, :3].T
    return out


T1, T1_POINT = f"p{written(TOOLS[1])}", six(tool_point(1, 1))
READ_IN_SCRIPT = {  # a ^ at the moves that are refused
    "condition on a copied number": (f"W = {W}", "d = W[2]", f"if d > {HEIGHT - 1e-4}:", "  movej(W) ^", "else:", f"  movej({V})", "end"),
    "condition on a number computed in steps": (f"W = {W}", "d = 2 * W[2]", "high = d > 1.4", "if high:", "  movej(W) ^", "end", f"movej({V})"),
    "bound of a loop": (f"W = {W}", f"n = W[2] / {HEIGHT / 2}", "i = 0", "while i < n:", "  movej(W) ^", "  i = i + 1", "end"),
    "number that a loop changes": (f"W = {W}", "d = W[2]", "while d > 0.5:", "  movej(W) ^", "  d = d - 0.1", "end"),
    "poses compared": (f"W = {W}", f"V = {W}", "if W == V:", "  movej(W) ^", "end", "movej(V) ^"),
    "offset": (f"W = {W}", "movej(W) ^", f"movej(pose_add({V}, p[0,0,W[2]*0.01,0,0,0]))"),
    "pose as the second of a sum": (f"W = {W}", "movej(W) ^", f"movej(pose_add({six(sum_to(POSES[2], POSES[1]))}, W))"),
    "tool": (f"W = {W}", "movej(W) ^", "set_tcp(p[0,0,W[2]*0.01,0,0,0])", f"movej({V})"),
    "tool by its element": (f"W = {W}", "T = p[0,0,0,0,0,0]", "T[2] = W[2]*0.02", "movej(W) ^", "set_tcp(T)", f"movej({V})"),
    "number from a routine": (f"W = {W}", "def high(at):", "  return at[2]*0.01", "end", "movej(W) ^", f"movej(pose_add({V}, p[0,0,high(W),0,0,0]))"),
}  # fmt: skip
READ_IN_RAPID = {
    "offset": ([A, B], ["MoveJ a,v100,fine,t0; ^", "MoveJ Offs(b,0,0,a.trans.z*0.01),v100,fine,t0;"]),
    "offset by a variable": ([A, B, "VAR num z;"], ["z:=a.trans.z-690;", "MoveJ a,v100,fine,t0; ^", "MoveJ Offs(b,0,0,z),v100,fine,t0;"]),
    "along the tool": ([A, B, "VAR num z;"], ["z:=a.trans.z-690;", "MoveJ a,v100,fine,t0; ^", "MoveJ RelTool(b,0,0,z),v100,fine,t0;"]),
    "condition on a variable": ([A, B, "VAR num z;"], ["z:=a.trans.z;", f"IF z>{1e3 * HEIGHT - 0.1} THEN", "MoveJ a,v100,fine,t0; ^", "ELSE", "MoveJ b,v100,fine,t0;", "ENDIF"]),
    "variable that is increased": ([A, B, "VAR num z;"], ["z:=a.trans.z;", "Incr z;", f"IF z>{1e3 * HEIGHT + 0.9} THEN", "MoveJ a,v100,fine,t0; ^", "ENDIF", "MoveJ b,v100,fine,t0;"]),
    "bound of FOR": ([A, B], [f"FOR i FROM 1 TO a.trans.z/{1e3 * HEIGHT - 1} DO", "MoveJ a,v100,fine,t0; ^", "ENDFOR"]),
    "index": ([LIST, B], [f"b_is:=b.trans.z/{1e3 * POSES[2][2, 3]};", "MoveJ b,v100,fine,t0; ^", "IF b_is>0 MoveJ list{1},v100,fine,t0;"]),
    "places compared": ([A, f"CONST robtarget c:={robtarget(1)};"], ["IF a.trans=c.trans THEN", "MoveJ a,v100,fine,t0; ^", "ENDIF", "MoveJ c,v100,fine,t0; ^"]),
    "tool": ([A, B], ["t1.tframe.trans.z:=a.trans.z*0.01;", "MoveJ a,v100,fine,t0; ^", "MoveJ b,v100,fine,t1;"]),
}  # fmt: skip


def refused_lines(tmp_path, text, **options):
    with pytest.raises(ProgramRefused) as caught:
        corrected(tmp_path, text, **options)
    assert {one.remedy for one in caught.value.refused} == {"split"}
    return {one.line for one in caught.value.refused}


def check(tmp_path, text):
    """The moves with a ^ are refused; with numbers of their own, every move of the true arm ends where it should."""
    marked = {k for k, line in enumerate(text.splitlines(), start=1) if "^" in line}
    text = text.replace(" ^", "")
    assert refused_lines(tmp_path, text) == marked
    assert misses(text, corrected(tmp_path, text, split=True)).max() < 1e-6


@pytest.mark.parametrize("form", READ_IN_SCRIPT)
def test_what_is_computed_from_a_target_in_a_script(tmp_path, form):
    check(tmp_path, program(*READ_IN_SCRIPT[form]))


@pytest.mark.parametrize("form", READ_IN_RAPID)
def test_what_is_computed_from_a_target_in_rapid(tmp_path, form):
    data, main = READ_IN_RAPID[form]
    check(tmp_path, module([*data, "VAR num b_is;"], main))


def test_joints_that_are_computed_from_a_pose_are_refused(tmp_path):
    """Kept joints would change with the corrected pose."""
    text = program(f"W = {W}", "movej(W)", f"q = {written(Q[2])}", "q[5] = W[2]", "movej(q)")
    with pytest.raises(ProgramRefused) as caught:
        corrected(tmp_path, text, joint_moves=JointMoves.KEEP)
    assert [(one.line, one.why) for one in caught.value.refused] == [
        (6, "its joint readings are computed from the numbers of a pose")
    ]


def test_a_distance_decides_only_between_known_places(tmp_path):
    """How far the robot is away may decide: both are in the controller's own numbers."""
    text = program(f"W = {W}", "if point_dist(W, get_actual_tcp_pose()) < 2:", "  sleep(1)", "end", "movej(W)")
    corrected(tmp_path, text)
    assert refused_lines(tmp_path, text.replace("get_actual_tcp_pose()", V)) == {6}


def test_where_too_many_targets_decide_all_of_them_do(tmp_path):
    """Their number is bounded; beyond it, any target may be meant."""
    path = ", ".join([W] * 120)
    lines = (f"path = [{path}]", "if path == [1]:", "  sleep(1)", "end", f"movej({V})")
    assert refused_lines(tmp_path, program(*lines)) == {6}
    corrected(tmp_path, program(lines[0].replace(path, W), *lines[1:]))


# numbers of their own


TCP_OF_ITS_OWN = {
    "argument": (f"set_tcp({T1})", "movej(get_inverse_kin(x_w, tcp=p[0,0,0,0,0,0]))"),
    "argument and qnear": (f"set_tcp({T1})", f"movej(get_inverse_kin(x_w, qnear={written(Q[1])}, tcp=p[0,0,0,0,0,0]))"),
    "solved before": ("q = get_inverse_kin(x_w)", f"set_tcp({T1})", "movej(q)"),
}


@pytest.mark.parametrize("form", TCP_OF_ITS_OWN)
def test_a_separate_target_keeps_the_tool_of_its_inverse(tmp_path, form):
    """The tool in force is another one."""
    first, rest = W[2:-1].split(", ", 1)
    text = program(f"x = {first}", *TCP_OF_ITS_OWN[form]).replace("x_w", f"p[x, {rest}]")
    after = corrected(tmp_path, text, split=True)
    assert "tcp=p[" in after.splitlines()[-2]
    assert misses(text, after).max() < 1e-6


def test_a_computed_robtarget_keeps_its_configuration(tmp_path):
    """Its quarter turns choose the configuration, and are written into the separate target."""
    configuration = robtarget(1)[robtarget(1).index("[-1,-1,-1,0],[9E9") :]
    text = module([A, "VAR robtarget c;"], ["c:=a;", "c.trans.z:=c.trans.z+5;", "MoveJ c,v100,fine,t0;"])
    after = corrected(tmp_path, text, split=True, home=None)
    assert f"{configuration},v100" in after
    assert misses(text, after).max() < 1e-6


# short circuits, and literals in other forms


@pytest.mark.parametrize("how", ["x = True or set_tcp({})", "if False and set_tcp({}):\n    sleep(1)\n  end"])
def test_whether_and_or_evaluate_the_second_is_not_guessed(tmp_path, how):
    with pytest.raises(ProgramRefused):
        corrected(tmp_path, program(how.format(T1), f"movej({W})"))


SPREAD = {
    "script, two lines": program(f"W = {W.replace(', ', f',{chr(10)}      ', 1)}", "movej(W)"),
    "script, spaces after signs": program(f"W = p[{W[2:].replace('-', '- ')}", "movej(W)"),
    "rapid, spaces after signs": module([A.replace("-", "- ")], ["MoveJ a,v100,fine,t0;"]),
    "rapid, lines": module([A.replace("],[", "],\r\n    [")], ["MoveJ a,v100,fine,t0;"]),
}


@pytest.mark.parametrize("form", SPREAD)
def test_literals_may_span_lines_and_signs_be_apart(tmp_path, form):
    """Only numbers change, each with its sign."""
    text = SPREAD[form]
    after = corrected(tmp_path, text)
    assert misses(text, after).max() < 1e-6
    without = [re.sub(r"(?:[-+] *)?[0-9.]+", "1", one) for one in (text, after)]
    assert without[0] == without[1]
    assert text != after


# frames


@pytest.mark.parametrize(
    "given", [{}, {"base": (0.1, 0.0, 0.0, 0.0, 0.0, 0.3), "flange": (0.0, 0.0, 0.0, 0.2, 0.0, 0.0)}]
)
def test_a_robots_own_frames_have_the_names_of_its_description(tmp_path, given):
    """Where no mounting is taken out, own frames change nothing: base_link stays half a turn from a Universal Robots base."""
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    base = matrix(given["base"]) if given else turned
    flange = matrix(given["flange"]) if given else np.eye(4)
    path = tmp_path / "p.script"
    path.write_text(program(*(f"movej({six(np.linalg.inv(base) @ POSES[k] @ flange)})" for k in range(3))))
    how = HowCorrected(ModelPair(CHAIN, DESIGN, TRUTH), "newton", 1, Q[0], MARGIN)
    options = ProgramOptions(tool=TOOLS[0], **given)
    texts = [
        correct_program(path, how, CalibrationFrames("base_link", "tool0", brought=False, own=own), options).text
        for own in (False, True)
    ]
    assert texts[0] == texts[1] != path.read_bytes()


def test_a_link_of_a_urdf_is_asked_for_also_in_own_frames(tmp_path):
    path = tmp_path / "p.script"
    path.write_text(program(f"movej({W})"))
    how = HowCorrected(ModelPair(CHAIN, DESIGN, TRUTH), "newton", 1, Q[0], MARGIN)
    names = CalibrationFrames("base", "wrist_3_link", brought=False, own=True)
    with pytest.raises(ProgramError, match="frame wrist_3_link") as caught:
        correct_program(path, how, names, ProgramOptions(tool=TOOLS[0]))
    assert "own frames" not in str(caught.value)


COUNTED = {
    "script": program("n = 0", f"V = {V}", "def at():", "  global n = n + 1", "  x = 0.01", "  return pose_trans(V, p[0,0,x,0,0,0])", "end", "movej(V)", "movej(at())", "if n == 1:", f"  movej({six(POSES[3])})", "end"),
    "rapid": module([A, "VAR num n:=0;"], ["MoveJ a,v100,fine,t0;", "MoveJ at(),v100,fine,t0;", "IF n=1 MoveJ b,v100,fine,t0;"], B, "FUNC robtarget at()", "n:=n+1;", "RETURN Offs(a,0,0,20);", "ENDFUNC"),
}  # fmt: skip


@pytest.mark.parametrize("language", COUNTED)
def test_a_routine_that_is_called_for_a_target_is_not_written_over(tmp_path, language):
    """It may do more than return the target, as this one counts."""
    text = COUNTED[language]
    (call,) = [k for k, line in enumerate(text.splitlines(), start=1) if "(at()" in line or " at()," in line]
    with pytest.raises(ProgramRefused) as caught:
        corrected(tmp_path, text, split=True)
    assert [(one.line, one.remedy) for one in caught.value.refused] == [(call, "")]


PARTS = {
    "element": program(f"path = [{W}, {V}]", "if path[0][2] > 0.1:", "  movej(path[0])", "end", "movej(path[1])"),
    "field": program(f"s = struct(at={W})", "if s.at[2] > 0.1:", "  movej(s.at)", "end", "movej((s.at))"),
    "element in rapid": module([LIST], ["IF list{1}.trans.z>1 MoveJ list{1},v100,fine,t0;", "MoveJ list{2},v100,fine,t0;"]),
    "component in rapid": module(["RECORD stop", "  robtarget at;", "  num wait;", "ENDRECORD", f"VAR stop s:=[{robtarget(1)},0.5];"], ["IF s.at.trans.z>1 MoveJ s.at,v100,fine,t0;"]),
}  # fmt: skip


@pytest.mark.parametrize("form", PARTS)
def test_a_part_of_a_list_is_written_over_with_its_name(tmp_path, form):
    assert misses(PARTS[form], corrected(tmp_path, PARTS[form], split=True)).max() < 1e-6
