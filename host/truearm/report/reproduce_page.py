"""An HTML page that compares a paper's numbers with those of this program, for ``truearm reproduce``.

A claim has a number from the paper (or none, if only truearm has one), truearm's number, and the theoretical
expectation. Its verdict follows from the numbers: reproduced if they agree within the tolerance, which must be given
with its reason; in kind if the paper does not give what is needed to compute its number; not judged if there are so few
experiments that the result depends on chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from truearm.report.figures import Figure
from truearm.report.page_parts import (
    command_block,
    html_page,
    picture,
    pictures,
    section,
    step_table,
    table,
    table_of,
    tiles,
)
from truearm.report.page_text import ABSENT, escape, figures

REPRODUCED, NOT_REPRODUCED, IN_KIND, TRUEARM_ONLY = "reproduced", "not reproduced", "in kind", "not in the paper"
NOT_JUDGED = "not judged"


@dataclass(frozen=True)
class Claim:
    """One number. ``expected`` is the theoretical value of truearm's; ``why`` explains a difference or the method."""

    what: str
    unit: str  # "mm", "rad", "1" …; "" for a count
    paper: float | None
    ours: float
    expected: float | None = None
    tolerance: float | None = 0.0  # about the paper's number; None: the paper gives too little
    why: str = ""
    judged: bool = True  # False: there are too few experiments

    @property
    def verdict(self) -> str:
        if self.paper is None:
            return TRUEARM_ONLY
        if self.tolerance is None:
            return IN_KIND
        if not self.judged:
            return NOT_JUDGED
        return REPRODUCED if abs(self.ours - self.paper) <= self.tolerance else NOT_REPRODUCED


@dataclass(frozen=True)
class PageTable:
    """A table whose cells are already text; the first column names its row."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Chapter:
    """A table or figure of the paper, or the numbers of a paragraph."""

    title: str
    text: str
    claims: tuple[Claim, ...] = ()
    tables: tuple[PageTable, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True)
class ReproducePage:
    """A paper, chapter by chapter; ``steps`` are names and seconds, ``command`` makes the page again."""

    title: str
    source: str
    chapters: tuple[Chapter, ...]
    steps: tuple[tuple[str, float], ...] = ()
    command: str = ""


def left_out(rows: tuple[tuple[str, str], ...]) -> Chapter:
    """Return the chapter of the paper's numbers and figures that are not reproduced: each, and why."""
    table = PageTable("Left out", ("number or figure of the paper", "why it is not reproduced"), rows)
    text = "Numbers and figures of the paper that are not computed here, and why."
    return Chapter("Not on this page", text, tables=(table,))


def counts(page: ReproducePage) -> dict[str, int]:
    """Return the number of claims per verdict; "not judged" only if there are any."""
    every = [claim.verdict for chapter in page.chapters for claim in chapter.claims]
    verdicts = (REPRODUCED, IN_KIND, NOT_REPRODUCED, *[NOT_JUDGED] * (NOT_JUDGED in every), TRUEARM_ONLY)
    return {verdict: every.count(verdict) for verdict in verdicts}


def document(page: ReproducePage) -> dict[str, Any]:
    """Return all numbers of the page, for JSON."""
    return {
        "format": "truearm-reproduce-1",
        "paper": page.source,
        "counts": counts(page),
        "chapters": [
            {
                "title": chapter.title,
                "claims": [_claim_document(claim) for claim in chapter.claims],
                "tables": [vars(table) for table in chapter.tables],
            }
            for chapter in page.chapters
        ],
    }


def _claim_document(claim: Claim) -> dict[str, Any]:
    """Return a claim for JSON, which has no NaN: a number that does not exist is null."""
    fields = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in vars(claim).items()}
    return fields | {"verdict": claim.verdict}


def render(page: ReproducePage) -> str:
    """Return the page as HTML text, to be written as UTF-8."""
    sections = (_summary(page), *map(_chapter, page.chapters), _making(page))
    return html_page("truearm reproduce", page.title, page.source, sections)


def _summary(page: ReproducePage) -> str:
    notes = {
        REPRODUCED: ("fit", "within the tolerance explained in the remark"),
        IN_KIND: ("old", "compared by eye: the paper does not give everything that its number depends on"),
        NOT_REPRODUCED: ("val", "the remark says why"),
        NOT_JUDGED: ("old", "too few experiments: a quick run"),
        TRUEARM_ONLY: ("old", "the paper does not give this number"),
    }
    shown = tiles(
        (css, name, [(str(number), "")], note) for name, number in counts(page).items() for css, note in [notes[name]]
    )
    return (
        '<section><h2 class="verdict">The numbers in the column “truearm” were computed when this page was made; those in the '
        f"column “paper” are quoted.</h2>{shown}</section>\n"
    )


def _chapter(chapter: Chapter) -> str:
    parts = [f"<p>{escape(chapter.text, 2000)}</p>", _claims(chapter.claims), *map(_table, chapter.tables)]
    if chapter.figures:
        parts.append(pictures(map(picture, chapter.figures)))
    return section(escape(chapter.title), "".join(parts))


def _claims(claims: Sequence[Claim]) -> str:
    if not claims:
        return ""
    titles = ("", "paper", "truearm", "theory", "unit", "verdict")
    return table(titles, "".join(map(_claim, claims)), "numbers", "claims")


def _claim(claim: Claim) -> str:
    paper = ABSENT if claim.paper is None else f"{claim.paper:.4g}"  # as printed, without extra figures
    cells = "".join(f"<td>{v}</td>" for v in (paper, _number(claim.ours), _number(claim.expected)))
    css = claim.verdict.replace(" ", "-")
    why = f'<tr class="why"><td colspan="6">{escape(claim.why, 800)}</td></tr>' if claim.why else ""
    return (
        f'<tr class="{css}"><th scope="row">{escape(claim.what, 300)}</th>{cells}<td class="unit">'
        f'{escape(claim.unit)}</td><td class="note">{claim.verdict}</td></tr>{why}'
    )


def _number(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return ABSENT
    whole = abs(value) < 1e6 and value == round(value)
    return str(round(value)) if whole else figures(value)


def _table(table: PageTable) -> str:
    title = escape(table.title)
    return f"<h3>{title}</h3>" + table_of(
        list(map(escape, table.head)), [list(map(escape, row)) for row in table.rows], title
    )


def _making(page: ReproducePage) -> str:
    content = command_block(page.command) + (step_table(page.steps) if page.steps else "")
    return section("How it was made", content) if content else ""
