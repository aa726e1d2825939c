"""Names of files in messages: what to say of a file that does not exist."""

from __future__ import annotations

import difflib
from itertools import islice
from pathlib import Path

MOST_NAMES = 10_000  # of a folder that are compared


def no_such_file(path: Path) -> str:
    """Return the message for a file that does not exist: the name that was probably meant, or what to check."""
    folder = path.parent
    try:
        if not folder.is_dir():
            return f"{path}: no such file, because the folder {folder} does not exist; check the path"
        names = [one.name for one in islice(folder.iterdir(), MOST_NAMES) if one.name != path.name]
    except OSError:  # a folder that may not be listed
        names = []
    if close := difflib.get_close_matches(path.name, names, n=1, cutoff=0.75):
        return f"{path}: no such file; did you mean {folder / close[0]}?"
    return f"{path}: no such file; check its name and folder"
