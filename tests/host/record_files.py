"""A recording in virtual time, and the content of its file."""

import json
from dataclasses import replace

from record_box import run_of

from truearm.record.operator import Operator
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session


class Watching(Operator):
    """An operator who only takes each status."""

    def __init__(self, take):
        self.status = take


def run(lab, box, path, seconds=3.0, options=None, **more):
    options = replace(options or RecordOptions(), duration_s=seconds)
    with SessionWriter(path, lab) as writer:
        return record(box.link, writer, lab, options=options, **more)


def topics(path):
    """Return messages by topic; the file must be complete."""
    found: dict[str, list] = {}
    for message in open_session(path).messages():
        found.setdefault(message.topic, []).append(message)
    return found


def events(path, kind=None):
    rows = [json.loads(m.data) for m in topics(path).get("/events", [])]
    return [row["kind"] for row in rows] if kind is None else [row for row in rows if row["kind"] == kind]


def received(path):
    """Return all bytes of the box in the order of the file, without delimiters."""
    messages = [m for m in open_session(path).messages() if m.topic.startswith("/box/")]
    return b"".join(m.data if m.topic == "/box/console" else run_of(m.data) for m in messages)
