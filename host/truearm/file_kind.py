"""The kinds of file by their first bytes: to say what is expected instead, and what truearm wrote and may replace."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

HEAD = 4096  # bytes


class FileKind(NamedTuple):
    """A kind of file: its description, the suffixes of its name (none: any), and a pattern of its beginning."""

    description: str
    suffixes: tuple[str, ...]
    beginning: bytes

    def fits(self, head: bytes) -> bool:
        """Return whether a file with this beginning is of this kind."""
        return re.search(self.beginning, head, re.MULTILINE | re.IGNORECASE) is not None


RIG_KEYS = rb"^(\[\[?(bar|chuck|sphere|socket|target|tracker|line)\b|\w+_sigma_(m|mm|rad|deg)\s*=)"
PLAN_HEADER = rb'\A[\xef\xbb\xbf\s]*+(?!.*\bkind\b)([\w" ]*,)*[" ]*pose[" ]*[,\r\n]'  # its columns stand in any order
KINDS = {
    "session": FileKind("a session (.mcap)", (".mcap",), rb"\A\x89MCAP"),
    "result": FileKind("a result (result.json)", (".json",), rb'\A\s*\{\s*"format":\s*"truearm-result"'),
    "page": FileKind("a page (.html)", (".html",), rb'<meta name="generator" content="truearm">'),
    "picture": FileKind("a map (.svg)", (".svg",), rb"\A<svg[^\0]*Error of"),
    "robot": FileKind("a robot (.toml or .urdf)", (), rb"<robot\b|^convention\s*="),
    "exported": FileKind("a robot for another program", (), rb"written by truearm export"),
    "noise": FileKind("a noise file (.toml)", (".toml",), rb"\A# noise of a robot"),
    "plan": FileKind("a plan (plan.csv)", (".csv",), PLAN_HEADER),
    "program": FileKind("a program", (), rb"\A(pose,|def truearm_|MODULE truearm_)"),
    "map": FileKind("a map (.csv)", (".csv",), rb"\Au_mm,v_mm"),
    "fleet": FileKind("a table of arms (.csv)", (".csv",), rb"\Aarm,robot,serial"),
    "curves": FileKind("a table of error curves (.csv)", (".csv",), rb"\Ajoint,reading_deg,error_mrad"),
    "targets": FileKind("a table of targets (.csv)", (".csv",), rb"\A.*\bafter_mm\b"),
    "table": FileKind("a table of observations (.csv)", (".csv",), rb"\A(\w+,)*kind,"),
    "project": FileKind("a project's file (truearm.toml)", (".toml",), rb"^model\s*="),
    "rig": FileKind("a rig (rig.toml)", (".toml",), RIG_KEYS),
    "truth": FileKind("the truth of a simulation (.json)", (".json",), rb'"truearm-truth"'),
    "configuration": FileKind("a box's configuration (.toml)", (".toml",), rb"\A# The configuration of a truearm box"),
}


def kind_of(path: Path) -> str | None:
    """Return the kind of a file, a key of ``KINDS``; None if it is no file or its kind is not recognised."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return None
        with path.open("rb") as file:
            head = file.read(HEAD)
    except (OSError, ValueError):
        return None
    return next((name for name, kind in KINDS.items() if kind.fits(head)), None)
