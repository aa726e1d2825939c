"""Each notebook runs from its first cell to its last in its own process, and prints what is committed."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
PAPERS = sorted((ROOT / "docs" / "notebooks").glob("*_19*.ipynb"))


def printed(path: Path) -> list[list[str]]:
    """Return what each cell printed, and a mark for each picture."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [
        ["".join(output.get("text", ["<picture>"])) for output in cell["outputs"]]
        for cell in cells
        if cell["cell_type"] == "code"
    ]


def run(path: Path, folder: Path, **environment: str) -> Path:
    """Return a copy of the notebook, run in a process of its own."""
    copy = Path(shutil.copy(path, folder))
    command = [sys.executable, str(ROOT / "docs" / "_site" / "run_notebook.py"), str(copy), "--write"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MPLCONFIGDIR": str(folder)} | environment
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return copy


@pytest.mark.parametrize("path", PAPERS, ids=lambda p: p.stem)
def test_every_number_of_a_paper_meets_its_criterion(path, tmp_path):
    """With fewer experiments; a cell raises an error for a number that does not."""
    assert printed(run(path, tmp_path, TRUEARM_QUICK="1"))


@pytest.mark.parametrize(
    ("paper", "here", "theory", "tolerance", "differs", "holds"),
    [
        (1.0, 1.1, None, 0.2, "", True),
        (1.0, 1.3, None, 0.2, "", False),
        (1.0, np.array([0.8, 1.2, 1.6]), None, 0.0, "", True),
        (1.0, np.array([1.3, 1.31, 1.32]), None, 0.0, "", False),
        (0.0, np.array([-0.2, 0.1, 0.2]), None, 0.0, "", True),
        (1.0, 1.3, None, 0.2, "its lines are not stated", True),
        (1.0, 1.1, None, 0.2, "its lines are not stated", False),
        (1.0, 1.0, (1.1, 1.2), 0.0, "", False),
        (None, 1.15, (1.1, 1.2), 0.0, "", True),
        (None, np.nan, (1.1, 1.2), 0.0, "", False),
        (None, 1.0, None, 0.0, "", False),
    ],
)
def test_a_criterion_can_fail(monkeypatch, paper, here, theory, tolerance, differs, holds):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "notebooks"))
    from papers import Number, compare

    number = Number("a", "mm", paper, here, theory, tolerance, differs)
    with contextlib.nullcontext() if holds else pytest.raises(AssertionError, match="a: "):
        compare([number])


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.soak] * (p in PAPERS)) for p in NOTEBOOKS], ids=lambda p: p.stem
)
def test_notebook(path, tmp_path):
    copy = run(path, tmp_path)
    assert printed(copy) == printed(path), "make notebooks"
    assert sum(cell.count("<picture>") for cell in printed(path)) >= 1


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_is_one_for_jupyter(path):
    """The fields of nbformat 4.5 that every reader wants, and no picture above 60 kB."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    for cell in notebook["cells"]:
        assert set(cell) == {"cell_type", "id", "metadata", "source"} | (
            {"execution_count", "outputs"} if cell["cell_type"] == "code" else set()
        )
        for output in cell.get("outputs", []):
            assert len(output.get("data", {}).get("image/png", "")) < 60_000


def test_there_are_five():
    assert len(NOTEBOOKS) == 5
