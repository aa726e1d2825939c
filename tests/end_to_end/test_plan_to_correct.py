"""docs/how-to/rig.md's way from a plan to a corrected program, command by command: what comes out is checked against the true robot.

The rows come as tables. Sessions of a simulated box are test_real_time.py's, and those of the rehearsal.
"""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.end_to_end.conftest import noise_alone, truearm
from tests.host import plan_bench as bench
from tests.host.correct_bench import visited
from tests.host.findings_bench import listed
from tests.host.target_bench import driven, miss, rapid, script, table

from truearm.correct.target_table import parse_targets
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import write_table
from truearm.model.chain import forward
from truearm.model.inverse import singular_value
from truearm.model.robot_file import builtin_robot, load_robot
from truearm.plan.ball_bar_plan import all_pairings
from truearm.plan.forecast import bar_table
from truearm.plan.plan_file import read_plan
from truearm.plan.shells import candidates

UNITS = ("rad",) * 6
N = 40  # targets
SAME = "0,0,0,0,0,0"  # nobody told a script's tool
PROGRAMS = {"irb120": "program.mod", "ur5e": "program.script"}
MORE = ("--rig", "rig.toml")


class Walk:
    """A robot that errs as a small arm does, 1 mm and 4 mrad in each free parameter, and a folder in which commands are run."""

    def __init__(self, name, folder, printed):
        self.name, self.folder, self.typed, robot = name, folder, printed, builtin_robot(name)
        self.chain, self.nominal = robot.chain, robot.chain.params_nominal
        sigma = np.array([{"m": 1e-3, "rad": 4e-3, "1": 0.0}[p.unit] for p in robot.chain.parameters]) * robot.free
        self.truth = self.nominal + sigma * np.random.default_rng(3).standard_normal(sigma.size)
        write_rig(folder / "rig.toml", bench.RIGS[name])
        self.q = self._targets()
        self.targets = forward(self.chain, self.nominal, self.q)

    def _targets(self):
        """Joints (N, 6) within the region that is measured, at no pose that is."""
        rig = bench.RIGS[self.name]
        q = candidates(bench.site(self.name), all_pairings(rig), 10 * N, seed=77).q
        good = [singular_value(self.chain, p, q) > 0.08 for p in (self.nominal, self.truth)]
        return visited(q[np.logical_and(*good)])[:N]

    def lands(self, q):
        """Where the true robot stands."""
        return forward(self.chain, self.truth, q)

    def measured(self, plan, seed):
        """Observations at a plan's poses."""
        visits = read_plan(self.folder / plan)
        rows = bar_table(replace(bench.known(self.name), params=self.truth), visits.select(visits.dwells))
        value = rows.value + bench.SIGMA * np.random.default_rng(seed).standard_normal(len(rows))
        assert np.abs(value - [bench.RIGS[self.name].bars[b].zero for b in rows.bar]).max() < 0.0375
        out = plan.replace(".csv", "_rows.csv")
        write_table(self.folder / out, replace(rows, value=value), UNITS)
        return out


@pytest.fixture(params=["irb120", pytest.param("ur5e", marks=pytest.mark.soak)])
def walk(request, tmp_path, monkeypatch, printed):
    monkeypatch.chdir(tmp_path)
    return Walk(request.param, tmp_path, printed)


def plan(walk, out, bar, *more):
    given = ("--model", walk.name, "--rig", "rig.toml", "--bar", bar, "--candidates", 150, "--out", out)
    told = json.loads(walk.typed("plan", "ballbar", *given, *more, "--json"))
    assert Path(out).exists()
    return told


def test_from_a_plan_to_a_corrected_program(walk):
    short, long = bench.RIGS[walk.name].bars
    # plan, measure few, identify
    told = plan(walk, "few.csv", short, "--poses", 40, "--program-out", "few.script", "--program-out", "few.mod")
    assert told["rank"] == told["free"]
    plan(walk, "other.csv", short, "--poses", 25, "--seed", 9, "--criterion", "D")  # another day's, to judge by
    few, other = walk.measured("few.csv", 1), walk.measured("other.csv", 2)
    walk.typed("identify", few, "--model", walk.name, *MORE, "--out", "first.json")
    # re-plan on the better model, what was measured counted; measure and identify both
    told = plan(walk, "more.csv", long, "--poses", 60, "--result", "first.json", "--measured", few)
    assert told["rows"] == 100
    more = walk.measured("more.csv", 3)
    result = json.loads(
        walk.typed("identify", few, more, "--model", walk.name, *MORE, "--out", "result.json", "--json")
    )
    assert result["n_observations"] == 100
    assert result["status"] == "converged"
    with noise_alone():
        by_noise = json.loads(walk.typed("identify", few, more, "--model", walk.name, *MORE, "--json"))
    forecast = {p["name"]: p["sigma"] for p in told["parameters"]}
    ratio = [p["sigma"] / forecast[p["name"]] for p in by_noise["parameters"] if p["free"]]
    assert len(ratio) == told["rank"] == result["rank"]
    assert np.abs(np.array(ratio) - 1.0).max() < 0.1
    judged(walk, other)
    corrected(walk)
    exported(walk)
    mapped(walk)


def judged(walk, other):
    told = json.loads(walk.typed("validate", "result.json", other, *MORE, "--json"))
    assert told["rows"] == 25
    assert told["identified_from"] == []
    assert told["rms_raw_mm"] > 1.0
    assert told["rms_before_mm"] > 3.0 * told["rms_after_mm"]  # base and tool placed: the arm's own error is left
    # 25 rows: σ of their RMS is 14 %
    assert told["rms_after_mm"] < 1.4 * told["expected"]["rms_mm"] < 0.25
    assert {"validation-holds", "validation-uncertain"} & set(listed(told))


def corrected(walk):
    Path("targets.csv").write_text(table(walk.targets, walk.q))
    Path("program.mod").write_bytes(rapid(walk.targets, walk.q))
    Path("program.script").write_bytes(script(walk.targets).encode("latin-1"))
    missed = miss(walk.lands(walk.q), walk.targets)
    assert missed > 3e-3
    out = "corrected.csv"
    walk.typed("correct", "result.json", "targets.csv", "--out", out)
    there = parse_targets(Path(out).read_text(), out, UNITS).q_start
    assert miss(walk.lands(there), walk.targets) < 0.35e-3
    home = ",".join(map(repr, np.rad2deg(walk.q[0]).tolist()))
    name = PROGRAMS[walk.name]
    tool = ("--tool", SAME) if name.endswith("script") else ()
    walk.typed("correct", "result.json", name, f"--home={home}", "--out", f"corrected-{name}", *tool)
    q = driven(Path(f"corrected-{name}").read_bytes().decode("latin-1"), name, walk.q[0], walk.chain, walk.nominal)
    assert miss(walk.lands(q), walk.targets[[*range(N), N - 1]]) < 0.35e-3  # the last one twice


def exported(walk):
    """What other programs read says where the true robot is; where a file holds no gains, over the poses that were measured."""
    for form in ("urdf", "dh-hayati", "sheth-uicker", "dh", "mdh"):
        is_urdf = form == "urdf"
        out, over = f"{form}.{'urdf' if is_urdf else 'toml'}", ("--over", "more.csv") if is_urdf else ()
        walk.typed("export", "result.json", "--format", form, "--out", out, *over)
        chain = load_robot(out, *((walk.chain.base_frame, walk.chain.end_frame) if is_urdf else ())).chain
        most = 0.5e-3 if is_urdf else 0.35e-3
        assert miss(forward(chain, chain.params_nominal, walk.q), walk.lands(walk.q)) < most
    kinematics = ("export", "result.json", "--format", "ur", "--out", "kinematics.yaml")
    if walk.name == "ur5e":
        walk.typed(*kinematics)
        assert "kinematics:" in Path("kinematics.yaml").read_text()
    else:
        done = truearm(*kinematics)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert not Path("kinematics.yaml").exists()


def mapped(walk):
    said = walk.typed(
        "map", "result.json", "--out", "map.csv", "--picture-out", "map.svg", "--task", "100x100", "--cell-mm", 40
    )
    assert "Best place for" in said
    assert Path("map.svg").read_text().startswith("<svg")
    rows = list(csv.DictReader(Path("map.csv").open()))
    q = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    off = np.linalg.norm((walk.lands(q) - forward(walk.chain, walk.nominal, q))[:, :3, 3], axis=1)
    error, sigma = (np.array([1e-3 * float(row[key]) for row in rows]) for key in ("error_mm", "sigma_mm"))
    # the error's own error is the part of the end's uncertainty that lies along it
    assert np.sqrt(np.mean(((error - off) / sigma) ** 2)) < 1.5
