"""``truearm inspect``: what is in a session file."""

from __future__ import annotations

from pathlib import Path

import typer

from truearm.cli.command import command
from truearm.cli.output import print_json, print_lines
from truearm.text import one_line


@command()
def inspect(
    session: Path,
    *,
    json: bool = False,
    allow_damaged: bool = False,
) -> None:
    """Show what is in a session: rates, gaps, losses, clock quality, dwells.

    Example: truearm inspect session.mcap
    """
    from truearm.cli.inspect_text import lines
    from truearm.session.session_file import open_session
    from truearm.workflows.inspect import describe
    from truearm.workflows.session_parts import session_parts

    first, *more = [describe(open_session(part, allow_damaged)) for part in session_parts(session)]
    if json:
        print_json({**first, "parts": more})
        return
    print_lines(lines(first))
    for document in more:
        typer.echo(f"\n{one_line(document['file'])} continues it:")
        print_lines(lines(document))
