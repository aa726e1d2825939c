"""What comes of a session of a simulated box is marked as simulated, on the screen and in every file."""

import csv
import io
import json
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

from truearm.cli.main import main
from truearm.estimate.law_curves import SampledCurve
from truearm.session.frames import EMULATED_UID
from truearm.workflows.export import curve_table
from truearm_sim.box import BoxSetup

SESSION = Path(__file__).parents[1] / "data" / "sessions" / "ball-bar.mcap"
WATERMARK = '<p class="watermark" aria-hidden="true">simulated</p>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A result of the session, whose three rows are no usable fit, and its report."""
    folder = tmp_path_factory.mktemp("simulated")
    files = ("--out", str(folder / "result.json"), "--report", str(folder / "fit.html"))
    said = io.StringIO()
    with redirect_stdout(said):
        assert main(["identify", str(SESSION), "--model", "puma560", *files]) == 3
    assert said.getvalue().startswith("SIMULATED")  # before the reasons why the result must not be used
    return folder


def test_result_and_its_pages(folder, tmp_path, printed):
    assert json.loads((folder / "result.json").read_text())["simulated"] is True
    printed("report", folder / "result.json", SESSION, "--out", tmp_path / "page.html")
    assert "a simulated calibration" in (tmp_path / "page.html").read_text()
    for page in (folder / "fit.html", tmp_path / "page.html"):
        assert WATERMARK in page.read_text()
    assert "SIMULATED" in printed("validate", folder / "result.json", SESSION)


def test_correction(folder, tmp_path, printed):
    targets, page = tmp_path / "targets.csv", tmp_path / "page.html"
    targets.write_text("name,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\na,500,150,300,170,5,10\n")
    more = ("--allow-unusable", "--home", "20,-30,150,0,20,0", "--out", tmp_path / "c.csv", "--report", page)
    assert "SIMULATED" in printed("correct", folder / "result.json", targets, *more)
    assert WATERMARK in page.read_text()
    assert [row["simulated"] for row in csv.DictReader((tmp_path / "c.csv").open())] == ["yes"]
    again = ("--allow-unusable", "--out", tmp_path / "again.csv")  # the table has the joints
    assert "SIMULATED" in printed("correct", folder / "result.json", tmp_path / "c.csv", *again)


PROGRAMS = {
    "p.mod": (
        "MODULE m\n  CONST robtarget p1:=[[500,150,300],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
        "  PROC main()\n    MoveL p1,v100,fine,tool0;\n  ENDPROC\nENDMODULE",
        "!",
    ),
    "p.script": ("def p():\n  movel(p[0.5,0.15,0.3,0,3.1,0], a=1.2, v=0.25)\nend\n", "#"),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_corrected_program(folder, tmp_path, printed, name):
    """Its last line is a comment; further lines have their numbers."""
    program, sign = PROGRAMS[name]
    (tmp_path / name).write_text(program)
    poses = ("--work=0,0,0,0,0,0", "--flange=0,0,0,0,0,0", *["--tool=0,0,0,0,0,0"] * (sign == "#"))
    more = ("--allow-unusable", "--home", "20,-30,150,0,20,0", *poses, "--out", tmp_path / f"c{name}")
    printed("correct", folder / "result.json", tmp_path / name, *more)
    *lines, last = (tmp_path / f"c{name}").read_text().splitlines()
    assert len(lines) == len(program.splitlines())
    assert last.startswith(f"{sign} truearm: SIMULATED")


def test_session(printed):
    assert "SIMULATED" in printed("inspect", SESSION)
    assert json.loads(printed("inspect", SESSION, "--json"))["simulated"] is True


def test_map_and_exported_robot(folder, tmp_path, printed):
    files = ("--allow-unusable", "--cell-mm", 200, "--picture-out", tmp_path / "map.svg", "--out", tmp_path / "map.csv")
    assert "SIMULATED" in printed("map", folder / "result.json", *files)
    assert "Simulated" in (tmp_path / "map.svg").read_text()
    assert {row["simulated"] for row in csv.DictReader((tmp_path / "map.csv").open())} == {"yes"}
    files = ("--allow-unusable", "--format", "sheth-uicker", "--out", tmp_path / "robot.toml")
    assert "SIMULATED" in printed("export", folder / "result.json", *files)
    assert "# SIMULATED" in (tmp_path / "robot.toml").read_text()


@pytest.mark.parametrize("simulated", [False, True])
def test_curves(simulated):
    two = np.array([0.0, 0.1])
    curve = SampledCurve("joint1", two, two, two, two < 0.05, ((0.0, 0.0),))
    rows = list(csv.DictReader(curve_table([curve], simulated).splitlines()))
    assert [row.get("simulated") for row in rows] == 2 * (["yes"] if simulated else [None])
    assert [row["covered"] for row in rows] == ["1", "0"]


def test_the_emulated_chip_is_known_by_its_reserved_uid():
    """It runs the firmware of a real box, so nothing else in its ident tells."""
    assert BoxSetup().uid.hex() == EMULATED_UID
