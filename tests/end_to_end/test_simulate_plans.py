"""`truearm simulate` with the user's plan, with lines, and with impossible requests."""

import numpy as np
import pytest
from tests.refusals import ended

from truearm.cli.main import main
from truearm.kinds.rig_file import read_rig, write_rig
from truearm.model.robot_file import builtin_robot
from truearm.plan.plan_file import read_plan, write_plan
from truearm.workflows.requests import SimulateOptions
from truearm.workflows.simulate import simulated_robot, visits
from truearm_sim.line_plan import drawn_line_plan, line_rig
from truearm_sim.world import World, standard_plan, standard_rig


def visited(options):
    return visits(options, simulated_robot(options.robot, options.truth, options.seed)[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("plans")
    write_plan(out / "lines.csv", drawn_line_plan(1, 2))
    write_rig(out / "lines.toml", line_rig())
    write_plan(out / "bars.csv", standard_plan(9, 1))
    ur5e = builtin_robot("ur5e")
    of_ur5e = standard_plan(9, 1, standard_rig(ur5e), ur5e)
    write_rig(out / "ur5e.toml", standard_rig(ur5e))
    write_plan(out / "ur5e.csv", of_ur5e.of_robot("ur5e"))
    write_plan(out / "nameless.csv", of_ur5e)
    (out / "short.csv").write_text("pose,shell,bar,chuck,sphere,q1_rad\n0,,bar46,c1,s1,0.1\n")
    return out


def test_plans_from_files_are_what_is_visited(folder):
    plan, rig = visited(SimulateOptions(folder, plan=folder / "lines.csv", rig=folder / "lines.toml"))
    assert np.array_equal(plan.q, read_plan(folder / "lines.csv").q)
    assert rig == read_rig(folder / "lines.toml")
    assert list(World(1, plan, rig).rig.lines) == ["l1"]
    plan, rig = visited(SimulateOptions(folder, plan=folder / "bars.csv"))
    assert (len(plan), rig) == (18, standard_rig())


def test_lines_are_drawn_and_driven_there_and_back(folder):
    plan, rig = visited(SimulateOptions(folder, lines=1, seed=2))
    assert np.array_equal(plan.q, read_plan(folder / "lines.csv").q)
    assert plan.move.tolist() == ["via", "line", "line"]
    assert list(rig.targets) == ["magnet"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--plan", "{}/lines.csv", "--lines", "2"], "give one"),
        (["--rig", "{}/lines.toml"], "needs-option"),
        (["--plan", "{}/short.csv"], "other-robot"),
        (["--plan", "{}/lines.csv"], "not-in-rig"),
        (["--plan", "{}/none.csv"], "missing-file"),
        (["--plan", "{}/ur5e.csv", "--rig", "{}/ur5e.toml"], "ur5e.csv: was made for robot ur5e"),
        (["--plan", "{}/nameless.csv", "--rig", "{}/ur5e.toml", "--model", "panda"], "other-robot"),
        (["--model", "nope"], "wrong-value"),
        (["--masses-kg", "1,2"], "wrong-value"),
        (["--masses-kg", "1,2,x"], "wrong-value"),
        (["--tolerance", "1"], "wrong-value"),
        (["--gear-periods-deg", "0"], "--gear-periods-deg:"),
        (["--fast", "--protocol", "rtde"], "--fast opens no ports"),
        (["--fast", "--truth-out", "{}/ur5e.toml"], "ur5e.toml"),
        (["--model", "panda", "--protocol", "rtde", "--poses", "9"], "--protocol rtde:"),
        (["--robot-delay-ms", "nan"], "--robot-delay-ms must be"),
    ],
)
def test_what_cannot_be_simulated_is_said(folder, tmp_path, capsys, options, says):
    arguments = [text.format(folder) for text in options]
    assert main(["simulate", "--out", str(tmp_path / "x"), *arguments]) == 2
    ended(capsys.readouterr().err, says)
    assert not (tmp_path / "x").exists()


def test_a_plan_names_its_robot_and_says_so_again(folder):
    """A name that every row has; a plan without it is as it was."""
    assert set(read_plan(folder / "ur5e.csv").robot) == {"ur5e"}
    assert set(read_plan(folder / "nameless.csv").robot) == {""}
    assert (folder / "nameless.csv").read_text().startswith("pose,shell,bar,chuck,sphere,q1_rad")
    assert np.array_equal(read_plan(folder / "ur5e.csv").q, read_plan(folder / "nameless.csv").q)
