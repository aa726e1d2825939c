"""Sessions of one robot with different rigs, recorded by the simulated lab and identified together."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from tests.end_to_end.conftest import record_session, truearm

from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import read_table
from truearm.types import Point
from truearm_sim.world import standard_rig

SHIFT = np.array([0.004, -0.003, 0.002])  # m, of the spheres that were mounted again on Tuesday


def moved_rig():
    """The second day's truth: the same chucks and bars, the spheres' plate elsewhere on the endpoint."""
    rig = standard_rig()
    spheres = {n: Point(n, tuple((np.array(p.xyz) + SHIFT).tolist())) for n, p in rig.spheres.items()}
    return replace(rig, spheres=spheres)


@pytest.fixture(scope="module")
def days(tmp_path_factory):
    """monday.mcap and tuesday.mcap, each with the rig that was true on its day."""
    folder = tmp_path_factory.mktemp("days")
    record_session(folder / "monday.mcap", 36, osr=16384)
    record_session(folder / "tuesday.mcap", 36, seed=2, osr=16384, rig=moved_rig())
    return folder


@functools.cache
def identified(folder, *more, code=0):
    command = ("identify", folder / "monday.mcap", folder / "tuesday.mcap", "--model", "puma560", "--json", *more)
    done = truearm(*command)
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout)


def test_each_session_has_the_rig_that_it_was_recorded_with(days):
    result = identified(days)
    assert (result["status"], result["rank"], result["n_free"]) == ("converged", 36, 36)
    assert {p["of"] for p in result["parameters"]} == {"robot"}  # both rigs are known exactly
    freedom = result["n_observations"] - 36
    assert freedom > 100
    assert abs(result["chi2_reduced"] - 1.0) < 4.0 * np.sqrt(2.0 / freedom)  # 4 standard deviations of χ²


def test_one_rig_for_both_sessions_is_not_usable(days):
    """It is wrong by the 5.4 mm that the spheres were moved: the fit says so, and that either session alone fits."""
    write_rig(days / "monday.toml", standard_rig())
    wrong = identified(days, "--rig", days / "monday.toml", code=3)
    assert wrong["rms_after_mm"] > 10 * identified(days)["rms_after_mm"]
    assert (wrong["usable"], wrong["unusable_because"]) == (False, "wrong inputs")
    monday = sum(entry["used"] for entry in wrong["sessions"][:1])
    (found,) = (entry for entry in wrong["explanations"] if entry["code"] == "rows-apart")
    assert found["n"] in (monday, wrong["n_observations"] - monday)
    assert found["values"]["leave_out"] in ([f"1:{monday}"], [f"{monday + 1}:{wrong['n_observations']}"])


def test_a_rig_of_its_own_stands_in_for_what_a_session_carries(days):
    """Nobody measured Tuesday's spheres: they become unknowns of that rig alone, the robot stays shared."""
    guess = standard_rig()
    unknown = {name: replace(point, sigma=None) for name, point in guess.spheres.items()}
    write_rig(days / "unknown.toml", replace(guess, spheres=unknown))
    result = identified(days, "--rig", f"tuesday={days / 'unknown.toml'}")
    assert (result["status"], result["rank"]) == ("converged", 36)
    rig = {p["name"]: p for p in result["parameters"] if p["of"] == "rig"}
    assert sorted(rig) == [f"tuesday.sphere.{s}.{k}" for s in ("s1", "s2", "s3") for k in "xyz"]
    for name, true in moved_rig().spheres.items():
        for k, xyz in zip("xyz", true.xyz, strict=True):
            found = rig[f"tuesday.sphere.{name}.{k}"]
            # 4.5 σ: one of nine coordinates lies beyond once in 16,000 draws
            assert abs(found["value"] - xyz) < 4.5 * found["sigma"]
    assert [entry["role"] for entry in result["inputs"]] == ["observations", "observations", "rig"]


def test_both_rigs_may_be_given_and_are_saved_with_the_rows(days, tmp_path):
    write_rig(tmp_path / "m.toml", standard_rig())
    write_rig(tmp_path / "t.toml", moved_rig())
    rigs = ("--rig", f"monday={tmp_path / 'm.toml'}", "--rig", f"tuesday={tmp_path / 't.toml'}")
    result = identified(days, *rigs, "--table-out", tmp_path / "all.csv")
    assert result["rms_after_mm"] == identified(days)["rms_after_mm"]
    assert set(read_table(tmp_path / "all.csv").rig) == {"monday", "tuesday"}
    again = truearm("identify", tmp_path / "all.csv", "--model", "puma560", *rigs, "--json")
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout)["rms_after_mm"] == pytest.approx(result["rms_after_mm"], rel=1e-9)
    held = identified(days, *rigs, "--hold-out", "rig=tuesday")
    assert held["held_out"]["n"] == result["n_observations"] - held["n_observations"] > 0


def test_two_sessions_of_one_name_are_refused(days, tmp_path):
    other = tmp_path / "monday.mcap"
    other.write_bytes((days / "tuesday.mcap").read_bytes())
    two = truearm("identify", days / "monday.mcap", other, "--model", "puma560")
    assert (two.returncode, two.stdout) == (2, "")
    assert "also named monday but" in two.stderr
