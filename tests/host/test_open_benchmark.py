"""The open benchmark: two methods agree on a small arm, and its page lists the methods, the data sets and their licences."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from truearm.model.chain import point_forward
from truearm.model.robot_file import builtin_robot

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "open-benchmark.md").read_text(encoding="utf-8")
NOISE = 5e-5  # m


@pytest.fixture(scope="module")
def benchmark():
    """Return bench/open_benchmark.py, which is no package."""
    sys.path.insert(0, str(ROOT / "bench"))
    try:
        spec = importlib.util.spec_from_file_location("open_benchmark", ROOT / "bench" / "open_benchmark.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(ROOT / "bench"))
    return module


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Write 120 points of a UR5e whose lengths are off by 0.3 mm, of which 20 judge."""
    robot, rng = builtin_robot("ur5e"), np.random.default_rng(3)
    chain, target = robot.chain, np.array([0.02, 0.0, 0.09])
    off = np.array([3e-4 * (p.unit == "m") for p in chain.parameters])
    truth = chain.params_nominal + off * robot.free * rng.normal(size=len(off))
    q = rng.uniform(-2.0, 2.0, (120, 6))
    points = point_forward(chain, truth, q, target) + NOISE * rng.normal(size=(120, 3))
    path = tmp_path_factory.mktemp("bench") / "small.npz"
    fitted, judged = {"q": q[20:], "y": points[20:]}, {"q_held": q[:20], "y_held": points[:20]}
    np.savez(path, dh=np.zeros((6, 4)), target=target, robot="ur5e", **fitted, **judged)
    return path


def test_methods_agree_and_those_that_are_missing_are_said(benchmark, small, tmp_path):
    figures = [
        benchmark.run(benchmark.METHODS[name], small)
        for name in ("truearm, geometry alone", "scipy lm, analytic Jacobian")
    ]
    assert not [one["status"] for one in figures if "status" in one]
    errors = [one["mean_mm"] for one in figures]
    assert errors[0] == pytest.approx(errors[1], rel=0.15)
    assert errors[1] < 2.5 * 1e3 * NOISE
    assert all(one["max_mm"] >= one["mean_mm"] and one["seconds"] > 0.0 for one in figures)
    assert benchmark.run(benchmark.Method("scipy_lm", "nowhere"), small) == {"status": "not installed"}
    assert benchmark.run(benchmark.METHODS["truearm"], tmp_path / "none.npz")["status"].startswith("failed: ")


def test_the_page_has_every_method_on_every_set(benchmark):
    rows = re.findall(r"^\| (.+?), .* \| \d+ / \d+ \| (.+?) \|", PAGE, re.MULTILINE)
    assert len(rows) == len(benchmark.SETS) * len(benchmark.METHODS)
    assert {name for _, name in rows} == set(benchmark.METHODS)
    for name, method in benchmark.METHODS.items():
        assert (ROOT / "bench" / "methods" / f"{method.file}.py").is_file(), name
        assert not method.environment or (ROOT / "bench" / "peers" / f"{method.environment}.txt").is_file()
