"""``truearm session relabel``: settle after the recording what was mounted at each dwell."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from truearm.bounds import OneOf
from truearm.cli.command import command
from truearm.cli.output import print_result
from truearm.exit_codes import ExitCode
from truearm.live.keyboard import may_ask
from truearm.text import counted, one_line

if TYPE_CHECKING:
    from truearm.session.dwell_labels import Pairing
    from truearm.workflows.relabel import Run

TRUSTS = ("plan", "typed", "evidence")  # workflows.relabel.Trust


@command()
def relabel(
    session: Path,
    *,
    model: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    rig: Path | None = None,
    trust: Annotated[str | None, OneOf(TRUSTS)] = None,
    undo: bool = False,
    json: bool = False,
) -> None:
    """Decide what was mounted at each dwell of a session where plan, operator and readings disagree.

    The session itself is not changed: the labels are written beside it, to NAME.labels.json, and all later commands use them. A
    dwell is a rest of the robot at one pose. With --trust evidence it is labelled if one pairing of bar, chuck and sphere has a
    probability of at least 99.8 %, otherwise it is left out. Without --trust you are asked about each series of neighbouring
    doubtful dwells.

    Example:
      truearm session relabel session.mcap --model puma560 --trust evidence
      truearm session relabel session.mcap --undo

    Options
    -------
    trust
        Accept the plan, the typed confirmations, or the evidence of both and the readings together (needs --model).
        Default: ask.
    undo
        Undo the last decision.
    """
    from truearm.errors import InputError
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.relabel import RelabelOptions, StopAsking, Trust
    from truearm.workflows.relabel import relabel as relabel_session
    from truearm.workflows.relabel import undo as undo_labels

    if undo:
        if trust is not None:
            raise InputError("exclusive", first="--undo", second="--trust")
        document = undo_labels(session)
    else:
        ask = _ask if may_ask() and not json else None
        options = RelabelOptions(RobotChoice(model, base, tip), rig, Trust(trust) if trust else None, ask)
        try:
            document = relabel_session(session, options)
        except StopAsking:  # before the first answer: nothing was saved
            raise typer.Abort from None
    print_result(document, lines(document, str(session)), json)
    if document.get("unanswered"):
        raise typer.Exit(ExitCode.INTERRUPTED)


def lines(document: dict[str, Any], session: str) -> list[str]:
    """What was settled, for people."""
    sessions = ", ".join(map(one_line, document["sessions"]))
    if "decisions_left" in document:
        left = document["decisions_left"]
        return [
            f"{sessions}: the last decision is undone; "
            + (f"{left} left" if left else "plan and confirmations apply again")
        ]
    text = [
        f"{sessions}: {counted(document['dwells'], 'dwell')}, {document['with_reading']} with a reading within the stroke: "
        f"{document['usable']} labelled; {counted(document['otherwise_than_planned'], 'label differs', 'labels differ')} from the plan"
    ]
    if document["unanswered"]:
        unanswered = counted(document["unanswered"], "dwell is", "dwells are")
        text.append(
            f"The questions were ended: the answers so far are kept, and {unanswered} left out. Ask again: truearm session relabel "
            f"{shlex.quote(one_line(session))}"
        )
    for row in document["table"]:
        if row["bar"] is None and row["reading"]:
            text.append(f"  dwell {row['dwell']} left out: {one_line(row['detail'])}")
    return [*text, f"Undo: truearm session relabel {shlex.quote(one_line(session))} --undo"]


def _ask(run: Run) -> Pairing | None:
    """Ask what was mounted at a run of dwells. Raises StopAsking on Ctrl-C and at the end of the input."""
    from truearm.errors import InputError
    from truearm.live.mounted_parts import parse_mounted
    from truearm.session.dwell_labels import pairing_of
    from truearm.workflows.relabel import StopAsking

    choices = {}
    where = f"dwell {run.first}" if run.first == run.last else f"dwells {run.first} to {run.last}"
    typer.echo(f"{one_line(run.part.name)}, {where}:")
    for letter, what, pairing in (
        ("p", "the plan", run.planned[0] if len(run.planned) == 1 else None),
        ("t", "confirmed", run.confirmed),
        ("e", f"evidence, {run.probability:.1%}", run.found),
    ):
        if pairing is not None:
            choices[letter] = pairing
            typer.echo(f"  {letter}  {one_line(' '.join(pairing))} ({what})")
    while True:
        try:
            answer = typer.prompt(
                "  letter, bar=NAME,chuck=NAME,sphere=NAME, s to leave them out, or Ctrl-C to keep the answers and end"
            ).strip()
        except typer.Abort:  # which typer makes of Ctrl-C and of the end of the input
            typer.echo()
            raise StopAsking from None
        if answer == "s":
            return None
        if answer in choices:
            return choices[answer]
        try:
            pairing = pairing_of(parse_mounted(answer))
        except InputError as exc:
            typer.echo(f"  {exc}")
            continue
        if pairing is not None:
            return pairing
        typer.echo("  name bar, chuck and sphere")
