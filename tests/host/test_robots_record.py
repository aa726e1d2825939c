"""``truearm record`` with robots that use their own protocols: the session's content, and its evaluation."""

import json
import re
import time
from contextlib import closing

import numpy as np
import pytest
from test_record_command import box_on_a_socket
from tests.host.tcp_peer import Peer

from truearm.cli.main import main
from truearm.session.session_file import open_session


def rows_of(path):
    return [json.loads(message.data) for message in open_session(path).messages({"/robot/joints"})]


def recorded(tmp_path, printed, talk, address):
    """Return the session of a robot that talks and then closes its stream, and inspect's account of the robot."""
    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (_, device), closing(Peer(talk)) as robot:
        source = ["--address", address.format(robot.address), "--patience-s", "0"]
        printed("record", "--box", device, *source, "--out", out)
    return out, json.loads(printed("inspect", out, "--json"))["robot"]


def test_csv_in_degrees(tmp_path, printed):
    """A robot that was running before us: half a line, then rows; its columns stand in the address."""

    def robot(peer):
        peer.sendall(b".5,20\n")
        for k in range(150):
            peer.sendall(b"%d,%d,%.3f,20.0,10.5,20.5\n" % (8 * k, k, 10.0 + 0.01 * k))
            time.sleep(0.008)

    columns = "t_ms,seq,q1_deg,q2_deg,q1_cmd_deg,q2_cmd_deg"
    out, said = recorded(tmp_path, printed, robot, "lines+tcp://{}?columns=" + columns)
    rows = rows_of(out)
    assert np.allclose(np.rad2deg([row["q"] for row in rows])[:, 0], 10.0 + 0.01 * np.arange(150), atol=1e-12)
    assert np.allclose([row["q_cmd"] for row in rows], np.deg2rad([10.5, 20.5]), atol=1e-15)
    assert [row["t"] for row in rows] == [8 * k / 1000 for k in range(150)]
    assert rows[7]["line"] == "56,7,10.070,20.0,10.5,20.5"
    assert [message.data for message in open_session(out).messages({"/robot/console"})] == [b".5,20"]
    assert (said["readings"], said["lost"], said["malformed"], said["joints"]) == (150, 0, 0, 2)
    assert said["rate_hz"] == pytest.approx(125.0, abs=1e-6)


def test_a_header_that_is_not_understood_is_said(tmp_path, capsys):
    def robot(peer):
        peer.sendall(b"t_s,q1_grad\n")
        time.sleep(1.0)

    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (_, device), closing(Peer(robot)) as served:
        source = ["--address", f"lines+tcp://{served.address}", "--duration-s", "3"]
        assert main(["record", "--box", device, *source, "--out", str(out)]) == 4
    # the box here has no calibrated channel; whether its warning comes before the end is a matter of milliseconds
    complaint = [line for line in capsys.readouterr().err.splitlines() if "warning: no channel" not in line]
    assert len(complaint) == 1
    assert re.search(r"column 2 \('q1_grad'\).* q1_rad, q1_deg", complaint[0])
