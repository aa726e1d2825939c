"""``truearm record`` on a real terminal: the live view, typed lines, Ctrl-C in every state, and the choice of the box."""

import codecs
import fcntl
import json
import os
import re
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from record_files import events
from record_real import PATIENCE_S, box_on_a_socket
from test_record_command import CALIBRATED
from tests.refusals import ended

from truearm.cli.main import main
from truearm.findings import Finding
from truearm.session.session_file import open_session

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
CONTROL_C, CONTROL_Z = b"\x03", b"\x1a"
RUN = "import sys; from truearm.cli.main import main; sys.exit(main())"


class OnTerminal:
    """A process on a terminal controlled by the test. ``text``: everything that it wrote."""

    def __init__(self, *arguments, code=RUN):
        self.master, slave = os.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, b"\x32\0\xc8\0\0\0\0\0")  # 50 lines of 200
        self.before = termios.tcgetattr(slave)

        def own_terminal():
            os.setsid()
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)
            for number in (signal.SIGINT, signal.SIGHUP):  # whoever runs the tests under nohup has them ignored
                signal.signal(number, signal.SIG_DFL)

        command = [sys.executable, "-c", code, *map(str, arguments)]
        self.process = subprocess.Popen(
            command,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            preexec_fn=own_terminal,
            env={**os.environ, "TERM": "xterm"},
        )
        self.slave = slave
        self.text = ""
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        decoder = codecs.getincrementaldecoder("utf-8")("replace")  # a read may end inside a character
        while not self._closed.is_set():
            if not select.select([self.master], [], [], 0.05)[0]:
                continue
            try:
                data = os.read(self.master, 65536)
            except OSError:
                return
            self.text += decoder.decode(data)

    def close(self):
        """Close the window. No thread may be reading it: a read in progress would keep it open."""
        self._closed.set()
        self._thread.join(PATIENCE_S)
        os.close(self.slave)
        os.close(self.master)

    def type(self, data):
        os.write(self.master, data if isinstance(data, bytes) else data.encode())

    def expect(self, pattern):
        """Wait until the process has written this."""
        deadline = time.monotonic() + PATIENCE_S
        while not (found := re.search(pattern, self.text)) and time.monotonic() < deadline:
            assert self.process.poll() is None or time.sleep(0.3) or re.search(pattern, self.text), self.text
            time.sleep(0.02)
        assert found, self.text[-3000:]
        return found

    def end(self):
        """Return the exit code; the terminal must be restored."""
        code = self.process.wait(PATIENCE_S)
        time.sleep(0.1)
        after = termios.tcgetattr(self.slave)
        self.close()
        assert after == self.before
        assert "Traceback" not in self.text
        return code


@contextmanager
def recording(tmp_path, *options):
    """Return a recording that has begun, its box, and its file."""
    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (box, device):
        box.lvdt = CALIBRATED
        terminal = OnTerminal("record", "--box", device, "--out", out, *options)
        terminal.expect(r"recording, [1-9]")
        yield terminal, box, out


class TestTyping:
    def test_what_is_typed_reaches_the_file(self, tmp_path):
        with recording(tmp_path) as (terminal, box, out):
            terminal.expect(r"Enter: mounted as asked")
            terminal.type("bar=b4")
            terminal.expect(r"> bar=b4")
            terminal.type("7\x7f6,chuck=c1\r")
            terminal.expect(r"mounted: bar b46, chuck c1")
            terminal.type("note a draught from the d\x1b[Aoor\r")  # with an arrow key
            terminal.expect(r"noted: a draught from the door")
            for byte in "note μm\r".encode():  # a read may end inside a character
                terminal.type(bytes([byte]))
                time.sleep(0.05)
            terminal.expect(r"noted: μm")
            terminal.type("q\r")
            assert terminal.end() == 0
        assert not box.streaming
        assert [kind for kind in events(out) if kind != "dwell"] == ["start", "mounted", "note", "note", "stop"]
        assert events(out, "mounted")[0]["bar"] == "b46"
        assert events(out, "stop")[0]["reason"] == "operator"
        assert "ended: operator" in " ".join(terminal.text.split())

    def test_plain(self, tmp_path):
        out = tmp_path / "s.mcap"
        with box_on_a_socket() as (box, device):
            box.lvdt = CALIBRATED
            terminal = OnTerminal("record", "--plain", "--box", device, "--out", out)
            terminal.expect(r"\d s: box recording, [^\r\n]*; adc 1017\.3 Hz; lvdt [^\r\n]*; taken ")
            terminal.type("bar=b61\n")
            terminal.expect(r"mounted: bar b61")
            terminal.type("q\n")
            assert terminal.end() == 0
        assert "\x1b[" not in terminal.text

    @pytest.mark.soak
    def test_control_z_does_not_stop_it(self, tmp_path):
        with recording(tmp_path) as (terminal, box, out):
            blocks = box.blocks
            terminal.type(CONTROL_Z)
            deadline = time.monotonic() + PATIENCE_S
            while box.blocks < blocks + 100 and time.monotonic() < deadline:  # a second
                time.sleep(0.05)
            terminal.type("q\r")
            assert terminal.end() == 0
        assert box.blocks >= blocks + 100
        assert len(list(open_session(out).messages({"/box/adc"}))) == box.blocks

    def test_a_terminal_that_is_closed(self, tmp_path):
        """The window is closed: the file is complete."""
        with recording(tmp_path) as (terminal, box, out):
            terminal.close()
            terminal.process.wait(PATIENCE_S)
            assert not box.streaming
        assert events(out, "stop")[0]["reason"] == "interrupted"


class TestControlC:
    def test_while_it_records(self, tmp_path):
        with recording(tmp_path) as (terminal, box, out):
            terminal.type("half a li")
            terminal.type(CONTROL_C)
            assert terminal.end() == 130
        assert not box.streaming
        assert "ended: interrupted" in " ".join(terminal.text.split())
        assert len(list(open_session(out).messages({"/box/adc"}))) == box.blocks

    def test_while_the_box_is_away(self, tmp_path):
        with recording(tmp_path) as (terminal, box, out):
            box.link.on_write = lambda raw: (_ for _ in ()).throw(OSError)  # play() ends: the connection is closed
            terminal.expect(Finding("box-lost").text())
            terminal.type(CONTROL_C)
            assert terminal.end() == 4
        assert "the box was gone at the end" in terminal.text
        assert [kind for kind in events(out) if kind != "dwell"] == ["start", "link-lost", "stop"]


def port(name, vid=0x2E8A, pid=5, serial="E66"):
    return SimpleNamespace(device=name, vid=vid, pid=pid, serial_number=serial, product="truearm", description="")


class TestWhichBox:
    def test_several_and_nobody_to_ask(self, tmp_path, monkeypatch, capsys):
        ports = [
            port("/dev/ttyACM1", serial="E2"),
            port("/dev/ttyS0", None, None, None),
            port("/dev/ttyACM0", serial="E1"),
        ]
        monkeypatch.setattr("truearm.record.links.list_ports.comports", lambda: ports)
        assert main(["record", "--out", str(tmp_path / "s.mcap")]) == 2
        complaint = capsys.readouterr().err
        boxes = ["/dev/ttyACM0 (truearm, serial E1)", "/dev/ttyACM1 (truearm, serial E2)"]
        ended(complaint, "several-boxes", boxes=boxes)
        assert complaint.count("\n") == 1

    def test_the_only_one(self, tmp_path, monkeypatch, capsys):
        monkeypatch.setattr("truearm.record.links.list_ports.comports", lambda: [port("/dev/none")])
        assert main(["record", "--out", str(tmp_path / "s.mcap")]) == 1
        said = capsys.readouterr().err
        assert "box: /dev/none (truearm, serial E66)" in said
        assert "/dev/none: not found" in said


class TestChecked:
    def test_refused_before_anything_is_written(self, tmp_path, capsys):
        out = tmp_path / "s.mcap"
        with box_on_a_socket() as (box, device):
            assert main(["record", "--box", device, "--mounted", "bar=b46", "--out", str(out)]) == 2
        complaint = capsys.readouterr().err
        assert "c0, c1, c2, c3)" in complaint
        assert not out.exists()
        assert 50 not in [command[0] for command in box.commands]

    def test_all_the_same(self, tmp_path, capsys):
        out = tmp_path / "s.mcap"
        with box_on_a_socket() as (_, device):
            options = ["--mounted", "bar=b46", "--unchecked", "--duration-s", "0.3"]
            assert main(["record", "--box", device, *options, "--out", str(out)]) == 0
        assert "no channel lvdt" in capsys.readouterr().err
        assert json.loads(open_session(out).metadata["box"]["ident"])
