"""Hostile and odd input to all commands: one clear line, exit code 2, nothing written or changed."""

import json
import os
import shutil

import pytest
from tests.host import correct_bench
from tests.host import plan_bench as bench
from tests.host.command_line import told
from tests.host.puma_bench import RIG, SIGMA, TRUTH, lengths
from tests.host.puma_bench import table as rows_of
from tests.host.result_schema import signed
from tests.host.target_bench import rapid, script, table

from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import write_table

CORRECT = "correct result.json targets.csv --out new.csv"
PROGRAM = "correct result.json program.mod --own-frames"
PLAN = "plan ballbar --model irb120 --rig irb120.toml --poses 36 --bar bar25 --candidates 60 --out new.csv"
LINE = "plan line --model irb120 --rig irb120.toml --lines 2 --candidates 4 --length-mm 200 --out new.csv"
EXPORT = "export result.json --format urdf --out new.urdf"
MAP = "map result.json --out new.csv --picture-out new.svg"
VALIDATE = "validate result.json rows.csv --rig rig.toml"
REPLAN = PLAN.replace("irb120", "puma560").replace("puma560.toml", "rig.toml").replace("bar25", "short")
HEAD = "x_mm,y_mm,z_mm"
JOINTS = ",".join(f"q{i}_rad" for i in range(1, 7))
URDF = """<robot name="puma560"><link name="chuck_fixture"/><link name="m"/><link name="sphere_fixture"/>
<joint name="a" type="revolute"><parent link="chuck_fixture"/><child link="m"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="b" type="fixed"><parent link="m"/><child link="sphere_fixture"/></joint></robot>"""


@pytest.fixture(scope="module")
def origin(tmp_path_factory):
    """A folder of good files."""
    folder = tmp_path_factory.mktemp("hostile")
    correct_bench.write(folder / "result.json", correct_bench.identified())
    q = correct_bench.good_poses(9)
    targets = correct_bench.nominal_poses(q)
    (folder / "targets.csv").write_text(table(targets, q))
    (folder / "program.mod").write_bytes(rapid(targets, q))
    (folder / "program.script").write_text(script(targets))
    for name in ("precious.csv", "precious.toml", "precious.svg", "precious.mod"):
        (folder / name).write_text("precious")
    (folder / "short.csv").write_text("kind,q1_rad,place,socket\nseat,0,a,0\n")
    (folder / "socket.csv").write_text(f"kind,{JOINTS},place,socket\nseat,0,0,0,0,0,0,a,0\n")
    (folder / "targets.urdf").write_text(table(targets, q))
    write_rig(folder / "rig.toml", RIG)
    write_rig(folder / "irb120.toml", bench.RIGS["irb120"])
    pairs = [("c0", "s0")] * len(q)
    write_table(folder / "rows.csv", rows_of(q, lengths(TRUTH, q, pairs) + SIGMA, pairs), ("rad",) * 6)
    return folder


def result(path, value):
    """The good result with one field replaced, at a path as parameters/3/value."""

    def change(folder):
        document = json.loads((folder / "result.json").read_text())
        *way, last = [int(step) if step.isdigit() else step for step in path.split("/")]
        at = document
        for step in way:
            at = at[step]
        at[last] = value
        return signed(document)  # whoever wrote it meant it

    return change


def edited(name, old, new):
    """A good file with a string replaced."""

    def change(folder):
        was = (folder / name).read_text()
        assert old in was
        return was.replace(old, new)

    return change


def move(**parts):
    """A RAPID module with one move."""
    target = {"x": "500,0,500", "turn": "1,0,0,0", "cf": "0,0,0,0"} | parts
    line = f"MoveL [[{target['x']}],[{target['turn']}],[{target['cf']}],[9E9,9E9,9E9,9E9,9E9,9E9]],v1,fine,tool0;"
    return f"MODULE m\nPROC main() {line} ENDPROC\nENDMODULE"


def seen_from(joints):
    return f"kind,{JOINTS},length_mm,bar,chuck,sphere\nball_bar,{joints},460,short,c0,s0\n"


def visit(joints, pose=0):
    return f"pose,shell,bar,chuck,sphere,{JOINTS}\n{pose},s,b,c,s,{joints}\n"


ALL = (CORRECT, EXPORT, MAP, VALIDATE, f"{REPLAN} --result result.json")
READ_BY_ALL = ("empty", "value huge")  # one reader for all commands
# what stands in the result's place, and what is said of it
RESULTS = {
    "empty": ("", "strict JSON"),
    "binary": (bytes(range(256)), "UTF-8"),
    "a list": ("[1]", "truearm identify"),
    "deep": ("[" * 60_000 + "]" * 60_000, "nested too deeply"),
    "cut off": (lambda folder: (folder / "result.json").read_text()[:5000], "strict JSON"),
    "NaN": (edited("result.json", '"rank_gap": ', '"rank_gap": NaN, "x": '), "strict JSON"),
    "5000 digits": (
        edited("result.json", '"format_version": ', '"format_version": ' + "1" * 5000),
        "integer value out",
    ),
    "tomorrow's": (result("format_version", 99), "format version 99"),
    "of another program": (result("format", "other"), "truearm-result"),
    "of an unknown robot": (result("robot/name", "x\ny"), "other-robot"),
    "no parameters": (result("parameters", []), "parameters: their names"),
    "value null": (result("parameters/0/value", None), "missing or implausible"),
    "value huge": (result("parameters/0/value", 1e300), "missing or implausible"),
    "nominal null": (result("parameters/0/nominal", None), "parameters[0].nominal: expected float, got null"),
    "nominal of another": (result("parameters/0/nominal", 0.5), "other-robot"),
    "a name twice": (result("parameters/0/name", "link1.y"), "parameters"),
    "joints in metres": (result("robot/joint_units", ["m"] * 6), "differ from those"),
    "null space a text": (result("null_space", "none"), "null_space: expected array, got str"),
    "a digit of a value": (edited("result.json", '"value": 0.', '"value": 0.1'), "was changed or damaged"),
    "no version": (edited("result.json", '"format_version"', '"formatversion"'), "format_version"),
    "no checksum": (edited("result.json", '"checksum"', '"checksun"'), "was changed or damaged"),
    "weights beyond": (
        edited("result.json", '"null_space": []', '"null_space": [{"names": ["link1.x"], "weights": [1e999]}]'),
        "number out",
    ),
}
BOMB = '<!DOCTYPE r [<!ENTITY a "1"><!ENTITY b "&a;&a;">]><robot name="&b;"/>'
# beside test_model_urdf's: what reaches the commands
URDFS = {
    "bomb": (BOMB, "document type"),
    "of another robot": (URDF, "differ from those"),
    "of other links": ('<robot name="x"><link name="a"/></robot>', "no link 'chuck_fixture'"),
}
TARGETS = {
    "not a number": (f"{HEAD}\nnan,0,0\n", "row 2 column x_mm: nan"),
    "infinite": (f"{HEAD}\n1e999,0,0\n", "column x_mm: '1e999'"),
    "out of reach": (f"{HEAD}\n9000,0,0\n", "row 2: no joint values within"),
    "in the base": (f"{HEAD}\n0,0,0\n", "row 2: no joint values within"),
    "another alphabet": (f"{HEAD}\n١,2,3\n", "row 2 column x_mm"),
    "half a rotation": (f"{HEAD},rx_deg\n1,2,3,4\n", "has no column ry"),
    "joints beyond": (
        f"{HEAD},rx_deg,ry_deg,rz_deg,{JOINTS}\n500,0,500,0,0,0,50,0,0,0,0,0\n",
        "row 2: no joint values within",
    ),
    "UTF-16": (f"{HEAD}\n1,2,3\n".encode("utf-16"), "not-text"),
    "long line": (f"{HEAD}\n{'1' * 200_000},2,3\n", "field larger than"),
    "an open quote": (f'{HEAD}\n"1,2,3\n', "CSV"),
    "empty": ("", "no-rows"),
    "no rows": (f"{HEAD}\n", "no-rows"),
    "two cells": (f"{HEAD}\n1,2\n", "malformed-file"),
    "an axis twice": ("x_mm,x_m,y_mm,z_mm\n1,2,3,4\n", "given-twice"),
    "one joint": (f"{HEAD},q1_deg\n1,2,3,4\n", "other-robot"),
    "a joint in mm": (f"{HEAD},{JOINTS.replace('q1_rad', 'q1_mm')}\n1,2,3,4,5,6,7,8,9\n", "bad.csv column q1_mm"),
    "far": (f"{HEAD}\n1e9,0,0\n", "column x_mm: '1e9'"),
}
MODULES = {
    "expressions": (move(x="reg1,0,0"), "uncertain-moves"),
    "huge": (move(x="1e30,0,0"), "uncertain-moves"),
    "far": (move(x="90000,0,0"), "uncertain-moves"),
    "no turn": (move(turn="0,0,0,0"), "uncertain-moves"),
    "configuration beyond": (move(cf="1e99,0,0,0"), "uncertain-moves"),
    "configuration a name": (move(cf="a,0,0,0"), "uncertain-moves"),
    "open bracket": (move() + "[[[", "uncertain-moves"),
    "closed bracket": ("MODULE m\n]", "nothing to correct"),
    "in a comment": (move().replace("MoveL", "! MoveL").replace("ENDPROC", "\nENDPROC"), "nothing to correct"),
    "NUL": ("MODULE m\n\0", "not-text"),
    "binary": (b"\xff\xfe\x00binary", "UTF-8"),
    "no move": ("MODULE m\nPROC main()", "no-move"),
    "too large": (" " * (64 * 2**20 + 1), "64 MiB"),
}
SCRIPTS = {
    "not a number": ("\nmovel(p[nan,0,0,0,0,0])", "uncertain-moves"),
    "five": ("movel(p[1,0,0,0,0])", "uncertain-moves"),
    "infinite": ("movel(p[1e999,0,0,0,0,0])", "uncertain-moves"),
    "far": ("movel(p[100,0,0,0,0,0])", "uncertain-moves"),
    "wound up": ("movel(p[0.5,0,0.5,1e9,0,0])", "uncertain-moves"),
    "cut off": ("movel(p[1,0,0,0,0,0", "uncertain-moves"),
    "in a text": ('x = "p[1,2,3,4,5,6]"', "nothing to correct"),
    "empty": ("", "no-move"),
    "brackets": ("[" * 100_000, "no-move"),
    "joints": ("movej([0,0,0,0,0,0])", "give --joint-moves keep or correct"),
    "relative": ("movel(pose_trans(get_actual_tcp_pose(),p[0,0,0.02500,0,0,0]))", "uncertain-moves"),
}
VISITS = {
    "empty": ("", "no-rows"),
    "a gap": (visit("1,0,0,0,0,0", 3), "numbered from 0"),
    "one joint": ("pose,shell,bar,chuck,sphere,q1_rad\n0,s,b,c,s,1\n", "1 joint"),
}
ROWS = {"empty": ("", "no-rows"), "another bar": (seen_from("1,0,0,0,0,0").replace("short", "x"), "not-in-rig")}
RIGS = {
    "no bar": ("", "rig needs at least one chuck"),
    "far": (edited("irb120.toml", "0.06]", "6.0]"), "cannot reach any pose"),
}
OPTIONS = {
    f"{PLAN} --minutes 5": "exclusive",
    f"{PLAN.replace('--poses 36', '--minutes nan')}": "--minutes",
    f"{PLAN.replace('--poses 36', '--poses 99999')}": "ask for fewer --poses",
    f"{PLAN} --dwell-s 1e300": "--dwell-s",
    f"{PLAN} --region nan:1,0:1,0:1": "wrong-value",
    f"{PLAN} --region 1e300:2e300,0:1,0:1": "no-plan",
    f"{PLAN} --branch 9:1,0:1,0:1,0:1,0:1,0:1": "wrong-value",
    f"{PLAN} --branch -9999:9999,0:1,0:1,0:1,0:1,0:1": "joint1 must lie within its limits, -165 to 165 deg",
    f"{PLAN} --reserve-mm 1e9": "'--reserve-mm': 1000000000.0 ",
    f"{PLAN} --reserve-mm 1e5": "lower --reserve-mm",
    f"{PLAN} --result result.json": "robot irb120",
    f"{PLAN} --measured rows.csv": "not-in-rig",
    f"{PLAN} --out irb120.toml": "given-twice",
    f"{PLAN} --out nope/x.csv": "folder nope does",
    f"{PLAN} --program-out new.csv": "given-twice",
    f"{LINE} --length-mm nan": "--length-mm",
    f"{LINE} --rig-out irb120.toml": "given-twice",
    f"{LINE.replace('--lines 2', '--minutes 1')}": "device takes 180 s",
    f"{MAP} --at 1e300,0,0,0,0,0": "1e+300 deg",
    f"{MAP} --cell-mm nan": "--cell-mm",
    "map result.json --out new --picture-out new": "given-twice",
    f"{MAP} --picture-out result.json": "given-twice",
    f"{MAP} --vary 2": "wrong-value",
    f"{MAP} --vary 2,9": "must be two joints between 1 and 6",
    f"{MAP} --vary 1,2": "--vary",
    f"{MAP} --at 1,2": "must be 6 finite numbers",
    f"{MAP} --task 0x10": "wrong-value",
    f"{MAP} --task 9x9 --within 9:1,0:1": "wrong-value",
    f"{MAP} --within 0:1,0:1": "needs-option",
    f"{MAP} --cell-mm 1": "choose larger cells",
    "map result.json --picture-out precious.svg": "file-exists",
    f"{EXPORT} --adjust nope*": "--adjust nope*: matches no parameter",
    f"{EXPORT} --adjust *.gain": "leaves no parameter",
    f"{EXPORT} --over targets.csv": "missing-column",
    f"{EXPORT} --over short.csv": "other-robot",
    "export result.json --format dh-hayati --out precious.toml": "file-exists",
    EXPORT.replace("result.json", "rows.csv"): "observations, where",
    "export result.json --format ur --out new.yaml": "Universal Robots",
    f"{EXPORT} --out result.json": "given-twice",
    f"{CORRECT} --home=0,-90,5,-90,0,90,0": "must be 6 finite numbers",
    f"{CORRECT} --home 1,2,3,4,5,nan": "needs finite numbers",
    f"{CORRECT} --work 1,2,3": "needs 6 numbers",
    f"{CORRECT} --tool 0,0,0,0,0,9999": "rotation vector in deg",
    f"{CORRECT} --model ur5e": "robot ur5e",
    f"{CORRECT} --method magic": "magic",
    f"{CORRECT} --mark": "--mark needs --partial",
    CORRECT.replace("new.csv", "-"): "unreadable-file",
    CORRECT.replace(
        "targets.csv", "targets.urdf"
    ): ".mod, .prg, .modx, .sys, .sysx, .script, .urscript, .src, .dat, .sub, .ls",
    f"{PROGRAM} --out program.mod": "given-twice",
    f"{PROGRAM} --out program.script": "wrong-suffix",
    f"{PROGRAM} --out precious.mod": "file-exists",
    f"{CORRECT} --home 1e300,0,0,0,0,0": "1e+300 deg",
    f"{CORRECT} --work 1e9,0,0,0,0,0": "--work",
    f"{CORRECT} --margin nan": "--margin",
    f"{CORRECT} --margin 1.0": "too near",
    f"{CORRECT} --steps 3": "--steps: 3",
    f"{CORRECT} --strict": "targets.csv:",
    f"{CORRECT} --joint-moves keep": "--joint-moves",
    f"{CORRECT} --unchanged go": "--unchanged",
    f"{CORRECT} --flange 0,0,0,0,0,0": "--flange",
    f"{CORRECT} --tool grip=0,0,100,0,0,0": "give --tool without",
    f"{CORRECT} --work table=0,0,100,0,0,0": "give --work without",
    f"{CORRECT} --out precious.csv": "file-exists",
    f"{CORRECT.replace('result.json', '/dev/null')}": "unreadable-file",
    f"{VALIDATE} --rig irb120.toml": "several rigs need names",
    f"{VALIDATE.replace('rows.csv', 'targets.csv')}": "missing-column",
    VALIDATE.replace("rows.csv", "none.csv"): "missing-file",
    VALIDATE.replace("rows.csv", "result.json"): "session (.mcap) or",
    VALIDATE.replace("rows.csv", "rows.csv rows.csv"): "given-twice",
    "validate result.json socket.csv": "no row can judge",
}


LONG = "a" * 300  # a name that no file system takes
IDENTIFY = "identify t.csv --model puma560"
# of a folder of odd files
ODD = {
    "identify circle t.csv --model puma560": "cannot be read: Too many",
    f"{IDENTIFY} --out circle": "symbolic link loop",
    f"{IDENTIFY} --report circle": "symbolic link loop",
    f"identify {LONG} --model puma560": "cannot be read: File name too long",
    f"{IDENTIFY} --out {LONG}": f"{LONG}: cannot be written: File name too long",
    f"inspect {LONG}.mcap": "cannot be read: File name too long",
    "identify - --model puma560": "unreadable-file",
    f"{IDENTIFY} --out -": "unreadable-file",
    "simulate --out - --fast": "unreadable-file",
    ("identify", "", "--model", "puma560"): "unreadable-file",
    (*IDENTIFY.split(), "--report", ""): "unreadable-file",
    f"{IDENTIFY} --out r.csv": "wrong-suffix",
    "record --box x --out s.bag": "wrong-suffix",
    "plan ballbar --model puma560 --rig r.toml --poses 9 --out plan.txt": "wrong-suffix",
    "export r.json --format urdf --out e.toml": "wrong-suffix",
    "identify pipe.csv --model puma560": "unreadable-file",
    "identify empty --model puma560": "no-rows",
    "identify latin.csv --model puma560": "not-text",
    "identify empty.mcap --model puma560": "not-a-session",
    "identify folder.mcap --model puma560": "unreadable-file",
    "inspect text.mcap": "not-a-session",
    "inspect claims.mcap": "session-incomplete",
    ("identify", "\udcff", "--model", "puma560"): "missing-file",
    ("identify", "t.csv", "--model", "a\x00b"): "wrong-value",
    "identify t.csv --model t.csv": "t.csv:",
    f"{IDENTIFY} --rig =x": "missing-file",
    f"{IDENTIFY} --rig a=": "unreadable-file",
    f"{IDENTIFY} --also-free ,": "matches no parameter",
    f"{IDENTIFY} --free [": "matches no parameter",
    f"{IDENTIFY} --hold-out 1e-300": "less than one row",
    ("demo", "--out", ""): "file-exists",
    "demo --out t.csv": "cannot be used as",
    "demo --out .": "file-exists",
    "demo --rate nan --out new": "--rate must be",
    "record --box socket:// --out s.mcap": "wrong-value",
    "record --box x --out s.mcap --duration-s inf": "finite number",
    "simulate --port 99999": "65535",
    "simulate --rate 300 --out new": "needs-option",
    "simulate --fast --level abc --out new": "not one of",
    f"{IDENTIFY} --seed 3 --hold-out bar=b": "needs-option",
    f"{IDENTIFY} --line-points 9": "no-effect",
    "simulate --fast --stage --out new": "in real time: leave out --fast",
    ("",): "No such command",
}


def odd_files(folder):
    """Make a table, links in a circle, pipes, folders and files that are not what their names say."""
    seats = "".join(f"seat,0,0,0,0,0,{i},a,0\n" for i in range(4))
    contents = {"empty": b"", "empty.mcap": b"", "text.mcap": b"hello", "latin.csv": "kind,é".encode("latin-1")}
    contents |= {
        "t.csv": f"kind,{JOINTS},place,socket\n{seats}".encode(),
        "claims.mcap": b"\x89MCAP0\r\n\x06" + (2**62).to_bytes(8, "little"),  # a record of 2^62 bytes
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    for name in ("folder", "folder.mcap"):
        (folder / name).mkdir()
    (folder / "circle").symlink_to("circle")
    for name in ("pipe.csv", "pipe.mcap"):
        os.mkfifo(folder / name)


def files(folder):
    """Return the names in a folder, with the bytes of its files."""
    return {path.name: path.read_bytes() if path.is_file() else None for path in folder.iterdir()}


@pytest.mark.parametrize(("command", "says"), ODD.items(), ids=[str(command)[-60:] for command in ODD])
def test_odd_input_is_one_line(tmp_path, monkeypatch, run, command, says):
    odd_files(tmp_path)
    before = files(tmp_path)
    monkeypatch.chdir(tmp_path)
    told(run(*(command.split() if isinstance(command, str) else command)), says)
    assert files(tmp_path) == before


def cases():
    """(id, command, what stands in the file `bad` + suffix, suffix, what is said)."""
    for name, (content, says) in RESULTS.items():
        for command in ALL if name in READ_BY_ALL else (CORRECT,):
            yield f"{command.split()[0]} result {name}", command.replace("result.json", "bad"), content, "", says
    for name, (content, says) in URDFS.items():
        for command in (EXPORT, CORRECT):
            yield f"{command.split()[0]} URDF {name}", f"{command} --model bad.urdf", content, ".urdf", says
    kinds = (
        ("targets", CORRECT.replace("targets.csv", "bad.csv"), ".csv", TARGETS),
        (
            "RAPID",
            f"{CORRECT.replace('targets.csv', 'bad.mod').replace('new.csv', 'new.mod')} --own-frames",
            ".mod",
            MODULES,
        ),
        (
            "URScript",
            f"{CORRECT.replace('targets.csv', 'bad.script').replace('new.csv', 'new.script')} --own-frames --tool 0,0,0,0,0,0",
            ".script",
            SCRIPTS,
        ),
        (
            "joints kept",
            "correct result.json bad.script --own-frames --joint-moves keep --out new.script",
            ".script",
            {"only": ("movej([0,0,0,0,0,0])", "no move besides those to joint values")},
        ),
        (
            "Fanuc",
            "correct result.json bad.ls --own-frames --partial --mark --out new.ls",
            ".ls",
            {"no comments": ("/MN\n   1:J PR[1] 100% FINE ;\n/POS\n/END\n", "no-effect")},
        ),
        ("over", f"{EXPORT} --over bad.csv", ".csv", VISITS),
        ("rows", VALIDATE.replace("rows.csv", "bad.csv"), ".csv", ROWS),
        ("measured", f"{REPLAN} --measured bad.csv", ".csv", ROWS),
        ("rig", PLAN.replace("irb120.toml", "bad.toml"), ".toml", RIGS),
    )
    for kind, command, suffix, table_of in kinds:
        for name, (content, says) in table_of.items():
            yield f"{kind} {name}", command, content, suffix, says
    for command, says in OPTIONS.items():
        yield command[:60] + command[-30:], command, None, "", says


@pytest.mark.parametrize(
    ("command", "content", "suffix", "says"), [c[1:] for c in cases()], ids=[c[0] for c in cases()]
)
def test_what_strangers_give(origin, tmp_path, monkeypatch, run, command, content, suffix, says):
    for path in origin.iterdir():
        shutil.copy(path, tmp_path)
    if content is not None:
        made = content(tmp_path) if callable(content) else content
        (tmp_path / f"bad{suffix}").write_bytes(made if isinstance(made, bytes) else made.encode())
    before = files(tmp_path)
    monkeypatch.chdir(tmp_path)
    done = run(*command.split())
    lines = done.err.splitlines(keepends=True)
    if done.finding is not None and done.finding.code == "uncertain-moves":
        lines = lines[-1:]  # below the table of the moves
    last = done._replace(err="".join(lines))
    last.finding = done.finding
    told(last, says)
    assert files(tmp_path) == before
