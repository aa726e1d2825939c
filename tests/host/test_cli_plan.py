"""``truearm plan`` on the command line: its files, and one-line errors."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.host import plan_bench as bench
from tests.host.findings_bench import listed
from tests.refusals import ended

from truearm.cli.main import main
from truearm.estimate.identify import identify
from truearm.estimate.result_document import result_of
from truearm.estimate.result_file import RobotFrames, write_result
from truearm.export.urdf import new_urdf
from truearm.export.writing import link_frames
from truearm.kinds.rig_file import read_rig, write_rig
from truearm.kinds.table_file import write_table
from truearm.model.robot_file import builtin_text
from truearm.plan.forecast import bar_table
from truearm.plan.plan_file import check_against_rig, read_plan
from truearm.results import Diagnosis, Rival

COMMON = ("--model", "irb120", "--bar", "bar25", "--poses", "36", "--candidates", "60")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("plan")
    write_rig(out / "rig.toml", bench.RIGS["irb120"])
    (out / "bare.toml").write_text(builtin_text("irb120").partition("[branch]")[0])
    return out


def test_plan_measure_identify_plan_again(folder, printed):
    """The documented path: 36 poses on the design, identified; the second plan on the better model counts them."""
    rig = str(folder / "rig.toml")
    plan, script = folder / "plan.csv", folder / "plan.script"
    lines = printed("plan", "ballbar", *COMMON, "--rig", rig, "--out", plan, "--program-out", script).splitlines()
    assert lines[0].startswith("36 poses in ")
    assert len(lines) <= 15
    assert lines[-2:] == [f"Written: {plan}", f"Written: {script}"]
    visits = read_plan(plan).select(read_plan(plan).dwells)
    assert len(visits) == 36
    assert script.read_text().count(": dwell") == 36

    known = bench.known("irb120")
    rng = np.random.default_rng(0)
    truth = known.params + 1e-3 * known.free * rng.standard_normal(known.params.size)
    table = bar_table(replace(known, params=truth), visits)
    table = replace(table, value=table.value + bench.SIGMA * rng.standard_normal(36))
    write_table(folder / "measured.csv", table, ("rad",) * 6)
    found = identify(known.chain, known.rig, table, free=known.free)
    frames = RobotFrames("irb120", "base", "flange", ("rad",) * 6)
    write_result(folder / "result.json", result_of(found, table, frames))

    more = ("--result", str(folder / "result.json"), "--measured", str(folder / "measured.csv"), "--json")
    again = json.loads(printed("plan", "ballbar", *COMMON, "--rig", rig, *more))
    assert again["rows"] == 72
    assert again["rank"] == 30
    first = dict(zip(found.parameter_names, found.sigma, strict=True))
    assert all(p["sigma"] < first[p["name"]] for p in again["parameters"])

    sphere, chuck = visits.sphere[-1], visits.chuck[-1]
    assert again["pairings"][0]["chuck"] != chuck
    cause = Rival("base.drift", "base.drift", None, 1.0, 1e-4, 1e-4, 0.1, 2.0)
    fault = Diagnosis((cause, cause), cause, (), (), 30.0, 2, 9.0, (f"chuck {chuck}", f"sphere {sphere}"))
    write_result(folder / "result.json", result_of(replace(found, faults=(fault,)), table, frames))
    pairings = json.loads(printed("plan", "ballbar", *COMMON, "--rig", rig, *more))["pairings"]
    assert {(mount["chuck"], mount["sphere"]) for mount in pairings if mount["poses"]} == {(chuck, sphere)}


def test_a_urdf_with_several_ends(folder, capsys, printed):
    """As makers' files have them: the end is chosen, or is that of the result. What is predicted, identify then says."""
    chain = bench.known("irb120").chain
    text = new_urdf(link_frames(chain, chain.params_nominal, chain.params_nominal))
    camera = '<link name="camera"/><joint name="c" type="fixed"><parent link="tool0"/><child link="camera"/></joint>'
    plate = camera.replace("camera", "plate").replace('"c"', '"p"')
    urdf, rig = folder / "arm.urdf", str(folder / "rig.toml")
    urdf.write_text(text.replace("</robot>", f"{camera}{plate}</robot>"))
    branch = bench.known("irb120").branch
    lower, upper = (np.rad2deg(bound) for bound in (branch.lower, branch.upper))
    branch = ",".join(f"{a:.6g}:{b:.6g}" for a, b in zip(lower, upper, strict=True))
    given = ("plan", "ballbar", "--model", str(urdf), *COMMON[2:], "--rig", rig, f"--branch={branch}", "--json")
    assert main([*given]) == 2
    assert "choose --tip among camera, plate" in capsys.readouterr().err
    told = json.loads(printed(*given, "--tip", "tool0", "--out", folder / "arm.csv"))
    visits = read_plan(folder / "arm.csv")
    write_table(folder / "arm_rows.csv", bar_table(bench.known("irb120"), visits.select(visits.dwells)), ("rad",) * 6)
    result = str(folder / "arm.json")
    rows = ("identify", str(folder / "arm_rows.csv"), "--model", str(urdf), "--tip", "tool0", "--rig", rig)
    found = {
        p["name"]: p["sigma"] or np.nan
        for p in json.loads(printed(*rows, "--out", result, "--json"))["parameters"]
        if p["free"]
    }
    assert found == pytest.approx({p["name"]: p["sigma"] or np.nan for p in told["parameters"]}, rel=1e-3, nan_ok=True)
    more = ("--result", result, "--measured", str(folder / "arm_rows.csv"))
    assert json.loads(printed(*given, *more))["rows"] == 72


LINES = ("--model", "irb120", "--lines", "2", "--candidates", "6", "--length-mm", "200", "--seed", "3")


def test_lines_are_planned(folder, printed):
    """The plan file is for record, the rig with the lines for record and identify, the program drives what the plan says."""
    out, rig, script = (folder / name for name in ("lines.csv", "lines.toml", "lines.script"))
    written = ("--out", str(out), "--rig-out", str(rig), "--program-out", str(script))
    findings = listed(json.loads(printed("plan", "line", *LINES, "--rig", folder / "rig.toml", *written, "--json")))
    assert next(iter(findings)) == "planned"
    assert (findings["planned"]["lines"], findings["planned"]["minutes"]) == (2, 6)
    assert {f"base.{k}" for k in "xyz"} <= set(findings["held-frames"]["base"])  # the lines' places move with the base
    visits, around = read_plan(out), read_rig(rig)
    assert visits.line[visits.lines].tolist() == ["plan1", "plan1", "plan2", "plan2"]
    assert script.read_text().count("movel(") == 4
    assert list(around.lines) == ["plan1", "plan2"]
    assert list(around.chucks) == list(bench.RIGS["irb120"].chucks)
    check_against_rig(visits, around, str(out))


def test_lines_with_a_delay_that_is_not_known(folder, printed):
    write_rig(folder / "delay.toml", replace(bench.RIGS["irb120"], time_offset_sigma=None))
    lines = printed("plan", "line", *LINES, "--rig", folder / "delay.toml", "--details").splitlines()
    (row,) = [line for line in lines if line.startswith("time_offset ")]
    assert row.split()[-1] == "ms"


@pytest.mark.parametrize(
    ("of", "change", "message"),
    [
        ("line", ["--target", "x"], "[[target]] to it"),
        ("ballbar", ["--model", "bare.toml"], "give LOW:HIGH"),
        ("ballbar", ["--bar", "nope"], "bar 'nope'"),
        *(("ballbar", ["--region", text], "wrong-value") for text in ("0:1,2:3,5:4", "a:b,0:1,0:1", "0:1:2,0:1,0:1")),
        ("ballbar", ["--branch", "1:2"], "--branch: needs bounds"),
        (
            "ballbar",
            ["--poses", "60", "--branch=-10:10,-60:60,-60:60,-60:60,10:60,-60:60"],
            "bar attached, too few for 60",
        ),
        ("ballbar", ["--program-out", "x.txt"], "programs cannot be written as '.txt'"),
        ("ballbar", ["--criterion", "Q"], "'Q'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(folder, capsys, monkeypatch, of, change, message):
    monkeypatch.chdir(folder)
    before = (folder / "rig.toml").read_bytes()
    assert main(["plan", of, *(LINES if of == "line" else COMMON), "--rig", "rig.toml", *change]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    ended(said[0], message)
    assert (folder / "rig.toml").read_bytes() == before


def test_check_poses_that_are_not_planned_are_named(folder, printed):
    findings = listed(
        json.loads(printed("plan", "ballbar", *COMMON, "--rig", folder / "rig.toml", "--check-poses", "7", "--json"))
    )
    assert findings["fewer-checks"] == {"asked": 7, "planned": 0, "visits": False}
    assert not findings["planned"]["checks"]


def test_too_few_poses_are_told_in_a_few_words(folder, printed):
    few = [text.replace("36", "12") for text in COMMON]
    command = ["plan", "ballbar", *few, "--rig", str(folder / "rig.toml")]
    findings = listed(json.loads(printed(*command, "--json")))
    assert findings["few-poses"] == {"n": 12}
    assert findings["planned-rank"]["unseen"] == 30 - 12
    unseen = [line for line in printed(*command, "--details").splitlines() if line.startswith("unidentifiable: ")]
    assert len(unseen) == 30 - 12
    assert all(len(re.findall(r"\d\.\d\d \w", line)) <= 4 for line in unseen)


def test_a_language_that_the_robot_cannot_use_is_told_before_the_planning(folder, capsys):
    branch = "-150:150,-95:95,-80:80,-165:-25,-150:150,25:165,-160:160"
    common = ["plan", "ballbar", "--model", "panda", f"--branch={branch}", "--rig", str(folder / "rig.toml")]
    plan, script = folder / "seven.csv", folder / "seven.script"
    assert main([*common, "--poses", "36", "--out", str(plan), "--program-out", str(script)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "URScript programs have six joints" in said
    assert not plan.exists()
    assert not script.exists()


def test_a_joint_that_slides_has_no_bounds_in_degrees(folder, tmp_path, capsys):
    """0:100 would be 1.7 m of a rail."""
    chain = bench.known("irb120").chain
    rail = (
        '<link name="floor"/><joint name="rail" type="prismatic"><parent link="floor"/><child link="base"/>'
        '<limit lower="0" upper="2" effort="1" velocity="1"/></joint>'
    )
    text = new_urdf(link_frames(chain, chain.params_nominal, chain.params_nominal)).replace(
        "</robot>", rail + "</robot>"
    )
    (tmp_path / "railed.urdf").write_text(text)
    bounds = "0:100,-155:155,-80:100,-60:65,-150:150,12:115,-180:180"
    given = ["--model", str(tmp_path / "railed.urdf"), "--base", "floor", "--tip", "tool0"]
    for arguments in (
        ["plan", "ballbar", *given, "--rig", str(folder / "rig.toml"), "--poses", "20", f"--branch={bounds}"],
        ["plan", "ballbar", *given, "--rig", str(folder / "rig.toml"), "--poses", "20"],
        ["init", str(tmp_path / "cell"), *given, "--minutes", "0", f"--branch={bounds}"],
    ):
        assert main(arguments) == 2
        assert "revolute joints only" in capsys.readouterr().err
    assert not (tmp_path / "cell").exists()
