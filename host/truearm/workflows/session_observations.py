"""From a session file to observations: the border between the file (record) and what is made of it (sync)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.errors import Argument, RigError, SessionError
from truearm.text import one_line

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.session.session_file import Session
    from truearm.types import DwellLabel, Rig

SUFFIX = ".mcap"
RIG = "rig.toml"
SAID = 3  # places where a file is damaged; inspect says all

Say = Callable[[str], None]  # is called with a line of progress or of warning
Heard = Callable[["Session", "SyncResult"], None]  # is called with each session and what was made of it


def silent(_: str) -> None:
    """A ``Say`` that says nothing."""


def unheard(_: Session, __: SyncResult) -> None:
    """A ``Heard`` that keeps nothing."""


@dataclass(frozen=True)
class SessionOptions:
    """How to read a session.

    ``allow_damaged``: use what is whole of a damaged file, and call ``say`` with what is lost. ``may_be_empty``: a part of
    a session need not give an observation. ``line_points``: of each pass along a line at most. ``heard`` is called with the
    session and its observations.
    """

    allow_damaged: bool = False
    may_be_empty: bool = False
    line_points: int | None = None
    say: Say = silent
    heard: Heard = unheard


def labels_of(path: Path) -> tuple[DwellLabel, ...] | None:
    """What was settled of a session's dwells (``truearm relabel``), None where nothing was. Raises SessionError."""
    from truearm.files.labels_file import last_dwells, read_labels

    return last_dwells(read_labels(path))


def is_session(path: Path) -> bool:
    """Whether a file's name says that it is a session."""
    return path.suffix.lower() == SUFFIX


def attached_rig(session: Session, path: Path) -> Rig | None:
    """The rig that the recorder was given, None if it was given none. Raises RigError if it is no rig."""
    from truearm.files.rig_file import parse_rig

    data = session.attachments.get(RIG)
    if data is None:
        return None
    try:
        return parse_rig(data.decode(), f"{path}: {RIG}")
    except UnicodeDecodeError as exc:
        raise RigError(f"{path}: {RIG} is not UTF-8") from exc


def observations_of_session(path: Path, rig: Rig | None = None, options: SessionOptions | None = None) -> SyncResult:
    """Hops 4 and 5 of a session file. ``rig`` stands in for the one that was recorded.

    Raises SessionError for a file that is none or gave no observation, RigError if there is no rig.
    """
    from truearm.session.line_passes import LineRules
    from truearm.session.observations import observations
    from truearm.session.session_file import open_session, words_of
    from truearm.workflows.inspect import ident_of
    from truearm.workflows.temperature_warning import temperature_warning

    options = options or SessionOptions()
    session = open_session(path, options.allow_damaged)
    if session.damage:
        said = ", ".join(words_of(damage.at, damage.lost_s, damage.of_s) for damage in session.damage[:SAID])
        more = f" and in {len(session.damage) - SAID} places more" if len(session.damage) > SAID else ""
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
