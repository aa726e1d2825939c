"""Later sessions: `truearm validate` judges a calibration by them, and `plan --measured` counts their rows."""

import json

import numpy as np
import pytest
from tests.end_to_end.conftest import record_session
from tests.host.findings_bench import listed

from truearm.cli.main import main
from truearm.files.rig_file import write_rig
from truearm.model.robot import builtin_robot
from truearm_sim.world import standard_rig

POSES = 18  # with each bar of a session that judges


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """result.json of the first session; friday.mcap of the same robot; changed.mcap of it after its third joint's zero moved."""
    out = tmp_path_factory.mktemp("later")
    record_session(out / "monday.mcap", 45, osr=16384)
    assert main(["identify", str(out / "monday.mcap"), "--model", "puma560", "--out", str(out / "result.json")]) == 0
    record_session(out / "friday.mcap", POSES, seed=2, osr=16384)
    robot = builtin_robot("puma560")
    moved = robot.parameter_sets["optimised"].copy()
    moved[robot.chain.parameter_names.index("joint3.offset")] += 2e-3
    record_session(out / "changed.mcap", POSES, seed=3, osr=16384, params=moved)
    write_rig(out / "rig.toml", standard_rig())
    return out


@pytest.fixture
def said(capsys):
    def call(*arguments):
        capsys.readouterr()
        assert main([str(a) for a in arguments]) == 0
        return capsys.readouterr().out

    return call


def judged(said, folder, name):
    return json.loads(said("validate", folder / "result.json", folder / name, "--json"))


def test_another_day_of_the_same_robot_holds_in_every_region(said, folder):
    found = judged(said, folder, "friday.mcap")
    assert found["rows"] == 2 * POSES
    assert found["rms_raw_mm"] > 5.0
    assert found["rms_before_mm"] > 10.0 * found["rms_after_mm"]  # base and tool placed: the arm's own error is left
    # 0.084 mm of repeatability; 90 poses for 36 parameters leave √(1 + 36/54) of it, 0.11 mm, its σ with 36 rows 12 %
    assert 0.07 < found["rms_after_mm"] < 0.16
    regions = {region["region"]: region for region in found["regions"]}
    assert {"bar=bar46", "bar=bar61", "shell=bar46-c1", "shell=bar61-c3"} <= set(regions)
    assert sum(name.startswith("radius") for name in regions) == 4
    assert regions["bar=bar46"]["rows"] == regions["bar=bar61"]["rows"] == POSES
    assert all(region["rms_after_mm"] < 0.25 * region["rms_before_mm"] for region in regions.values())
    assert found["identified_from"] == []
    lines = said("validate", folder / "result.json", folder / "friday.mcap", "--details").splitlines()
    assert found["verdict"].startswith(lines[1].strip())
    assert any(line.startswith("bar=bar61") for line in lines)


def test_a_robot_that_has_changed_since_is_found_out(said, folder):
    """2 mrad at the elbow of an arm of 0.9 m are about a millimetre."""
    found = judged(said, folder, "changed.mcap")
    assert found["rms_after_mm"] > 0.4
    assert "validation-changed" in listed(found)


def test_the_session_that_it_was_identified_from_proves_little(said, folder):
    assert "validation-own-rows" in listed(judged(said, folder, "monday.mcap"))


def test_what_sessions_measured_counts_in_a_plan(said, folder):
    """The forecast of one more dwell after a session is what the identification of the session reports, and a little less."""
    common = ("plan", "ballbar", "--model", "puma560", "--rig", folder / "rig.toml", "--json", "--candidates", "60")
    given = ("--result", folder / "result.json", "--measured", folder / "monday.mcap")
    told = json.loads(said(*common, "--poses", "9", *given))
    assert told["rows"] == 90 + 9
    assert told["rank"] == 36
    result = json.loads((folder / "result.json").read_text())
    now = {p["name"]: p["sigma"] for p in result["parameters"] if p["sigma"]}
    ratio = np.array([p["sigma"] / now[p["name"]] for p in told["parameters"]])
    assert ratio.max() < 1.0
    assert ratio.min() > 0.5  # nine more of ninety, well chosen
