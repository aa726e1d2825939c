"""A new joint source in one new file and one line of the registry: readings of a server come out as a session has them."""

import json
import math

import pytest

from tests.host.tcp_peer import Peer
from tests.recipes.recipes import Copy
from truearm.session.joint_format import parse_line

SENT = b"0;89.0\n1500;90.0;-45.5\nhello\n\xff\n1502;nan;0\n1502\n;;\n1504;90.0;-45.0\n1506;9"
OPEN = """
import sys
from truearm.errors import LinkClosed
from truearm.record.links import HostClock
from truearm.record.robots.sources import open_source

link, got = open_source(sys.argv[1], HostClock()), b""
try:
    while True:
        got += b"".join(data for _, data in link.read(0.1))
except LinkClosed:
    link.close()
print(got.hex())
"""


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The package with the source."""
    copy = Copy(tmp_path_factory.mktemp("source"))
    copy.apply("A joint source")
    assert copy.changes() == {
        "host/truearm/record/robots/semicolons.py": "new file",
        "host/truearm/record/robots/sources.py": "+1 -0",
    }
    return copy


def test_readings_come_out(copy):
    got = bytes.fromhex(copy.python("-c", OPEN, f"semicolons://{Peer(SENT).address}").out)
    first, reading, *others, last, rest = got.split(b"\n")
    assert (first, rest) == (
        b"0;89.0",
        b"1506;9",
    )  # the first of a connection may have lost its head, the last its tail
    assert others == [b"hello", b"\xff", b"1502;nan;0", b"1502", b";;"]
    found = [parse_line(line) for line in (reading, last)]
    assert [each.t for each in found] == pytest.approx([1.5, 1.504], rel=1e-15)
    assert found[0].q == pytest.approx([math.pi / 2, math.radians(-45.5)], rel=1e-15)
    assert json.loads(reading)["line"] == "1500;90.0;-45.5"
    assert not any(map(parse_line, others))


def test_help_and_errors_name_it(copy):
    said = " ".join(copy.run("record", "--help").split())
    assert "semicolons://192.168.0.2:5000 (milliseconds and degrees between semicolons)" in said
    refused = {
        "colons://127.0.0.1:1": "tcp://, rtde://, lines+tcp://, lines+udp://, semicolons://",
        "semicolons://127.0.0.1:1/x": "needs tcp://host:port",
    }
    for url, why in refused.items():
        assert why in copy.python("-c", OPEN, url, code=1).err
