"""What commands print: lines, JSON, or their findings, the verdict first, and the files that were written."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Iterable, Sequence
from itertools import accumulate
from pathlib import Path
from textwrap import wrap
from typing import Any

from truearm.finding_texts import Severity
from truearm.findings import Finding, option
from truearm.report.tables import Table
from truearm.text import counted, one_line, strict_json

MAX_LINES = 15  # of the short form
IN_FILES = 120  # columns of a file or a pipe
DETAILS = "All notes and tables: --details"


def print_lines(lines: Iterable[str | Finding]) -> None:
    """Print lines, or findings with their severity, on standard output."""
    for line in lines:
        print(line if isinstance(line, str) else f"{line.severity}: {line.text(option)}", flush=True)


def print_json(document: Any) -> None:
    """Print a document as JSON on standard output; a number that is not finite is null."""
    print(strict_json(document))


def show(
    findings: Sequence[Finding],
    tables: Iterable[Table | str] = (),
    written: Iterable[Path | str | None] = (),
    hint: str = DETAILS,
    details: bool = False,
) -> None:
    """Print findings and the files that were written.

    Without ``details``, notes and tables are left out, and what is more than MAX_LINES lines, but no refusal; ``hint``
    says where they are, and without it nothing but notes is left out. With them, advice follows the tables.
    """
    files = [f"Written: {one_line(str(path))}" for path in written if path is not None]
    if not details:
        lines = _short(findings, MAX_LINES - len(files) if hint else math.inf)
        left_out = len(findings) > len(lines) or next(iter(tables), None) is not None
        hidden = sum(finding.severity is not Severity.NOTE for finding in findings) - len(lines)
        more = f"{counted(hidden, 'more finding')}. " if hidden else ""
        lines += [more + hint] if hint and left_out else []
    else:
        advice = [finding for finding in findings if finding.severity is Severity.ADVICE]
        stated = [_lines(finding) for finding in findings if finding not in advice]
        lines = [*stated, *map(str, tables), *map(_lines, advice)]
    for line in [*lines, *files]:
        print(line)


def _short(findings: Sequence[Finding], room: float) -> list[str]:
    """Return all refusals, and other findings but notes, in less than ``room`` lines."""
    stated = [(finding, _lines(finding)) for finding in findings if finding.severity is not Severity.NOTE]
    ends = accumulate(text.count("\n") + 1 for _, text in stated)
    return [
        text
        for (finding, text), end in zip(stated, ends, strict=True)
        if end < room or finding.severity is Severity.REFUSAL
    ]


def _lines(finding: Finding) -> str:
    """Return a finding in lines as wide as the terminal."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else IN_FILES
    return "\n".join(wrap(finding.text(option), width, break_long_words=False, break_on_hyphens=False))
