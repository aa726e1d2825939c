"""Count the usable dwells of a recording that just ended, and those that the operator must settle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from truearm.errors import TruearmError

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult


@dataclass(frozen=True)
class RecordedDwells:
    """Account of the stops at poses of the plan, or, without a plan, of all sufficiently long stops.

    ``unusable``: rejected for other reasons, with the number for each. ``lost``: poses of the plan that were visited
    and gave no observation.
    """

    dwells: int
    usable: int
    need_decision: int
    unusable: dict[str, int]
    lost: int


def recorded_dwells(session: Path) -> RecordedDwells | None:
    """Return the account of a session; None if it has no rig with a ball-bar or cannot be read."""
    from truearm.session.session_file import open_session
    from truearm.workflows.session_observations import SessionOptions, attached_rig, observations_of_session

    try:
        rig = attached_rig(open_session(session), session)
        if rig is None or not rig.bars:
            return None
        return counted_dwells(observations_of_session(session, rig, SessionOptions(may_be_empty=True)))
    except TruearmError:  # identify reports what is wrong with it
        return None


def counted_dwells(result: SyncResult) -> RecordedDwells:
    """Return the account of a session's dwells."""
    from truearm.session.dwells import DwellRules, needs_decision

    plan = result.survey.marks.plan()
    counts: dict[str, int] = {}
    visited, measured = set[int](), set[int]()
    total = 0
    for dwell in result.dwells:
        if plan is None:
            if dwell.reason == "too short":
                continue
        else:
            away = np.max(np.abs(plan.q - dwell.q), axis=1) if plan.q.shape[1] == dwell.q.size else np.array([np.inf])
            if away.min() > DwellRules().pose_tolerance:
                continue
            visited.add(int(away.argmin()))
            if not dwell.reason:
                measured.add(int(away.argmin()))
        total += 1
        counts[dwell.reason] = counts.get(dwell.reason, 0) + 1
    usable = counts.pop("", 0)
    words = sum(counts.pop(reason) for reason in list(counts) if needs_decision(reason, plan is not None))
    return RecordedDwells(total, usable, words, dict(sorted(counts.items())), len(visited - measured))
