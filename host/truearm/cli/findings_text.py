"""What commands print: their findings, the verdict first, and the files that were written."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Sequence
from itertools import accumulate
from pathlib import Path
from textwrap import wrap

from truearm.finding_texts import Severity
from truearm.findings import Finding, option
from truearm.report.tables import Table
from truearm.text import counted, one_line

MAX_LINES = 15  # of the short form
IN_FILES = 120  # columns of a file or a pipe


def show(
    findings: Sequence[Finding],
    tables: Iterable[Table | str] | None = None,
    written: Iterable[Path | str | None] = (),
    hint: str = "All notes and tables: --details",
) -> None:
    """Print findings and the files that were written.

    Without ``tables``, notes are left out, and what is more than MAX_LINES lines; ``hint`` says where they are. With
    them, advice follows the tables.
    """
    files = [f"Written: {one_line(str(path))}" for path in written if path is not None]
    if tables is None:
        lines = _short(findings, MAX_LINES - len(files), hint)
    else:
        advice = [finding for finding in findings if finding.severity is Severity.ADVICE]
        stated = [_lines(finding) for finding in findings if finding not in advice]
        lines = [*stated, *map(str, tables), *map(_lines, advice)]
    for line in [*lines, *files]:
        print(line)


def _short(findings: Sequence[Finding], room: int, hint: str) -> list[str]:
    """Return all findings but notes, in at most ``room`` lines."""
    texts = [_lines(finding) for finding in findings if finding.severity is not Severity.NOTE]
    ends = accumulate(text.count("\n") + 1 for text in texts)
    shown = sum(end < room for end in ends)
    hidden = len(texts) - shown
    return [*texts[:shown], f"{counted(hidden, 'more finding')}. {hint}" if hidden else hint] if hint else texts[:shown]


def _lines(finding: Finding) -> str:
    """Return a finding in lines as wide as the terminal."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else IN_FILES
    return "\n".join(wrap(finding.text(option), width, break_long_words=False, break_on_hyphens=False))
