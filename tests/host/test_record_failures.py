"""``truearm record`` when box or robot is missing, disappears or sends garbage: what is kept and what is printed."""

import json
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing

import pytest
from record_real import PATIENCE_S, box_on_a_socket
from test_record_command import posix
from tests.host.tcp_peer import Peer
from tests.refusals import shown

from truearm.cli.main import main
from truearm.errors import LinkError
from truearm.findings import Finding
from truearm.record.links import HostClock, SerialLink, TcpLink
from truearm.session.session_file import open_session

PRECIOUS = b"\x89MCAP0\r\nan earlier recording"


def silent(peer):
    while peer.recv(4096):
        pass


def random_bytes(peer):
    rng = random.Random(1)
    while True:
        peer.sendall(rng.randbytes(500))
        time.sleep(0.001)


@pytest.fixture
def hasty(monkeypatch):
    """Make the recorder wait less."""
    monkeypatch.setattr("truearm.record.requests.RETRY_NS", 30_000_000)


@pytest.fixture
def out(tmp_path):
    return tmp_path / "s.mcap"


@pytest.mark.usefixtures("hasty")
class TestWhatIsThereStays:
    @pytest.mark.parametrize("talk", [silent, random_bytes])
    @pytest.mark.parametrize("before", [PRECIOUS, None])
    def test_nobody_answers(self, out, capsys, talk, before):
        if before is not None:
            out.write_bytes(before)
        with closing(Peer(talk)) as robot:
            assert main(["record", "--box", f"socket://{robot.address}", "--out", str(out), "--force"]) == 1
        assert "no answer to 'identify'" in capsys.readouterr().err
        assert (out.read_bytes() if out.exists() else None) == before


@posix
def test_interrupted_before_the_box_answered(out):
    asked = threading.Event()

    def listen(peer):
        peer.recv(100)
        asked.set()
        silent(peer)

    with closing(Peer(listen)) as box:
        command = [sys.executable, "-c", "import sys; from truearm.cli.main import main; sys.exit(main())", "record"]
        process = subprocess.Popen(
            [*command, "--box", f"socket://{box.address}", "--out", str(out)], stderr=subprocess.PIPE, text=True
        )
        assert asked.wait(PATIENCE_S)  # the recorder has begun to ask and will do so for 5 s
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert re.fullmatch("interrupted .*\n", complaint)
    assert not out.exists()


class TestTheBoxGoes:
    def test_for_good(self, out, capsys):
        with box_on_a_socket() as (box, device):

            def die():
                while not box.blocks:  # it lives for a time after its start, which a busy computer delays
                    time.sleep(0.01)
                time.sleep(0.8)
                box.link.on_write = lambda raw: (_ for _ in ()).throw(OSError)  # play() ends: the connection is closed

            threading.Thread(target=die, daemon=True).start()
            assert main(["record", "--box", device, "--out", str(out), "--duration-s", "4"]) == 4
        said = capsys.readouterr()
        *lines, gone = said.err.splitlines()
        assert sum("s: box: " in line and line.endswith(f"; {Finding('box-lost').text()}") for line in lines) == 1
        assert "the box was gone " in gone
        assert str(out) in gone
        assert shown["recorded"]["ended"] == "duration"
        assert shown["recording-disturbed"]["link_losses"] == 1
        assert main(["inspect", str(out), "--json"]) == 0
        losses = json.loads(capsys.readouterr().out)["losses"]
        (silence,) = losses["silences"]
        assert 2.0 <= silence["to_s"] - silence["from_s"] <= 4.0
        missing = (silence["to_s"] - silence["from_s"]) / 983_040e-9
        assert losses["samples_missing"] == pytest.approx(missing, abs=1)


class TestTheRobotIsNone:
    @pytest.mark.parametrize(
        ("piece", "pause_s", "says"),
        [
            (None, 0.0, "robot within 0.5 s"),
            (b"", 0.0, "robot closed its stream without"),
            (b"hello there\n", 0.01, "robot within 0.5 s"),
            (b"x" * (1 << 20), 0.0, "robot within 0.5 s"),
        ],
        ids=["nothing", "closes", "text", "endless"],
    )
    def test_rubbish(self, out, capsys, monkeypatch, piece, pause_s, says):
        monkeypatch.setattr("truearm.record.recorder.ROBOT_NS", 500_000_000)

        def robot(peer):
            if piece is None:
                silent(peer)
            while piece:
                peer.sendall(piece)
                time.sleep(pause_s)

        with box_on_a_socket() as (box, device), closing(Peer(robot)) as served:
            arguments = ["--box", device, "--address", f"tcp://{served.address}", "--out", str(out)]
            assert main(["record", *arguments]) == 4
        (complaint,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("truearm: "))
        assert says in complaint
        if piece == b"":  # it had closed before the box started
            assert "nothing was recorded" in complaint
        else:
            assert len(list(open_session(out).messages({"/box/adc"}))) == box.blocks

    def test_joints_that_come_and_go(self, out, capsys):
        def robot(peer):
            for k in range(100):
                row = {"t": 0.01 * k, "seq": k, "q": [0.1] * (6 - k % 2)}
                peer.sendall(json.dumps(row).encode() + b"\n")
                time.sleep(0.01)
            peer.sendall(b'{"end": true}\n')

        with box_on_a_socket() as (_, device), closing(Peer(robot)) as served:
            arguments = ["--box", device, "--address", f"tcp://{served.address}", "--out", str(out)]
            assert main(["record", *arguments]) == 0
        assert (shown["recorded"]["readings"], shown["recording-disturbed"]["robot_other_joints"]) == (50, 50)
        capsys.readouterr()
        assert main(["inspect", str(out), "--json"]) == 0
        robot_said = json.loads(capsys.readouterr().out)["robot"]
        assert (robot_said["readings"], robot_said["malformed"], robot_said["joints"]) == (50, 50, 6)


def test_a_host_that_does_not_resolve(monkeypatch):
    def no_such_name(*_, **__):
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "create_connection", no_such_name)
    with pytest.raises(LinkError, match="unknown host name") as failure:
        SerialLink("socket://nohost:7007", HostClock())
    assert str(failure.value).count("nohost") == 1
    with pytest.raises(LinkError, match="unknown host name"):
        TcpLink("tcp://nohost:7008", HostClock())
