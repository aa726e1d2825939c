"""Printing that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from truearm.errors import TruearmError
from truearm.findings import Finding, option
from truearm.strict_json import strict_json
from truearm.text import one_line


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on standard output."""
    for line in lines:
        print(line, flush=True)


def print_json(document: Any) -> None:
    """Print a document as JSON on standard output; a number that is not finite is null."""
    print(strict_json(document))


@contextmanager
def before_error(findings: Iterable[Finding]) -> Iterator[None]:
    """Print findings on standard error if an error ends the command, as they may be its cause."""
    try:
        yield
    except TruearmError:
        for finding in findings:
            print(f"{finding.severity}: {finding.text(option)}", file=sys.stderr)
        raise


def warn_of_further_parts(session: Path, advice: str) -> None:
    """Print on standard error the further parts that a command does not read, and the ``advice`` about them. Raises SessionError."""
    from truearm.workflows.session_parts import session_parts

    names = [one_line(path.name) for path in session_parts(session)[1:]]
    if names:
        print(f"{one_line(session.name)} continues in {', '.join(names)}: {advice}", file=sys.stderr)
