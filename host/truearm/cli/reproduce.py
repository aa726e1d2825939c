"""``truearm reproduce``: a paper's tables and figures computed again, beside the paper's numbers."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, assert_never

import typer

from truearm.cli.options import SeedOption

if TYPE_CHECKING:
    from truearm.report.reproduce_page import Chapter, ReproducePage
    from truearm.reproduce.goswami import Bench

MARK = ".truearm-reproduce"  # in a folder that reproduce made and may write again


class Paper(StrEnum):
    """What can be reproduced."""

    goswami = "goswami"
    renders = "renders"


class _Steps:
    """Names and seconds of the steps, printed as they begin and end."""

    def __init__(self) -> None:
        self.done: list[tuple[str, float]] = []

    @contextmanager
    def __call__(self, name: str, /) -> Iterator[None]:
        typer.echo(f"{name:<64}", nl=False)
        started = time.perf_counter()
        yield
        self.done.append((name, time.perf_counter() - started))
        typer.echo(f"{self.done[-1][1]:7.1f} s")


def reproduce(
    paper: Annotated[
        Paper, typer.Argument(metavar="PAPER", help="goswami: the ball-bar, 1993. renders: the straight line, 1991.")
    ],
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Default: out/PAPER.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer Monte Carlo runs and line sets.")] = False,
    seed: SeedOption = 1,
) -> None:
    """Compute a paper's tables and figures again and lay them beside the paper's numbers.

    Writes report.html and numbers.json. Where a number cannot be reproduced the page says why.

    \b
    Example:
      truearm reproduce goswami --quick
    """
    from truearm.files.disk import own_folder

    folder = out or Path("out") / paper.value
    own_folder(folder, MARK)
    page = reproduced(paper, quick, seed, f"truearm reproduce {paper.value} --seed {seed}{' --quick' * quick}")
    write(folder, page)


def reproduced(paper: Paper, quick: bool, seed: int, command: str) -> ReproducePage:
    """All chapters of a paper."""
    from truearm.report.reproduce_page import ReproducePage
    from truearm.reproduce import goswami_page, renders_page

    steps = _Steps()
    chapters: tuple[Chapter, ...]
    match paper:
        case Paper.goswami:
            with steps("plan of the poses on the shells"):
                made = planned_bench(800, seed)
            title, source = goswami_page.TITLE, goswami_page.SOURCE
            chapters = tuple(goswami_page.chapters(made, quick, seed, steps))
        case Paper.renders:
            title, source = renders_page.TITLE, renders_page.SOURCE
            chapters = tuple(renders_page.chapters(quick, seed, steps))
        case _:
            assert_never(paper)
    return ReproducePage(title, source, chapters, tuple(steps.done), command)


def planned_bench(n_poses: int, seed: int) -> Bench:
    """The simulator's plan and rig: poses on the shells of both bars that the arm can go to."""
    from truearm.model.robot import builtin_robot
    from truearm.reproduce.goswami import bench
    from truearm_sim.world import standard_plan, standard_rig

    plan = standard_plan(n_poses, seed)
    return bench(builtin_robot("puma560"), standard_rig(), plan.q, plan.bar, plan.chuck, plan.sphere)


def write(folder: Path, page: ReproducePage) -> None:
    """report.html and numbers.json, and a summary on the terminal."""
    from truearm.files.disk import write_atomic
    from truearm.report.reproduce_page import NOT_REPRODUCED, counts, document, render

    numbers = json.dumps(document(page), indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / "numbers.json", numbers)
    write_atomic(folder / "report.html", render(page))
    typer.echo("\n" + ", ".join(f"{number} {verdict}" for verdict, number in counts(page).items()))
    for chapter in page.chapters:
        for claim in chapter.claims:
            if claim.verdict == NOT_REPRODUCED:
                unit = f" {claim.unit}" * (claim.unit not in ("", "1"))
                typer.echo(
                    f"  {claim.what}: paper {claim.paper:g}{unit}, ours {claim.ours:.3g}{unit}. {claim.why}".rstrip()
                )
    typer.echo(f"\nreport          {folder / 'report.html'}\nnumbers         {folder / 'numbers.json'}")
