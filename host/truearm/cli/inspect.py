"""``truearm inspect``: what is in a session file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from truearm.text import one_line
from truearm.workflows.session_parts import session_parts


def inspect(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Session file (.mcap) of truearm record.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")] = False,
    allow_damaged: Annotated[
        bool,
        typer.Option(
            "--allow-damaged",
            "--allow-truncated",
            help="Read what is whole of a file that is damaged, or whose recorder was killed.",
        ),
    ] = False,
) -> None:
    """Say what is in a session: rates, gaps, losses, clock quality, dwells.

    Example: truearm inspect session.mcap
    """
    from truearm.cli.inspect_text import lines
    from truearm.session.session_file import open_session
    from truearm.workflows.inspect import describe

    first, *more = [describe(open_session(part, allow_damaged)) for part in session_parts(session)]
    if as_json:
        typer.echo(json.dumps({**first, "parts": more}, indent=2, allow_nan=False))
        return
    for line in lines(first):
        typer.echo(line)
    for document in more:
        typer.echo(f"\n{one_line(document['file'])} goes on with it:")
        for line in lines(document):
            typer.echo(line)
