"""Loops with a known number of turns: what the n-th turn assigns is what its moves use, and no other turn's."""

import pytest
from tests.host.test_program_corrections import ProgramRefused, corrected, misses, module, program
from tests.host.test_program_indexes import LISTS, NEARS, POINTS, THREE_TOOLS, UNDER_TOOLS, turns

SCRIPTS = {
    "a tool for each": (f"path = {UNDER_TOOLS}", f"tools = {THREE_TOOLS}", *turns("i", 3, "set_tcp(tools[i])", "movej(path[i])")),
    "kept in names": (f"path = {POINTS}", f"near = {NEARS}", *turns("i", 3, "w = path[i]", "q = near[i]", "movej(get_inverse_kin(w, qnear=q))")),
    "from the last": (
        f"path = {UNDER_TOOLS}", f"tools = {THREE_TOOLS}", "i = 2", "while i >= 0:", "  set_tcp(tools[i])", "  movej(path[i])", "  i = i - 1", "end",
    ),
    "left early": (
        f"path = {UNDER_TOOLS}", f"tools = {THREE_TOOLS}",
        *turns("i", 3, "set_tcp(tools[i])", "if random() > 0.5:", "  break", "end", "movej(path[i])"), "movej(path[i - 1])",
    ),
    "a turn left out": (
        f"path = {UNDER_TOOLS}", f"tools = {THREE_TOOLS}", "i = -1", "while i < 2:", "  i = i + 1", "  set_tcp(tools[i])", "  if i == 1:", "    continue", "  end", "  movej(path[i])", "end",
    ),
    "within another": (
        f"path = {UNDER_TOOLS}", f"tools = {THREE_TOOLS}", "n = 0", "while n < 2:", *(f"  {line}" for line in turns("i", 3, "set_tcp(tools[i])", "movej(path[i])")), "  n = n + 1", "end",
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", SCRIPTS)
def test_each_turn_keeps_together(tmp_path, form):
    text = program(*SCRIPTS[form])
    if form == "left early":  # where it is left is known only at run time
        with pytest.raises(ProgramRefused) as caught:
            corrected(tmp_path, text)
        assert {text.splitlines()[one.line - 1].strip() for one in caught.value.refused} >= {"movej(path[i - 1])"}
        return
    assert misses(text, text)[:, 0].min() > 1e-3
    assert misses(text, corrected(tmp_path, text)).max() < 1e-6


NOW = ["PERS tooldata now:=[TRUE,[[0,0,0],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];"]
MODULES = {
    "a tool for each": ["FOR i FROM 1 TO 3 DO", "now:=t{i};", r"MoveJ p{i},v100,fine,now\WObj:=w{i};", "ENDFOR"],
    "by the length of the list": ["FOR i FROM 1 TO Dim(p,1) DO", "now:=t{i};", r"MoveJ p{i},v100,fine,now\WObj:=w{i};", "ENDFOR"],
    "backwards": ["FOR i FROM 3 TO 1 DO", "now:=t{i};", r"MoveJ p{i},v100,fine,now\WObj:=w{i};", "ENDFOR"],
    "every second": ["FOR i FROM 1 TO 3 STEP 2 DO", "now:=t{i};", r"MoveJ p{i},v100,fine,now\WObj:=w{i};", "ENDFOR"],
    "the counter hides a variable": ["n:=2;", "FOR n FROM 1 TO 3 DO", "now:=t{n};", r"MoveJ p{n},v100,fine,now\WObj:=w{n};", "ENDFOR", "now:=t{n};", r"MoveJ p{n},v100,fine,now\WObj:=w{n};"],
}  # fmt: skip


@pytest.mark.parametrize("form", MODULES)
def test_each_turn_keeps_together_in_rapid(tmp_path, form):
    text = module([*LISTS, *NOW], MODULES[form])
    assert misses(text, text)[:, 0].min() > 1e-3
    assert misses(text, corrected(tmp_path, text)).max() < 1e-6


UNKNOWN = {
    "as many as an input says": ["n:=DInput(di1);", "FOR i FROM 1 TO n DO"],
    "as many as fit": ["FOR i FROM 1 TO 400 DO"],
    "steps that are not whole": ["FOR i FROM 1 TO 3 STEP 0.5 DO"],
}


@pytest.mark.parametrize("form", UNKNOWN)
def test_a_loop_of_unknown_turns_is_refused_where_turns_would_mix(tmp_path, form):
    move = r"MoveJ p{i},v100,fine,now\WObj:=w{i};"
    text = module([*LISTS, *NOW, "VAR num di1:=0;"], [*UNKNOWN[form], "now:=t{i};", move, "ENDFOR"])
    with pytest.raises(ProgramRefused) as caught:
        corrected(tmp_path, text)
    assert {text.splitlines()[one.line - 1].strip() for one in caught.value.refused} == {move}


def test_a_counter_hides_a_variable_only_in_its_loop(tmp_path):
    """After it, an assignment is to the module's variable again, which a routine reads."""
    main = ["FOR n FROM 1 TO 2 DO", "go;", "ENDFOR", "n:=3;", "go;"]
    text = module(LISTS, main, "PROC go()", r"MoveJ p{n},v100,fine,t{n}\WObj:=w{n};", "ENDPROC")
    assert misses(text, corrected(tmp_path, text)).max() < 1e-6
