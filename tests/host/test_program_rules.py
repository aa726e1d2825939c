"""What a controller refuses to load, and what a person gives beside a program that it does not use: neither is corrected in silence."""

import numpy as np
import pytest
from tests.host.test_files_programs import FREE, T1, T2, TOOL, WORK, module, parsed, reasons
from tests.host.test_program_corrections import TOOLS, outcome
from tests.host.test_program_corrections import module as moved_by

from truearm.errors import ProgramError
from truearm.files.programs.target_poses import poses_of
from truearm.files.programs.targets import targets_of

DATA = [f"CONST robtarget a:={T1};", f"CONST robtarget b:={T2};", "CONST num n:=1;", f"CONST tooldata t:={TOOL};", f"CONST wobjdata w:={WORK};",
        f"CONST jointtarget j:=[[0,0,0,0,30,0],{FREE}];", f"CONST robtarget list{{2}}:=[{T1},{T2}];"]  # fmt: skip
MOVE = "MoveL a,v10,fine,tool0;"
FIXED = {
    "a target": ["a:=b;"],
    "a component": ["a.trans.z:=5;"],
    "an element": ["list{1}:=b;"],
    "a number": ["n:=2;"],
    "a number that is counted": ["Incr n;"],
    "a tool": ["t.tframe.trans.z:=5;"],
    "a work object": ["w:=wobj0;"],
    "joint readings": ["j.robax.rax_1:=5;"],
    "found by a search": [r"SearchL\Stop,di1,a,b,v10,tool0;"],
    "passed to what assigns to it": ["up a;"],
    "passed by name": [r"up b0\more:=a;"],
    "of the routine": ["k:=3;"],
    "in a loop": ["WHILE TRUE DO", "a:=b;", "ENDWHILE"],
    "the controller's own": ["tool0:=t;"],
    "a counter": ["FOR i FROM 1 TO 2 DO", "i:=2;", "ENDFOR"],
}
UP = [r"PROC up(INOUT robtarget x\INOUT robtarget more)", "x.trans.z:=x.trans.z+1;", "ENDPROC"]


@pytest.mark.parametrize("what", FIXED)
def test_a_module_that_changes_a_constant_is_refused_with_the_line(what):
    lines = FIXED[what]
    inner = lines[0].startswith(("FOR", "WHILE"))  # its second line changes it
    data = [*DATA, f"VAR robtarget b0:={T1};", *UP]
    line = 2 + len(data) + 2 + inner  # after MODULE, the data, PROC and a constant of its own
    with pytest.raises(ProgramError, match=rf"line {line}: \w+ is .*, so no controller loads this module; "):
        module("CONST num k:=2;", *lines, MOVE, data=data)


ALLOWED = {
    "a variable of the routine hides the constant": ["n:=2;", MOVE],
    "a parameter is a copy": ["go a;"],
    "a counter hides it": ["FOR a0 FROM 1 TO 2 DO", MOVE, "ENDFOR"],
}


@pytest.mark.parametrize("what", ALLOWED)
def test_what_only_looks_like_a_change_of_a_constant(what):
    text = ["VAR num n;", *ALLOWED[what], "ENDPROC", "PROC go(robtarget x)", "x.trans.z:=x.trans.z*1;", MOVE]
    data = [*DATA, "CONST num a0:=1;"]
    assert reasons(module(*text, data=data)[1]) == []


def two_modules(first, second):
    return "\n".join(["MODULE one", *first, "ENDMODULE", "MODULE two", *second, "ENDMODULE"])


HIDDEN = {
    "data": ([f"LOCAL CONST robtarget p:={T1};"], ["PROC main()", "MoveL p,v10,fine,tool0;", "ENDPROC"], 6),
    "a tool": ([f"LOCAL PERS tooldata p:={TOOL};"], ["PROC main()", f"MoveL {T1},v10,fine,p;", "ENDPROC"], 6),
    "a routine": (["LOCAL PROC p()", MOVE.replace("a,", f"{T1},"), "ENDPROC"], ["PROC main()", "p;", "ENDPROC"], 8),
    "a function": (["LOCAL FUNC robtarget p()", f"RETURN {T1};", "ENDFUNC"], ["PROC main()", "MoveL p(),v10,fine,tool0;", "ENDPROC"], 8),
    "in a first value": ([f"LOCAL CONST robtarget p:={T1};"], ["PERS robtarget q:=p;", "PROC main()", "MoveL q,v10,fine,tool0;", "ENDPROC"], 5),
}  # fmt: skip


@pytest.mark.parametrize("what", HIDDEN)
def test_what_is_local_to_another_module_is_not_seen(what):
    first, second, line = HIDDEN[what]
    with pytest.raises(ProgramError, match=f"line {line}: p is LOCAL to module one, so module two does not know it"):
        parsed(two_modules(first, second), "rapid")
    whole = parsed(two_modules([one.removeprefix("LOCAL ") for one in first], second), "rapid")
    assert reasons(targets_of(whole, True, False)) == []


def test_a_name_of_ones_own_is_not_another_modules():
    first = [f"LOCAL CONST robtarget p:={T1};", "PROC main()", "go p;", "ENDPROC"]
    second = ["PROC go(robtarget p)", "MoveL p,v10,fine,tool0;", "ENDPROC"]
    program = parsed(two_modules(first, second), "rapid")
    assert reasons(targets_of(program, True, False)) == []


LINE = rf"MoveL {T1},v10,fine,tGrip\WObj:=wTable;"
GIVEN = {
    "a misspelt tool": ({"tools": {"tGrp": TOOLS[1]}}, "no line names tool tgrp, which is given by .*; did you mean tgrip"),
    "a misspelt work object": ({"works": {"wTabel": TOOLS[1]}}, "no line names work object wtabel, which .*; did you mean wtable"),
    "nothing like it": ({"works": {"conveyor": TOOLS[1]}}, "no line names work object conveyor, .*; correct the name, or leave it out"),
    "both": ({"tools": {"tGrip": TOOLS[1]}, "works": {"tgrip": TOOLS[1]}}, "tgrip is given as a tool and as a work object"),
    "the flange": ({"tools": {"tool0": TOOLS[1]}}, "tool0 is predefined; leave it out of the options"),
}  # fmt: skip


@pytest.mark.parametrize("what", GIVEN)
def test_a_tool_that_the_program_does_not_use_is_refused(tmp_path, what):
    options, says = GIVEN[what]
    with pytest.raises(ProgramError, match=says):
        outcome(tmp_path, moved_by([], [LINE]), **options)


def test_a_tool_is_no_work_object():
    """What is given as the one is not used as the other."""
    _, targets = module(LINE, tools={"wtable": TOOLS[1]}, works={"tgrip": TOOLS[2]})
    assert {why for _, why in reasons(targets)} == {"its tool is not a tooldata"}
    _, targets = module(LINE, tools={"tgrip": TOOLS[1]}, works={"wtable": TOOLS[2]})
    assert reasons(targets) == []
    _, frame, tool = poses_of(targets.poses)
    np.testing.assert_allclose(frame[0, :3, 3], TOOLS[2][:3], atol=1e-12)
    np.testing.assert_allclose(tool[0, :3, 3], TOOLS[1][:3], atol=1e-12)
