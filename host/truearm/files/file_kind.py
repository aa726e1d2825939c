"""Tell by its first bytes what kind of file somebody named, to say what is expected instead."""

from __future__ import annotations

import re
from pathlib import Path

HEAD = 4096  # bytes
DESCRIPTIONS = {
    "session": "a session (.mcap)",
    "result": "a result (result.json)",
    "page": "a page (.html)",
    "robot": "a robot (.toml or .urdf)",
    "noise": "a noise file (.toml)",
    "plan": "a plan (plan.csv)",
    "table": "a table of observations (.csv)",
    "project": "a project's file (truearm.toml)",
    "rig": "a rig (rig.toml)",
}
_BEGINNINGS = {
    "session": rb"\A\x89MCAP",
    "result": rb'\A\s*\{\s*"format":\s*"truearm-result"',
    "page": rb"\A\s*<!doctype html",
    "robot": rb"<robot\b|^convention\s*=",
    "noise": rb"\A# noise of a robot",
    "plan": rb"\Apose,",
    "table": rb"\A(\w+,)*kind,",
    "project": rb"^model\s*=",
    "rig": rb"^(\[\[?(bar|chuck|sphere|socket|target|tracker)\b|\w+_sigma_(m|mm|rad|deg)\s*=)",
}


def kind_of(path: Path) -> str | None:
    """Return the kind of a file, a key of ``DESCRIPTIONS``; None if it is no file or its kind is not recognised."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return None
        with path.open("rb") as file:
            head = file.read(HEAD)
    except (OSError, ValueError):
        return None
    return next(
        (kind for kind, pattern in _BEGINNINGS.items() if re.search(pattern, head, re.MULTILINE | re.IGNORECASE)), None
    )
