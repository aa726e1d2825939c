"""A robot's lines, distinguished from everything else that it may print."""

import pytest

from truearm.record.joint_lines import MAX_LINE, JointLines
from truearm.session.joint_format import parse_line

GOOD = b'{"t": 1.5, "seq": 3, "q": [0.1, -2]}'


class TestJointLines:
    @pytest.mark.parametrize(
        "line",
        [
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
        ],
        ids=lambda line: line[:40].decode("latin-1"),
    )
    def test_what_is_none(self, line):
        lines = JointLines()
        good = parse_line(GOOD)
        assert good is not None
        assert lines.push(GOOD + b"\n" + line + b"\n" + GOOD + b"\n") == [(good, GOOD), (None, line), (good, GOOD)]

    def test_a_line_without_end(self):
        lines = JointLines()
        pieces = [item for _ in range(100) for item in lines.push(b"x" * 1000)]
        assert all(reading is None and len(piece) <= MAX_LINE for reading, piece in pieces)
        assert sum(len(piece) for _, piece in pieces) + len(lines.flush()) == 100_000
