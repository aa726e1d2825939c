"""Printing that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer

from truearm.cli.progress_line import CLEAR
from truearm.files.strict_json import strict_json
from truearm.text import one_line


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on standard output."""
    for line in lines:
        typer.echo(line)


def print_json(document: Any) -> None:
    """Print a document as JSON on standard output; a number that is not finite is null."""
    typer.echo(strict_json(document))


def warn(text: str) -> None:
    """Print a warning on standard error, on a terminal in place of the step that is shown there."""
    clear = CLEAR if sys.stderr.isatty() else ""
    typer.echo(f"{clear}warning: {text}", err=True)


def warn_of_further_parts(session: Path, what: str) -> None:
    """Print on standard error the further parts that a command does not read, and ``what`` to do with them. Raises SessionError."""
    from truearm.workflows.session_parts import session_parts

    parts = [one_line(part.name) for part in session_parts(session)[1:]]
    if parts:
        typer.echo(f"{one_line(session.name)} continues in {', '.join(parts)}: {what}", err=True)
