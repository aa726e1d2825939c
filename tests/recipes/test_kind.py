"""A new kind of observation, an inclinometer, in one new file and one line of the registry."""

import csv
import json
import math
from unittest.mock import patch

import numpy as np
import pytest

from tests.host import session_stream
from tests.host.record_box import Lab
from tests.recipes.recipes import Copy, findings
from truearm.model.chain import forward
from truearm.model.robot import builtin_robot
from truearm.record.session_writer import SessionWriter

SIGMA_RAD, SIGMA_M = 1e-4, 2e-5
ZERO = {"i1": 0.01, "i2": -0.005}
AXES = {"i1": (1.0, 0.0, 0.0), "i2": (-1.0, 0.0, 0.0)}
RIG = """
[[inclinometer]]
name = "i1"
sigma_rad = 1e-4
zero_sigma_deg = "unknown"

[[inclinometer]]
name = "i2"
sigma_rad = 1e-4
axis = [-1, 0, 0]
zero_sigma_deg = "unknown"

[[tracker]]
name = "t"
sigma_mm = [0.02, 0.02, 0.02]
xyz_mm = [0, 0, 0]
position_sigma_mm = 0
turn_sigma_deg = 0
"""
COMMAND = ("--model", "puma560", "--rig", "rig.toml")


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The package with the kind, and its inputs."""
    copy = Copy(tmp_path_factory.mktemp("kind"))
    copy.apply("A kind of observation")
    assert copy.changes() == {
        "host/truearm/kinds/inclinometer.py": "new file",
        "host/truearm/kinds/__init__.py": "+1 -0",
    }
    write_inputs(copy.folder)
    return copy


def write_inputs(folder):
    """Write poses.csv and rig.toml: points of a tracker and readings of two inclinometers on a PUMA 560."""
    robot, rng = builtin_robot("puma560"), np.random.default_rng(4)
    q = rng.uniform(-2.0, 2.0, (500, 6))
    pose = forward(robot.chain, robot.parameter_sets["optimised"], q)
    name = np.array(list(AXES))[np.arange(len(q)) % 2]
    angle = np.arcsin(np.einsum("nk,nk->n", pose[:, 2, :3], np.array([AXES[n] for n in name])))
    angle += np.array([ZERO[n] for n in name]) + SIGMA_RAD * rng.normal(size=len(q))
    point = pose[:, :3, 3] + SIGMA_M * rng.normal(size=(len(q), 3))
    lines = [
        "kind,inclinometer,tracker,inclination_deg,x_m,y_m,z_m,sigma_deg," + ",".join(f"q{i}_rad" for i in range(1, 7))
    ]
    for i, joints in enumerate(q.tolist()):
        if i < 300:
            cells = ["position", "", "t", "", *map(repr, point[i].tolist()), ""]
        elif abs(angle[i]) < 1.3:
            cells = ["inclinometer", name[i], "", repr(math.degrees(angle[i])), "", "", "", "0.006" if i % 3 else ""]
        else:
            continue
        lines.append(",".join([*cells, *map(repr, joints)]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    (folder / "rig.toml").write_text(RIG)


def test_a_session_has_a_row_for_each_dwell(copy):
    """The box reads the inclinometer in place of an LVDT; its channel is calibrated in rad, and no bar is mounted."""
    document = session_stream.ident_document()
    (stream,) = document["streams"]
    stream["channels"][0] |= {"name": "inclinometer", "calibration": {"unit": "rad", "poly": session_stream.POLY}}
    with patch.object(session_stream, "ident_document", lambda *_: document):
        messages, truth = session_stream.session(np.random.default_rng(6), dwells=4, plan=False)
    with SessionWriter(copy.folder / "s.mcap", Lab()) as writer:
        for message in messages:
            writer.add(*message)
        writer.close({"reason": "test"})
    (copy.folder / "device.toml").write_text("[[inclinometer]]\nname = 'i1'\nsigma_rad = 1e-4\n")
    copy.run("session", "export", "s.mcap", "--rig", "device.toml", "--out", "exported")
    with (copy.folder / "exported" / "observations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["kind"], row["inclinometer"]) for row in rows] == [("inclinometer", "i1")] * 4
    assert [float(row["inclination_rad"]) for row in rows] == pytest.approx(truth.length - 0.46, abs=1e-6)


def test_it_is_identified_judged_and_reported(copy):
    outputs = ("--out", "result.json", "--report", "page.html", "--table-out", "saved.csv")
    said = copy.run("identify", "poses.csv", *COMMAND, "--hold-out", "inclinometer=i2", "--details", *outputs)
    assert "error [mm]" in said
    assert "error [deg]" in said
    assert "inclinometer" in said.partition("error [deg]")[2]
    result = json.loads((copy.folder / "result.json").read_text())
    inclined, tracked = sorted(result["observations"], key=lambda entry: entry["kind"])
    assert (inclined["kind"], tracked["kind"]) == ("inclinometer", "position")
    # Some 90 readings: the RMS is known to 1/sqrt(180) = 7.5 %; 4 of these
    assert inclined["rms_after_deg"] == pytest.approx(math.degrees(SIGMA_RAD), rel=0.3)
    assert inclined["rms_held_out_deg"] == pytest.approx(math.degrees(SIGMA_RAD), rel=0.3)
    assert (inclined["rms_after_mm"], tracked["rms_after_deg"]) == (None, None)
    assert result["rms_after_deg"] == inclined["rms_after_deg"]
    assert result["held_out"]["rms_deg"] == inclined["rms_held_out_deg"]
    assert result["held_out"]["rms_mm"] is None
    (zero,) = (p for p in result["parameters"] if p["name"] == "inclinometer.i1.zero")
    assert zero["unit"] == "rad"
    assert abs(zero["value"] - ZERO["i1"]) < 5 * zero["sigma"] < 1e-3
    page = (copy.folder / "page.html").read_text()
    assert "measured minus predicted inclination." in page
    assert "<dt>inclinometers</dt><dd>i1, i2</dd>" in page


def test_it_is_proposed_where_it_would_show_more(copy):
    """A target on the axis of joint 6 does not show how far that joint turns; an inclinometer's axis turns with it."""
    lines = (copy.folder / "poses.csv").read_text().splitlines()
    inclined = next(line for line in lines[1:] if line[:9] != "position,")  # the user has one
    (copy.folder / "points.csv").write_text(
        "\n".join([lines[0], *(line for line in lines if line[:9] == "position,"), inclined]) + "\n"
    )
    said = copy.run("identify", "points.csv", *COMMAND, "--also-free", "joint6.offset")
    assert "end to identify 1 more parameter: joint6.offset." in " ".join(said.split())


WRONG = {
    "no reading": ("inclinometer,i1,\n", RIG, "malformed-file", ["row 2", "inclination_deg", "inclination_rad"]),
    "unknown": ("inclinometer,i7,3\n", RIG, "not-in-rig", ["row 2", "inclinometer", "i7", "i1", "i2"]),
    "too large": ("inclinometer,i1,91\n", RIG, "malformed-file", ["row 2", "inclination_deg", "91"]),
    "misspelt key": (
        "inclinometer,i1,3\n",
        RIG.replace("axis", "axes"),
        "malformed-file",
        ["[[inclinometer]] 2", "'axes'", "axis?"],
    ),
}


@pytest.fixture(scope="module")
def refused(copy):
    """What each wrong input is answered with."""
    joints, commands = ",".join(f"q{i}_rad" for i in range(1, 7)), []
    for i, (row, rig, *_) in enumerate(WRONG.values()):
        (copy.folder / f"wrong{i}.csv").write_text(
            f"kind,inclinometer,inclination_deg,{joints}\n{row.strip()},{','.join('0' * 6)}\n"
        )
        (copy.folder / f"wrong{i}.toml").write_text(rig)
        commands.append(("identify", f"wrong{i}.csv", "--model", "puma560", "--rig", f"wrong{i}.toml", "--json"))
    return dict(zip(WRONG, copy.run_each(*commands), strict=True))


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_input_is_one_line(refused, wrong):
    said, (*_, code, words) = refused[wrong], WRONG[wrong]
    assert said.code == 2
    (values,) = (values for name, values in findings(said.out).items() if name == code)
    assert [word for word in words if word not in str(values)] == []
    assert said.err.count("\n") == 1
