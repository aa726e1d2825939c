"""Lists with one index: the n-th target with the n-th tool, work object, qnear or step, and with no other."""

import numpy as np
import pytest
from tests.host.test_files_programs import module as read_module
from tests.host.test_files_programs import reasons, script
from tests.host.test_program_corrections import (
    DATA,
    POSES,
    TOOLS,
    ProgramRefused,
    Q,
    corrected,
    flipped,
    jointtarget,
    misses,
    module,
    outcome,
    program,
    robtarget,
    six,
    tool_point,
    written,
)


def turns(name, n, *body, first=0):
    return (
        f"{name} = {first}",
        f"while {name} < {n}:",
        *(f"  {line}" for line in body),
        f"  {name} = {name} + 1",
        "end",
    )


POINTS = "[" + ", ".join(six(POSES[k]) for k in (1, 2, 3)) + "]"
NEARS = "[" + ", ".join((written(Q[1]), written(flipped(Q[2])), written(Q[3]))) + "]"
STEPS = f"[{six(np.eye(4))}, p[0,0.004,0,0,0,0], p[0,0,0.01,0,0,0.1]]"
THREE_TOOLS = "[" + ", ".join(f"p{written(one)}" for one in TOOLS) + "]"
UNDER_TOOLS = "[" + ", ".join(six(tool_point(4 + k, k)) for k in range(3)) + "]"
SCRIPTS = {
    "qnear": (f"path = {POINTS}", f"near = {NEARS}", *turns("i", 3, "movej(get_inverse_kin(path[i], qnear=near[i]))")),
    "qnear of a list of structs": (
        "all = ["
        + ", ".join(f"struct(at={six(POSES[k])}, near={written(q)})" for k, q in ((1, Q[1]), (2, flipped(Q[2]))))
        + "]",
        *turns("i", 2, "movej(get_inverse_kin(all[i].at, qnear=all[i].near))"),
    ),
    "tool of its own": (
        f"path = {UNDER_TOOLS}",
        f"tools = {THREE_TOOLS}",
        *turns("i", 3, f"movej(get_inverse_kin(path[i], qnear={written(Q[5])}, tcp=tools[i]))"),
    ),
    "counted from one": (
        f"path = {POINTS}",
        f"near = {NEARS}",
        *turns("i", 4, "movej(get_inverse_kin(path[i - 1], near[i - 1]))", first=1),
    ),
    "passed to a function": (
        "def go(w, q):",
        "  movej(get_inverse_kin(w, qnear=q))",
        "end",
        f"path = {POINTS}",
        f"near = {NEARS}",
        *turns("i", 3, "go(path[i], near[i])"),
    ),
    "kept in a name": (
        f"path = {POINTS}",
        f"near = {NEARS}",
        *turns("i", 3, "q = get_inverse_kin(path[i], qnear=near[i])", "movej(q)"),
    ),
    "chosen by a function's argument": (
        f"path = {POINTS}",
        f"near = {NEARS}",
        "def go(k):",
        "  movej(get_inverse_kin(path[k], qnear=near[k]))",
        "end",
        "go(1)",
        "go(0)",
    ),
    "two numbers that it may be": (
        f"path = {POINTS}",
        f"near = {NEARS}",
        "k = 1",
        "if random() > 0.5:",
        "  k = 2",
        "end",
        "movej(get_inverse_kin(path[k], qnear=near[k]))",
    ),
}


@pytest.mark.parametrize("form", SCRIPTS)
def test_the_true_arm_goes_where_a_perfect_one_would(tmp_path, form):
    text = program(*SCRIPTS[form])
    assert misses(text, text)[:, 0].min() > 1e-3
    assert misses(text, corrected(tmp_path, text)).max() < 1e-6


def tooldata(k):
    return DATA[k].split(":=", 1)[1][:-1]


def array(kind, name, values):
    return f"PERS {kind} {name}{{{len(values)}}}:=[" + ",\r\n    ".join(values) + "];"


LISTS = [
    array("robtarget", "p", [robtarget(1 + k, k, k) for k in range(3)]),
    array("tooldata", "t", [tooldata(k) for k in range(3)]),
    array("wobjdata", "w", [tooldata(3 + k) for k in range(3)]),
    array("jointtarget", "j", [jointtarget(5 + k) for k in range(3)]),
    "VAR num n:=1;",
]
GO = r"MoveJ p{i},v100,fine,t{i}\WObj:=w{i};"
MODULES = {
    "a loop": (["FOR i FROM 1 TO 3 DO", GO, "ENDFOR"],),
    "a loop of unknown length": (["FOR i FROM 1 TO Dim(p,1) DO", GO, "MoveAbsJ j{i}\\NoEOffs,v100,fine,t{i};", "ENDFOR"],),
    "backwards": (["FOR i FROM 3 TO 1 STEP -1 DO", GO, "ENDFOR"],),
    "from the fourth": (["FOR i FROM 4 TO 6 DO", GO.replace("{i}", "{i-3}"), "ENDFOR"],),
    "while": (["WHILE n<=3 DO", GO.replace("{i}", "{n}"), "Incr n;", "ENDWHILE"],),
    "a number": (["go 2;", "go 3;"], "PROC go(num i)", GO, "ENDPROC"),
    "passed to a routine": (
        ["FOR i FROM 1 TO 3 DO", "go p{i},t{i},w{i};", "ENDFOR"],
        "PROC go(robtarget at,PERS tooldata with,PERS wobjdata on)",
        r"MoveJ at,v100,fine,with\WObj:=on;",
        "ENDPROC",
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", MODULES)
def test_the_true_arm_goes_where_a_perfect_one_would_in_rapid(tmp_path, form):
    main, *routines = MODULES[form]
    text = module(LISTS, main, *routines)
    assert misses(text, text)[:, 0].min() > 1e-3
    assert misses(text, corrected(tmp_path, text)).max() < 1e-6


CROSSED = {
    "another index": r"MoveJ p{i},v100,fine,t{n}\WObj:=w{i};",
    "shifted differently": r"MoveJ p{i},v100,fine,t{1}\WObj:=w{4-i};",
}


@pytest.mark.parametrize("form", CROSSED)
def test_what_does_not_belong_together_is_refused(tmp_path, form):
    text = module([*LISTS, "VAR num di1:=0;"], ["FOR i FROM 1 TO 1+DInput(di1) DO", CROSSED[form], "n:=4-n;", "ENDFOR"])
    with pytest.raises(ProgramRefused) as caught:
        corrected(tmp_path, text)
    assert {text.splitlines()[one.line - 1].strip() for one in caught.value.refused} == {CROSSED[form]}


def test_a_step_that_counts_with_the_index_is_not_one_of_a_list():
    """Its number may be any, so it is known at run time only."""
    _, targets = read_module(
        "n:=AInput(a);",
        "MoveJ Offs(list{n},0,0,n),v10,fine,tool0;",
        "MoveJ Offs(list{n},list{n}.trans.x,0,n),v10,fine,tool0;",
        data=["VAR num n:=1;", f"PERS robtarget list{{2}}:=[{robtarget(1)},{robtarget(2)}];"],
    )
    assert {line for line, _ in reasons(targets)} >= {6, 7}


def test_an_index_that_a_thread_changes_is_not_the_same():
    """Between one list and the other it may count."""
    lines = ["global i = 0", "thread T():", "  i = 1 - i", "end", "run T()", f"path = {POINTS}", f"near = {NEARS}"]
    _, targets = script(*lines, "movej(get_inverse_kin(path[i], qnear=near[i]))")
    assert len(targets.revisits) > 0


def test_lists_of_a_hundred_targets_are_followed(tmp_path):
    near = [POSES[1] @ np.diag([1.0, 1.0, 1.0, 1.0]) for _ in range(100)]
    for k, one in enumerate(near):
        one[2, 3] += 1e-4 * k
    path = "[" + ", ".join(map(six, near)) + "]"
    lines = [f"path = {path}", f"near = [{', '.join([written(Q[1])] * 100)}]"]
    text = program(*lines, *turns("i", 100, "movej(get_inverse_kin(path[i], qnear=near[i]))"))
    assert len(outcome(tmp_path, text).targets.places) == 100
