"""Fixtures shared by the host tests."""

import importlib.util
import io
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from command_line import Outcome, Run
from identify_bench import SIGMA, exact_lengths
from record_box import Lab
from tests.refusals import findings

from truearm.cli import main as cli
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import write_table
from truearm.types import Rig


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Return the real main() with arguments; it returns the exit code and the output."""

    def call(*arguments: object) -> Outcome:
        findings.clear()
        code = cli.main([str(a) for a in arguments])
        captured = capsys.readouterr()
        outcome = Outcome(code, captured.out, captured.err)
        outcome.finding = findings[-1] if findings else None
        return outcome

    return call


@pytest.fixture(scope="session")
def real_arms() -> ModuleType:
    """bench/real_arms.py, which is no package."""
    spec = importlib.util.spec_from_file_location("real_arms", Path(__file__).parents[2] / "bench" / "real_arms.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a valid table and a valid rig."""
    folder = tmp_path_factory.mktemp("identify")
    table, rig = exact_lengths(90)
    write_table(folder / "poses.csv", table, ("rad",) * 6)
    write_rig(folder / "rig.toml", rig)
    return folder


@pytest.fixture
def good(files: Path) -> list[object]:
    """Return the arguments of an identification that must succeed."""
    return ["identify", files / "poses.csv", "--model", "puma560", "--rig", files / "rig.toml"]


@pytest.fixture(scope="session")
def good_text(files: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the result file of that identification, which is also its JSON output (test_cli_identify)."""
    out = tmp_path_factory.mktemp("good") / "result.json"
    arguments = ["identify", files / "poses.csv", "--model", "puma560", "--rig", files / "rig.toml", "--out", out]
    with redirect_stdout(io.StringIO()):
        assert cli.main([str(a) for a in arguments]) == 0
    return out.read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def noisy() -> tuple[ObservationTable, Rig]:
    table, rig = exact_lengths(180)
    return replace(table, value=table.value + np.random.default_rng(6).normal(0.0, SIGMA, 180)), rig


@pytest.fixture
def lab():
    return Lab()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s.mcap"
