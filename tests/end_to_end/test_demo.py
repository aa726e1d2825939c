"""The claims of the demo, each compared with theory, on one run. In make soak it has 800 poses per bar, as in `make demo`."""

import json
import math
import re

import pytest
from tests.end_to_end.conftest import truearm, truearm_process

from truearm.cli.main import main
from truearm_sim import micropython

SIGMA = 0.084  # mm, drawn once a dwell
POSES = 800  # by default


@pytest.fixture(scope="module", params=[300, pytest.param(POSES, marks=pytest.mark.soak)])
def poses(request):
    return request.param


@pytest.fixture(scope="module")
def demo(tmp_path_factory, poses):
    out = tmp_path_factory.mktemp("demo")
    done = truearm_process("demo", "--out", out, *(("--poses", poses) if poses != POSES else ()), timeout_s=600)
    assert done.returncode == 0, done.stderr
    return out, done.stdout, json.loads((out / "result.json").read_text())


def test_firmware_ran_in_micropython(demo):
    assert "Firmware in MicroPython" in demo[1]


def test_residual_is_what_noise_leaves(demo, poses):
    """With 36 parameters: σ·√(1 − 36/n), with a standard error of σ/√(2 (n − 36))."""
    _, _, result = demo
    n = sum(kind["fitted"] for kind in result["observations"])
    assert n == poses
    expected, error = SIGMA * math.sqrt(1 - 36 / n), SIGMA / math.sqrt(2 * (n - 36))
    assert abs(result["rms_after_mm"] - expected) <= 3 * error


def test_rank_and_iterations(demo):
    _, stdout, result = demo
    assert result["status"] == "converged"
    assert result["iterations"] <= 10
    assert result["rank"] == 36
    assert "rank 36 of 36 free (rank 36 if all 54 were free)" in stdout


def test_validation_on_the_other_shells(demo, poses):
    """0.097 mm with 800 poses; the square of what the parameters' errors add to the noise falls as 1/n."""
    held_out = demo[2]["held_out"]
    assert held_out["n"] == poses
    assert held_out["rms_mm"] <= math.sqrt(SIGMA**2 + (0.097**2 - SIGMA**2) * POSES / poses)


def test_nothing_was_lost_and_the_clock_kept_its_bound(demo):
    assert re.search(r"recorded, 0 lost", demo[1])
    assert "within its reported bound" in demo[1]


def test_every_step_has_its_time(demo):
    assert len(re.findall(r"\d+\.\d s$", demo[1], re.M)) >= 6


def test_the_session_identifies_to_the_same_result(demo):
    out, _, result = demo
    done = truearm("identify", out / "session.mcap", "--model", "puma560", "--hold-out", "bar=bar61", "--json")
    assert done.returncode == 0, done.stderr
    again = json.loads(done.stdout)
    assert again["rms_after_mm"] == pytest.approx(result["rms_after_mm"], rel=1e-9)
    assert again["held_out"]["rms_mm"] == pytest.approx(result["held_out"]["rms_mm"], rel=1e-9)


def test_its_result_and_page_are_marked_as_simulated(demo):
    assert demo[2]["simulated"] is True
    assert '<p class="watermark" aria-hidden="true">simulated</p>' in (demo[0] / "report.html").read_text()


def test_without_micropython_the_demo_says_so_and_works(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(micropython, "find", lambda: None)
    assert main(["demo", "--out", str(tmp_path), "--poses", "90", "--rate", "250"]) == 0
    stdout = capsys.readouterr().out
    assert "MicroPython not found: the firmware runs in CPython instead" in stdout
    assert "0 lost" in stdout
    assert "rank 36 of 36 free (rank 36 if all 54 were free)" in stdout
