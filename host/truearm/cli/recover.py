"""``truearm session recover``: write the intact data of a damaged or unfinished session to a new file."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from truearm.cli.command import command
from truearm.cli.output import print_json, print_lines, warn_of_further_parts
from truearm.text import counted, one_line

if TYPE_CHECKING:
    from truearm.record.recover import Recovered

SHOWN = 10  # damaged places that are listed


@command()
def recover(
    session: Path,
    *,
    out: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Write all intact data of a damaged or unfinished session to a new file that every command reads.

    For a file whose recorder was killed, whose disk was full, or whose bytes were damaged. The file itself is not changed. Saved
    and lost data are listed by place, time and topic; gaps are not filled. An intact file is left alone. Exit code 0 if the data
    were saved, however many are lost, or if the file is intact; 2 if nothing could be saved.

    Example:
      truearm session recover session.mcap --out recovered.mcap

    Options
    -------
    out : FILE
        File to write: a session (default: NAME-recovered.mcap for NAME.mcap).
    """
    from truearm.workflows.recover import recover_file, recovered_name

    out = out or recovered_name(session)
    found = recover_file(session, out, force)
    if json:
        print_json(
            {"whole": found is None, "out": None if found is None else str(out), **(asdict(found) if found else {})}
        )
    elif found is None:
        typer.echo(f"{one_line(str(session))}: is intact; there is nothing to recover, and nothing was written")
    else:
        print_lines(lines(found))
        reading = "every command reads it" if found.samples else "but no sample in it can be used"
        typer.echo(f"{one_line(str(out))}: written, with all data that are intact; {reading}")
    if found is not None:
        warn_of_further_parts(session, f"later commands do not find them from {one_line(out.name)}; name each file")


def lines(found: Recovered) -> list[str]:
    """What was saved and what was lost, for people."""
    from truearm.report.session_findings import damage_finding

    messages = sum(account.saved for account in found.topics.values())
    text = [
        f"saved  {counted(messages, 'message')} over {found.seconds:.1f} s, {counted(found.samples, 'sample')}, "
        f"{_named(found.attachments, 'attachment')}"
    ]
    width = max((len(topic) for topic in found.topics), default=0)
    for topic, account in found.topics.items():
        lost = f", {account.lost} lost" if account.lost else ""
        text.append(f"         {one_line(topic):<{width}}  {account.saved}{lost}")
    for damage in found.damage[:SHOWN]:
        text.append(f"lost   {damage_finding(vars(damage)).text()}")
    if len(found.damage) > SHOWN:
        text.append(f"lost   and in {counted(len(found.damage) - SHOWN, 'place')} more")
    if found.undescribed:
        lost = counted(found.undescribed, "block of samples", "blocks of samples")
        text.append(f"lost   what {lost} mean: the box's description of its channels was in a damaged place")
    if found.cut_off:
        text.append(
            f"lost   the end of the file, after {found.seconds:.1f} s: its length is unknown (at most a second if the "
            "recorder was killed)"
        )
    text.append(f"       {counted(found.unread_bytes, 'byte is', 'bytes are')} outside intact records")
    return text


def _named(names: tuple[str, ...], what: str) -> str:
    return f"{what} {', '.join(map(one_line, names))}" if names else f"no {what}"
