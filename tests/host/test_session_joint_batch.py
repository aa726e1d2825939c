"""Joint readings as columns: the recorder's columns equal the robot's lines."""

import gc
import json

import cbor2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from record_box import MS, SECOND, Lab
from session_stream import columns_of
from test_session_joint_readings import assert_same
from tests.refusals import refused

from truearm.record.robots.sources import AddedReading
from truearm.record.session_copies import add_readings, recover
from truearm.record.session_writer import SessionWriter
from truearm.session.joint_format import COLUMNS, JOINTS, READINGS, concatenate, pack, parse_line, parse_lines, unpack
from truearm.session.joint_readings import JointReader
from truearm.session.session_file import open_session
from truearm.types import Message

number = st.one_of(st.floats(-10, 10), st.integers(-9, 9))
joints = st.lists(number, min_size=3, max_size=3)
odd = st.sampled_from([None, "x", [1.0], [1, 2, float("nan")], {"a": 1}, True])
LINE = st.fixed_dictionaries(
    {"t": st.floats(0, 1e6), "q": joints},
    optional={
        "seq": st.integers(-(2**61), 2**61),
        **dict.fromkeys(("q_cmd", "qd", "current", "effort"), st.one_of(joints, odd)),
        "inputs": st.one_of(st.integers(-1, 2**63), odd),
        **dict.fromkeys(("robot_mode", "runtime_state"), st.one_of(number, odd)),
        "note": st.text(max_size=3),
    },
)


@given(st.lists(LINE, min_size=1, max_size=8), st.integers(0, 8))
def test_columns_are_what_the_lines_say(rows, cut):
    """Packed and unpacked bit for bit, in one piece or in two; words, null and NaN where numbers should be, too."""
    lines = [json.dumps(row, ensure_ascii=False).encode() for row in rows]
    batch = parse_lines(lines, range(len(lines)))
    assert len(batch) == len(lines)
    assert_same(unpack(pack(batch)), batch)
    parts = [
        parse_lines(lines[part], range(len(lines))[part]) for part in (slice(cut), slice(cut, None)) if lines[part]
    ]
    assert_same(concatenate(parts), batch)


def test_a_line_alone_says_the_same():
    row = {
        "t": 1.5,
        "seq": 7,
        "q": [1, 2.5],
        "q_cmd": [1.0, 2],
        "qd": [0, 0],
        "inputs": 5,
        "robot_mode": 7,
        "line": "é",
    }
    batch = parse_lines([json.dumps(row, ensure_ascii=False).encode()], [3])
    assert (batch.arrival_ns, batch.t, batch.seq) == (3, 1.5, 7)
    assert batch.q.tolist() == [[1.0, 2.5]]
    more = {key: values.tolist() for key, values in batch.columns.items() if key not in ("arrival_ns", "t", "seq", "q")}
    assert more == {"q_cmd": [[1.0, 2.0]], "qd": [[0.0, 0.0]], "inputs": [5], "robot_mode": [7.0]}


@pytest.mark.parametrize("more", ["", ', "current": [NaN]'], ids=["usual", "unusual"])
@pytest.mark.parametrize("q", ["1e308", "-1e9", str(10**15)])
def test_numbers_whose_differences_would_overflow_are_no_reading(q, more):
    assert parse_line(f'{{"t": 1.0, "q": [{q}]{more}}}'.encode()) is None
    assert parse_line(f'{{"t": 1.0, "q": [9e8]{more}}}'.encode()) is not None


@pytest.mark.parametrize(
    "change",
    [
        {"t": None},
        {"t": np.array([1.0, -1.0])},
        {"t": np.array([1.0, np.nan])},
        {"t": np.array([1, 2])},
        {"q": np.array([1.0, 2.0, 3.0])},
        {"q": np.array([])},
        {"q": np.array([1.0, np.inf])},
        {"q": np.array([1.0, 1e308])},
        {"q_cmd": np.array([1.0, -1e308])},
        {"q": np.zeros(66)},
        {"seq": np.array([1.0, 2.0])},
        {"seq": np.array([2**62, 1])},
        {"arrival_ns": np.array([1])},
        {"inputs": np.array([-2, 0])},
        {"qd": np.array([1.0])},
    ],
    ids=str,
)
def test_what_is_no_batch_is_none(change):
    columns = {
        "arrival_ns": np.array([1, 2]),
        "t": np.array([1.0, 2.0]),
        "seq": np.array([1, 2]),
        "q": np.array([0.1, 0.2]),
    }
    tags = {"f": 86, "i": 79}
    said = {
        name: column if column is None else cbor2.CBORTag(tags[column.dtype.kind], column.tobytes())
        for name, column in (columns | change).items()
    }
    assert unpack(cbor2.dumps(said)) is None


@pytest.mark.parametrize("data", [b"", b"\xff", b"\x01", b"\xa1\x61t\x01", cbor2.dumps({"t": cbor2.CBORTag(86, "x")})])
def test_what_is_no_map_of_arrays_is_none(data):
    assert unpack(data) is None


def recorded(path, n=3000, hz=500.0, odd_line=b"", numeric=False):
    """A session of a robot alone, with an event in its middle; ``numeric``: of a source that sends numbers."""
    lab = Lab()
    rng = np.random.default_rng(3)
    q = np.cumsum(rng.normal(0, 1e-4, (n, 6)), axis=0)
    with SessionWriter(path, lab) as writer:
        for k in range(n):
            t_ns = lab.now + round(k * SECOND / hz)
            line = json.dumps({"t": 5.0 + k / hz, "seq": k, "q": q[k].tolist(), "inputs": k // 100 % 4}).encode()
            if k == n // 2:
                writer.event("robot-back", t_ns)
            if odd_line and k == n // 2:
                writer.add(JOINTS, t_ns, odd_line)
            elif numeric:
                writer.add_reading(t_ns, None, parse_line(line))
            else:
                writer.add(JOINTS, t_ns, line)
            if k % 7 == 0:
                writer.add("/box/adc", t_ns, bytes(40))
            writer.tick(t_ns + MS)
    return open_session(path)


def stream_of(messages):
    reader = JointReader()
    reader.take(columns_of(messages))
    return reader.finish()


def assert_same_stream(ours, theirs):
    for name in ("readings", "malformed", "duplicated", "late", "lost", "gaps", "restarts", "rate_hz", "reports"):
        assert repr(getattr(ours, name)) == repr(getattr(theirs, name))  # NaN is not equal to itself
    columns = ([*bins.times, *bins.joints(0, len(bins))] for bins in (ours.bins, theirs.bins))
    for our_column, their_column in zip(*columns, strict=True):
        np.testing.assert_array_equal(our_column, their_column)


@pytest.mark.parametrize("odd_line", [b"", b"nonsense", b'{"t":8,"q":[1,2]}'])
def test_a_reader_of_columns_reads_what_a_reader_of_lines_reads(tmp_path, odd_line):
    """Also where a line of a copy is not a reading: its neighbours have no columns."""
    messages = list(recorded(tmp_path / "s.mcap", odd_line=odd_line).messages())
    lines = [m for m in messages if m.topic != COLUMNS]
    ours, theirs = stream_of(messages), stream_of(lines)
    assert (ours.readings, ours.malformed, ours.restarts) == (3000 - bool(odd_line), bool(odd_line), 1)
    assert_same_stream(ours, theirs)


def test_readings_of_numbers_are_columns_alone(tmp_path):
    """They say what lines would say, also in a copy; a message that is damaged costs its own readings."""
    lines = list(recorded(tmp_path / "lines.mcap").messages())
    session = recorded(tmp_path / "numbers.mcap", numeric=True)
    numbers = list(session.messages())
    assert {message.topic for message in numbers} == {READINGS, "/box/adc", "/events"}
    recover(session, tmp_path / "copy.mcap", {})
    assert list(open_session(tmp_path / "copy.mcap").messages()) == numbers
    ours, theirs = stream_of(numbers), stream_of(lines)
    assert (ours.readings, ours.restarts) == (3000, 1)
    assert_same_stream(ours, theirs)
    place = [message.topic for message in numbers].index(READINGS)
    fewer = 3000 - len(unpack(numbers[place].data))
    numbers[place] = numbers[place]._replace(data=b"\xa0")
    damaged = stream_of(numbers)
    assert (damaged.readings, damaged.malformed) == (fewer, 1)


def test_readings_of_numbers_are_replaced_too(tmp_path):
    session = recorded(tmp_path / "numbers.mcap", numeric=True)
    added = AddedReading(0.5, b'{"t":0.5,"q":[1.0],"arrival":false}')
    with refused("malformed-file", "replace", place=session.path):
        add_readings(session, iter([added]), tmp_path / "refused.mcap", 0.0, {})
    assert add_readings(session, iter([added]), tmp_path / "new.mcap", 0.0, {}, replace=True) == 1
    new = list(open_session(tmp_path / "new.mcap").messages())
    assert not [message for message in new if message.topic == READINGS]
    assert [message.data for message in new if message.topic == JOINTS] == [added.line]


def test_columns_stand_in_the_chunk_of_their_lines(tmp_path):
    """So that a damaged chunk costs both. All lines have columns, and none waits over the event."""
    covered = waiting = 0
    for message in recorded(tmp_path / "s.mcap").messages():
        if message.topic == JOINTS:
            waiting += 1
        elif message.topic == COLUMNS:
            assert len(unpack(message.data)) == waiting
            covered, waiting = covered + waiting, 0
        elif message.topic == "/events":
            assert waiting == 0
    assert (covered, waiting) == (3000, 0)


def test_a_copy_has_columns_of_its_own(tmp_path):
    session = recorded(tmp_path / "s.mcap")
    recover(session, tmp_path / "copy.mcap", {})
    copied = open_session(tmp_path / "copy.mcap")
    for topics in (JOINTS, "/events"):
        assert list(copied.messages(topics)) == list(session.messages(topics))
    batches = [[unpack(m.data) for m in one.messages(COLUMNS)] for one in (session, copied)]
    assert_same(*(concatenate(of_one) for of_one in batches))


def test_columns_that_do_not_fit_their_lines_are_passed_over():
    lines = [json.dumps({"t": k / 100, "seq": k, "q": [0.1]}).encode() for k in range(50)]
    said = [Message(JOINTS, k * 10 * MS, line) for k, line in enumerate(lines)]
    others = [Message(COLUMNS, SECOND, data) for data in (b"", b"\xf6", pack(parse_lines(lines[:9], range(9))))]
    stream = stream_of(said[:30] + others + said[30:])
    assert (stream.readings, stream.malformed, stream.lost) == (50, 0, 0)


def test_a_lost_and_a_doubled_line_before_the_same_columns_are_counted():
    """As many lines as the columns have, but not the same ones."""
    rows = [{"t": 0.02 * k, "seq": k, "q": [0.0, 0.1 * k]} for k in range(60)]
    lines = [json.dumps(row).encode() for row in rows]
    arrival_ns = [20 * MS * k for k in range(60)]
    messages = [Message(JOINTS, *pair) for pair in zip(arrival_ns, lines, strict=True)]
    received = [*messages[:20], *messages[21:40], messages[39], *messages[40:]]
    columns = Message(COLUMNS, arrival_ns[-1], pack(parse_lines(lines, arrival_ns)))
    for cut in (0, 10, 60):
        reader = JointReader()
        reader.take(columns_of(received[:cut]))
        reader.take(columns_of([*received[cut:], columns]))
        stream = reader.finish()
        assert (stream.readings, stream.lost, stream.duplicated) == (59, 1, 1)


def batch_of(first: int, joints: int = 2, **more: float):
    rows = [{"t": k / 100, "seq": k, "q": [0.1 * k] * joints, **more} for k in range(first, first + 1 + first % 3)]
    return parse_lines([json.dumps(row).encode() for row in rows], [10 * MS * row["seq"] for row in rows])


@pytest.mark.parametrize("other", [batch_of(4, joints=3), batch_of(4, robot_mode=7), batch_of(5, joints=1)])
def test_messages_are_decoded_together_as_one_by_one_if_their_columns_are_alike(other):
    batches = [batch_of(k) for k in (0, 4, 8, 9)]
    assert_same(unpack(*map(pack, batches)), concatenate(batches))
    assert unpack(pack(other)) is not None
    assert unpack(pack(batch_of(1)), pack(other)) is None


def test_the_collector_is_as_it_was():
    """It is paused while lines become columns, also where one cannot be read, and stays off where it was off."""
    line = json.dumps({"t": 1.5, "q": [1.0]}).encode()
    for enabled in (gc.disable, gc.enable):
        enabled()
        before = gc.isenabled()
        assert len(parse_lines([line, b"no"], [1, 2])) == 1
        with pytest.raises(ValueError, match="shorter"):
            parse_lines([line, b"no"], [1])
        assert gc.isenabled() == before
