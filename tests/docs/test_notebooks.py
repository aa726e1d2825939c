"""Each notebook runs from its first cell to its last in its own process, and prints what is committed."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def printed(path: Path) -> list[list[str]]:
    """Return what each cell printed, and a mark for each picture."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [
        ["".join(output.get("text", ["<picture>"])) for output in cell["outputs"]]
        for cell in cells
        if cell["cell_type"] == "code"
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook(path, tmp_path):
    copy = Path(shutil.copy(path, tmp_path))
    runner = ROOT / "docs" / "_site" / "run_notebook.py"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MPLCONFIGDIR": str(tmp_path)}
    command = [sys.executable, str(runner), str(copy), "--write"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
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
    assert path.stat().st_size < 100_000


def test_there_are_three():
    assert len(NOTEBOOKS) == 3
