"""What a routine does is remembered by all that it reads: the analysis finds the same as where each call is followed anew."""

from contextlib import contextmanager
from unittest.mock import patch

from hypothesis import given, settings
from hypothesis import strategies as st

from truearm.errors import ProgramError
from truearm.files.programs.dataflow import Flow
from truearm.files.programs.program import Surroundings, parse_program
from truearm.files.programs.targets import targets_of
from truearm.files.programs.values import NOWHERE

FREE = "[9E9,9E9,9E9,9E9,9E9,9E9]"
T = [f"[[{400 + k},100,300],[0,1,0,0],[0,0,0,0],{FREE}]" for k in range(6)]
P = [f"p[0.{k}1,0.1,0.3,0,3,0]" for k in range(1, 7)]
TOOL = "[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]]"

RAPID = [
    "MoveJ a,v10,fine,t0;", "MoveL now,v10,fine,t0;", "MoveL list{n},v10,fine,tool0;", "MoveL Offs(now,0,0,n),v10,fine,t0;", f"MoveJ {T[5]},v10,fine,t0;", "MoveL x,v10,fine,t0;",
    "now:=a;", "now:=b;", "x:=now;", "x:=b;", "now:=x;", "list{n}:=x;", "n:=1;", "Incr n;", "n:=n+1;", "t0:=tool0;", "t0:=t1;", "now.trans.x:=n;", "c:=TRUE;",
    "r0 a;", "r0 now;", "r1 now;", "r1 list{2};", "r2 b,n;", "r2 x,2;", "r3;", "r3;", r"r4 now\k:=n;", "r4 a;", "now:=f(b);", "IF g(n) now:=b;", "MoveJ f(now),v10,fine,t0;",
    "IF c THEN\nnow:=b;\nr3;\nELSE\nr0 b;\nENDIF", "WHILE n<4 DO\nr2 now,n;\nn:=n+1;\nENDWHILE", "FOR k FROM 1 TO 2 DO\nr1 list{k};\nENDFOR", "TEST n\nCASE 1:\nr3;\nRETURN;\nDEFAULT:\nnow:=a;\nENDTEST",
    r"ConfL\Off;", r"ConfL\On;", "PDispSet d;", "PDispOff;", r"SearchL\Stop,di1,now,b,v10,t0;", "away;", "EXIT;", "SetDO d1,n;",
]  # fmt: skip
HEADS = [
    ("PROC main()", "ENDPROC"), ("PROC r0(robtarget x)", "ENDPROC"), ("PROC r1(INOUT robtarget x)", "ENDPROC"), ("PROC r2(robtarget x,num n)", "ENDPROC"), ("PROC r3()", "ENDPROC"),
    (r"PROC r4(robtarget x\num k)", "ENDPROC"), ("FUNC robtarget f(robtarget x)", "RETURN x;\nENDFUNC"), ("FUNC bool g(num n)", "RETURN n>1;\nENDFUNC"), ("TRAP t", "ENDTRAP"),
]  # fmt: skip
DATA = [f"PERS tooldata t0:={TOOL};", f"PERS tooldata t1:={TOOL.replace('100', '50')};", f"CONST robtarget a:={T[0]};", f"CONST robtarget b:={T[1]};", f"VAR robtarget now:={T[2]};",
        f"VAR robtarget x:={T[3]};", f"VAR robtarget list{{2}}:=[{T[4]},{T[0]}];", "VAR num n:=1;", "VAR bool c;", "VAR num d;"]  # fmt: skip
ENDINGS = [
    "",
    "",
    "ERROR\nMoveJ now,v10,fine,t0;\nTRYNEXT;",
    "ERROR\nr3;\nRETRY;",
    "again:\nMoveL now,v10,fine,t0;\nnow:=b;\nGOTO again;",
]

SCRIPT = [
    "movej(A)", "movel(W)", "movel(path[n])", "movel(pose_trans(F, W))", f"movej(get_inverse_kin({P[5]}))", "movel(x)", "W = A", "W = B", "global W = A", "global W = x", "local W = B", "x = W",
    "path[n] = x", "n = 0", "n = n + 1", "global n = 1", "set_tcp(T1)", "set_tcp(p[0,0,0,0,0,0])", "W[2] = n", "r0(A)", "r0(W)", "r1(W, n)", "r2()", "r2()", "W = f(B)", "movej(f(W))",
    "if n == 1:\nW = B\nr2()\nelse:\nr0(B)\nend", "while n < 3:\nr1(W, n)\nn = n + 1\nend", "if f(x):\nreturn A\nend", "h = run T()", "join h", "halt", "away()", "if g(n) and g(2):\nr2()\nend",
]  # fmt: skip
SCRIPT_HEADS = ["def r0(x):", "def r1(x, n=0):", "def r2():", "def f(x):", "def g(n):", "thread T():"]


def bodies(statements, most):
    return st.lists(st.sampled_from(statements), min_size=2, max_size=most)


@st.composite
def modules(draw):
    """Routines that call one another, and change and use the same data."""
    lines = ["MODULE m", *DATA]
    for head, end in HEADS:
        local, ending = draw(st.sampled_from(["", "", "VAR robtarget now;"])), draw(st.sampled_from(ENDINGS))
        lines += [head, local, *draw(bodies(RAPID, 5)), ending, end]
    return "\n".join([*lines, "ENDMODULE"])


@st.composite
def scripts(draw):
    """Functions and a thread within a program, which have the same names as its variables."""
    routines = [line for head in SCRIPT_HEADS for line in (head, *draw(bodies(SCRIPT, 4)), "return x", "end")]
    data = [
        f"A = {P[0]}",
        f"global B = {P[1]}",
        f"W = {P[2]}",
        f"F = {P[3]}",
        f"path = [{P[4]}, A]",
        "n = 0",
        "T1 = p[0,0,0.1,0,0,0]",
    ]
    return "\n".join(["def work():", *data, *routines, *draw(bodies(SCRIPT, 6)), "end"])


@contextmanager
def no_memory():
    """Each call of a routine is followed anew."""
    with patch.object(Flow, "_repeats", lambda flow, trace: False):
        yield


def found(text, language):
    """Everything that the analysis finds; moves from one place to another count once."""
    try:
        program = parse_program(text.encode(), language, Surroundings(tool=NOWHERE))
        motions = [
            (one.start, tuple(one.goals), tuple(one.problems), one.straight, frozenset(one.legs))
            for one in program.motions
        ]
        return motions, targets_of(program, True, False)
    except ProgramError as exc:
        return str(exc)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(modules())
def test_modules_are_the_same_without_the_memory(text):
    with no_memory():
        anew = found(text, "rapid")
    assert found(text, "rapid") == anew


@settings(max_examples=60, deadline=None, derandomize=True)
@given(scripts())
def test_scripts_are_the_same_without_the_memory(text):
    with no_memory():
        anew = found(text, "urscript")
    assert found(text, "urscript") == anew


def test_a_callers_own_variable_is_no_other_callers():
    """set_w assigns to the program's W, and where a caller has its own W, possibly to that."""
    data = [f"global W = {P[0]}", "def set_w():", f"global W = {P[1]}", "end"]
    lines = [*data, "def go():", f"local W = {P[2]}", "set_w()", "movel(W)", "end", "set_w()", "go()", "movel(W)"]
    motions, _ = found("\n".join(["def work():", *lines, "end"]), "urscript")
    assert [len(goals) for _, goals, *_ in motions] == [2, 1]


def test_calls_within_calls_do_not_multiply():
    """Twelve routines, each called three times from different places by the next: 3¹² moves of the innermost."""
    routines = [
        f"PROC r{k}()\nMoveJ a,v10,fine,t0;\nr{k + 1};\nMoveJ b,v10,fine,t0;\nr{k + 1};\nr{k + 1};\nENDPROC"
        for k in range(12)
    ]
    text = "\n".join(["MODULE m", *DATA, *routines, "PROC r12()\nMoveL now,v10,fine,t0;\nENDPROC", "ENDMODULE"])
    motions, targets = found(text, "rapid")
    assert targets.refused == ()
    *_, (_, goals, _, _, legs) = motions
    assert len(goals) == 1
    assert len(legs) == 3  # from a, from b, and from where the routine has just been
