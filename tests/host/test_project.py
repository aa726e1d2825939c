"""A project folder: init writes it, commands take missing options from it, and status names the next command."""

import io
import json
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import told
from result_schema import signed
from session_stream import RIG, session, write_session
from tests.refusals import ended

from truearm.cli.project import defaults, project_model
from truearm.errors import InputError
from truearm.kinds.rig_file import read_rig
from truearm.model.robot_file import builtin_names, builtin_robot
from truearm.plan.branches import branch_of
from truearm.plan.first_rig import reach
from truearm.results import Unusable
from truearm.workflows.project import results_of, sessions_of
from truearm.workflows.project_file import FILE, Project, find_project, format_project, read_project


@pytest.fixture
def project(tmp_path, run, monkeypatch):
    """Make a project of the PUMA without a plan, as the working folder."""
    home = tmp_path / "cell"
    assert run("init", home, "--model", "puma560", "--minutes", 0).code == 0
    monkeypatch.chdir(home)
    return home


def recorded(path, dwells=12):
    write_session(path, session(np.random.default_rng(2), dwells=dwells)[0], RIG)


def test_a_urdf_begins_with_its_branch(tmp_path, run, monkeypatch):
    """A URDF has no [branch]: without one nothing is written, and with one the project keeps it for the commands that draw poses.

    The file is named from where it is typed, and found from the project's folder afterwards.
    """
    shutil.copy(Path(__file__).parents[1] / "data" / "mukca" / "panda.urdf", tmp_path / "arm.urdf")
    monkeypatch.chdir(tmp_path)
    known = ["--model", "arm.urdf", "--base", "panda_link0", "--tip", "panda_link8", "--minutes", 0]
    code, _, err = run("init", tmp_path / "cell", *known)
    assert code == 2
    assert "--branch" in err
    assert not [path for path in (tmp_path / "cell").rglob("*") if path.is_file()]
    assert run("init", "cell", *known, f"--branch={BOUNDS}").code == 0
    project = read_project(tmp_path / "cell" / FILE)
    assert (project.model, project.branch) == ("../arm.urdf", BOUNDS)
    monkeypatch.chdir(tmp_path / "cell")
    assert defaults(Path())["plan"]["ballbar"]["branch"]() == BOUNDS
    assert Path(defaults(Path())["identify"]["model"]()).is_file()


def test_a_project_is_found_from_below(tmp_path):
    (tmp_path / FILE).write_text(format_project(Project("ur5e", serial="2019-1")))
    below = tmp_path / "a" / "b"
    below.mkdir(parents=True)
    assert find_project(below) == tmp_path / FILE
    assert read_project(tmp_path / FILE) == Project("ur5e", serial="2019-1")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('modell = "ur5e"', "unknown key 'modell'"),
        ("", "needs model"),
        ('model = "ur5e"\nbox = 3', "box: 3 "),
        ('model = "a\\nb"', "at most 400 characters, on one line"),
        ("model = ", "truearm.toml"),
        ('model = "' + "x" * 70_000 + '"', "truearm.toml"),
    ],
)
def test_a_wrong_project_is_one_line(tmp_path, run, monkeypatch, text, complaint):
    (tmp_path / FILE).write_text(text)
    monkeypatch.chdir(tmp_path)
    code, out, err = run("status")
    assert (code, out) == (2, "")
    ended(err, complaint)
    assert err.count("\n") == 1


@pytest.mark.parametrize("name", builtin_names())
def test_init_writes_a_rig_that_every_robot_reaches(tmp_path, run, name):
    code, out, err = run("init", tmp_path / "cell", "--model", name, "--minutes", 0)
    assert (code, err) == (0, "")
    assert "rig.toml" in out
    rig = read_rig(tmp_path / "cell" / "rig.toml")
    assert all(point.sigma is None for point in (*rig.chucks.values(), *rig.spheres.values()))
    farthest = max(np.linalg.norm(point.xyz[:2]) for point in rig.chucks.values())
    assert farthest + min(bar.zero for bar in rig.bars.values()) < 1.3 * reach(
        builtin_robot(name), branch_of(builtin_robot(name))
    )
    assert [bar.zero_sigma for bar in rig.bars.values()] == [1e-4, 1e-3]


def test_init_takes_what_was_measured(tmp_path, run):
    given = ["--chucks", "2", "--spheres", "1", "--bars-mm", "460,610", "--measured-with", "machine", "--minutes", "0"]
    assert run("init", tmp_path, "--model", "puma560", *given).code == 0
    rig = read_rig(tmp_path / "rig.toml")
    assert [list(parts) for parts in (rig.chucks, rig.spheres, rig.bars)] == [["c1", "c2"], ["s1"], ["bar46", "bar61"]]
    parts = (*rig.chucks.values(), *rig.spheres.values())
    assert {part.sigma for part in parts} == {bar.zero_sigma for bar in rig.bars.values()} == {2e-5}


BOUNDS = "-150:150,-95:95,-80:80,-165:-25,-150:150,25:165,-160:160"


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("answers", "expected", "sigmas", "named"),
    [
        (["puma560", "tcp://127.0.0.1:7008", "tape"], Project("puma560", address="tcp://127.0.0.1:7008"), {1e-3}, ()),
        (  # one wrong answer to each question that can be wrong: each is named, and the answers after them hold
            ["ur55", "puma560", "127.0.0.1", "rtde://127.0.0.1:9", "ruler", "calliper"],
            Project("puma560", address="rtde://127.0.0.1:9"),
            {1e-4},
            ("ur55", "address", "nothing, tape, calliper, machine"),
        ),
    ],
)
def test_init_asks_on_a_terminal_and_again_after_a_typing_error(
    tmp_path, run, monkeypatch, answers, expected, sigmas, named
):
    monkeypatch.setattr(sys, "stdin", Terminal("\n".join(answers) + "\n"))
    monkeypatch.chdir(tmp_path)
    code, _, err = run("init", "--minutes", 0)
    assert code == 0, err
    assert all(word in err for word in named)
    assert read_project(tmp_path / FILE) == expected
    assert {bar.zero_sigma for bar in read_rig(tmp_path / "rig.toml").bars.values()} == sigmas


def test_the_devices_that_init_offers_are_a_valid_rig(project):
    text = (project / "rig.toml").read_text()
    head, _, others = text.partition("# Other devices")
    used = [line[2:] for line in others.splitlines() if re.match(r"# (\[\[|\w+ = )", line)]
    (project / "all.toml").write_text("\n".join([head, *used]))
    rig = read_rig(project / "all.toml")
    assert (list(rig.lines), list(rig.sockets)) == (["l1"], [("p1", "0")])
    assert not read_rig(project / "rig.toml").lines


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "--model"),
        (("--model", "ur55"), "ur5"),
        (("--model", "ur5e", "--bars-mm", "370,370"), "given-twice"),
        (("--model", "ur5e", "--bars-mm", "460;610"), "wrong-value"),
        (("--model", "ur5e", "--bars-mm", "0.37"), "lengths from 50 to 5000 mm"),
        (("--model", "ur5e", "--measured-with", "ruler"), "'ruler'"),
        (("--model", "ur5e", "--base", "a"), "URDF"),
        (("--model", "ur5e", "--ball-mm", "20"), "no-effect"),
    ],
)
def test_init_refuses_and_leaves_nothing(tmp_path, run, monkeypatch, arguments, complaint):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    code, out, err = run("init", tmp_path / "cell", "--minutes", 0, *arguments)
    assert (code, out) == (2, "")
    ended(err, complaint)
    assert not (tmp_path / "cell" / FILE).exists()


@pytest.mark.parametrize("end", [InputError("the arm cannot reach any pose"), KeyboardInterrupt()])
def test_an_init_that_ends_early_can_be_repeated(tmp_path, run, monkeypatch, end):
    """At the last step, the plan: the files that it made are removed, those that were there stay."""

    def plan(*_):
        raise end

    monkeypatch.setattr("truearm.workflows.plan.plan_ball_bar_files", plan)
    for folder in (tmp_path / "a" / "b", tmp_path / "mine"):
        if folder.name == "mine":
            folder.mkdir()
            (folder / "notes.txt").write_text("mine")
        assert run("init", folder, "--model", "puma560").code in (2, 130)
    assert [path.name for path in sorted(tmp_path.rglob("*"))] == ["mine", "notes.txt"]
    assert run("init", tmp_path / "a" / "b", "--model", "puma560", "--minutes", 0).code == 0


@pytest.mark.parametrize("exists", [True, False])
def test_of_two_inits_at_once_one_makes_the_project(tmp_path, run, monkeypatch, exists):
    """The other is refused, with nothing of it in the folder: its rig once stayed beside the project of another robot."""
    home, other = tmp_path / "cell", tmp_path / "other"
    if exists:
        home.mkdir()

    def plan(*_):
        assert run("init", home, "--model", "ur5e", "--minutes", 0).code == 0

    monkeypatch.setattr("truearm.workflows.plan.plan_ball_bar_files", plan)
    code, _, err = run("init", home, "--model", "puma560")
    assert code == 2
    assert f"{home / FILE} already exists" in err
    assert run("init", other, "--model", "ur5e", "--minutes", 0).code == 0
    contents = [
        {path.relative_to(folder): path.is_file() and path.read_bytes() for path in folder.rglob("*")}
        for folder in (home, other)
    ]
    assert contents[0] == contents[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cell", "other"]


@pytest.mark.parametrize("name", ["file", "file/cell"])
def test_init_where_no_folder_can_be(tmp_path, run, name):
    (tmp_path / "file").write_text("mine")
    told(run("init", tmp_path / name, "--model", "puma560", "--minutes", 0), "invalid-input", place=tmp_path / name)


@pytest.mark.parametrize("name", ["sessions", "results"])
def test_init_where_a_folder_of_the_project_is_a_file_writes_nothing(tmp_path, run, name):
    (tmp_path / name).write_text("mine")
    told(run("init", tmp_path, "--model", "puma560", "--minutes", 0), "invalid-input", place=tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_init_as_json_names_the_files_and_the_plan(tmp_path, run):
    code, out, err = run("init", tmp_path / "cell", "--model", "puma560", "--minutes", 0, "--json")
    assert code == 0, err
    files = [str(tmp_path / "cell" / name) for name in (FILE, "rig.toml")]
    document = json.loads(out)
    assert [finding["code"] for finding in document.pop("findings")] == ["init-next"]
    assert document == {"written": files, "plan": None}


@pytest.mark.parametrize(
    ("file", "options"),
    [("rig.toml", ("--chucks", 3)), ("rig.toml", ("--measured-with", "tape")), ("plan.csv", ("--minutes", 10))],
)
def test_options_of_a_file_that_exists_are_refused(tmp_path, run, file, options):
    (tmp_path / file).write_text("# mine")
    outcome = run("init", tmp_path, "--model", "puma560", *options)
    told(outcome, "no-effect", options[0], reason=tmp_path / file)
    assert [path.name for path in tmp_path.iterdir()] == [file]


def test_status_says_what_comes_next(project, run):
    assert "truearm plan ballbar" in run("status").out
    (project / "sessions").mkdir(exist_ok=True)
    recorded(project / "sessions" / "2026-01-01.mcap")
    state = json.loads(run("status", "--json").out)
    assert state["next"].startswith("truearm identify")
    assert state["sessions"] == [
        {
            "file": str(project / "sessions" / "2026-01-01.mcap"),
            "size_bytes": (project / "sessions" / "2026-01-01.mcap").stat().st_size,
            "complete": True,
            "written": False,
            "other_robot": None,
        }
    ]


def test_status_of_many_sessions_is_short(project, run):
    (project / "sessions").mkdir(exist_ok=True)
    first, *copies = (project / "sessions" / f"{number:02}.mcap" for number in range(12))
    recorded(first)
    for copy in copies:
        copy.write_bytes(first.read_bytes())
    lines = run("status").out.splitlines()
    assert len(lines) <= 15
    assert sum(".mcap, " in line for line in lines) == 3
    assert sum(".mcap, " in line for line in run("status", "--details").out.splitlines()) == 12


def test_status_names_a_fit_that_converged_and_is_not_usable(project, files, run):
    """As many unknowns as rows: the operator is not told to correct programs by it."""
    recorded(project / "sessions" / "2026-01-01.mcap")
    few = files / "few.csv"
    few.write_text("".join((files / "poses.csv").read_text().splitlines(keepends=True)[:7]))
    assert run("identify", few, "--rig", files / "rig.toml").code == 3
    said = run("status").out
    assert f"({Unusable.NO_FREEDOM})" in said
    (result,) = json.loads(run("status", "--json").out)["results"]
    assert (result["status"], result["unusable_because"]) == ("converged", Unusable.NO_FREEDOM)
    assert "truearm correct" not in said


def test_status_does_not_count_a_rehearsal(project, files, run):
    """Neither its session, in another folder, nor its result, newer than the project's own."""
    (project / "rehearsal").mkdir()
    recorded(project / "rehearsal" / "session.mcap")
    own = project / "results" / "2026-01-01.json"
    assert run("identify", files / "poses.csv", "--rig", files / "rig.toml", "--out", own).code == 0
    rehearsed = {**json.loads(own.read_text()), "simulated": True}
    (project / "results" / "2026-01-02.json").write_text(json.dumps(rehearsed))
    state = json.loads(run("status", "--json").out)
    assert state["sessions"] == []
    assert [result["simulated"] for result in state["results"]] == [False, True]
    assert state["next"].startswith("truearm plan")
    recorded(project / "sessions" / "2026-01-01.mcap")
    os.utime(project / "sessions" / "2026-01-01.mcap", (1e9, 1e9))
    os.utime(own, (1e9 - 1, 1e9 - 1))  # only the rehearsal's is newer
    assert json.loads(run("status", "--json").out)["next"].startswith("truearm identify")


def test_status_of_a_recording_that_was_cut_off(project, run):
    """It is recovered, and from then on the recovered one counts."""
    (project / "sessions").mkdir(exist_ok=True)
    path = project / "sessions" / "2026-01-01.mcap"
    recorded(path)
    path.write_bytes(path.read_bytes()[:-30])
    command = json.loads(run("status", "--json").out)["next"]
    assert command == "truearm session recover sessions/2026-01-01.mcap"
    assert run(*command.split()[1:]).code == 0
    state = json.loads(run("status", "--json").out)
    assert state["next"].startswith("truearm identify")
    assert [Path(one["file"]).name for one in state["sessions"]] == ["2026-01-01-recovered.mcap"]


def test_status_leads_from_a_simulated_result_to_no_correction(project, files, run):
    recorded(project / "sessions" / "2026-01-01.mcap")
    result = project / "results" / "2026-01-01.json"
    assert run("identify", files / "poses.csv", "--rig", files / "rig.toml", "--out", result).code == 0
    assert json.loads(run("status", "--json").out)["next"].startswith("truearm correct")
    result.write_text(signed({**json.loads(result.read_text()), "simulated": True}))
    assert json.loads(run("status", "--json").out)["next"] == "truearm record"
    assert "2026-01-01.json, simulated, converged" in run("status").out


def test_a_result_that_is_not_named_is_the_newest_that_was_measured(project, files, run):
    """Before the files that are typed, of which the first may be no result; a rehearsal's is used if there is no other."""
    shutil.copytree(files, "data")
    measured = "data/poses.csv", "--rig", "data/rig.toml"
    result, rehearsed = project / "results" / "2026-01-01.json", project / "results" / "2026-01-02.json"
    assert run("identify", *measured, "--out", result).code == 0
    simulated = {**json.loads(result.read_text()), "simulated": True}
    rehearsed.write_text(json.dumps(simulated))
    (project / "targets.csv").write_text("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n600,100,300,180,0,0\n")
    taken = f"from truearm.toml: {result.relative_to(project)} --model"
    code, _, err = run("validate", *measured)
    assert (code, err.startswith(taken)) == (0, True)
    assert run("correct", "targets.csv", "--out", "corrected.csv").err.startswith(taken)
    assert run("validate", rehearsed, *measured).err.startswith("from truearm.toml: --model")
    assert "gone.csv: no such file" in run("correct", "gone.csv", "--out", "corrected.csv").err
    assert "INPUT..." in run("validate", result).err
    result.unlink()
    assert run("validate", *measured).err.startswith(f"from truearm.toml: {rehearsed.relative_to(project)} --model")


def test_commands_take_what_they_are_not_told(project, files, run, monkeypatch):
    below = project / "notes"
    below.mkdir()
    monkeypatch.chdir(below)
    recorded(project / "sessions" / "2026-01-01.mcap")
    code, _, err = run("inspect")
    assert code == 0
    assert err.splitlines()[0] == "from truearm.toml: ../sessions/2026-01-01.mcap"
    err = run("identify").err
    assert err.startswith("from truearm.toml: ../sessions/2026-01-01.mcap --model puma560 --out ../results/")
    measured = ["identify", files / "poses.csv", "--rig", files / "rig.toml"]
    assert run(*measured).code == 0
    *_, result = every = sorted((project / "results").glob("*.json"))
    assert json.loads(result.read_text())["robot"]["name"] == "puma560"
    code, said, _ = run(*measured, "--out", below / "own.json")
    assert code == 0
    (kept,) = {*(project / "results").glob("*.json")} - {*every}  # a copy of what is typed
    assert kept.read_bytes() == (below / "own.json").read_bytes()
    assert f"Written: ../results/{kept.name}" in said
    kept.unlink()
    assert run("export", "--format", "dh", "--out", below / "robot.csv").err.startswith(
        f"from truearm.toml: ../results/{result.name} --model"
    )
    code, _, err = run("correct", "../sessions/2026-01-01.mcap", "targets.csv", "--out", "corrected.csv")
    # it stands where a result belongs
    assert (code, "2026-01-01.mcap" in err, "targets.csv" in err) == (2, True, False)


def test_a_plan_is_never_written_over_by_default(project, run):
    (project / "plan.csv").write_text("mine")
    err = run("plan", "ballbar", "--poses", 9, "--candidates", 9).err
    assert "--out plan-2.csv" in err
    assert (project / "plan.csv").read_text() == "mine"


def test_status_names_a_session_of_another_robot(project, run):
    assert project_model(project / "sessions") == "puma560"
    for name in ("puma560", "irb120"):
        write_session(project / "sessions" / f"{name}.mcap", [], setup={"model": name})
    text, state = run("status").out, json.loads(run("status", "--json").out)
    assert {Path(one["file"]).stem: one["other_robot"] for one in state["sessions"]} == {
        "puma560": None,
        "irb120": "irb120",
    }
    assert text.count("recorded for another robot") == 1
    assert state["next"].startswith("move sessions/irb120.mcap ")  # truearm identify refuses it beside the other


@pytest.mark.parametrize(
    ("words", "taken"),
    [
        ("box test", "--box /dev/none"),
        ("box reset", "--box /dev/none"),
        ("box config get", "--box /dev/none"),
        ("box config set osr=2048", "--box /dev/none"),
        ("record --duration-s 1", "--box /dev/none --out sessions/.* --address nonsense://x --rig rig.toml"),
        ("record --resume gone.mcap", "--box /dev/none"),
        # without the plan there is nothing that its rig could belong to
        ("simulate --fast --rate 1e9 --out rehearsal --poses 9", "--model puma560"),
        ("simulate --fast --rate 1e9 --out rehearsal --lines 2", "--model puma560"),
        ("simulate --fast --out rehearsal", "--model puma560 --plan plan.csv --rig rig.toml"),
    ],
)
def test_commands_take_box_and_robot_plan_and_rig(project, run, words, taken):
    (project / FILE).write_text(format_project(Project("puma560", address="nonsense://x", box="/dev/none")))
    if words.startswith("simulate"):
        (project / "plan.csv").write_text("not a plan")
    code, _, err = run(*words.split())
    assert code != 0
    assert re.fullmatch(f"from truearm.toml: {taken}", err.splitlines()[0])


def test_without_a_project_status_says_how_to_make_one(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "truearm init" in run("status").err


def test_the_newest_file_is_the_one_written_last(tmp_path):
    """Names need not be dates: what was written last is what a command without options takes."""
    names = ["z-old", "2026-11-25-120000", "a-new"]
    for suffix, of in ((".mcap", sessions_of), (".json", results_of)):
        for k, name in enumerate(names):
            path = tmp_path / f"{name}{suffix}"
            path.write_bytes(b"")
            os.utime(path, ns=(0, (k + 1) * 10**9))
        assert [path.stem for path in of(tmp_path)] == names
        os.utime(tmp_path / f"z-old{suffix}", ns=(0, 3 * 10**9))
        assert [path.stem for path in of(tmp_path)] == ["2026-11-25-120000", "a-new", "z-old"]


def test_a_command_without_a_file_names_the_command_that_makes_one(project, run):
    told(run("inspect"), "usage", "folder sessions (truearm.toml)", "truearm record")
    told(run("report"), "usage", "folder results (truearm.toml)", "truearm identify")
    (project / "results").mkdir(exist_ok=True)
    (project / "results" / "deep.json").write_text(f'{{"a": {90_000 * "["}{90_000 * "]"}}}')
    assert (run("report").code, run("status").code) == (2, 0)


def test_the_first_minutes_are_not_spent_on_mounts_that_show_little_of_the_arm(tmp_path, run):
    """The first poses of all mounts with unknown chucks and spheres seem to be worth the same: 8 of them left 0.53 mm."""
    _, out, _ = run("init", tmp_path / "cell", "--model", "ur5e", "--minutes", 8)
    assert float(re.search(r"will be (\S+) mm RMS", " ".join(out.split()))[1]) < 0.36
