"""The claims of the demo, each compared with theory, on one run. In make soak it also has 800 poses per bar."""

import json
import math

import pytest
from tests.end_to_end.conftest import truearm, truearm_process

from truearm.cli.main import main
from truearm_sim import micropython

SIGMA = 0.084  # mm, drawn once a dwell
POSES, FULL_POSES = 90, 800


@pytest.fixture(scope="module", params=[POSES, pytest.param(FULL_POSES, marks=pytest.mark.soak)])
def poses(request):
    return request.param


@pytest.fixture(scope="module")
def demo(tmp_path_factory, poses):
    out = tmp_path_factory.mktemp("demo")
    done = truearm_process("demo", "--out", out, *["--full"] * (poses == FULL_POSES), timeout_s=600)
    assert done.returncode == 0, done.stderr
    return out, done.stdout, json.loads((out / "result.json").read_text())


def test_the_fit_converges_to_what_noise_leaves(demo, poses):
    # With 36 parameters: σ·√(1 − 36/n), with a standard error of σ/√(2 (n − 36)).
    _, _, result = demo
    n = sum(kind["fitted"] for kind in result["observations"])
    assert n == poses
    expected, error = SIGMA * math.sqrt(1 - 36 / n), SIGMA / math.sqrt(2 * (n - 36))
    assert abs(result["rms_after_mm"] - expected) <= 3 * error
    result = demo[2]
    assert result["status"] == "converged"
    assert result["iterations"] <= 10
    assert result["rank"] == 36


def test_validation_on_the_other_shells(demo, poses):
    """0.097 mm with 800 poses; the square of what the parameters' errors add to the noise falls as 1/n."""
    held_out = demo[2]["held_out"]
    assert held_out["n"] == poses
    assert held_out["rms_mm"] <= math.sqrt(SIGMA**2 + (0.097**2 - SIGMA**2) * FULL_POSES / poses)


def test_the_answer_is_five_lines_and_a_page_marked_as_simulated(demo):
    recorded, *answer = demo[1].splitlines()[1:]
    assert "robot time" in recorded
    assert len(answer) <= 5
    assert answer[-1] == f"Written: {demo[0] / 'report.html'}"
    assert demo[2]["simulated"] is True
    assert '<p class="watermark" aria-hidden="true">simulated</p>' in (demo[0] / "report.html").read_text()
    assert "firmware: MicroPython" in demo[1]
    done = truearm("inspect", demo[0] / "session.mcap", "--json")
    losses = json.loads(done.stdout)["losses"]
    assert (losses["frames_lost"], losses["samples_lost"], losses["samples_overrun"]) == (0, 0, 0)


def test_lines_are_fitted_but_for_the_last_one(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("click.launch", opened.append)
    assert main(["demo", "--lines", "4", "--out", str(tmp_path), "--open"]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert opened == [str(tmp_path / "report.html")]
    assert result["held_out_by"] == ["line=l4"]
    assert result["held_out"]["rms_mm"] < result["held_out_before"]["rms_mm"] / 3


def test_without_micropython_the_demo_says_so_and_works(tmp_path, monkeypatch, printed):
    monkeypatch.setattr(micropython, "find", lambda: None)
    assert "firmware: CPython" in printed("demo", "--out", tmp_path, "--poses", "45", "--rate", "250")
    assert json.loads((tmp_path / "result.json").read_text())["rank"] == 36
    (stream,) = json.loads(printed("inspect", tmp_path / "session.mcap", "--json"))["streams"]
    assert stream["rate_nominal_hz"] == pytest.approx(254.3, abs=0.05), "the rate of the converter next to 250 Hz"
