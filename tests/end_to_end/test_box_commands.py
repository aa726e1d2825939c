"""``truearm box`` against a box in real time: over a socket and a pseudo-terminal, as an operator types it."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from tests.end_to_end.box_server import MAG_PERIOD_NS, BootDrive, Stage, served
from tests.host.test_uf2 import image

from truearm.cli import main
from truearm.commands.box_link import conversation
from truearm.files.boot_drive import find_drives
from truearm.record import ports
from truearm_sim.box import BoxSetup
from truearm_sim.chip import FILE_SYSTEM, STORE, ChipBox

EMULATOR = 120  # tries of half a second: it may run at a quarter of the real pace
SILENT = {"converter_id": 0, "excitation": 20, "noise_0": 0, "stops": 3, "rail_5v": 4420}


@pytest.fixture
def no_ports(monkeypatch):
    """A machine with nothing plugged in."""
    monkeypatch.setattr(ports.list_ports, "comports", lambda: [])


@pytest.fixture(params=["socket", "pty"])
def device(request):
    with served(pty=request.param == "pty") as (device, _, _):
        yield device


def box(*arguments):
    return main(["box", *map(str, arguments)])


def test_info_and_self_test_in_words(device, capsys):
    assert box("info", "--device", device) == 0
    said = capsys.readouterr().out
    assert "firmware  0.2.0 on vm" in said
    assert "stream adc: 1017.25 samples a second, osr 4096, group delay 0.737 ms" in said
    assert "calibrated to m by 2 coefficients (sim-lvdt 1993-10-01)" in said
    assert box("test", "--device", device) == 0
    said = capsys.readouterr().out
    assert "PASS  the converter answers: 0x2402" in said
    assert said.splitlines()[-1] == "8 passed, 0 with a warning, 0 failed"
    assert box("info", "--device", device, "--json") == 0
    assert json.loads(capsys.readouterr().out)["board"] == "vm"


def test_a_self_test_that_fails(capsys):
    world = Stage()
    with served(world, setup=BoxSetup(config=world.box_config(), self_test=SILENT)) as (device, _, _):
        assert box("test", "--device", device) == 1
        said = capsys.readouterr()
        assert (
            "FAIL  the converter answers: 0x0 (allowed: 0x2400 to 0x24ff)\n      check its supply and the SPI wires"
            in said.out
        )
        assert "WARN  5 V of the USB port: 4.42 V\n      near its limit" in said.out
        assert "WARN  noise of converter input 1, shorted\n      the box did not measure it" in said.out
        assert said.err == ""
        assert box("test", "--device", device, "--json") == 1
        assert {f["name"]: f["verdict"] for f in json.loads(capsys.readouterr().out)}["converter_id"] == "fail"


def test_configuration_by_file_and_by_value(device, tmp_path, capsys):
    path = tmp_path / "box.toml"
    assert box("config", "get", "--device", device, "--out", path) == 0
    assert box("config", "set", path, "--device", device) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{device}: nothing changes"
    assert box("config", "set", "osr=2048", "channel.lvdt.gain=2", "--device", device, "--dry-run") == 0
    assert capsys.readouterr().out.splitlines() == [
        "osr: 4096 → 2048",
        "channel.lvdt.gain: (none) → 2",
        f"{device}: unchanged (--dry-run)",
    ]
    path.write_text(path.read_text().replace("osr = 4096", "osr = 2048"))
    assert box("config", "set", path, "channel.lvdt.gain=2", "--device", device) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{device}: stored and in force"
    assert box("config", "get", "--device", device) == 0
    assert "osr = 2048  # 2034.51 samples a second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["config", "set", "osr=2047"], 2, "osr must be one of"),
        (["config", "set", "gone.toml"], 2, "gone.toml: no such file"),
        (["config", "set", "osr"], 2, "osr: no such file"),
        (["gauge", "nothing"], 2, "no channel 'nothing'; there are lvdt"),
        (["gauge", "magnetostrictive"], 2, "its stream is off"),
        (["gauge", "lvdt", "--unit", "parsec"], 2, "--unit 'parsec' is not one of mm, um, in"),
        (["gauge", "lvdt", "--order", "9"], 2, "order"),
        (["monitor", "--duration", "0"], 2, "no time"),
    ],
)
def test_bad_input_is_one_line(arguments, code, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with served() as (device, _, _):
        assert box(*arguments, "--device", device) == code
    said = capsys.readouterr().err
    assert says in said
    assert len(said.strip().splitlines()) == 1


def test_no_box_there(capsys):
    assert box("info", "--device", "/dev/gone") == 1
    assert "is not there" in capsys.readouterr().err
    assert box("info", "--device", "ftp://x") == 2
    assert box("info") == 2
    assert "--device" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["list", "flash", "info", "test", "reset", "gauge", "monitor", "config get", "config set"]
)
def test_every_subcommand_has_help_with_an_example(name, capsys):
    assert box(*name.split(), "--help") == 0
    assert f"truearm box {name}" in capsys.readouterr().out.split("Example", 1)[1]


def test_a_box_that_streams_is_left_alone_until_stop(capsys):
    from truearm_wire.messages import START

    with served() as (device, _, _):
        with conversation(device) as talk:  # as a recorder that is killed leaves it
            talk.command(START)
        for command in (["config", "get"], ["config", "set", "osr=2048"], ["test"], ["reset"]):
            assert box(*command, "--device", device) == 1
            said = capsys.readouterr().err
            assert "the box is streaming; end the recording first, or give --stop" in said
            assert len(said.splitlines()) == 1
        assert box("info", "--device", device) == 0
        assert box("config", "set", "osr=2048", "--device", device, "--stop") == 0
        assert box("config", "get", "--device", device) == 0


def test_a_restart_forgets_the_traceback(capsys):
    with served() as (device, _, shown):
        (shown.flash / "last_error.txt").write_text("Traceback:\n  somewhere\nMemoryError: no room")
        assert box("info", "--device", device) == 0
        assert "  MemoryError: no room" in capsys.readouterr().out
        assert box("reset", "--device", device) == 0
        with conversation(device, retries=20) as talk:
            assert "last_error" not in talk.identify().document


# --- list


class Port:
    def __init__(self, device, vid=0x2E8A, pid=0x0005, product="Board in FS mode"):
        self.device, self.vid, self.pid, self.product = device, vid, pid, product
        self.serial_number, self.description = "e661", "n/a"


def test_boxes_are_listed_by_their_usb_identity(monkeypatch, capsys):
    with served(pty=True) as (device, _, _):
        found = [Port("/dev/ttyS0", None, None, None), Port("/dev/ttyUSB0", 0x0403, 0x6001, "FT232R"), Port(device)]
        monkeypatch.setattr(ports.list_ports, "comports", lambda: found)
        assert box("list") == 0
        (line,) = capsys.readouterr().out.splitlines()  # a stranger's serial port is not even opened
        assert re.fullmatch(rf"{device} \(2e8a:0005 Board in FS mode\): truearm box \w+, firmware 0.2.0 on vm", line)
        assert box("list", "--json", "--device", "/dev/gone") == 0
        rows = json.loads(capsys.readouterr().out)["ports"]
        assert [row["device"] for row in rows] == [device, "/dev/gone"]
        assert rows[0]["box"]["firmware"] == "0.2.0"
        assert rows[1]["box"] is None
        assert "is not there" in rows[1]["answer"]


def test_nothing_to_list(no_ports, capsys):
    assert box("list") == 0
    assert "no box was found" in capsys.readouterr().out


# --- flash


def test_a_running_box_is_flashed(tmp_path, no_ports, capsys):
    """Asked to show its drive, written to, and heard again, by another boot."""
    path, drive = tmp_path / "box.uf2", tmp_path / "media" / "RPI-RP2"
    path.write_bytes(image())
    with served(drive=drive) as (device, _, shown):
        assert box("flash", path, "--device", device, "--drive", drive) == 0
        said = capsys.readouterr().out
        assert shown.written == image()
    assert "for the RP2040, 1 KiB in 4 blocks: the box's firmware" in said
    assert "it enters its boot loader" in said
    assert said.splitlines()[-1].startswith("it answers: truearm box e6614103e7452b2f, firmware 0.2.0")


def test_a_drive_that_is_there_is_written_to(tmp_path, no_ports, capsys):
    path, drive = tmp_path / "box.uf2", tmp_path / "drive"
    path.write_bytes(image(mark=b"MicroPython alone"))
    drive.mkdir()
    assert box("flash", path, "--drive", drive) == 2
    assert "is no boot drive" in capsys.readouterr().err
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO.replace("RPI-RP2", "RP2350"))
    assert box("flash", path, "--drive", drive) == 2
    assert "'RP2350', the image is for RPI-RP2" in capsys.readouterr().err
    assert [p.name for p in drive.iterdir()] == ["INFO_UF2.TXT"]
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO)
    assert box("flash", path, "--drive", drive, "--no-check") == 0
    assert (drive / "box.uf2").read_bytes() == path.read_bytes()
    assert "without the box's firmware" in capsys.readouterr().out
    assert box("flash", path, "--drive", drive, "--timeout", 0) == 1
    assert "no box answered" in capsys.readouterr().err


def test_drives_are_found_where_systems_mount_them(tmp_path):
    for place in ("media/me/RPI-RP2", "run/media/me/RPI-RP21", "Volumes/RPI-RP2", "media/me/OTHER"):
        (tmp_path / place).mkdir(parents=True)
    assert find_drives("RPI-RP2", tmp_path) == []
    for place in ("media/me/RPI-RP2", "run/media/me/RPI-RP21", "media/me/OTHER"):
        (tmp_path / place / "INFO_UF2.TXT").write_text(BootDrive.INFO)
    assert find_drives("RPI-RP2", tmp_path) == [tmp_path / "media/me/RPI-RP2", tmp_path / "run/media/me/RPI-RP21"]
    (tmp_path / "media/me/RPI-RP2/INFO_UF2.TXT").write_bytes(b"\xff" * 10_000)
    assert find_drives("RPI-RP2", tmp_path) == [tmp_path / "run/media/me/RPI-RP21"]


def test_a_damaged_image_reaches_no_drive(tmp_path, capsys):
    path, drive = tmp_path / "box.uf2", tmp_path / "drive"
    path.write_bytes(image()[:-512])
    drive.mkdir()
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO)
    assert box("flash", path, "--drive", drive) == 2
    assert "the file is not whole" in capsys.readouterr().err
    assert box("flash", "--drive", drive) == 2
    assert box("flash", "--stock") == 2
    assert [p.name for p in drive.iterdir()] == ["INFO_UF2.TXT"]


FAKE = """#!{python}
import json, os, sys
with open({log!r}, "a") as log:
    log.write(json.dumps(sys.argv[1:]) + "\\n")
    for source in sys.argv[1:]:
        if os.path.isdir(source):
            log.write(json.dumps(sorted(os.listdir(source))) + "\\n")
if "exec" in sys.argv:
    print({answer!r})
sys.exit({code})
"""


@pytest.fixture
def fake_mpremote(tmp_path, monkeypatch):
    """An executable in mpremote's place that keeps what it was called with."""

    def install(answer="is micropython 1 25 Raspberry Pi Pico with RP2040", code=0):
        tool, log = tmp_path / "bin" / "mpremote", tmp_path / "log"
        tool.parent.mkdir(exist_ok=True)
        tool.write_text(FAKE.format(python=sys.executable, log=str(log), answer=answer, code=code))
        tool.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tool.parent}{os.pathsep}{os.environ['PATH']}")
        return log

    return install


def test_files_onto_a_stock_micropython(fake_mpremote, no_ports, capsys):
    """The commands that mpremote gets, exactly; a box that runs is asked for the prompt first."""
    log = fake_mpremote()
    with served() as (device, _, shown):
        assert box("flash", "--stock", "--device", device, "--no-check") == 0
        assert shown._hardware is None  # it left its protocol
    calls = [json.loads(line) for line in log.read_text().splitlines()]
    ask, clear, copy, *listings, last = calls
    assert ask[:3] == clear[:3] == ["connect", device, "exec"]
    assert "'truearm_box'" in clear[3]
    compile(clear[3], "clear", "exec")  # it is a program
    folder = os.path.dirname(copy[5])
    assert copy == [
        "connect", device, "fs", "cp", "-r",
        *(f"{folder}/{name}" for name in ("chips", "drivers", "truearm_box", "truearm_wire", "board.mpy")), ":",
    ]  # fmt: skip
    assert "rp2040.mpy" in listings[0]
    assert {"ads131m04.mpy", "magnetostrictive.mpy", "triggers.mpy"} <= set(listings[1])
    assert {"box.mpy", "config.mpy"} <= set(listings[2])
    assert {"cbor.mpy", "frame.mpy", "messages.mpy"} <= set(listings[3])
    assert last == ["connect", device, "fs", "cp", f"{folder}/main.py", ":main.py", "+", "reset"]
    assert not os.path.exists(folder)
    assert "MicroPython 1.25 on Raspberry Pi Pico with RP2040" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("fake", "code", "says"),
    [
        ({"answer": "is micropython 1 24 Raspberry Pi Pico with RP2040"}, 2, "1.25 or newer is needed"),
        ({"answer": "is circuitpython 9 2 Raspberry Pi Pico with RP2040"}, 2, "runs circuitpython"),
        ({"answer": "is micropython 1 25 ESP32 module"}, 2, "the box is a Raspberry Pi Pico"),
        ({"answer": "hello"}, 1, "no MicroPython answers"),
        ({"code": 1}, 1, "mpremote: "),
    ],
)
def test_boards_that_cannot_serve(fake, code, says, fake_mpremote, monkeypatch, capsys):
    monkeypatch.setattr("truearm.commands.box_flash._to_prompt", lambda device, stop: None)
    log = fake_mpremote(**fake)
    assert box("flash", "--stock", "--device", "/dev/ttyACM9") == code
    assert says in capsys.readouterr().err
    assert len(log.read_text().splitlines()) == 1  # nothing was copied


def test_without_mpremote(monkeypatch, capsys):
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert box("flash", "--stock", "--device", "/dev/ttyACM9") == 2
    assert "take mpremote; install it: pip install 'truearm[stock]'" in capsys.readouterr().err


def flash_files(path):
    """Names of the files of a flash image, by another reader of littlefs than the box's."""
    from littlefs import LittleFS

    fs = LittleFS(mount=False, **FILE_SYSTEM)
    fs.context.buffer[:] = path.read_bytes()
    fs.mount()
    return {f"{folder}/{name}".lstrip("/") for folder, _, names in fs.walk("/") for name in names}


@pytest.mark.soak
def test_the_real_mpremote_and_a_real_micropython():
    """Onto MicroPython's RP2040 port in the emulator, over USB as it is: compiled files leave room for the ring, and then the box answers.

    The image has the firmware frozen in as well; files on flash are found first.
    """
    with served(pty=True, power_on=ChipBox) as (device, _, shown):
        with conversation(device, retries=EMULATOR) as talk:
            before = talk.identify().boot_id
        done = subprocess.run(
            [sys.executable, "-m", "truearm", "box", "flash", "--stock", "--device", device, "--timeout", "60"],
            capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[-1].endswith("firmware 0.2.0 on rp2040")
        with conversation(device, retries=EMULATOR) as talk:
            assert talk.identify().boot_id != before
        files = flash_files(shown.flash / STORE)
        assert {"main.py", "board.mpy", "truearm_box/box.mpy", "drivers/triggers.mpy", "config.json"} <= files


# --- gauge


class Operator(io.StringIO):
    """Standard input of somebody who sets the stage to each reference before typing it."""

    def __init__(self, world, lines, unit=1e-3):
        super().__init__()
        self._world, self._lines, self._unit = world, list(lines), unit

    def readline(self, *_):
        line = self._lines.pop(0) if self._lines else ""
        if isinstance(line, tuple):  # (where the stage is, what is typed)
            self._world.position, line = line[0] * self._unit, line[1]
        return f"{line}\n"


def test_an_lvdt_is_calibrated(tmp_path, monkeypatch, capsys):
    """Typed references, there and back: the bend is found, the box then reads the stage."""
    monkeypatch.chdir(tmp_path)
    references = [*np.linspace(-30, 30, 7), *np.linspace(25, -25, 5)]
    with served() as (device, world, _):
        lines = [*((mm, f"{mm}") for mm in references), (3.0, "7"), "undo", "seven", "", "y"]
        monkeypatch.setattr(sys, "stdin", Operator(world, lines))
        assert box("gauge", "lvdt", "--device", device, "--seconds", "0.3", "--serial", "LV-1") == 0
        said = capsys.readouterr().out
        assert "dropped place 13" in said
        assert "'seven' is no reading of a reference; type a number of mm" in said
        assert "order 2:" in said.split("← taken")[0].splitlines()[-1]
        assert "12 places, sigma" in said
        assert said.splitlines()[-1] == f"store it in the box? [y/N] {device}: stored and in force"
        assert box("info", "--device", device, "--json") == 0
        entry = json.loads(capsys.readouterr().out)["streams"][0]["channels"][0]
    calibration = entry["calibration"]
    assert (calibration["unit"], calibration["serial"]) == ("m", "LV-1")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", calibration["date"])
    assert calibration["temperature_mdegc"] == 24_500
    poly = [m * 10.0**e for m, e in calibration["poly"]]
    volts = np.linspace(-0.75, 0.75, 31)
    error = np.polynomial.polynomial.polyval(volts, poly) - np.polynomial.polynomial.polyval(volts, Stage.POLY)
    # 0.3 s are 305 samples of 5 µV or 0.19 µm: a mean is good to 11 nm, and the polynomial too; five times that, and 1 nm of rounding
    assert np.max(np.abs(error)) <= 5 * 11e-9 + 1e-9
    page = (tmp_path / "gauge-lvdt.html").read_text()
    assert "<svg" in page
    assert "residual [µm]" in page
    assert "<script" not in page


def test_references_from_a_file_and_no_at_the_end(tmp_path, monkeypatch, capsys):
    table, page = tmp_path / "steps.csv", tmp_path / "page.html"
    table.write_text("place,reference_um\n1,-20000\n2,-10000\n3,0\n4,10000\n5,20000\n6,30000\n")
    with served() as (device, world, _):
        lines = [*((mm, "") for mm in (-20, -10, 0, 10, 20)), "s", "n"]
        monkeypatch.setattr(sys, "stdin", Operator(world, lines))
        options = ["--references", table, "--seconds", "0.2", "--out", page, "--order", "1"]
        assert box("gauge", "lvdt", "--device", device, *options) == 0
        said = capsys.readouterr().out
        assert "1 of 6: set -20.0000 mm, then Enter" in said
        assert "order 1: left-out error" in said
        assert said.splitlines()[-1].endswith(f"{device}: unchanged")
        assert box("config", "get", "--device", device) == 0
        assert 'serial = "sim-lvdt"' in capsys.readouterr().out
    assert page.exists()


def test_a_magnetostrictive_head_is_calibrated(tmp_path, monkeypatch, capsys):
    """Its velocity of sound and the delay of its electronics, of which the latter takes up where the reference has its zero."""
    monkeypatch.chdir(tmp_path)
    world = Stage(mag_period_ns=MAG_PERIOD_NS)
    with served(world) as (device, _, _):
        lines = [(mm, f"{mm + 300}") for mm in (-100, -50, 0, 50, 100)]
        monkeypatch.setattr(sys, "stdin", Operator(world, [*lines, ""]))
        assert box("gauge", "magnetostrictive", "--device", device, "--seconds", "0.5", "--yes") == 0
        capsys.readouterr()
        assert box("config", "get", "--device", device) == 0
        said = capsys.readouterr().out
    speed = float(re.search(r"us_per_inch = ([\d.]+)", said)[1])
    delay = float(re.search(r"delay_us = ([\d.]+)", said)[1])
    # 500 shots with 5.1 µm of noise over 22.5 µm ticks: the noise leaves up to 2.6 µm of the ticks' steps in a mean (truearm_sim/sensors.py)
    # and √(5.1² + 22.5²/12)/√500 = 0.4 µm of its own; over 200 mm that turns the slope by no more than 2 · 3 µm / 200 mm
    assert abs(speed / 9.031 - 1) <= 2 * 3e-6 / 0.2
    assert abs(delay - 1.5) * 2.812 <= 1e3 * (
        3e-6 + 0.4 * 6e-6 / 0.2
    )  # mm/µs; the zero lies 0.4 m beyond the middle, at most


def test_places_that_make_no_reading(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    world = Stage(mag_period_ns=MAG_PERIOD_NS)
    world.magnet = False
    with served(world) as (device, _, _):
        monkeypatch.setattr(sys, "stdin", Operator(world, ["1", ""]))
        assert box("gauge", "magnetostrictive", "--device", device, "--seconds", "0.2") == 2
        said = capsys.readouterr()
        assert "stop pulses are missing; is the magnet on the rod?" in said.out
        assert "0 places were taken; a calibration needs four or more" in said.err
        world.POLY = (0.0, 1e-3, 0.0)  # 1.5 mm are 1.5 V, beyond the converter
        monkeypatch.setattr(sys, "stdin", Operator(world, [(1.5, "1.5"), ""]))
        assert box("gauge", "lvdt", "--device", device, "--seconds", "0.2") == 2
        assert "at the converter's rail" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "needs one column"),
        ("reference_mm,reference_um\n1,2\n", "needs one column"),
        ("reference_mm\n", "has 0 references"),
        ("reference_mm\none\n", "row 2: 'one' is no reading"),
        ("a,reference_mm\n1\n", "row 2: '' is no reading"),
        ("reference_mm\nnan\n", "row 2"),
        ("reference_mm\n1e9\n", "row 2"),
        ("reference_mm\n" + "1\n" * 2000, "1 to 1000"),
    ],
)
def test_bad_reference_files(text, says, tmp_path, capsys):
    path = tmp_path / "r.csv"
    path.write_text(text)
    assert box("gauge", "lvdt", "--references", path, "--device", "/dev/gone") == 2
    assert says in capsys.readouterr().err


# --- monitor


def test_the_monitor_shows_values_and_ends_with_its_time(capsys):
    world = Stage(mag_period_ns=MAG_PERIOD_NS)
    world.position = 0.0123
    with served(world) as (device, _, _):
        assert box("monitor", "--device", device, "--duration", "3.5") == 0
        assert box("config", "get", "--device", device) == 0  # it was stopped
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
    assert re.match(r"± \d+ µs, host [+-][\d.]+ ppm faster", last["clock"])
    assert last["box"].startswith("24.5 °C")
    assert last["losses"].startswith("0 frames on the link, 0 samples in the box")
    assert next(line for line in lines if line.startswith("ended; lost: 0 frames"))


def test_on_a_terminal_the_monitor_keeps_to_its_place():
    master, slave = os.openpty()
    with served() as (device, _, _):
        command = [sys.executable, "-m", "truearm", "box", "monitor", "--device", device, "--duration", "4"]
        environ = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
        done = subprocess.run(command, stdout=slave, stderr=subprocess.PIPE, env=environ, timeout=60)
    os.close(slave)
    shown = os.read(master, 1 << 16).decode()
    os.close(master)
    assert (done.returncode, done.stderr) == (0, b"")
    assert shown.count("transverse_b") >= 2
    assert "\x1b[1A" in shown  # back to the line above


def test_ctrl_c_ends_the_monitor_in_order():
    with served() as (device, _, _):
        command = [sys.executable, "-u", "-m", "truearm", "box", "monitor", "--device", device]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while "time" not in process.stdout.readline():
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=20)
        assert process.returncode == 0
        assert stderr == ""
        assert stdout.splitlines()[-1].startswith("ended; lost: 0 frames")
        assert box("test", "--device", device) == 0  # stopped
