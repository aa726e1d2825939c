"""Numbers and poses that are computed from constants, and optional arguments: decided as the controller decides."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from tests.host import rapid_machine, urscript_machine
from tests.host.controllers import pose_from
from tests.host.test_files_programs import module as read_module
from tests.host.test_files_programs import reasons, script
from tests.host.test_program_corrections import (
    OBJECTS,
    POSES,
    ProgramRefused,
    corrected,
    matrix,
    misses,
    mm,
    module,
    program,
    robtarget,
    six,
)


def interpolated(_, first, second, share):
    a, b = first.matrix(), second.matrix()
    turn = Slerp([0.0, 1.0], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))([share])[0]
    return urscript_machine.Machine._pose(pose_from(a[:3, 3] + share * (b - a)[:3, 3], turn))


def as_matrix(numbers):
    return rapid_machine.Machine.pose(numbers)


@pytest.fixture
def functions(monkeypatch):
    """Add to the interpreters what the manuals say of these functions: RAPID's angles are in degrees."""
    scripts = {
        "cos": math.cos,
        "sin": math.sin,
        "sqrt": math.sqrt,
        "atan2": math.atan2,
        "floor": math.floor,
        "pow": math.pow,
    }
    for name, function in scripts.items():
        monkeypatch.setitem(urscript_machine.BUILTINS, name, lambda _, *given, f=function: float(f(*given)))
    monkeypatch.setitem(urscript_machine.BUILTINS, "interpolate_pose", interpolated)
    modules = {
        "cos": lambda x: math.cos(math.radians(x)), "sin": lambda x: math.sin(math.radians(x)), "sqrt": math.sqrt, "abs": abs, "max": max,
        "atan2": lambda y, x: math.degrees(math.atan2(y, x)), "round": round, "posemult": lambda a, b: rapid_machine.Machine.numbers(as_matrix(a) @ as_matrix(b)),
        "poseinv": lambda a: rapid_machine.Machine.numbers(np.linalg.inv(as_matrix(a))),
    }  # fmt: skip
    for name, function in modules.items():
        monkeypatch.setitem(rapid_machine.FUNCTIONS, name, lambda _, *given, f=function: f(*given))


SCRIPTS = {
    "angles and roots": (
        f"W = {six(POSES[1])}",
        "movej(pose_trans(W, p[0.01*cos(0.5), 0.01*sin(0.5), sqrt(0.0001), 0, 0, atan2(0.1, 2)]))",
        "r = pow(0.1, 2)",
        "movel(pose_add(" + six(POSES[2]) + ", p[0, r, floor(1.7)*0.01, 0, 0, 0]))",
    ),
    "remainders": (
        "k = 7 % 4",
        f"movej(pose_trans({six(POSES[1])}, p[0, 0, k*0.002, 0, 0, 0]))",
    ),
    "between two poses": (f"movej(interpolate_pose({six(POSES[1])}, {six(POSES[1] @ matrix((0.01, 0, 0.02, 0.1, 0, 0.2)))}, 0.4))",),
    "between two poses that it also goes to": (
        f"A = {six(POSES[1])}",
        f"B = {six(POSES[1] @ matrix((0.01, 0, 0.02, 0.1, 0, 0.2)))}",
        "movej(A)",
        "movel(interpolate_pose(A, B, 0.5))",
        "movel(B)",
    ),
}  # fmt: skip


@pytest.mark.usefixtures("functions")
@pytest.mark.parametrize("form", SCRIPTS)
def test_constants_of_urscript(tmp_path, form):
    text = program(*SCRIPTS[form])
    assert misses(text, corrected(tmp_path, text, split=True)).max() < 1e-6


def posed(frame):
    return f"[{mm(frame)}]"


USERS, OWN = (matrix(one) for one in OBJECTS[1])
OPTIONAL = [r"PROC go(robtarget at\PERS wobjdata on\switch high)", "IF Present(on) THEN", r"MoveJ at,v100,fine,t0\WObj:=on;", "ELSE", "MoveJ at,v100,fine,t0;", "ENDIF", "ENDPROC"]  # fmt: skip
MODULES = {
    "angles and roots": (
        [f"CONST robtarget a:={robtarget(1)};"],
        ["MoveJ Offs(a,10*Cos(30),Sqrt(100),Max(3,Abs(-5))),v100,fine,t0;", r"MoveL RelTool(" + robtarget(2) + r",0,0,5\Rz:=ATan2(1,10)),v100,fine,t0;"],
    ),
    "whole numbers": ([f"CONST robtarget a:={robtarget(1)};"], ["MoveJ Offs(a,(7 DIV 2)*5,(7 MOD 4)*2,0),v100,fine,t0;"]),
    "a frame from frames": (
        [f"PERS pose users:={posed(USERS)};", f"PERS pose more:={posed(OWN)};", "PERS wobjdata here:=" + '[FALSE,TRUE,"",' + f"{posed(np.eye(4))},{posed(np.eye(4))}];", f"CONST robtarget a:={robtarget(2, 0, 1)};"],
        ["here.uframe:=PoseMult(users,more);", r"MoveJ a,v100,fine,t0\WObj:=here;"],
    ),
    "a frame from its inverse": (
        [f"PERS pose back:={posed(np.linalg.inv(USERS @ OWN))};", "PERS wobjdata here:=" + '[FALSE,TRUE,"",' + f"{posed(np.eye(4))},{posed(np.eye(4))}];", f"CONST robtarget a:={robtarget(2, 0, 1)};"],
        ["here.oframe:=PoseInv(back);", r"MoveJ a,v100,fine,t0\WObj:=here;"],
    ),
    "an argument that only some calls give": (
        [f"CONST robtarget a:={robtarget(1, 0, 1)};", f"CONST robtarget b:={robtarget(2)};"],
        [r"go a\on:=w1;", "go b;"],
        *OPTIONAL,
    ),
    "passed on": (
        [f"CONST robtarget a:={robtarget(1, 0, 1)};", f"CONST robtarget b:={robtarget(2)};"],
        [r"via a\on:=w1;", "via b;"],
        *[r"PROC via(robtarget at\PERS wobjdata on)", r"go at\on?on;", "ENDPROC", "PROC other()", "go b;", "ENDPROC"],
        *OPTIONAL,
    ),
    "not given": (
        [f"CONST robtarget a:={robtarget(1, 0, 1)};", f"CONST robtarget b:={robtarget(2)};"],
        [r"go a\on:=w1;", "go b;"],
        r"PROC go(robtarget at\PERS wobjdata on)", "IF NOT Present(on) THEN", "MoveJ at,v100,fine,t0;", "RETURN;", "ENDIF", r"MoveJ at,v100,fine,t0\WObj:=on;", "ENDPROC",
    ),
}  # fmt: skip


@pytest.mark.usefixtures("functions")
@pytest.mark.parametrize("form", MODULES)
def test_constants_of_rapid(tmp_path, form):
    data, main, *routines = MODULES[form]
    text = module(data, main, *routines)
    assert misses(text, text)[:, 0].min() > 1e-3
    assert misses(text, corrected(tmp_path, text)).max() < 1e-6


def test_what_another_file_may_give_is_followed_too(tmp_path):
    """All calls here leave the argument out, but both ways are in the file: neither is left uncorrected in silence."""
    here = f"CONST robtarget b:={robtarget(2)};"
    text = module([here], ["go b;"], r"PROC go(robtarget at\switch fast)", "IF Present(fast) THEN", f"MoveJ {robtarget(3)},v100,fine,t0;", "ENDIF", "MoveJ at,v100,fine,t0;", "ENDPROC")  # fmt: skip
    after = corrected(tmp_path, text)
    assert after.splitlines()[13] != text.splitlines()[13]
    assert "MoveJ [[" in text.splitlines()[13]


def test_a_way_that_no_call_can_reach_is_refused(tmp_path):
    """It is called with the argument only where it was called with it."""
    here = f"CONST robtarget b:={robtarget(2)};"
    moved = f"MoveJ {robtarget(3)},v100,fine,t0;"
    text = module([here], ["go b;"], r"PROC go(robtarget at\switch fast)", "IF Present(fast) THEN", moved, r"go at\fast;", "ENDIF", "MoveJ at,v100,fine,t0;", "ENDPROC")  # fmt: skip
    with pytest.raises(ProgramRefused) as caught:
        corrected(tmp_path, text)
    assert moved in {text.splitlines()[one.line - 1] for one in caught.value.refused}


UNKNOWN = ["movel(p[sqrt(-1),0.1,0.3,0,3,0])", "movel(p[acos(2),0.1,0.3,0,3,0])", "movel(interpolate_pose(p[0.4,0,0.3,0,0,0], p[0.4,0,0.3,0,0,3.1415926], 0.5))",
           "movel(p[pow(10, 400),0,0,0,0,0])", "movel(p[cos(),0,0,0,0,0])", "movel(interpolate_pose(p[0.4,0,0.3,0,0,0], p[0.5,0,0.3,0,0,0], get_analog_in(0)))"]  # fmt: skip


@pytest.mark.parametrize("line", UNKNOWN)
def test_what_has_no_certain_result_is_refused(line):
    _, targets = script("movel(p[0.5,0.2,0.3,0,3,0])", line)
    assert {at for at, _ in reasons(targets)} == {3}


@pytest.mark.parametrize(
    "number", ["Round(2.5)", r"Round(2.46\Dec:=1)", "(-7) MOD 4", "7.5 DIV 2", "7 DIV 0", "Sqrt(-1)"]
)
def test_numbers_of_rapid_that_have_no_certain_result(number):
    _, targets = read_module(f"MoveJ Offs({robtarget(1)},0,0,{number}),v10,fine,tool0;")
    assert len(targets.refused) == 1
