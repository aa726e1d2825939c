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
from truearm.session.box_ident import EMULATED_UID
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


def run(capsys, *words):
    assert main([*map(str, words)]) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_result_and_its_pages(folder, tmp_path, capsys):
    assert json.loads((folder / "result.json").read_text())["simulated"] is True
    run(capsys, "report", folder / "result.json", SESSION, "--out", tmp_path / "page.html")
    assert "Certificate of a simulated calibration" in (tmp_path / "page.html").read_text()
    for page in (folder / "fit.html", tmp_path / "page.html"):
        assert WATERMARK in page.read_text()
    assert "SIMULATED" in run(capsys, "validate", folder / "result.json", SESSION)


def test_correction(folder, tmp_path, capsys):
    targets, page = tmp_path / "targets.csv", tmp_path / "page.html"
    targets.write_text("name,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\na,500,150,300,170,5,10\n")
    more = ("--allow-unusable", "--home", "20,-30,150,0,20,0", "--out", tmp_path / "c.csv", "--report", page)
    assert "SIMULATED" in run(capsys, "correct", folder / "result.json", targets, *more)
    assert WATERMARK in page.read_text()


def test_map_and_exported_robot(folder, tmp_path, capsys):
    files = ("--allow-unusable", "--cell-mm", 200, "--picture-out", tmp_path / "map.svg", "--out", tmp_path / "map.csv")
    assert "SIMULATED" in run(capsys, "map", folder / "result.json", *files)
    assert "Simulated" in (tmp_path / "map.svg").read_text()
    assert {row["simulated"] for row in csv.DictReader((tmp_path / "map.csv").open())} == {"yes"}
    files = ("--allow-unusable", "--format", "sheth-uicker", "--out", tmp_path / "robot.toml")
    assert "SIMULATED" in run(capsys, "export", folder / "result.json", *files)
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
