"""Write the intact data of a session that is damaged or was cut off to a new file (``truearm session recover``)."""

from __future__ import annotations

import os
from pathlib import Path

from truearm.errors import SessionError, WriteError
from truearm.file_names import system_reason
from truearm.files.disk import check_writable, sha256, working_folder
from truearm.progress import step
from truearm.record.recover import Recovered, is_whole
from truearm.record.recover import recover as recover_session
from truearm.session.session_file import Session
from truearm.workflows.session_parts import open_finished


def recovered_name(session: Path) -> Path:
    """Return the default path of a recovered session: ``session-recovered.mcap``."""
    return session.parent / f"{session.stem}-recovered.mcap"


@step("recovering the session")
def recover_file(session: Path, out: Path, force: bool = False) -> Recovered | None:
    """Write the intact parts of a session to ``out``; None if the session is intact, and then nothing is written.

    Raises InputError, SessionError if nothing can be saved or the session is still being written, WriteError.
    """
    opened = open_finished(session, allow_damaged=True)
    if is_whole(opened):
        return None
    check_writable(out, force, inputs=[session], kind="session")
    return _write(session, opened, out, {"source": session.name, "sha256": sha256(session)})


def _write(path: Path, opened: Session, out: Path, said: dict[str, str]) -> Recovered:
    """Write next to ``out`` and rename, so that ``out`` is always complete."""
    try:
        with working_folder(out.parent) as folder:
            partial = folder / "session.mcap"
            found = recover_session(opened, partial, said)
            if not found.topics and not opened.metadata:
                raise SessionError(f"{path}: contains nothing that can be recovered; record again")
            os.replace(partial, out)
    except (OSError, WriteError) as exc:
        raise WriteError(
            f"{out}: cannot be written: {system_reason(exc)}; {path} is unchanged", exc.strerror or ""
        ) from exc
    return found
