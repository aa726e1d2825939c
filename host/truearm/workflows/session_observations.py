"""Read observations from a session file: the interface between the file (record) and its evaluation (sync)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.errors import Argument, RigError, SessionError
from truearm.text import counted, one_line

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.session.session_file import Session
    from truearm.types import DwellLabel, Rig

SUFFIX = ".mcap"
RIG = "rig.toml"
SAID = 3  # damaged places reported; inspect lists all

Say = Callable[[str], None]  # called with a line of progress or a warning
Heard = Callable[["Session", "SyncResult"], None]  # called with each session and its results


def silent(_: str) -> None:
    """A ``Say`` that discards its lines."""


def unheard(_: Session, __: SyncResult) -> None:
    """A ``Heard`` that does nothing."""


@dataclass(frozen=True)
class SessionOptions:
    """How to read a session.

    ``allow_damaged``: use the intact parts of a damaged file, and call ``say`` with the losses. ``may_be_empty``: a
    part of a session need not give an observation. ``line_points``: maximum number per pass along a line. ``heard`` is
    called with the session and its observations.
    """

    allow_damaged: bool = False
    may_be_empty: bool = False
    line_points: int | None = None
    say: Say = silent
    heard: Heard = unheard


def labels_of(path: Path) -> tuple[DwellLabel, ...] | None:
    """Return the settled labels of a session's dwells (``truearm relabel``), None if there are none. Raises
    SessionError.
    """
    from truearm.files.labels_file import last_dwells, read_labels

    return last_dwells(read_labels(path))


def is_session(path: Path) -> bool:
    """Return whether a file's name is that of a session."""
    return path.suffix.lower() == SUFFIX


def attached_rig(session: Session, path: Path) -> Rig | None:
    """Return the rig given to the recorder, None if there was none. Raises RigError if it is not a valid rig."""
    from truearm.files.rig_file import parse_rig

    data = session.attachments.get(RIG)
    if data is None:
        return None
    try:
        return parse_rig(data.decode(), f"{path}: {RIG}")
    except UnicodeDecodeError as exc:
        raise RigError(f"{path}: {RIG} is not UTF-8") from exc


def observations_of_session(path: Path, rig: Rig | None = None, options: SessionOptions | None = None) -> SyncResult:
    """Make observations from a session file. ``rig`` replaces the recorded one.

    Raises SessionError for a file that is not a session or gives no observation, RigError if there is no rig.
    """
    from truearm.session.line_passes import LineRules
    from truearm.session.observations import observations
    from truearm.session.session_file import open_session, words_of
    from truearm.workflows.inspect import ident_of
    from truearm.workflows.session_parts import refuse_unfinished
    from truearm.workflows.temperature_warning import temperature_warning

    options = options or SessionOptions()
    session = open_session(path, options.allow_damaged)
    refuse_unfinished(session)
    if session.damage:
        said = ", ".join(words_of(damage.at, damage.lost_s, damage.of_s) for damage in session.damage[:SAID])
        more = f" and in {counted(len(session.damage) - SAID, 'place')} more" if len(session.damage) > SAID else ""
        options.say(one_line(f"{path}: {said}{more}"))
    rig = rig or attached_rig(session, path)
    if rig is None:
        raise RigError(f"{path}: was recorded without a rig; give one as ", Argument("rig"))
    rules = LineRules(points=options.line_points)
    result = observations(
        session.batches, rig, ident=ident_of(session), name=path.name, line_rules=rules, labels=labels_of(path)
    )
    if not len(result.table) and not options.may_be_empty:
        what, rejected = ("line", result.pass_reasons) if result.passes else ("dwell", result.reasons)
        reasons = ", ".join(f"{n} {reason}" for reason, n in sorted(rejected.items()))
        raise SessionError(
            f"{path}: no {what} gave an observation ({reasons or 'none was found'}); see truearm inspect {path}"
        )
    if warning := temperature_warning(result, rig):
        options.say(one_line(f"{path}: {warning}"))
    options.heard(session, result)
    return result
