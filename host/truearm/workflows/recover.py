"""The work of ``truearm recover``: a complete session from one that is damaged or was cut off."""

from __future__ import annotations

import os
from pathlib import Path

from truearm.errors import SessionError, WriteError
from truearm.files.disk import check_writable, sha256, working_folder
from truearm.record.recover import Recovered, is_whole
from truearm.record.recover import recover as recover_session
from truearm.session.session_file import Session, open_session


def recover_file(session: Path, out: Path, force: bool = False) -> Recovered | None:
    """Write what is whole of a session to ``out``; None where all is whole, and nothing was written.

    Raises InputError, SessionError where nothing can be saved, WriteError.
    """
    opened = open_session(session, allow_damaged=True)
    if is_whole(opened):
        return None
    check_writable(out, force, inputs=[session])
    return _write(session, opened, out, {"source": session.name, "sha256": sha256(session)})


def _write(path: Path, opened: Session, out: Path, said: dict[str, str]) -> Recovered:
    """Write beside ``out`` and rename: whoever finds it finds it whole."""
    try:
        with working_folder(out.parent) as folder:
            partial = folder / "session.mcap"
            found = recover_session(opened, partial, said)
            if not found.topics and not opened.metadata:
                raise SessionError(f"{path}: holds nothing that could be saved")
            os.replace(partial, out)
    except (OSError, WriteError) as exc:
        raise WriteError(f"{out}: cannot be written: {exc.strerror}; {path} is as it was", exc.strerror or "") from exc
    return found
