"""``truearm reproduce``: compute the tables and figures of a paper again."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from truearm.bounds import SEED
from truearm.cli.command import command
from truearm.cli.output import print_result
from truearm.workflows.reproduce import Paper

if TYPE_CHECKING:
    from truearm.report.reproduce_page import ReproducePage

MARK = ".truearm-reproduce"  # marks a folder that reproduce created and may overwrite


class _Steps:
    """Names and seconds of the steps, printed as they begin and end, on standard error if ``err``."""

    def __init__(self, err: bool) -> None:
        self._err = err
        self.done: list[tuple[str, float]] = []

    @contextmanager
    def __call__(self, name: str, /) -> Iterator[None]:
        typer.echo(f"{name:<64}", nl=False, err=self._err)
        started = time.perf_counter()
        yield
        self.done.append((name, time.perf_counter() - started))
        typer.echo(f"{self.done[-1][1]:7.1f} s", err=self._err)


@command()
def reproduce(
    paper: Paper,
    *,
    out: Path | None = None,
    quick: bool = False,
    seed: Annotated[int, SEED] = 1,
    json: bool = False,
) -> None:
    """Compute the tables and figures of a paper again, and compare them with the paper's numbers.

    Writes report.html and numbers.json. If a number cannot be reproduced, the report says why.

    Example:
      truearm reproduce goswami --quick

    Arguments
    ---------
    paper : PAPER
        goswami: the ball-bar, 1993. renders: the straight line, 1991.

    Options
    -------
    out : FOLDER
        Folder to write: report.html and numbers.json; default: out/PAPER.
    quick
        Fewer Monte Carlo runs and line sets.
    """
    from truearm.files.disk import own_folder
    from truearm.report.reproduce_page import document
    from truearm.workflows.reproduce import reproduced, write_page

    folder = out or Path("out") / paper.value
    own_folder(folder, MARK)
    steps = _Steps(json)
    page = reproduced(paper, quick, seed, steps)
    command_line = f"truearm reproduce {paper.value} --seed {seed}{' --quick' * quick}"
    report, numbers = write_page(folder, replace(page, steps=tuple(steps.done), command=command_line))
    print_result(
        {**document(page), "report": str(report), "numbers": str(numbers)},
        [*lines(page), f"\nreport          {report}", f"numbers         {numbers}"],
        json,
    )


def lines(page: ReproducePage) -> list[str]:
    """Return the number of claims by verdict, and the claims that are not reproduced."""
    from truearm.report.reproduce_page import NOT_REPRODUCED, counts

    found = ["\n" + ", ".join(f"{number} {verdict}" for verdict, number in counts(page).items())]
    for claim in (claim for chapter in page.chapters for claim in chapter.claims):
        if claim.verdict == NOT_REPRODUCED:
            unit = f" {claim.unit}" * (claim.unit not in ("", "1"))
            text = f"  {claim.what}: paper {claim.paper:g}{unit}, truearm {claim.ours:.3g}{unit}. {claim.why}"
            found.append(text.rstrip())
    return found
