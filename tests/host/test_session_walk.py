"""docs/explanation/code_flow.md lists the files through which a measurement passes, each once; a session here is traced to check it."""

import re
import sys
from pathlib import Path

import numpy as np
import session_stream

import truearm.session
from truearm.session import session_file
from truearm.session.observations import observations, survey
from truearm.session.session_file import open_session
from truearm.workflows.inputs import Sources, read_sources

FOLDER = Path(truearm.session.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "code_flow.md"
HOP = re.compile(r"^\| \d+ \| `session/(\w+)\.py` \| `(?:\w+\.)?(\w+)\(\)` \|(.*)$", re.MULTILINE)


def test_an_identified_session_is_opened_and_checked_once(monkeypatch):
    opened, walk = [], session_file.RecordWalk
    monkeypatch.setattr(
        session_file, "RecordWalk", lambda path, *more, **k: opened.append(path) or walk(path, *more, **k)
    )
    path = Path(__file__).parents[1] / "data" / "sessions" / "ball-bar.mcap"
    assert len(read_sources(Sources((path,)), None).table) == 3
    assert opened == [path]


def test_the_table_has_every_file_once():
    text = "\n".join(row.group(0) for row in HOP.finditer(PAGE.read_text(encoding="utf-8")))
    named = re.findall(r"`session/(\w+)\.py`", text)
    assert sorted(named) == sorted(file.stem for file in FOLDER.glob("*.py") if file.stem != "__init__")


def test_a_session_passes_through_the_files_in_the_order_of_the_table(tmp_path):
    """In the order in which the entries first hand something on; no line is driven, and nothing is exported."""
    hops = {(str(FOLDER / f"{row[1]}.py"), row[2]): row[1] for row in HOP.finditer(PAGE.read_text(encoding="utf-8"))}
    messages, _ = session_stream.session(np.random.default_rng(1), dwells=3, robot_hz=50.0)
    session_stream.write_session(tmp_path / "session.mcap", messages)
    walked = []

    def listen(frame, event, _):
        hop = hops.get((frame.f_code.co_filename, frame.f_code.co_name))
        if event == "return" and hop is not None and hop not in walked:
            walked.append(hop)

    sys.setprofile(listen)
    try:
        observations(survey(open_session(tmp_path / "session.mcap").batches), session_stream.RIG)
    finally:
        sys.setprofile(None)
    assert walked == [hop for hop in hops.values() if hop not in ("line_passes", "session_tables")]
