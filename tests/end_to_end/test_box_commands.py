"""``truearm box`` with a box in real time, over a socket and a pseudo-terminal, as an operator uses it."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from tests.end_to_end.box_server import MAG_PERIOD_NS, Stage, box, served
from tests.host.findings_bench import listed

from truearm import __version__
from truearm.box.control import conversation
from truearm.record import links
from truearm_sim.box import BoxSetup

SILENT = {"converter_id": 0, "excitation": 20, "noise_0": 0, "stops": 3, "rail_5v": 4420}


@pytest.fixture(params=["socket", "pty"])
def device(request):
    with served(pty=request.param == "pty") as (device, _, _):
        yield device


def test_info_and_self_test_in_words(device, printed):
    said = printed("box", "info", "--box", device)
    assert f"firmware  {__version__} on vm" in said
    assert (
        "stream adc: 1017.25 samples per second (at most 4069.01 without loss), osr 4096, group delay 0.737 ms" in said
    )
    assert "calibrated to m by 2 coefficients (sim-lvdt 2026-01-01)" in said
    said = printed("box", "test", "--box", device)
    assert "the converter answers: 0x2402" in said
    assert re.findall(r"\d+", said.splitlines()[0])[:3] == ["8", "0", "0"]
    assert len(said.splitlines()) <= 15
    assert json.loads(printed("box", "info", "--box", device, "--json"))["board"] == "vm"


def test_a_self_test_that_fails(capsys):
    world = Stage()
    with served(world, setup=BoxSetup(config=world.box_config(), self_test=SILENT)) as (device, _, _):
        assert box("test", "--box", device) == 1
        said = capsys.readouterr()
        assert said.out.splitlines()[1].startswith("fail: the converter answers: 0x0 (allowed: 0x2400 to 0x24ff)")
        assert said.err == ""
        assert box("test", "--box", device, "--json") == 1
        results = {result["name"]: result for result in json.loads(capsys.readouterr().out)}
        words = " ".join(said.out.split())
        assert all(f"{result['verdict']}: {result['title']}" in words for result in results.values())
        assert all(result["advice"] in words for result in results.values())
        assert f"channel.NAME.over= --box {device}" in results["excitation"]["text"]
        codes = {
            name: (results[name]["verdict"], results[name]["code"]) for name in ("converter_id", "rail_5v", "noise_1")
        }
        warned = {"rail_5v": ("warn", "test-supply"), "noise_1": ("warn", "test-noise")}
        assert codes == {"converter_id": ("fail", "test-converter"), **warned}


def test_configuration_by_file_and_by_value(device, tmp_path, printed):
    path = tmp_path / "box.toml"
    assert box("config", "get", "--box", device, "--out", path) == 0
    assert printed("box", "config", "set", path, "--box", device).splitlines()[-1] == f"{device}: nothing changes"
    assert printed(
        "box", "config", "set", "osr=2048", "channel.lvdt.gain=2", "--box", device, "--dry-run"
    ).splitlines() == ["osr: 4096 → 2048", "channel.lvdt.gain: (none) → 2", f"{device}: unchanged (--dry-run)"]
    path.write_text(path.read_text().replace("osr = 4096", "osr = 2048"))
    assert (
        printed("box", "config", "set", path, "channel.lvdt.gain=2", "--box", device)
        .splitlines()[-1]
        .startswith(f"{device}: stored")
    )
    assert "osr = 2048  # 2034.51 samples per second" in printed("box", "config", "get", "--box", device)
    assert "trigger_ms: [0, 0] → [50, 150]" in printed("box", "config", "set", "trigger_ms=[50,150]", "--box", device)
    assert "channel.lvdt.gain: 2 → (none)" in printed("box", "config", "set", "channel.lvdt.gain=", "--box", device)
    said = json.loads(printed("box", "config", "set", "osr=4096", "--box", device, "--dry-run", "--json"))
    assert (said["changes"], said["stored"], said["config"]["osr"]) == (["osr: 2048 → 4096"], False, 4096)
    assert json.loads(printed("box", "config", "get", "--box", device, "--json"))["osr"] == 2048


def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with served() as (device, _, _):
        for arguments, says in (
            (["config", "set", "osr=2047"], "osr: must be one"),
            (["config", "set", "gone.toml"], "gone.toml: no such file"),
            (["config", "set", "osr"], "neither KEY=VALUE, such as osr=2048, nor"),
            (["gauge", "nothing"], "no channel nothing"),
            (["gauge", "magnetostrictive"], "switch it on"),
            (["gauge", "lvdt", "--unit", "parsec"], "'--unit': 'parsec'"),
            (["gauge", "lvdt", "--order", "9"], "order"),
            (["monitor", "--duration-s", "0"], "'--duration-s': 0"),
        ):
            assert box(*arguments, "--box", device) == 2
            said = capsys.readouterr().err
            assert says in said
            assert len(said.strip().splitlines()) == 1


def test_no_box_there(capsys):
    assert box("info", "--box", "/dev/gone") == 1
    assert "plug" in capsys.readouterr().err
    assert box("info", "--box", "ftp://x") == 2
    assert box("info") == 1
    assert "plugged in" in capsys.readouterr().err


def test_a_box_that_streams_is_left_alone_until_stop(capsys):
    from truearm_wire.messages import START

    with served() as (device, _, _):
        with conversation(device) as talk:  # as a recorder that is killed leaves it
            talk.command(START)
        for command in (["config", "get"], ["config", "set", "osr=2048"], ["test"], ["reset"]):
            assert box(*command, "--box", device) == 1
            said = capsys.readouterr().err
            assert "recording first, or give --stop" in said
            assert len(said.splitlines()) == 1
        assert box("info", "--box", device) == 0
        assert box("config", "set", "osr=2048", "--box", device, "--stop") == 0
        assert box("config", "get", "--box", device) == 0


def test_a_restart_forgets_the_traceback(printed):
    with served() as (device, _, shown):
        (shown.flash / "last_error.txt").write_text("Traceback:\n  somewhere\nMemoryError: no room")
        assert "  MemoryError: no room" in printed("box", "info", "--box", device)
        assert box("reset", "--box", device) == 0
        with conversation(device, retries=20) as talk:
            assert "last_error" not in talk.identify().document


# --- list


class Port:
    def __init__(self, device, vid=0x2E8A, pid=0x0005, product="Board in FS mode"):
        self.device, self.vid, self.pid, self.product = device, vid, pid, product
        self.serial_number, self.description = "e661", "n/a"


def test_boxes_are_listed_by_their_usb_identity(monkeypatch, printed):
    with served(pty=True) as (device, _, _):
        found = [Port("/dev/ttyS0", None, None, None), Port("/dev/ttyUSB0", 0x0403, 0x6001, "FT232R"), Port(device)]
        monkeypatch.setattr(links.list_ports, "comports", lambda: found)
        (line,) = printed("box", "list").splitlines()  # a stranger's serial port is not even opened
        assert re.fullmatch(
            rf"{device} \(2e8a:0005 Board in FS mode\): truearm box \w+, firmware {re.escape(__version__)} on vm", line
        )
        monkeypatch.setattr(links.list_ports, "comports", lambda: [Port(device), Port("/dev/gone")])
        rows = json.loads(printed("box", "list", "--json"))["ports"]
        gone, there = sorted(rows, key=lambda row: row["device"] == device)
        assert (gone["device"], there["device"]) == ("/dev/gone", device)
        assert there["box"]["firmware"] == __version__
        assert gone["box"] is None
        assert "not found" in gone["answer"]


def test_nothing_to_list(no_ports, printed):
    assert listed(json.loads(printed("box", "list", "--json"))).keys() == {"no-box-plugged-in"}


# --- monitor


def test_the_monitor_shows_values_and_ends_with_its_time(capsys):
    world = Stage(mag_period_ns=MAG_PERIOD_NS)
    world.position = 0.0123
    with served(world) as (device, _, _):
        assert box("monitor", "--box", device, "--duration-s", "3.5") == 0
        assert box("config", "get", "--box", device) == 0  # it was stopped
    lines = capsys.readouterr().out.splitlines()
    shown = [line for line in lines if line.startswith("time ")]
    assert len(shown) >= 2
    last = dict(part.split(" ", 1) for part in shown[-1].split("; "))
    assert last["adc"] == "1017.25 Hz, 0 samples lost"
    # what the box's label says of the volts of 12.3 mm, to 0.1 µm as shown
    expected = 1e3 * np.polynomial.polynomial.polyval(world.volts(), (-4.213e-4, 3.78812e-2))
    assert float(last["lvdt"].split(" mm")[0]) == pytest.approx(expected, abs=2e-4)
    assert last["transverse_a"].startswith("0.3000")
    assert " mm ± " in last["magnetostrictive"]
    assert re.match(r"± \d+ µs, (host [\d.]+ ppm (faster|slower)|rate .* yet), shortest", last["clock"])
    assert last["box"].startswith("24.5 °C")
    assert re.findall(r"(\d+) (frame|sample)", last["losses"]) == [("0", "frame"), ("0", "sample")]
    assert next(line for line in lines if line.startswith("ended"))


def all_of(master):
    """Return everything written to a terminal until no process has it open."""
    shown = bytearray()
    with contextlib.suppress(OSError):  # EIO at the end
        while piece := os.read(master, 1 << 16):
            shown += piece
    return shown.decode()


def on_a_terminal(command):
    """Return the finished process and its output on a terminal that is read continuously, as a real one is."""
    master, slave = os.openpty()
    environ = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    with ThreadPoolExecutor(1) as reader:
        shown = reader.submit(all_of, master)
        try:
            done = subprocess.run(command, stdout=slave, stderr=subprocess.PIPE, env=environ, timeout=60)
        finally:
            os.close(slave)
    os.close(master)
    return done, shown.result()


def test_on_a_terminal_the_monitor_keeps_to_its_place():
    with served() as (device, _, _):
        command = [sys.executable, "-m", "truearm", "box", "monitor", "--box", device, "--duration-s", "4"]
        done, shown = on_a_terminal(command)
    assert (done.returncode, done.stderr) == (0, b"")
    assert shown.count("transverse_b") >= 2
    assert "\x1b[1A" in shown  # back to the line above


def test_ctrl_c_ends_the_monitor_in_order():
    with served() as (device, _, _):
        command = [sys.executable, "-u", "-m", "truearm", "box", "monitor", "--box", device]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while "time" not in process.stdout.readline():
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=20)
        assert process.returncode == 0
        assert stderr == ""
        assert stdout.splitlines()[-1].startswith("ended")
        assert box("test", "--box", device) == 0  # stopped
