"""SESSION.labels.json: what was mounted at each dwell, as settled after the recording by ``truearm session relabel``.

The format is described in docs/reference/session-format.md. The file is stored next to the session, which is never
modified, and identifies it by its SHA-256. If there are several decisions, the last one counts.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from truearm.errors import SessionError
from truearm.files.disk import read_text, sha256, write_atomic
from truearm.files.strict_json import strict_json
from truearm.schema import IDENTIFIER, Choice, Key, List, Number, SchemaError, Table, Text, Whole, raising
from truearm.types import BAR_MOUNTED, DwellLabel

FORMAT, FORMAT_VERSION = "truearm-labels", 1
SUFFIX = ".labels.json"
MAX_BYTES = 64 << 20
MOST_DWELLS, MOST_DECISIONS = 100_000, 1000


@dataclass(frozen=True)
class Decision:
    """Labels settled at one time. ``trust``: what was assumed correct; ``robot``: its nominal model, or ""."""

    trust: str
    dwells: tuple[DwellLabel, ...]
    robot: str = ""


@dataclass(frozen=True)
class Labels:
    """All decisions about the session with this SHA-256, the earliest first."""

    session: str
    sha256: str
    decisions: tuple[Decision, ...]


def labels_path(session: Path) -> Path:
    """Return the path of the labels of a session."""
    return session.with_name(session.stem + SUFFIX)


def read_labels(session: Path) -> Labels | None:
    """Return the labels of a session, or None if it has none.

    Raises SessionError, also for labels that belong to another session.
    """
    path = labels_path(session)
    if not path.exists():
        return None
    text = read_text(path, MAX_BYTES, SessionError)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as exc:
        raise SessionError(
            f"{path}: is not JSON: {str(exc)[:100]}; label the dwells again with truearm session relabel"
        ) from exc
    with raising(SessionError, str(path)):
        found = _LABELS.parse(document)
    if found.sha256 != sha256(session):
        raise SessionError(
            f"{path}: was made for another session named {session.name}; remove it, and label the dwells again with truearm session relabel"
        )
    return found


def write_labels(session: Path, decision: Decision) -> None:
    """Write the labels of a session atomically. Raises InputError."""
    name = session.name.encode(errors="backslashreplace").decode()
    document = _document(Labels(name, sha256(session), (decision,)))
    write_atomic(labels_path(session), strict_json(document) + "\n")


def _document(labels: Labels) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "session": labels.session,
        "sha256": labels.sha256,
        "decisions": [
            {"trust": one.trust, "robot": one.robot, "dwells": [_entry(label) for label in one.dwells]}
            for one in labels.decisions
        ],
    }


def _entry(label: DwellLabel) -> dict[str, Any]:
    said: dict[str, Any] = {"begin_ns": label.begin_ns, "end_ns": label.end_ns, **label.mounted}
    if label.pose is not None:
        said["pose"] = label.pose
    if math.isfinite(label.probability):
        said["probability"] = label.probability
    return {**said, "detail": label.detail} if label.detail else said


def _label(begin_ns: int, end_ns: int, **said: Any) -> DwellLabel:
    rest = {key: said.pop(key) for key in ("pose", "probability", "detail") if key in said}
    if said and not all(key in said for key in BAR_MOUNTED):
        raise SchemaError("names only some of bar, chuck and sphere; give all three or none")
    return DwellLabel(begin_ns, end_ns, said, **rest)


def _labels(format: str, format_version: int, **values: Any) -> Labels:
    return Labels(**values)


_TIME = Whole(-(2**62), 2**62)
_NAMES = tuple(Key(key, IDENTIFIER, optional=True) for key in (*BAR_MOUNTED, "shell"))
_DWELL = Table(
    (
        Key("begin_ns", _TIME),
        Key("end_ns", _TIME),
        *_NAMES,
        Key("pose", Whole(0, 10**9), optional=True),
        Key("probability", Number(least=0.0, most=1.0), optional=True),
        Key("detail", Text(500), optional=True),
    ),
    _label,
)
_DECISION = Table(
    (
        Key("trust", Text(one_line=True)),
        Key("robot", Text(), optional=True),
        Key("dwells", List(_DWELL, least=0, most=MOST_DWELLS)),
    ),
    Decision,
)
_LABELS: Table[Labels] = Table(
    (
        Key("format", Choice((FORMAT,))),
        Key("format_version", Whole(1, FORMAT_VERSION)),
        Key("session", Text(300)),
        Key("sha256", Text(64)),
        Key("decisions", List(_DECISION, least=1, most=MOST_DECISIONS)),
    ),
    _labels,
)


def last_dwells(labels: Labels | None) -> tuple[DwellLabel, ...] | None:
    """Return the labels of the last decision, or None if there are no labels."""
    return None if labels is None or not labels.decisions else labels.decisions[-1].dwells
