"""Robot programs: the targets are found, only their numbers change, and nothing hostile does harm."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truearm.errors import ProgramError
from truearm.files.target_programs import MAX_DEPTH, parse_program, poses_of, quadrants_of, read_program, with_poses
from truearm.model.poses import apart, pose_of

RAPID = (
    "MODULE Mod ! caf\xe9 with a target in a comment [[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]\r\n"
    '  CONST string s := "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]";\r\n'
    "  PERS tooldata tool1:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\r\n"
    "  CONST jointtarget home:=[[0,0,0,0,30,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\r\n"
    "  CONST robtarget p10:=[[600.5, -20 ,\t+300],[ 0.5,-.5,5.0E-1,0.5 ],[0,-1,0,1],[9E9,9E+09,9E9,9E9,9E9,9E9]];\r\n"
    "  CONST robtarget pp{2}:=[[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],\r\n"
    "    [[4,5,6],[0,0,0,-1],[1,-2,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]];\r\n"
    "PROC main()\r\n  MoveL [[7,8,9],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,fine,tool1;\r\n"
    "  MoveL Offs(p10,0,0,50),v100,z10,tool1;\r\nENDPROC\r\nENDMODULE"
)
SCRIPT = (
    "def prog():\n  set_tcp(p[0, 0, 0.1, 0, 0, 0])\n  # movel(p[9,9,9,9,9,9])\n  global here = p[0.4,-.2,0.3, 0,3.2,0]\n"
    '  feature = p[1,0,0,0,0,0]\n  textmsg("movej(p[1,2,3,4,5,6])")\n  movej(here, a=1.4, v=1.05)\n'
    "  movel(pose_trans(feature, p[0,0,0.05,0,0,0]), a=1.2)\n  movec(p[0.1,0.2,0.3,0.1,0.2,0.3], p[+0.2,0.2,0.3,0,0,1e-1], r=0)\n"
    "  x = p[0.5,0,0,0,0,0]\nend\n"
)


def test_robtargets_are_found_by_their_form():
    program = parse_program(RAPID, "rapid")
    assert [target.line for target in program.targets] == [5, 6, 7, 9]
    np.testing.assert_allclose(
        poses_of(program)[:, :3, 3], [[0.6005, -0.02, 0.3], *np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]]) * 1e-3]
    )
    # w, x, y, z = ½, −½, ½, ½ is 120° about (−1, 1, 1): x goes to −z, y to −x, z to y
    np.testing.assert_allclose(poses_of(program)[0, :3, :3], [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], atol=1e-15)
    expected = [[0, np.nan, np.nan, -1, np.nan, 0], [0] * 6, [1, np.nan, np.nan, -2, np.nan, 0], [0] * 6]
    found = quadrants_of(program, 6)
    np.testing.assert_array_equal(found[:, [0, 3, 5]], np.array(expected)[:, [0, 3, 5]])
    assert np.isnan(found[:, [1, 2, 4]]).all()
    assert quadrants_of(program, 7) is None


def test_script_targets_are_those_that_moves_go_to():
    program = parse_program(SCRIPT, "urscript")
    assert [target.line for target in program.targets] == [4, 9, 9]
    assert program.left == (2, 5, 8, 10)
    np.testing.assert_allclose(poses_of(program)[0, :3, 3], [0.4, -0.2, 0.3])
    np.testing.assert_allclose(poses_of(program)[0], pose_of(np.array([[0.4, -0.2, 0.3]]), np.array([[0, 3.2, 0]]))[0])
    assert quadrants_of(program, 6) is None


@pytest.mark.parametrize(("text", "kind", "pattern"), [(RAPID, "rapid", "rapid"), (SCRIPT, "urscript", "urscript")])
def test_only_the_numbers_change(text, kind, pattern):
    program = parse_program(text, kind)
    rng = np.random.default_rng(0)
    poses = pose_of(rng.normal(size=(len(program.targets), 3)), rng.normal(size=(len(program.targets), 3)))
    written = with_poses(program, poses).decode("latin-1")
    again = parse_program(written, kind)
    # 10 nm and 1e-10 of a quaternion or 1 nrad as written
    np.testing.assert_allclose(apart(poses_of(again), poses), 0.0, atol=1e-8)
    for before, after in zip(program.targets, again.targets, strict=True):
        assert before.configuration == after.configuration
    assert without(text, program) == without(written, again)


def without(text, program):
    """The text with every number of a target cut out."""
    spans = sorted((number.start, number.end) for target in program.targets for number in target.numbers)
    pieces, at = [], 0
    for start, end in spans:
        pieces.append(text[at:start])
        at = end
    return [*pieces, text[at:]]


def test_unchanged_poses_keep_their_sense_of_turning():
    for text, kind in ((RAPID, "rapid"), (SCRIPT, "urscript")):
        program = parse_program(text, kind)
        again = parse_program(with_poses(program, poses_of(program)).decode("latin-1"), kind)
        old, new = ([[n.value for n in t.numbers] for t in p.targets] for p in (program, again))
        np.testing.assert_allclose(new, old, atol=1e-5)  # 10 nm in a RAPID's mm


@pytest.mark.parametrize(
    ("text", "kind", "says"),
    [
        ("", "rapid", "has no robtarget"),
        ("def f():\nend\n", "urscript", "has no p"),
        ("[[1,2,3]", "rapid", "line 1: a bracket \\[ is not closed"),
        ("\n\n]", "rapid", "line 3: a bracket \\] that nothing opened"),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "rapid", "nested too deeply"),
        ("\n[[x+1,2,3],[1,0,0,0],[0,0,0,0],[1,1,1,1,1,1]]", "rapid", "line 2: a robtarget with expressions"),
        ("[[1,2,3],[1,1,0,0],[0,0,0,0],[1,1,1,1,1,1]]", "rapid", "line 1: the orientation is no unit quaternion"),
        ("[[1e9,2,3],[1,0,0,0],[0,0,0,0],[1,1,1,1,1,1]]", "rapid", "not a place that a robot reaches"),
        ("[[1e9999,2,3],[1,0,0,0],[0,0,0,0],[1,1,1,1,1,1]]", "rapid", "not a place that a robot reaches"),
        ("movel(p[1,2,3,4,5])", "urscript", "line 1: a target p.* must be six plain numbers"),
        ("movel(p[x,2,3,4,5,6])", "urscript", "must be six plain numbers"),
        ("movel(p[1,2,3000,4,5,6])", "urscript", "not a place that a robot reaches"),
        ("movel(p[nan,2,3,4,5,6])", "urscript", "must be six plain numbers"),
        ("a\0b", "rapid", "NUL"),
    ],
)  # fmt: skip
def test_bad_programs_are_one_clear_line(text, kind, says):
    with pytest.raises(ProgramError, match=says) as caught:
        parse_program(text, kind)
    assert "\n" not in str(caught.value)


def test_a_program_that_is_too_large_is_not_read(tmp_path):
    (tmp_path / "a.mod").write_bytes(b" " * (4 * 2**20 + 1))
    with pytest.raises(ProgramError, match="larger than 4 MiB"):
        read_program(tmp_path / "a.mod")


def test_a_large_program_is_read_in_reasonable_work():
    """Half a megabyte of brackets, numbers and words that are no targets: tokens are looked at a bounded number of times."""
    noise = "[[1,2],[3,[4]],x(1,2)];\n" * 20_000
    target = "[[1,2,3],[1,0,0,0],[0,0,0,0],[1,1,1,1,1,1]];"
    program = parse_program(noise + target, "rapid")
    assert [found.line for found in program.targets] == [20_001]


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet="[]()p,;:=.0123456789eE+-\"'!# \nmovelx", max_size=80), st.sampled_from(["rapid", "urscript"]))
def test_any_text_is_read_or_refused(text, kind):
    with contextlib.suppress(ProgramError):
        program = parse_program(text, kind)
        assert program.targets
        assert with_poses(program, poses_of(program))
