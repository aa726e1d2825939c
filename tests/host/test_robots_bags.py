"""ROS 2 bags: files of rosbags' own writer are read exactly and in order; hostile files give one clear error."""

import json
import math
import sys

import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from ros_bags import STORAGES, joint_state, write_bag
from tests.refusals import refused

from truearm.errors import InputError
from truearm.record.robots.bags import readings
from truearm.record.robots.sources import FileOptions
from truearm.session.joint_format import parse_line

TOPIC = "/joint_states"
# As Universal Robots' driver publishes them: the elbow first.
NAMES = ["elbow", "lift", "pan", "wrist1", "wrist2", "wrist3"]
JOINTS = ["pan", "lift", "elbow", "wrist1", "wrist2", "wrist3"]
T0 = 1_764_000_000_123_456_789
storages = pytest.mark.parametrize("storage", STORAGES)


def states(n, names=NAMES):
    """Position k + i/7 of joint i, velocity its negative, effort twice."""
    for k in range(n):
        q = [k + i / 7 for i in range(len(names))]
        state = joint_state(T0 + 2_000_000 * k, names, q, [-x for x in q], [2 * x for x in q])
        yield T0 + 2_000_000 * k + 300_000, state


def files_of(bag):
    return [file for file in bag.iterdir() if file.suffix in (".mcap", ".db3")]


def read(path, joints=JOINTS, **more):
    return list(readings(path, FileOptions(TOPIC, joints, **more)))


@pytest.mark.parametrize(
    ("storage", "compress"),
    [("mcap", None), ("mcap", "STORAGE"), ("sqlite3", None), ("sqlite3", "FILE"), ("sqlite3", "MESSAGE")],
)
def test_exactly_and_in_the_order_of_the_joints(tmp_path, storage, compress):
    bag = write_bag(tmp_path / "bag", storage, states(50), compress)
    for path in (bag, *files_of(bag)) if compress in (None, "STORAGE") else (bag,):
        found = read(path)
        assert len(found) == 50
        for k, (t, line) in enumerate(found):
            # a double has 52 bits: 2.4e-7 s at this time of the world
            assert t == pytest.approx(1e-9 * (T0 + 2_000_000 * k), abs=2.4e-7)
            reading = parse_line(line)
            assert reading.t == t
            assert reading.q == [k + i / 7 for i in (2, 1, 0, 3, 4, 5)]
    row = json.loads(line)
    assert row["qd"] == [-x for x in row["q"]]
    assert row["effort"] == [2 * x for x in row["q"]]
    assert row["arrival"] is False
    assert "seq" not in row


def test_chunks_of_lz4(tmp_path):
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, compression=CompressionType.LZ4, chunk_size=4096)
        writer.start(profile="ros2")
        channel = writer.register_channel(
            TOPIC, "cdr", writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        )
        for received_ns, data in states(100):
            writer.add_message(channel, received_ns, data, received_ns)
        writer.finish()
    assert [parse_line(reading.line).q[2] for reading in read(path)] == list(range(100))


WRONG = {
    "no joints": (
        [],
        "joints in order from",
    ),
    "an unknown joint": (["pan", "lid"], "no joint 'lid'.* elbow,lift"),
}


@storages
@pytest.mark.parametrize(("joints", "says"), WRONG.values(), ids=WRONG)
def test_joints_that_are_not_there(tmp_path, storage, joints, says):
    bag = write_bag(tmp_path / "bag", storage, states(2))
    with pytest.raises(InputError, match=says):
        read(bag, joints)


@storages
def test_a_topic_that_is_not_there(tmp_path, storage):
    bag = write_bag(tmp_path / "bag", storage, states(2), topic="/other")
    with pytest.raises(InputError, match="no messages on /joint_states"):
        read(bag)


STATES = {
    "cut off": (joint_state(T0, NAMES, [0.0] * 6)[:-3], "sensor_msgs/msg/JointState"),
    "empty": (b"", "sensor_msgs/msg/JointState"),
    "text": (b"hello there, this is not a state", "sensor_msgs/msg/JointState"),
    "endless": (
        b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0\0\0\0" + b"\xff\xff\xff\x7f",
        "sensor_msgs/msg/JointState",
    ),
    "no positions": (joint_state(T0, NAMES, []), "finite position"),
    "not a number": (joint_state(T0, NAMES, [0.0] * 5 + [math.nan]), "finite position"),
    "before 1970": (joint_state(-(10**18), NAMES, [0.0] * 6), "valid time"),
}


@storages
@pytest.mark.parametrize(("data", "says"), STATES.values(), ids=STATES)
def test_messages_that_are_none(tmp_path, storage, data, says):
    bag = write_bag(tmp_path / "bag", storage, [*states(1), (T0 + 10**9, data)])
    with pytest.raises(InputError, match="message 2: " + ".*" * bool(says) + says):
        read(bag)


def test_what_is_no_bag(tmp_path):
    (tmp_path / "empty").mkdir()
    with refused("malformed-file", place=tmp_path / "empty"):
        read(tmp_path / "empty")
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "nothing.db3")


def test_without_rosbags(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", "mcap", states(1))
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(InputError, match=r"pip install 'truearm\[ros\]'"):
        read(bag)
