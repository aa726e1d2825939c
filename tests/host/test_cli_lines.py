"""A session of the line device on the command line: inspect and identify."""

import json
import re

import numpy as np
import pytest
from line_stream import MAGNET, line_session, some_lines, true_params
from session_stream import write_session
from tests.host.findings_bench import listed
from tests.refusals import shown

from truearm.model.transforms import rotation_vector
from truearm.types import Device, Point, Rig


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with both.mcap, two lines there and back with readings that are 8 ms late, and one.mcap, in one direction."""
    path = tmp_path_factory.mktemp("lines")
    for name, back in (("both", True), ("one", False)):
        rng = np.random.default_rng(1)
        lines = some_lines(rng, 2, 0.25)
        made = line_session(rng, lines, true_params(rng), there_and_back=back, speed=0.2, delay_s=8e-3)
        cov = tuple(map(tuple, np.diag([62e-6, 100e-6, 62e-6]) ** 2))
        devices = {
            line.name: Device(line.name, cov, rotation=tuple(rotation_vector(line.turn)), turn_sigma=0.05)
            for line in lines
        }
        rig = Rig(targets={"magnet": Point("magnet", tuple(MAGNET))}, lines=devices)
        write_session(path / f"{name}.mcap", made.messages, rig)
    return path


@pytest.fixture
def said(run):
    """Return what a successful command prints."""

    def call(*arguments):
        outcome = run(*arguments)
        assert (outcome.code, outcome.err) == (0, "")
        return outcome.out

    return call


def test_inspect_lists_the_passes(folder, said):
    text = said("inspect", folder / "both.mcap", "--details")
    rows = [line.split() for line in text.splitlines() if line.rstrip().endswith((", y increases", ", y decreases"))]
    assert [(row[0], row[-3], row[-1]) for row in rows] == [
        *(("1", "l1,", "increases"), ("2", "l1,", "decreases")),
        *(("3", "l2,", "increases"), ("4", "l2,", "decreases")),
    ]
    document = json.loads(said("inspect", folder / "both.mcap", "--json"))
    passes, findings = document["passes"], listed(document)
    assert (findings["session-usable"]["passes"], findings["session-usable"]["planned_passes"]) == (4, 4)
    assert "pass-timing" in findings
    assert (passes["planned"], passes["found"], passes["rejected"]) == (4, 4, {})
    assert passes["points"] == sum(row["points"] for row in passes["table"])
    assert [row["speed_m_s"] for row in passes["table"]] == pytest.approx([0.2] * 4, rel=0.01)


def test_identify_in_words_and_on_its_page(folder, said):
    command = ("identify", folder / "both.mcap", "--model", "puma560", "--solver", "map", "--line-points", "8")
    text = said(*command, "--details", "--hold-out", "shell=l2-down", "--report", folder / "page.html")
    assert "24 line rows fitted, 8 held out" in " ".join(text.split())
    late, sigma = (shown["time-offset"][name]["ms"] for name in ("offset", "sigma"))
    assert abs(late - 8.4) < 3.0 * sigma < 1.0
    page = (folder / "page.html").read_text()
    assert re.search(r"l1, l2\W+2 \w+ 2 there and back", page)
    assert "32 in motion" in page
    assert f" {late:.3f} ms late" in page


def test_one_way_is_said_not_to_show_the_delay(folder, said):
    text = said("identify", folder / "one.mcap", "--model", "puma560", "--solver", "map", "--details")
    assert shown["time-offset-unidentifiable"] == {"name": "time_offset"}
    (row,) = [line.split() for line in text.splitlines() if line.startswith("time_offset ")]
    assert row[2:] == ["-", "-", "unidentifiable", "ms"]


def test_export_session_has_every_row_of_the_plan_and_every_pass(folder, said, tmp_path):
    said("session", "export", folder / "both.mcap", "--out", tmp_path / "x", "--format", "npz")
    plan, passes, rows = (np.load(tmp_path / "x" / f"{name}.npz") for name in ("plan", "passes", "observations"))
    assert plan["move"].tolist() == ["via", "line", "line"] * 2
    assert plan["line"].tolist() == ["", "l1", "l1", "", "l2", "l2"]
    listed = json.loads(said("inspect", folder / "both.mcap", "--json"))["passes"]["table"]
    for title, key in (("line", "line"), ("pose", "pose"), ("speed_m_s", "speed_m_s"), ("points", "points")):
        assert passes[title].tolist() == [one[key] for one in listed]
    assert plan["line"][passes["pose"]].tolist() == passes["line"].tolist()
    for title in ("noise_x_m", "noise_y_m", "noise_z_m", "window_s"):
        np.testing.assert_array_equal(passes[title], [one[title] for one in listed])
    np.testing.assert_array_equal(passes["controller_start_s"], [one["t_robot_s"] for one in listed])
    np.testing.assert_array_equal(
        [passes[f"noise_{axis}_m"] for axis in "xyz"], np.transpose([one["noise_m"] for one in listed])
    )
    np.testing.assert_array_equal(passes["joint_noise_si"], [max(one["joint_noise"]) for one in listed])
    assert all(one["joint_error"] >= 0.0 and sum(one["dropped"].values()) == one["points_dropped"] for one in listed)
    dropped = [", ".join(f"{count} {reason}" for reason, count in one["dropped"].items()) for one in listed]
    assert passes["dropped"].tolist() == dropped
    assert set(passes["reason"]) == {""}
    assert passes["points"].sum() == rows["kind"].size
    assert (passes["host_start_ns"] < passes["host_end_ns"]).all()
