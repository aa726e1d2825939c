"""``truearm inspect``: what is in a session file."""

from __future__ import annotations

import typer

from truearm.cli.options import AllowDamagedOption, JsonOption, SessionArgument
from truearm.cli.output import print_json, print_lines
from truearm.text import one_line


def inspect(
    session: SessionArgument,
    as_json: JsonOption = False,
    allow_damaged: AllowDamagedOption = False,
) -> None:
    """Show what is in a session: rates, gaps, losses, clock quality, dwells.

    Example: truearm inspect session.mcap
    """
    from truearm.cli.inspect_text import lines
    from truearm.session.session_file import open_session
    from truearm.workflows.inspect import describe
    from truearm.workflows.session_parts import session_parts

    first, *more = [describe(open_session(part, allow_damaged)) for part in session_parts(session)]
    if as_json:
        print_json({**first, "parts": more})
        return
    print_lines(lines(first))
    for document in more:
        typer.echo(f"\n{one_line(document['file'])} continues it:")
        print_lines(lines(document))
