"""``truearm inspect``: what is in a session file."""

from __future__ import annotations

from pathlib import Path

import click

from truearm.cli.command import command
from truearm.cli.output import print_json
from truearm.text import one_line


@command()
def inspect(session: Path, *, details: bool = False, json: bool = False, allow_damaged: bool = False) -> None:
    """Show whether a session is usable, what is in it, and what was lost.

    Example: truearm inspect session.mcap

    Options
    -------
    details
        Print rates, clocks and gaps, and tables of streams, dwells and lines.
    """
    from truearm.cli.details import session_tables
    from truearm.cli.findings_text import show
    from truearm.report.session_findings import session_findings
    from truearm.session.session_file import open_session
    from truearm.workflows.inspect import describe
    from truearm.workflows.session_parts import session_parts

    first, *further = [describe(open_session(path, allow_damaged)) for path in session_parts(session)]
    if json:
        print_json({**first, "parts": further})
        return
    for document in (first, *further):
        if document is not first:
            click.echo(f"\n{one_line(document['file'])} continues it:")
        show(session_findings(document), session_tables(document) if details else None)
