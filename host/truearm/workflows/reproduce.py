"""Compute all chapters of a paper and write them as a page and as numbers (``truearm reproduce``)."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, assert_never

if TYPE_CHECKING:
    from truearm.report.reproduce_page import ReproducePage
    from truearm.reproduce.goswami import Bench
    from truearm.reproduce.goswami_page import ReportStep


class Paper(StrEnum):
    """A paper that can be reproduced."""

    goswami = "goswami"
    renders = "renders"


def reproduced(paper: Paper, quick: bool, seed: int, step: ReportStep) -> ReproducePage:
    """Return all chapters of a paper, without their durations.

    ``quick``: with fewer experiments. ``step`` is entered as a context for each step.
    """
    from truearm.report.reproduce_page import ReproducePage
    from truearm.reproduce import goswami_page, renders_page

    match paper:
        case Paper.goswami:
            with step("plan of the poses on the shells"):
                bench = planned_bench(800, seed)
            chapters = tuple(goswami_page.chapters(bench, quick, seed, step))
            return ReproducePage(goswami_page.TITLE, goswami_page.SOURCE, chapters)
        case Paper.renders:
            chapters = tuple(renders_page.chapters(quick, seed, step))
            return ReproducePage(renders_page.TITLE, renders_page.SOURCE, chapters)
        case _:
            assert_never(paper)


def planned_bench(n_poses: int, seed: int) -> Bench:
    """Return the simulator's plan and rig: poses on the shells of both bars that the arm can reach."""
    from truearm.model.robot import builtin_robot
    from truearm.reproduce.goswami import bench
    from truearm_sim.world import standard_plan, standard_rig

    plan = standard_plan(n_poses, seed)
    return bench(builtin_robot("puma560"), standard_rig(), plan.q, plan.bar, plan.chuck, plan.sphere)


def write_page(folder: Path, page: ReproducePage) -> tuple[Path, Path]:
    """Write report.html and numbers.json; return their paths. Raises InputError."""
    from truearm.files.disk import write_atomic
    from truearm.report.reproduce_page import document, render

    report, numbers = folder / "report.html", folder / "numbers.json"
    write_atomic(numbers, json.dumps(document(page), indent=1, ensure_ascii=False, allow_nan=False))
    write_atomic(report, render(page))
    return report, numbers
