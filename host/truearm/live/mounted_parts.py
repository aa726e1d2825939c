"""Parse and check what is mounted, as typed by the operator."""

from __future__ import annotations

from collections.abc import Mapping

from truearm.errors import InputError
from truearm.live.session_progress import MOUNTABLE
from truearm.types import BAR_MOUNTED, Rig


def parse_mounted(text: str) -> dict[str, str]:
    """Parse ``bar=bar46,chuck=c1`` into a mapping. Raises InputError."""
    mounting: dict[str, str] = {}
    for entry in text.split(","):
        key, separator, name = (part.strip() for part in entry.partition("="))
        if key not in MOUNTABLE or not separator or not name:
            raise InputError(
                f"mounted: {entry[:40]!r} is not KEY=NAME, such as bar=bar46; KEY is {', '.join(MOUNTABLE[:-1])} or {MOUNTABLE[-1]}"
            )
        if key in mounting:
            raise InputError("given-twice", place="mounted", what=key)
        mounting[key] = name
    return mounting


def check_mounted(mounting: Mapping[str, str], rig: Rig, name: str) -> None:
    """Raise InputError for a part that the rig called ``name`` does not have; a rig without lines accepts any."""
    for key, names in rig.mounted().items():
        if key in mounting and (names or key in BAR_MOUNTED) and mounting[key] not in names:
            raise InputError("not-in-rig", place="mounted", what=key, name=mounting[key][:40], names=sorted(names))
