"""Sessions in other people's readers: every channel says what it holds, and JSON is what its schema says.

The rules are those of PlotJuggler's and Foxglove's loaders (the source of either): a schema for every channel; in a JSON schema one
type for every property, and of an array's items.
"""

import json
from itertools import pairwise

import pytest
from mcap.reader import make_reader
from record_box import Box, Robot
from record_files import run

from truearm.record.operator import Operator, OperatorEvent
from truearm.record.recorder import RecordOptions
from truearm.record.session_writer import encodings_of

TYPES = {
    "integer": int,
    "number": (int, float),
    "string": str,
    "boolean": bool,
    "array": list,
}
NOTHING = dict.fromkeys(("shell", "bar", "chuck", "sphere"), "")
PLAN = [
    {"pose": 0, "shell": "s", "bar": "b", "chuck": "c", "sphere": "k", "q": [0.1, 0.2]},
    {"pose": 1, **NOTHING, "move": "via", "q": [0.1, 0.2]},
    {"pose": 2, **NOTHING, "line": "l", "target": "t", "speed_m_s": 0.1, "q": [0.1, 0.2]},
]


class Typing(Operator):
    def __init__(self):
        self.typed = [
            OperatorEvent("note", {"text": "é"}),
            OperatorEvent(
                "dwell", {"begin_ns": 1, "end_ns": 2, "settled": True, "mean_m": 0.1, "noise_m": 1e-6, "pose": 0}
            ),
            OperatorEvent("line", {"pose": 2}),
        ]

    def wishes(self):
        typed, self.typed = self.typed, []
        return typed


@pytest.fixture
def recorded(lab, path):
    robot, options = Robot(lab, 2.0), RecordOptions(plan=PLAN, mounted={"bar": "b", "chuck": "c", "sphere": "k"})
    box = Box(lab)
    box.send_raw(b"Traceback\n\0")
    run(lab, box, path, None, robot=robot.link, options=options, operator=Typing())
    return path


def as_its_schema(schema, row):
    for key, value in row.items():
        said = schema["properties"][key]
        assert type(value) is not bool or said["type"] == "boolean"
        assert isinstance(value, TYPES[said["type"]]), (key, value)
        if said["type"] == "array":
            assert all(isinstance(item, TYPES[said["items"]["type"]]) for item in value)


def test_every_channel_has_a_schema_that_holds(recorded):
    """Of the file's summary, which is all that PlotJuggler looks at, and in the stream."""
    with recorded.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        messages = list(reader.iter_messages(log_time_order=False))
    topics = {channel.topic for channel in summary.channels.values()}
    of_box = {"/box/adc", "/box/ident", "/box/console", "/preview/adc"}
    assert topics >= of_box | {"/sync", "/events", "/plan", "/robot/joints"}
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert schema.name.startswith("truearm/")
        assert schema.encoding in ("jsonschema", "cddl", "text/plain")
        assert schema.data
        properties = json.loads(schema.data)["properties"] if schema.encoding == "jsonschema" else {}
        for said in properties.values():
            assert said["type"] in TYPES
            assert said["type"] != "array" or isinstance(said["items"]["type"], str)
    for schema, channel, message in messages:
        assert schema is not None
        if channel.message_encoding == "json":
            assert schema.encoding == "jsonschema"
            as_its_schema(json.loads(schema.data), json.loads(message.data))


def test_frames_are_described_element_by_element():
    text = encodings_of("/box/adc", b"").data
    data = "[16, seq: any, stream: any, n0: any, t0_us: any, period_ns: any, samples: any, flags: any, * any]"
    assert text.startswith(f"frame = {data} / [17, ")
    assert text.count("[") == 8


def test_the_lvdt_is_shown_ten_times_a_second(recorded):
    """The newest sample of a block, as a number with its unit, at the block's time of arrival."""
    with recorded.open("rb") as file:
        rows = [(m.log_time, json.loads(m.data)) for _, _, m in make_reader(file).iter_messages(["/preview/adc"])]
    times = [t for t, _ in rows]
    assert 15 <= len(rows) <= 21  # of two seconds
    assert min(b - a for a, b in pairwise(times)) >= 100_000_000
    assert set(rows[0][1]) == {"c0_V", "c1_V", "c2_V", "c3_V"}
