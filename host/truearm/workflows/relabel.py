"""Settle what was mounted at each dwell of a session (``truearm session relabel``)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from truearm.errors import Argument, InputError, RigError, SessionError
from truearm.estimate.mounted_pairings import SURE
from truearm.files.labels_file import Decision, labels_path, write_labels
from truearm.live.mounted_parts import check_mounted
from truearm.progress import step
from truearm.session.dwell_labels import Pairing, label_of
from truearm.types import BAR_MOUNTED, DwellLabel, Rig
from truearm.workflows.label_evidence import Stop, chances_of, stops_of
from truearm.workflows.session_observations import recorded_rig, surveyed
from truearm.workflows.session_parts import open_finished, session_parts

if TYPE_CHECKING:
    from truearm.model.robot import Robot


@step("examining the session")
def relabel(
    session: Path, robot: Robot | None, trust: str | None, mounted: Sequence[str] = (), rig: Rig | None = None
) -> dict[str, Any]:
    """Settle what was mounted at the dwells of a session and its further parts, and return the output.

    Where plan, operator and readings differ, ``trust`` decides: plan, typed or evidence. ``mounted`` names what was
    mounted at some dwells, as 12:14=BAR,CHUCK,SPHERE. All others are left out. The labels are saved next to each file
    if one of the two is given. Raises InputError; SessionError for a session that is incomplete or still being written.
    """
    if trust == "evidence" and robot is None:
        raise InputError("needs-option", place=Argument("trust"), needed=Argument("robot"))
    paths, stops = session_parts(session), list[Stop]()
    for path in paths:
        rig, of_file = _measured(path, rig)
        stops += of_file
    if rig is None or not stops:
        raise SessionError(f"{session}: the robot never stood still long enough; see truearm inspect {session}")
    named = dict(pair for text in mounted for pair in _named(text, rig, stops))
    chances = None if robot is None else chances_of(robot, rig, stops)
    labels, left_out = dict[tuple[Path, int], DwellLabel](), list[dict[str, Any]]()
    for k, stop in enumerate(stops):
        likely = (None, 0.0) if chances is None else chances.likeliest(k)
        label = labels[stop.place] = _label(stop, trust, named.get(stop.place), *likely)
        if not (label.mounted or stop.dwell.reason):
            left_out.append({"session": stop.place[0].name, "dwell": stop.place[1], "detail": label.detail})
    saved = paths if trust or mounted else []
    for path in saved:
        of_path = tuple(label for (file, _), label in labels.items() if file == path)
        write_labels(path, Decision(trust or "named", of_path, "" if robot is None else robot.chain.name))
    return {
        "sessions": [path.name for path in paths],
        "saved": [str(labels_path(path)) for path in saved],
        "dwells": len(stops),
        "with_reading": sum(not stop.dwell.reason for stop in stops),
        "left_out": left_out,
    }


def _measured(path: Path, rig: Rig | None) -> tuple[Rig, list[Stop]]:
    """Return the rig and the stops of a file."""
    session = open_finished(path)
    rig = rig or recorded_rig(session, path)
    if not (rig.bars and rig.chucks and rig.spheres):
        raise RigError(f"{path}: its rig has no ball-bar, chuck or sphere; there is nothing to relabel")
    return rig, stops_of(path, rig, surveyed(session))


def _label(stop: Stop, trust: str | None, named: Pairing | None, likely: Pairing | None, p: float) -> DwellLabel:
    """Return the label of a dwell, without a pairing if nothing settles it. ``likely``: by evidence, with probability ``p``."""
    planned, typed = stop.said.planned, stop.said.confirmed
    plan = planned[0] if planned and (len(planned) == 1 or stop.dwell.reason) else None
    sure = likely if p >= SURE else None
    agreed = plan if {typed, sure} <= {None, plan} else None
    pairing = named or {None: agreed, "plan": plan, "typed": typed, "evidence": sure}[trust]
    pairing = pairing or (plan if stop.dwell.reason else None)  # then it gives no observation
    statements = {
        "planned": " or ".join(map(" ".join, planned)),
        "confirmed": " ".join(typed or ()),
        f"evidence ({p:.2%}; {SURE:.2%} is needed)": p and " ".join(likely or ("nothing of the rig",)),
    }
    detail = "; ".join(f"{source} {words}" for source, words in statements.items() if words)
    label = label_of(stop.dwell, stop.said, stop.marks, pairing, "" if pairing else detail)
    return label._replace(probability=p) if pairing and pairing == likely else label


def _named(text: str, rig: Rig, stops: Sequence[Stop]) -> list[tuple[tuple[Path, int], Pairing]]:
    """Parse what was mounted at some dwells: ``12:14=BAR,CHUCK,SPHERE``; of a further part, ``s.2.mcap 12=…``."""
    match = re.fullmatch(r"(?:(.+) )?([0-9]{1,9})(?::([0-9]{1,9}))?=([^,]+),([^,]+),([^,]+)", text)
    file, first, last, bar, chuck, sphere = match.groups() if match else ("", "0", "0", "", "", "")
    file, dwells = file or stops[0].place[0].name, range(int(first), int(last or first) + 1)
    places = [stop.place for stop in stops if stop.place[0].name == file and stop.place[1] in dwells]
    if not places:
        form = "FIRST:LAST=BAR,CHUCK,SPHERE with numbers of dwells, such as 12:14=bar46,c1,s2"
        raise InputError("wrong-value", place=Argument("mounted"), value=text[:60], form=form)
    check_mounted(dict(zip(BAR_MOUNTED, (bar, chuck, sphere), strict=True)), rig, text)
    return [(place, (bar, chuck, sphere)) for place in places]
