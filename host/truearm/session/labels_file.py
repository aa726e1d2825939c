"""SESSION.labels.json: what was mounted at each dwell, as settled after the recording by ``truearm session relabel``.

The format is described in docs/reference/session-format.md. The file is stored next to the session, which is never
modified, and identifies it by its SHA-256. If there are several decisions, the last one counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from truearm.disk import read_text, sha256, write_atomic
from truearm.errors import SessionError
from truearm.schema import NAME
from truearm.strict_json import number_or_null, strict_json
from truearm.types import BAR_MOUNTED, DwellLabel

SUFFIX = ".labels.json"
FORMAT_VERSION: Literal[1] = 1
MAX_BYTES = 64 << 20
MOUNTED = (*BAR_MOUNTED, "shell")

Time = Annotated[int, Meta(ge=-(2**62), le=2**62)]
Name = Annotated[str, Meta(pattern=rf"^(?:{NAME.pattern})\Z")]
Text = Annotated[str, Meta(max_length=500, pattern=r"^[^\x00-\x1f\x7f]*\Z")]


class Dwell(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """A label; without ``bar``, ``chuck`` and ``sphere``, it is unknown what was mounted."""

    begin_ns: Time
    end_ns: Time
    bar: Name = ""
    chuck: Name = ""
    sphere: Name = ""
    shell: Name = ""
    pose: Annotated[int, Meta(ge=0, le=10**9)] | None = None
    probability: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    detail: Text = ""

    def __post_init__(self) -> None:
        if any(self.mounted.values()) and not all(getattr(self, name) for name in BAR_MOUNTED):
            raise ValueError("names only some of bar, chuck and sphere; give all three or none")

    @property
    def mounted(self) -> dict[str, str]:
        """Return what was mounted, by column."""
        return {name: getattr(self, name) for name in MOUNTED if getattr(self, name)}

    @property
    def label(self) -> DwellLabel:
        """Return the label of a dwell."""
        probability = math.nan if self.probability is None else self.probability
        return DwellLabel(self.begin_ns, self.end_ns, self.mounted, self.pose, probability, self.detail)


class Decision(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Labels settled at one time. ``trust``: what was assumed correct; ``robot``: its nominal model, or ""."""

    trust: Text
    dwells: Annotated[tuple[Dwell, ...], Meta(max_length=100_000)]
    robot: Text = ""


class _Header(Struct):
    format_version: int = 0


class Labels(Struct, frozen=True, forbid_unknown_fields=True):
    """All decisions about the session with this SHA-256, the earliest first."""

    format: Literal["truearm-labels"]
    format_version: Literal[1]
    session: Text
    sha256: Text
    decisions: Annotated[tuple[Decision, ...], Meta(min_length=1, max_length=1000)]


def labels_path(session: Path) -> Path:
    """Return the path of the labels of a session."""
    return session.with_name(session.stem + SUFFIX)


def read_labels(session: Path) -> tuple[DwellLabel, ...] | None:
    """Return the labels of the last decision about a session, or None if it has none.

    Raises SessionError, also for labels that belong to another session.
    """
    path = labels_path(session)
    if not path.exists():
        return None
    try:
        labels = msgspec.json.decode(_text_of(path), type=Labels)
    except (msgspec.MsgspecError, RecursionError) as exc:
        raise SessionError(f"{path}: {exc}; label the dwells again with truearm session relabel") from exc
    if labels.sha256 != sha256(session):
        raise SessionError(
            f"{path}: was made for another session named {session.name}; remove it, and label the dwells again with truearm session relabel"
        )
    return tuple(dwell.label for dwell in labels.decisions[-1].dwells)


def _text_of(path: Path) -> str:
    """Return the text of a file of labels. Raises SessionError for a later version, MsgspecError for other content."""
    text = read_text(path, MAX_BYTES, SessionError)
    version = msgspec.json.decode(text, type=_Header).format_version
    if version > FORMAT_VERSION:
        raise SessionError(f"{path}: has format version {version}, this truearm reads {FORMAT_VERSION}; update truearm")
    return text


def write_labels(session: Path, labels: Sequence[DwellLabel], trust: str, robot: str) -> None:
    """Write the labels of a session atomically; ``trust`` and ``robot`` as in ``Decision``.

    Raises InputError, and SessionError if a later version of truearm wrote labels, which would be lost.
    """
    path = labels_path(session)
    if path.exists():
        with suppress(msgspec.MsgspecError, RecursionError):  # what cannot be read may be written anew
            _text_of(path)
    dwells = tuple(
        Dwell(start, end, **mounted, pose=pose, probability=number_or_null(probability), detail=detail)
        for start, end, mounted, pose, probability, detail in labels
    )
    name = session.name.encode(errors="backslashreplace").decode()
    document = Labels("truearm-labels", FORMAT_VERSION, name, sha256(session), (Decision(trust, dwells, robot),))
    write_atomic(path, strict_json(msgspec.to_builtins(document)) + "\n")
