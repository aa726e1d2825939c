"""The open benchmark: every method on every tracked arm, judged on rows that were not fitted.

    .venv/bin/python bench/open_benchmark.py [--only TEXT] [--write]

A method is a file of bench/methods, a data set a case of bench/real_arms.py. Methods of other programs run in environments
of their own (make bench). --write puts the table into docs/explanation/open-benchmark.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import signal
import subprocess
import tempfile
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from real_arms import ROOT, Case, base_points, cases

PAGE = ROOT / "docs" / "explanation" / "open-benchmark.md"
TARGET = (0.0, 0.0, 0.093)  # m: about where the reflector is on the flange
PATIENCE = 150  # s of CPU of one method
SETS = ("ur10-c-0", "ur10-a-blocks-0", "ur5")
ENVIRONMENT = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Method(NamedTuple):
    """A file of bench/methods with its arguments, and the environment that it needs (bench/peers), "" for truearm's."""

    file: str
    environment: str = ""
    arguments: tuple[str, ...] = ()


METHODS = {
    "truearm": Method("truearm_identify"),
    "truearm, geometry alone": Method("truearm_identify", arguments=("geometry",)),
    "scipy lm, analytic Jacobian": Method("scipy_lm"),
    "pybotics": Method("pybotics_lm", "pybotics"),
    "figaroh": Method("figaroh_lm", "figaroh"),
    "robotkinecal": Method("robotkinecal_poe", "robotkinecal"),
}


def write_case(case: Case, path: Path) -> None:
    """Write what bench/methods/method.py describes."""
    chain, held = case.robot.chain, case.held
    values = dict(zip(chain.parameter_names, chain.params_nominal, strict=True))
    rows = [[values.get(f"joint{i}.{key}", 0.0) for key in ("offset", "d", "a", "alpha")] for i in range(1, 7)]
    q, points = case.table.q, base_points(case.robot, case.table)
    fitted, judged = {"q": q[~held], "y": points[~held]}, {"q_held": q[held], "y_held": points[held]}
    np.savez(path, dh=np.array(rows), target=np.array(TARGET), robot=case.robot.file, **fitted, **judged)


def run(method: Method, path: Path) -> dict[str, object]:
    """Return what a method prints, or only a ``status`` that says why it prints nothing."""
    folder = ROOT / "build/bench-venv" / method.environment if method.environment else ROOT / ".venv"
    if not folder.is_dir():
        return {"status": "not installed"}
    command = [folder / "bin/python", ROOT / "bench/methods" / f"{method.file}.py", path, *method.arguments]
    environment = ENVIRONMENT | {"PYTHONPATH": str(ROOT / "bench/workers")}
    limit = partial(resource.setrlimit, resource.RLIMIT_CPU, (PATIENCE, PATIENCE + 5))
    done = subprocess.run(command, env=environment, capture_output=True, text=True, preexec_fn=limit, check=False)
    if done.returncode == -signal.SIGXCPU:
        return {"status": f"not finished in {PATIENCE} s"}
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    return json.loads(lines[-1][7:]) if lines else {"status": f"failed: {done.stderr.strip().splitlines()[-1:]}"}


def row(case: Case, name: str, figures: dict[str, object]) -> str:
    head = f"| {case.name}, {case.split} | {int((~case.held).sum())} / {int(case.held.sum())} | {name} |"
    if "status" in figures:
        return f"{head} - | {figures['status']} | - | - | - |"
    return "{head} {version} | {mean_mm:.3f} | {max_mm:.2f} | {seconds:.2f} | {peak_mb:.0f} |".format(
        head=head, **figures
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="data sets or methods whose name contains this")
    parser.add_argument("--write", action="store_true", help="write the table into docs/explanation/open-benchmark.md")
    asked = parser.parse_args()
    makers, rows = dict(cases()), []
    with tempfile.TemporaryDirectory() as folder:
        for label in SETS:
            case = makers[label]()
            write_case(case, path := Path(folder) / f"{label}.npz")
            for name, method in METHODS.items():
                if asked.only in f"{label} {name}":
                    rows.append(row(case, name, run(method, path)))
                    print(rows[-1], flush=True)
    if asked.write:
        text = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(re.sub(r"(?<=\|--:\|\n)(\|.*\n)+", "".join(f"{line}\n" for line in rows), text, count=1))


if __name__ == "__main__":
    main()
