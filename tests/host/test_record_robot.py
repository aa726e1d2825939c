"""A robot's lines, distinguished from everything else that it may print."""

from record_box import HOST_0, SECOND, Box, Wire
from record_files import run, topics

from truearm.record.joint_lines import MAX_LINE

GOOD = b'{"t": 1.5, "seq": 3, "q": [0.1, -2]}'
OTHERS = [
    b"hello",
    b"\xff\xfe",
    b"[1, 2]",
    b'{"t": 1}',
    b'{"t": "1", "q": [1, 2]}',
    b'{"t": true, "q": [1, 2]}',
    b'{"t": NaN, "q": [1, 2]}',
    b'{"t": 1e999, "q": [1, 2]}',
    b'{"t": 1, "q": [1, Infinity]}',
    b'{"t": 1, "q": [1, null]}',
    b'{"t": 1, "q": []}',
    b'{"t": 1, "q": 1}',
    b'{"t": 1, "q": [1, 2], "seq": "x"}',
    b'{"t": 1, "q": [1, 2, 3]}',
    b'{"t": 1, "q": [' + b"1," * 32 + b"1]}",
    b'{"t": ' + b"9" * 400 + b', "q": [1, 2]}',
    b'{"t": ' + b"9" * 5000 + b', "q": [1, 2]}',
    b"[" * 8000,
    b'{"q":' * 1500,
]


def test_what_is_no_reading_is_kept_as_console(lab, path):
    """Also a line without end, in pieces."""
    link = Wire(lab, "robot in memory")

    def talk():
        for line in OTHERS:
            link.deliver(GOOD + b"\n" + line + b"\n")
        for _ in range(100):
            link.deliver(b"x" * 1000)

    lab.at(HOST_0 + SECOND, talk)
    summary = run(lab, Box(lab), path, robot=link)
    stored = topics(path)
    assert [m.data for m in stored["/robot/joints"]] == [GOOD] * len(OTHERS)
    console = [m.data for m in stored["/robot/console"]]
    assert console[: len(OTHERS)] == OTHERS
    assert b"".join(console[len(OTHERS) :]) == b"x" * 100_000
    assert max(map(len, console)) <= MAX_LINE
    assert summary.counters.robot_other_joints == 1
