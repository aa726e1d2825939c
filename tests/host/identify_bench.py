"""Tables and rigs for tests of the command line: the PUMA's ball-bar, exact and with noise."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from command_line import Run

from truearm.kinds.rig_file import write_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import write_table
from truearm.model.chain import point_forward
from truearm.model.robot_file import load_robot
from truearm.types import BallBar, Point, Rig

ROOT = Path(__file__).parents[2]
MUKCA = ROOT / "tests" / "data" / "mukca"


def exact_lengths(n: int, chucks: int = 3, seed: int = 5) -> tuple[ObservationTable, Rig]:
    """Return noise-free ball-bar rows of the PUMA with Table II's optimised parameters, all pairings in turn."""
    robot = load_robot("puma560")
    where = {
        "chuck": [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.0, 0.3, 0.1)][:chucks],
        "sphere": [(0.0, 0.0, 0.1), (0.08, 0.0, 0.1), (0.0, 0.06, 0.05)],
    }
    points = {
        what: {f"{what[0]}{i}": Point(f"{what[0]}{i}", p) for i, p in enumerate(ps)} for what, ps in where.items()
    }
    rig = Rig(points["chuck"], points["sphere"], {"b": BallBar("b", 2.1, 1.0, 4.0, 8.4e-5)})  # lengths of random poses
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, (n, 6))
    chuck, sphere = np.arange(n) % chucks, np.arange(n) // chucks % 3
    ball = point_forward(robot.chain, robot.parameter_sets["optimised"], q, np.array(where["sphere"])[sphere])
    table = ObservationTable(
        q=q,
        kind="ball_bar",
        value=np.linalg.norm(ball - np.array(where["chuck"])[chuck], axis=1),
        bar="b",
        chuck=np.char.add("c", chuck.astype(str)),
        sphere=np.char.add("s", sphere.astype(str)),
        shell=np.where(np.arange(n) < n - 20, "inner", "outer"),
    )
    return table, rig


SIGMA = 8.4e-5  # m, of the bar


def identified(run: Run, folder: Path, table: ObservationTable, rig: Rig, *more: object) -> tuple[dict[str, Any], str]:
    """Return the result file, and the printed text."""
    write_table(folder / "t.csv", table, ("rad",) * 6)
    write_rig(folder / "rig.toml", rig)
    arguments = ["identify", folder / "t.csv", "--model", "puma560", "--rig", folder / "rig.toml", *more]
    outcome = run(*arguments, "--out", folder / "r.json", "--force")  # what --json prints: test_cli_identify
    result = json.loads((folder / "r.json").read_text(encoding="utf-8"))
    assert outcome.code == (0 if result["usable"] else 3)
    return result, outcome.out
