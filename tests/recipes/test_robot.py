"""A new robot in one new file: named by --help and the API, and planned for."""

import csv
import math
from dataclasses import replace

import pytest

from tests.host.plan_bench import RIGS
from tests.recipes.recipes import Copy
from truearm.files.rig_file import write_rig
from truearm.types import BallBar

PLAN = ("plan", "ballbar", "--model", "ur3lab", "--rig", "rig.toml", "--poses", "36", "--candidates", "60", "--out")


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The package with the robot, and a rig for an arm of its size."""
    copy = Copy(tmp_path_factory.mktemp("robot"))
    copy.apply("A robot")
    assert copy.changes() == {"host/truearm/model/robots/ur3lab.toml": "new file"}
    bars = {"bar25": BallBar("bar25", 0.25, 1.0, 0.075, 84e-6)}
    write_rig(copy.folder / "rig.toml", replace(RIGS["irb120"], bars=bars))
    return copy


@pytest.fixture(scope="module")
def said(copy):
    """Return what the commands print."""
    wrong = ("identify", "none.csv", "--model", "ur3la", "--rig", "rig.toml")
    return copy.run_each(
        ("identify", "--help"),
        ("plan", "ballbar", "--help"),
        wrong,
        (*PLAN, "plan.csv", "--program-out", "plan.script"),
    )


def test_help_and_errors_name_it(copy, said):
    for text in (said[0].out, said[1].out, said[2].err):
        assert "ur3lab" in text
    (branch,) = (part for part in " ".join(said[1].out.split()).split(" --") if part.startswith("branch"))
    assert "ur3lab" in branch
    assert said[2].code == 2
    names = copy.python("-c", "import truearm; print(truearm.builtin_robots())").out
    assert "ur3lab" in names


def test_it_is_planned_for(copy, said):
    assert said[3].code == 0, said[3].err
    with (copy.folder / "plan.csv").open() as file:
        stops = list(csv.DictReader(file))
    assert sum(stop["move"] == "dwell" for stop in stops) == 36
    low, high = (-150, -170, -150, -200, -165, -180), (150, -10, -15, 60, -15, 180)
    for stop in stops:
        q = [math.degrees(float(stop[f"q{i}_rad"])) for i in range(1, 7)]
        assert all(a - 1e-6 <= joint <= b + 1e-6 for a, joint, b in zip(low, q, high, strict=True))
    assert "movej" in (copy.folder / "plan.script").read_text()
