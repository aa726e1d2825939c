"""Read observations from a session file: the interface between the file (record) and its evaluation (sync)."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from truearm.errors import RigError, SessionError
from truearm.text import counted, one_line
from truearm.workflows.session_parts import SUFFIX

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.session.session_file import Session
    from truearm.types import DwellLabel, Rig

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


class Rejected(NamedTuple):
    """The dwells and the passes along lines that gave no observation, by reason. ``planned``: the session has a plan."""

    dwells: Counter[str]
    passes: Counter[str]
    planned: bool


def rejected_of(result: SyncResult, doubtful: int = 0) -> Rejected:
    """Return what a session rejects. ``doubtful``: dwells that gave an observation which does not fit their label."""
    from truearm.session.dwells import DOUBTFUL

    dwells = Counter(result.reasons) + Counter({DOUBTFUL: doubtful})
    return Rejected(dwells, Counter(result.pass_reasons), result.survey.marks.plan() is not None)


def reasons_text(rejected: Mapping[str, int]) -> str:
    """Return ``3 gap, 1 rail``."""
    return ", ".join(f"{n} {reason}" for reason, n in sorted(rejected.items()))


def nothing_observed(path: Path, rejected: Rejected) -> str:
    """Return a sentence: a session gave no observation, why not, and which command helps."""
    from truearm.session.dwells import DOUBTFUL

    kinds = (("dwell", "dwells", rejected.dwells), ("motion along a line", "motions along a line", rejected.passes))
    parts = [f"{counted(count.total(), one, many)} ({reasons_text(count)})" for one, many, count in kinds if count]
    if not parts:
        return f"{path}: no dwell and no motion along a line was found; see truearm inspect {shlex.quote(one_line(str(path)))}"
    # One wrong label is a slip of the operator. If no reading fits its label, the prediction is wrong.
    wrong = "check that robot and rig are those that were measured; if so, " * (set(rejected.dwells) == {DOUBTFUL})
    return f"{path}: no observation from {' and '.join(parts)}; {wrong}{what_helps(path, rejected)}"


def what_helps(path: Path, rejected: Rejected) -> str:
    """Return which commands settle and explain the rejected dwells and passes of a session."""
    from truearm.session.dwells import needs_decision

    settled = sum(n for reason, n in rejected.dwells.items() if needs_decision(reason, rejected.planned))
    others = settled < rejected.dwells.total() + rejected.passes.total()
    name = shlex.quote(one_line(str(path)))
    parts = [f"decide what was mounted with truearm session relabel {name}"] * bool(settled)
    parts += [f"truearm inspect {name} shows why{' the others were rejected' * bool(settled)}"] * others
    return "; ".join(parts)


def labels_of(path: Path) -> tuple[DwellLabel, ...] | None:
    """Return the settled labels of a session's dwells (``truearm session relabel``), None if there are none. Raises
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
        raise RigError(f"{path}: {RIG} is not UTF-8 text; give the rig file with the argument rig") from exc


def recorded_rig(session: Session, path: Path) -> Rig:
    """Return the rig given to the recorder. Raises RigError if there was none, or if it is not a valid rig."""
    rig = attached_rig(session, path)
    if rig is None:
        raise RigError("no-rig", place=path)
    return rig


def observations_of_session(path: Path, rig: Rig | None = None, options: SessionOptions | None = None) -> SyncResult:
    """Make observations from a session file. ``rig`` replaces the recorded one.

    Raises SessionError for a file that is not a session or gives no observation, RigError if there is no rig.
    """
    from truearm.workflows.session_parts import open_finished

    options = options or SessionOptions()
    return observations_of_opened(open_finished(path, options.allow_damaged), rig, options)


def observations_of_opened(session: Session, rig: Rig | None, options: SessionOptions) -> SyncResult:
    """Do the same as ``observations_of_session`` with a session that was opened with the same ``allow_damaged``."""
    from truearm.report.session_findings import damage_finding
    from truearm.session.box_ident import recorded_ident
    from truearm.session.device_clock import recorded_wander
    from truearm.session.line_passes import LineRules
    from truearm.session.observations import observations, survey
    from truearm.workflows.temperature_warning import temperature_warning

    path = session.path
    if session.damage:
        said = " ".join(damage_finding(vars(damage)).text() for damage in session.damage[:SAID])
        more = f" And in {counted(len(session.damage) - SAID, 'place')} more." if len(session.damage) > SAID else ""
        options.say(one_line(f"{path}: {said}{more}"))
    rig = rig or recorded_rig(session, path)
    rules = LineRules(points=options.line_points)
    labels = labels_of(path)
    try:
        found = survey(session.batches, recorded_ident(session), wander=recorded_wander(session))
        result = observations(session.batches, rig, name=path.name, found=found, line_rules=rules, labels=labels)
    except (RigError, SessionError) as exc:
        if str(exc).startswith(str(path)):
            raise
        raise exc.within(path) from exc
    if not len(result.table) and not options.may_be_empty:
        raise SessionError(nothing_observed(path, rejected_of(result)))
    if warning := temperature_warning(result, rig):
        options.say(one_line(f"{path}: {warning}"))
    options.heard(session, result)
    return result
