"""The RAPID task of docs/tutorials/abb.md that sends joint readings: it is RAPID, and truearm reads what it sends."""

import re
from pathlib import Path

import numpy as np
import pytest
import rapid_machine

from truearm.record.robots.text_lines import LineDialect
from truearm.session.joint_format import parse_line

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "abb.md"
MAX_STRING = 80  # characters of a RAPID string
SENT = 200  # parts, after which the recorder closes the connection
STARTS = ("SocketCreate", "SocketBind", "SocketListen", "SocketAccept", "ClkStart")


class Gone(Exception):
    """The recorder closed the connection."""


class Controller:
    """An arm in motion, its clock, and a server socket with one client."""

    def __init__(self):
        self.t, self.calls, self.parts, self.moves = 0.0, [], [], []
        self.rng = np.random.default_rng(7)
        self.read = []

    def clock_read(self, machine, clock, highres=False):
        assert highres
        return self.t

    def joints(self, machine):
        self.read.append(self.rng.uniform(-360.0, 360.0, 6).tolist())
        return [self.read[-1], [9e9] * 6]

    def send(self, machine, socket, str):
        assert len(str.replace(r"\0A", "\n")) <= MAX_STRING
        self.parts.append(str.replace(r"\0A", "\n"))
        if len(self.parts) >= SENT:
            raise Gone

    def called(self, name):
        return lambda machine, *arguments, **options: self.calls.append(name)


def number_text(machine, number, digits):
    """Round to ``digits`` decimals, without trailing zeros."""
    text = f"{number:.{int(digits)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


@pytest.fixture
def source():
    blocks = re.findall(r"^```rapid[^\n]*\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (text,) = [block for block in blocks if "SendJoints" in block]
    return text


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of pyparsing, by rapidchecker
def test_a_checker_that_others_wrote_accepts_it(source):
    from rapidchecker.check import check_format

    assert check_format(source) == []


def test_truearm_reads_the_joints_that_it_sends(source, monkeypatch):
    controller = Controller()
    for name in STARTS:
        monkeypatch.setitem(rapid_machine.INSTRUCTIONS, name.lower(), controller.called(name))
    monkeypatch.setitem(rapid_machine.INSTRUCTIONS, "socketsend", controller.send)
    monkeypatch.setitem(rapid_machine.FUNCTIONS, "numtostr", number_text)
    monkeypatch.setitem(rapid_machine.FUNCTIONS, "cjointt", controller.joints)
    monkeypatch.setitem(rapid_machine.FUNCTIONS, "clkread", controller.clock_read)
    monkeypatch.setitem(rapid_machine.DATA, "wait_max", 60000.0)
    for i in range(6):
        monkeypatch.setitem(rapid_machine.COMPONENTS, f"rax_{i + 1}", i)
    with pytest.raises(Gone):
        rapid_machine.run_rapid(source, controller)
    assert tuple(controller.calls) == STARTS
    lines = "".join(controller.parts).split("\n")[:-1]
    dialect = LineDialect({})
    found = [parse_line(dialect.line(line.encode())) for line in lines]
    readings = [reading for reading in found if reading is not None]
    assert len(readings) >= (SENT - 1) // 2 - 1
    sent = controller.read[: len(readings)]
    np.testing.assert_allclose([reading.q for reading in readings], np.deg2rad(sent), atol=1e-7, rtol=0.0)
    times = [reading.t for reading in readings]
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
