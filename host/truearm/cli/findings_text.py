"""What commands print: their findings, the verdict first, and the files that were written."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table as RichTable

from truearm.finding_texts import Severity
from truearm.findings import Finding, option
from truearm.report.tables import Table
from truearm.text import counted, one_line

MAX_LINES = 15  # of the short form


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
    # No markup, because names come from files. Into a pipe, rich would wrap at 80 columns.
    width = None if sys.stdout.isatty() else 120
    console = Console(markup=False, highlight=False, emoji=False, width=width)
    files = [f"Written: {one_line(str(path))}" for path in written if path is not None]
    if tables is None:
        lines: list[str | Table] = [*_short(findings, console, MAX_LINES - len(files), hint)]
    else:
        advice = [finding for finding in findings if finding.severity is Severity.ADVICE]
        lines = [*(_text(finding) for finding in findings if finding not in advice), *tables, *map(_text, advice)]
    for line in [*lines, *files]:
        console.print(_printed(line) if isinstance(line, Table) else line)


def _short(findings: Sequence[Finding], console: Console, room: int, hint: str) -> list[str]:
    """Return all findings but notes, in at most ``room`` lines."""
    texts = [_text(finding) for finding in findings if finding.severity is not Severity.NOTE]
    shown: list[str] = []
    n_lines = 1
    for text in texts:
        n_lines += len(console.render_lines(text, pad=False))
        if n_lines > room:
            break
        shown.append(text)
    hidden = len(texts) - len(shown)
    return [*shown, f"{counted(hidden, 'more finding')}. {hint}" if hidden else hint] if hint else shown


def _text(finding: Finding) -> str:
    return finding.text(option)


def _printed(content: Table) -> RichTable:
    """Return a table as the terminal shows it, its texts wrapped."""
    table = RichTable(box=None, pad_edge=False)
    for number, name in enumerate(content.titles):
        is_text = not number or name.endswith(" ")
        table.add_column(name.strip(), justify="left" if is_text else "right", overflow="fold", no_wrap=not is_text)
    for row in content.rows:
        table.add_row(*map(str, row))
    return table
