"""The claims of the line demo, each compared with theory: Renders' experiment from the firmware to the report."""

import json
import math
import re

import numpy as np
import pytest

from truearm.cli.main import main

SENSORS_MM = math.hypot(0.062, 0.1, 0.062)  # norm of a point's declared errors


@pytest.fixture(scope="module", params=["line", pytest.param("both", marks=pytest.mark.soak)])
def demo(request, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param)
    said = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.echo", lambda text="", **_: said.append(text))
        assert main(["demo", "--experiment", request.param, "--out", str(out), "--poses", "90", "--rate", "500"]) == 0
    return request.param, "\n".join(said), json.loads((out / "result.json").read_text()), out


def figures(said, label):
    """Return RMS before and after [mm], and the number of rows."""
    found = re.search(rf"^{label} +([\d.]+) mm RMS before, ([\d.]+) mm after \((\d+) observations", said, re.M)
    return float(found[1]), float(found[2]), int(found[3])


def test_four_lines_fit_to_what_the_sensors_leave(demo):
    kind, said, result, _ = demo
    before, after, n = figures(said, "4 lines")
    assert before > 5 * after
    unknowns = 6 * 4 + (result["rank"] if kind == "line" else 0)
    # Of 3 n errors of unequal size; their mean square is known to (Σσ⁴ · 2/n)^½ / Σσ², and the samples' own noise adds a little.
    expected = SENSORS_MM * math.sqrt(1 - unknowns / (3 * n))
    share = math.sqrt(2 / n * (2 * 0.062**4 + 0.1**4)) / SENSORS_MM**2
    assert abs(after / expected - 1.0) < 3 * 0.5 * share + 0.02


def test_the_line_that_was_not_fitted_is_predicted(demo):
    _, said, result, _ = demo
    before, after, n = figures(said, "validation line")
    assert after < before / 3
    assert "line=check" in result["held_out_by"]
    assert result["held_out"]["n"] >= n


def test_the_hidden_delay_is_found(demo):
    found, sigma, true = map(float, re.search(r"([\d.]+) ± ([\d.]+) ms found, ([\d.]+) ms true", demo[1]).groups())
    assert true == 8.3
    assert 0.0 < sigma < 0.2
    assert abs(found - true) < 3 * sigma + 0.005  # what is printed is rounded


def test_both_solvers_agree_and_nothing_is_lost(demo):
    kind, said, result, out = demo
    assert "recorded, 0 lost" in said
    assert "within its reported bound" in said
    if kind == "line":
        apart = float(re.search(r"ends within (\S+) σ", said)[1])
        assert apart < 0.01
    else:
        _, bar, n = figures(said, "61 cm shells")
        assert n == 90
        # 36 parameters of 90 dwells and 4 lines; without lines the prediction is 0.084·√(1 + 36/90) at best.
        assert bar < 0.084 * 1.5
    assert {"line"} <= {kind["kind"] for kind in result["observations"]}
    page = (out / "report.html").read_text()
    assert "delay of the robot" in page
    assert f"truearm demo --experiment {kind} --out {out} --poses 90 --rate 500" in page
    assert np.isfinite([p["value"] for p in result["parameters"]]).all()
