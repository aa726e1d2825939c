"""Printing that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from truearm.findings import Finding, option
from truearm.strict_json import strict_json
from truearm.text import one_line


def print_lines(lines: Iterable[str | Finding]) -> None:
    """Print lines, or findings with their severity, on standard output."""
    for line in lines:
        print(line if isinstance(line, str) else f"{line.severity}: {line.text(option)}", flush=True)


def print_json(document: Any) -> None:
    """Print a document as JSON on standard output; a number that is not finite is null."""
    print(strict_json(document))


def warn_of_further_parts(session: Path, advice: str) -> None:
    """Print on standard error the further parts that a command does not read, and the ``advice`` about them. Raises SessionError."""
    from truearm.workflows.session_parts import session_parts

    names = [one_line(path.name) for path in session_parts(session)[1:]]
    if names:
        print(f"{one_line(session.name)} continues in {', '.join(names)}: {advice}", file=sys.stderr)
