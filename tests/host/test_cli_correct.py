"""``truearm correct``, from a noisy calibration to the position that the true robot reaches; bad input."""

import csv
import json
import re
from pathlib import Path
from typing import NamedTuple

import correct_bench
import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, TRUTH, damped
from scipy.spatial.transform import Rotation
from tests.host.findings_bench import listed
from tests.host.target_bench import driven, miss, rapid, script, table
from tests.refusals import ended, shown

from truearm.correct.target_table import parse_targets
from truearm.findings import Finding, Reason
from truearm.kinds.table_file import read_table
from truearm.model.chain import forward, joint_jacobian
from truearm.model.robot_file import load_robot
from truearm.model.robot_mounting import mountings
from truearm.types import Plan
from truearm.workflows.calibration import read_calibration
from truearm_sim.world import World, standard_rig

N = 40
MUKCA = Path(__file__).parents[1] / "data" / "mukca"


class Bench(NamedTuple):
    folder: Path
    q: np.ndarray  # (N, 6) what a perfect robot would do
    targets: np.ndarray  # (N, 4, 4)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("correct")
    correct_bench.write(folder / "result.json", correct_bench.identified())
    q = correct_bench.good_poses(N)
    targets = correct_bench.nominal_poses(q)
    (folder / "targets.csv").write_text(table(targets, q))
    (folder / "program.mod").write_bytes(rapid(targets, q))
    (folder / "program.script").write_bytes(script(targets).encode("latin-1"))
    return Bench(folder, q, targets)


SAME = "0,0,0,0,0,0"
FRAMES = ("--work", SAME, "--flange", SAME, "--tool", SAME)  # the bench's PUMA has frames of its own


def controller(told, q):
    """Return the joints of a controller with the design model for poses, from near q; its solver is not the tested one."""
    q = q.copy()
    for _ in range(60):
        pose = forward(CHAIN, DESIGN, q)
        spin = 0.5 * np.cross(pose[:, :3, :3], told[:, :3, :3], axis=1).sum(axis=2)
        q = q + damped(
            joint_jacobian(CHAIN, DESIGN, q), np.concatenate([told[:, :3, 3] - pose[:, :3, 3], spin], axis=1)
        )
    np.testing.assert_allclose(forward(CHAIN, DESIGN, q), told, atol=1e-7)
    return q


def lands(q):
    """Return where the simulated true robot is when it is sent to q, including servo errors."""
    names = [np.full(len(q), name) for name in ("s", "bar46", "c1", "s1")]
    world = World(3, Plan(q, *names), standard_rig())
    held = world.controller.q_held[world.controller.dwells]
    return forward(world.chain, world.params, held)


def test_corrected_targets_land_where_they_should(bench, printed):
    """The issue's end to end: within 0.35 mm RMS where it missed by some 20 mm."""
    out = bench.folder / "corrected.csv"
    said = printed("correct", bench.folder / "result.json", bench.folder / "targets.csv", "--out", out)
    assert "RMS" in said
    assert miss(lands(bench.q), bench.targets) > 15e-3
    corrected = parse_targets(out.read_text(), "corrected.csv", ("rad",) * 6)
    assert miss(lands(corrected.q_start), bench.targets) < 0.35e-3
    assert miss(lands(controller(corrected.pose, bench.q)), bench.targets) < 0.35e-3
    rows = list(csv.DictReader(out.open()))
    assert max(float(row["after_mm"]) for row in rows) < 1e-5
    assert np.mean([float(row["before_mm"]) for row in rows]) > 15.0


@pytest.mark.parametrize("name", ["program.mod", "program.script"])
def test_a_corrected_program_lands_where_it_should(bench, printed, name):
    given, out = bench.folder / name, bench.folder / f"corrected-{name}"
    more = ("--home", home(bench), "--json", *FRAMES[: 6 if name.endswith("script") else 4])
    said = printed("correct", bench.folder / "result.json", given, "--out", out, *more)
    rows = json.loads(said)["targets"]
    numbered = enumerate(given.read_bytes().splitlines(), start=1)
    mine = {"program.mod": b"[0,", "program.script": b"p["}[name]
    assert {int(row["place"].rpartition(" ")[2]) for row in rows} <= {
        line for line, text in numbered if mine in text or b"[[" in text
    }
    assert len(rows) == N + (name == "program.mod")  # the module's last target stands there twice
    assert all(row["error_before_mm"] > 5.0 and row["error_after_mm"] < 1e-5 for row in rows)
    before, after = (path.read_bytes().decode("latin-1") for path in (given, out))
    targets = bench.targets[[*range(N), N - 1]]  # the last one twice
    assert miss(lands(driven(before, name, bench.q[0])), targets) > 15e-3
    q = driven(after, name, bench.q[0])
    assert miss(lands(q), targets) < 0.35e-3
    # Where the true arm stands without its servo's errors: k = 2 on a norm of three correlated axes covers 95 % and more.
    error = np.linalg.norm((forward(CHAIN, TRUTH, q) - targets)[:, :3, 3], axis=1)
    assert np.mean(1e3 * error[: len(rows)] < [row["expected_mm"] for row in rows]) >= 0.9
    marks = "\r", "[9E9", "af\xe9", ";", "move", "Move", "a=1.2"
    assert [before.count(mark) for mark in marks] == [after.count(mark) for mark in marks]


def home(bench):
    return ",".join(map(repr, np.rad2deg(bench.q[0]).tolist()))


def test_frames_of_work_and_tool(bench, run, printed):
    """Targets in another frame and for a tool's tip get the same correction, expressed in that frame."""
    work = "100,-50,20,0,0,90"
    tool = "0,0,80,0,30,0"
    T_work, T_tool = np.eye(4), np.eye(4)
    T_work[:3, :3] = Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_matrix()
    T_work[:3, 3] = 0.1, -0.05, 0.02
    T_tool[:3, :3] = Rotation.from_rotvec([0.0, np.pi / 6, 0.0]).as_matrix()
    T_tool[:3, 3] = 0.0, 0.0, 0.08
    (bench.folder / "there.csv").write_text(table(np.linalg.inv(T_work) @ bench.targets @ T_tool, bench.q))
    outs = [bench.folder / name for name in ("plain.csv", "framed.csv")]
    run("correct", bench.folder / "result.json", bench.folder / "targets.csv", "--out", outs[0])
    frames = ("--work", work, "--tool", tool)
    printed("correct", bench.folder / "result.json", bench.folder / "there.csv", "--out", outs[1], *frames)
    plain, framed = (parse_targets(out.read_text(), "t", ("rad",) * 6) for out in outs)
    np.testing.assert_allclose(framed.q_start, plain.q_start, atol=1e-9)
    np.testing.assert_allclose(T_work @ framed.pose @ np.linalg.inv(T_tool), plain.pose, atol=1e-9)


@pytest.mark.parametrize("kind", ["poses", "positions", "script", "module"])
def test_a_configuration_that_nothing_determines_is_refused(bench, tmp_path, run, printed, kind):
    """Each configuration of the arm needs another correction; joints near the first target determine it."""
    elbow = np.array([[-0.4247, 0.0277, 2.2586, 1.1040, 1.1720, -2.5915]])  # up or down in the same quarter turns
    q = elbow if kind == "module" else bench.q[:2]
    targets = correct_bench.nominal_poses(q)
    given = tmp_path / {"script": "p.script", "module": "p.mod"}.get(kind, "p.csv")
    xyz = "\n".join(",".join(map(repr, row)) for row in (1e3 * targets[:, :3, 3]).tolist())
    given.write_text(
        {"poses": table(targets), "positions": f"x_mm,y_mm,z_mm\n{xyz}", "script": script(targets)}.get(kind)
        or rapid(targets, q).decode("latin-1").replace("\xe9", ""),
        encoding="latin-1",
    )
    out = given.with_stem("out")
    frames = {"script": FRAMES, "module": FRAMES[:4]}.get(kind, ())
    arguments = ("correct", bench.folder / "result.json", given, "--out", out, *frames, "--json")
    code, said, err = run(*arguments)
    assert (code, out.exists()) == (2, False)
    assert "--home" in err
    if kind in ("script", "module"):
        refused = json.loads(said)["error"]["values"]["refused"]
        assert {one["reason"] for one in refused} == {"configuration"}
    near = ",".join(map(repr, np.rad2deg(q[0]).tolist()))
    document = json.loads(printed(*arguments, "--home", near))
    reached = [document["targets"][0]["before"][f"q{k}_deg"] for k in range(1, 7)]
    np.testing.assert_allclose(reached, np.rad2deg(q[0]), atol=1e-3)
    configurations, expected = document["configurations"], document["targets"][0]["expected_mm"]
    assert (configurations is not None) == (kind in ("script", "module"))
    if configurations is not None:
        assert configurations["targets"] == 1
        assert configurations["correction_spread_mm"] > 0.1
        assert configurations["expected_min_mm"] < configurations["expected_max_mm"]
        assert configurations["expected_min_mm"] <= expected * 1.001 <= configurations["expected_max_mm"] * 1.002
        assert listed(document)["other-configurations"]["most"] == {"mm": configurations["expected_max_mm"]}
        assert "home-decides" in listed(document)


def test_screen_page_and_document_have_the_same_error(bench, tmp_path, run):
    """The tool's with --tool, with the point named; the end frame's otherwise."""
    for tool, point in (("0,0,200,0,0,0", "the tool"), ("0,0,0,0,0,0", "sphere_fixture")):
        offset = np.eye(4)
        offset[2, 3] = 1e-3 * float(tool.split(",")[2])
        (tmp_path / "t.csv").write_text(table(bench.targets @ offset, bench.q))
        arguments = ("correct", bench.folder / "result.json", tmp_path / "t.csv", "--tool", tool, "--force")
        files = ("--out", tmp_path / "o.csv", "--report", tmp_path / "r.html")
        _, said, _ = run(*arguments, *files, "--details")
        _, document, _ = run(*arguments, *files, "--json")
        document = json.loads(document)
        errors = [one["error_before_mm"] for one in document["targets"]]
        printed = [float(line.split()[1]) for line in said.splitlines() if re.match(r"\d+ +\d", line)]
        assert printed == pytest.approx(errors[: len(printed)], abs=6e-5)
        written = [float(row["before_mm"]) for row in csv.DictReader((tmp_path / "o.csv").open())]
        assert written == pytest.approx(errors, abs=1e-5)
        scene = json.loads(re.search(r'id="scene">(.*?)</script>', (tmp_path / "r.html").read_text())[1])
        vectors = np.array(scene["clouds"][0]["vectors"][0]["mm"])
        # the error at the corrected joints, not at the nominal ones
        assert np.linalg.norm(vectors, axis=1) == pytest.approx(errors, rel=0.05)
        rms = np.sqrt(np.mean(np.square(errors)))
        tile = re.search(r"error without correction, RMS</p>.*?>([\d.]+)<", (tmp_path / "r.html").read_text())
        assert float(tile[1]) == pytest.approx(rms, abs=0.05)  # three digits
        assert document["error_point"] == point
        assert point in said.splitlines()[0]
        assert point in (tmp_path / "r.html").read_text()


def test_a_correction_that_makes_it_worse_is_a_warning(bench, tmp_path, run):
    arguments = ("correct", bench.folder / "result.json", bench.folder / "targets.csv", "--method", "offsets", "--json")
    _, helped, _ = run(*arguments, "--out", tmp_path / "a.csv")
    _, worse, _ = run(*arguments, "--out", tmp_path / "b.csv", "--own-frames")
    warned = ["correction-worse" in listed(json.loads(said)) for said in (helped, worse)]
    assert warned == [False, True]


def test_own_frames_leave_the_mountings_out(bench, run):
    out = bench.folder / "own.csv"
    code, said, _ = run(
        *("correct", bench.folder / "result.json", bench.folder / "targets.csv"),
        *("--out", out, "--own-frames", "--json"),
    )
    assert code == 0
    values = listed(json.loads(said))["targets-frames"]
    assert values["base_frame"] == "chuck_fixture"
    found = read_calibration(bench.folder / "result.json")
    expected = mountings(found.chain, found.nominal, found.identified)
    for name, pose in zip(("base", "end"), expected, strict=True):  # as --work and --tool take them
        numbers = np.array(re.findall(r"-?\d[\d.e-]*", values[name]), float)
        np.testing.assert_allclose(numbers[:3], 1e3 * pose[:3, 3], atol=1e-3)
        turned = Rotation.from_rotvec(numbers[3:], degrees=True).as_matrix()
        np.testing.assert_allclose(turned, pose[:3, :3], atol=2e-6)
    assert np.abs(expected.base[:3, :3] - np.eye(3)).max() > 1e-3
    own = [float(row["before_mm"]) for row in csv.DictReader(out.open())]
    assert np.mean(own) < 15.0  # the base stands some 15 mm from where the design has it


def test_a_move_that_cannot_be_corrected_refuses_the_program(bench, tmp_path, run):
    """With line, statement and reason; with --partial the rest is corrected, and a comment stands there."""
    text = (bench.folder / "program.script").read_bytes().decode("latin-1")
    text = text.replace("  sleep(0.5)", "  grip(3)\n  movel(get_target_tcp_pose())\n  sleep(0.5)")
    (tmp_path / "p.script").write_bytes(text.encode("latin-1"))
    given = ("correct", bench.folder / "result.json", tmp_path / "p.script", "--home", home(bench), *FRAMES, "--out")
    code, said, err = run(*given, tmp_path / "o.script")
    line = text[: text.index("movel(get")].count("\n") + 1
    assert (code, said) == (2, "")
    assert f"p.script line {line}: movel(get_target_tcp_pose()): " in err
    n = N + 1  # the last one twice
    ended(err, "uncertain-moves", good=n, n=n + 1)
    assert not (tmp_path / "o.script").exists()
    code, said, _ = run(*given, tmp_path / "o.script", "--json")
    error = json.loads(said)["error"]
    refused = [(move["file"], move["line"], move["reason"]) for move in error["values"]["refused"]]
    assert (code, error["code"], refused) == (2, "uncertain-moves", [("p.script", line, "run-time")])
    code, said, err = run(*given, tmp_path / "o.script", "--partial", "--mark")
    assert code == 4, err
    assert shown["partly-corrected"]["refused"] == 1
    assert Finding("routines-absent", {"names": ["grip"]}).text()[:50] in said
    out = (tmp_path / "o.script").read_bytes().decode("latin-1")
    (row,) = (row for row in out.splitlines() if "# truearm: " in row)
    assert row.startswith("  movel(get_target_tcp_pose()) # truearm: ")
    assert row.endswith(Reason("run-time").text())
    plain = out.replace("  grip(3)", "  #").replace("  movel(get_target", "  # movel(get_target")
    assert miss(lands(driven(plain, "o.script", bench.q[0])), bench.targets[[*range(N), N - 1]]) < 0.35e-3


def test_a_folder_is_corrected_whole(bench, tmp_path, run, printed):
    """Data in one module, moves in another, a third without a target; every file is in the new folder, or none."""
    lines = rapid(bench.targets, bench.q).replace(b"\xe9", b"").split(b"\r\n")
    data = [b"MODULE Data", *(line for line in lines if b"CONST" in line), b"ENDMODULE", b""]
    moves = [line for line in lines if b"CONST" not in line]
    other = b"MODULE Other(SYSMODULE)\r\n! nothing \xff\r\nENDMODULE\r\n"
    files = {"a/Data.mod": b"\r\n".join(data), "Work.mod": b"\r\n".join(moves), "Other.sys": other}
    for name, text in files.items():
        (tmp_path / "cell" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "cell" / name).write_bytes(text)
    (tmp_path / "cell" / "notes.txt").write_text("no program")
    out = tmp_path / "corrected"
    given = ("correct", bench.folder / "result.json", tmp_path / "cell", *FRAMES[:4], "--home", home(bench), "--out")
    said = printed(*given, out, "--details")
    assert "Work.mod:" in said
    after = {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert after.keys() == files.keys()
    assert after["Other.sys"] == other
    assert after["a/Data.mod"] != files["a/Data.mod"]
    whole = b"\r\n".join(
        [b"MODULE Work", *after["a/Data.mod"].split(b"\r\n")[1:-2], *after["Work.mod"].split(b"\r\n")[1:]]
    )
    q = driven(whole.decode("latin-1"), "w.mod", bench.q[0])
    assert miss(lands(q), bench.targets[[*range(N), N - 1]]) < 0.35e-3
    for place, error in ((out, "file-exists"), (tmp_path / "cell" / "new", "invalid-input")):
        code, _, err = run(*given, place)
        assert code == 2
        ended(err, error, place=place)
    (tmp_path / "cell" / "p.script").write_text("movej(p[0,0,0,0,0,0])")
    code, _, err = run(*given, tmp_path / "new")
    ended(err, "no-program", names=["rapid", "urscript"])
    assert (code, (tmp_path / "new").exists()) == (2, False)
    assert not list(tmp_path.glob(".new*"))


def test_frames_that_the_names_do_not_tell_are_asked_for(bench, tmp_path, run):
    given = ("correct", bench.folder / "result.json", bench.folder / "program.mod", "--out", tmp_path / "o.mod")
    for more, what in (((), "base"), (FRAMES[:2], "flange")):
        code, _, err = run(*given, *more)
        assert (code, err.count("\n")) == (2, 1)
        ended(err, "frame", what=what)


def test_what_was_not_seen_is_said(tmp_path, run, printed):
    """Balls in sockets of unknown place do not say where the base stands; a calibration by them is said to be so."""
    urdf, rows, rig = (MUKCA / name for name in ("panda.urdf", "panda_3.csv", "rig.toml"))
    given = (rows, "--model", urdf, "--tip", "ball_link", "--rig", rig, "--joint-laws", "none")
    assert run("identify", *given, "--out", tmp_path / "r.json")[0] == 0
    chain = load_robot(str(urdf), None, "ball_link").chain
    q = read_table(rows, ("rad",) * 7).q[:5]
    place = 1e3 * forward(chain, chain.params_nominal, q)[:, :3, 3]
    titles = ",".join(["x_mm", "y_mm", "z_mm", *(f"q{i}_rad" for i in range(1, 8))])
    lines = [",".join(map(repr, row)) for row in np.concatenate([place, q], axis=1).tolist()]
    (tmp_path / "t.csv").write_text("\n".join([titles, *lines]))
    out = tmp_path / "o.csv"
    printed("correct", tmp_path / "r.json", tmp_path / "t.csv", "--model", urdf, "--out", out)
    given = ("correct", tmp_path / "r.json", tmp_path / "t.csv", "--model", urdf, "--json", "--out")
    held = {}
    for name, option in (("base.csv", ()), ("own.csv", ("--own-frames",))):
        findings = json.loads(run(*given, tmp_path / name, *option)[1])["findings"]
        held[name] = [bool(entry["values"]["base"]) for entry in findings if entry["code"] == "mounting-held"]
        assert not any("configuration" in entry["code"] for entry in findings)
    assert held == {"base.csv": [True, False], "own.csv": [False]}  # the pose of the base, the mounting of the tool
    assert max(float(row["after_mm"]) for row in csv.DictReader(out.open())) < 1e-5


def test_positions_without_joints_are_found_where_there_is_room(bench, printed):
    """How the tool is turned is free: no target is lost to a limit or a singularity that another turn avoids."""
    rows = "\n".join(",".join(map(repr, row)) for row in (1e3 * bench.targets[:, :3, 3]).tolist())
    (bench.folder / "positions.csv").write_text("x_mm,y_mm,z_mm\n" + rows)
    out = bench.folder / "positions-out.csv"
    given = ("correct", bench.folder / "result.json", bench.folder / "positions.csv", "--home", home(bench), "--out")
    printed(*given, out)
    np.testing.assert_allclose(parse_targets(out.read_text(), "t", ("rad",) * 6).q_start[0], bench.q[0], atol=0.3)
    assert miss(lands(parse_targets(out.read_text(), "t", ("rad",) * 6).q_start), bench.targets) < 0.35e-3
