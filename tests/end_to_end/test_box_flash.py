"""``truearm box flash`` with a box in real time, a boot drive, and a stock MicroPython."""

import json
import os
import subprocess
import sys

import pytest
from tests.end_to_end.box_server import BootDrive, box, by_the_labs_clock, served
from tests.host.test_box_uf2 import image

from truearm import __version__
from truearm.box.boot_drive import find_drives
from truearm_sim.chip import STORE, ChipBox, make_flash, read_flash

HUNG_S = 1800  # of the wall clock's time: nothing is measured by it


def test_a_running_box_is_flashed(tmp_path, no_ports, capsys):
    """The box shows its drive, the image is written, and the box answers after another boot."""
    path, drive = tmp_path / "box.uf2", tmp_path / "media" / "RPI-RP2"
    path.write_bytes(image())
    with served(drive=drive) as (device, _, shown):
        assert box("flash", path, "--box", device, "--drive", drive) == 0
        said = capsys.readouterr().out
        assert shown.written == image()
    assert "for the RP2040, 1 KiB in 4 blocks: the box's firmware" in said
    assert "it enters its boot loader" in said
    assert said.splitlines()[-1].startswith("it answers: truearm box e6614103e7452b2f, firmware " + __version__)


@pytest.mark.parametrize(
    ("version", "says"),
    [
        (__version__, f"firmware {__version__} on vm, as the image has; it enters"),
        ("0.10.0", f"firmware {__version__} on vm, the image has the newer 0.10.0; it enters"),
        ("0.1.9", f"firmware {__version__} on vm, the image has the older 0.1.9; it enters"),
    ],
)
def test_the_images_firmware_is_compared_with_the_boxs(tmp_path, no_ports, capsys, version, says):
    path, drive = tmp_path / "box.uf2", tmp_path / "RPI-RP2"
    path.write_bytes(image(mark=f"truearm_box {version}".encode()))
    with served(drive=drive) as (device, _, _):
        assert box("flash", path, "--box", device, "--drive", drive) == 0
        said = capsys.readouterr().out
    assert f"4 blocks: the box's firmware {version}\n" in said
    assert says in said
    # The box that comes up is the simulated one, whatever was written.
    assert (f"warning: the image has {version}, but the box runs {__version__}" in said) == (version != __version__)


def test_a_drive_that_is_there_is_written_to(tmp_path, no_ports, capsys):
    path, drive = tmp_path / "box.uf2", tmp_path / "drive"
    path.write_bytes(image(mark=b"MicroPython alone"))
    drive.mkdir()
    assert box("flash", path, "--drive", drive) == 2
    assert "boot drive" in capsys.readouterr().err
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO.replace("RPI-RP2", "RP2350"))
    assert box("flash", path, "--drive", drive) == 2
    assert "for RPI-RP2" in capsys.readouterr().err
    assert [p.name for p in drive.iterdir()] == ["INFO_UF2.TXT"]
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO)
    assert box("flash", path, "--drive", drive, "--no-check") == 0
    assert (drive / "box.uf2").read_bytes() == path.read_bytes()
    assert "without the box's firmware" in capsys.readouterr().out
    assert box("flash", path, "--drive", drive, "--timeout-s", 0) == 1
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


def test_a_damaged_image_reaches_no_drive(tmp_path, capsys, monkeypatch):
    path, drive = tmp_path / "box.uf2", tmp_path / "drive"
    path.write_bytes(image()[:-512])
    drive.mkdir()
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO)
    assert box("flash", path, "--drive", drive) == 2
    assert "the file is incomplete" in capsys.readouterr().err
    monkeypatch.setattr("truearm.box.flash.__version__", "0.0.0")  # of which there is no image
    assert box("flash", "--drive", drive) == 2
    assert "truearm-0.0.0.uf2" in capsys.readouterr().err
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
    """Return an executable in place of mpremote that records its arguments."""

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
        assert box("flash", "--stock", "--box", device, "--no-check") == 0
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
        ({"answer": "is micropython 1 24 Raspberry Pi Pico with RP2040"}, 2, "1.25 or newer"),
        ({"answer": "is circuitpython 9 2 Raspberry Pi Pico with RP2040"}, 2, "runs circuitpython"),
        ({"answer": "is micropython 1 25 ESP32 module"}, 2, "Raspberry Pi Pico"),
        ({"answer": "is micropython 1 25 Raspberry Pi Pico W with RP2040"}, 2, "Pico W"),
        ({"answer": "is micropython 1 26 Raspberry Pi Pico2 with RP2350"}, 2, "Raspberry Pi Pico"),
        ({"answer": "hello"}, 1, "no MicroPython answers"),
        ({"code": 1}, 1, "mpremote: "),
    ],
)
def test_boards_that_cannot_serve(fake, code, says, fake_mpremote, monkeypatch, capsys):
    monkeypatch.setattr("truearm.box.flash._to_prompt", lambda device, stop: None)
    log = fake_mpremote(**fake)
    assert box("flash", "--stock", "--box", "/dev/ttyACM9") == code
    assert says in capsys.readouterr().err
    assert len(log.read_text().splitlines()) == 1  # nothing was copied


def test_without_mpremote(monkeypatch, capsys):
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert box("flash", "--stock", "--box", "/dev/ttyACM9") == 2
    assert "install it: pip install 'truearm[stock]'" in capsys.readouterr().err


def test_a_flash_image_holds_folders(tmp_path):
    files = {"main.py": b"run()", "lib/deep/a.py": b"", "config.json": b"{}"}
    make_flash(tmp_path / "flash.bin", files)
    assert read_flash(tmp_path / "flash.bin") == files


@pytest.mark.soak
def test_the_real_mpremote_and_a_real_micropython(tmp_path):
    """Onto MicroPython's RP2040 port in the emulator, over USB as it is: compiled files leave room for the ring, and then the box answers.

    The image has the firmware frozen in as well; files on flash are found first. All that waits, mpremote too, waits by the emulated
    chip's time.
    """
    clock = tmp_path / "clock"

    def typed(*arguments, tries=1):
        for _ in range(tries):
            done = subprocess.run(
                [sys.executable, "-m", "truearm", "box", *arguments],
                capture_output=True, text=True, env=by_the_labs_clock(clock), timeout=HUNG_S,
            )  # fmt: skip
            if done.returncode == 0:
                return done.stdout
        raise AssertionError(done.stderr)

    with served(pty=True, power_on=ChipBox, clock=clock) as (device, _, shown):
        before = json.loads(typed("info", "--box", device, "--json", tries=5))  # it boots
        said = typed("flash", "--stock", "--box", device, "--timeout-s", "60")
        assert said.splitlines()[-1].endswith(f"firmware {__version__} on rp2040")
        after = json.loads(typed("info", "--box", device, "--json"))
        assert after["boot_id"] != before["boot_id"]
        files = read_flash(shown.flash / STORE)
        assert {"main.py", "board.mpy", "truearm_box/box.mpy", "drivers/triggers.mpy", "config.json"} <= files.keys()
