"""``truearm box flash`` with a box in real time and a boot drive."""

import json

import pytest
from tests.end_to_end.box_server import BootDrive, box, served
from tests.host.findings_bench import listed
from tests.host.test_box_uf2 import image

from truearm import __version__
from truearm.box.flash import find_drives


def test_a_running_box_is_flashed(tmp_path, no_ports, printed):
    """The box shows its drive, the image is written, and the box answers after another boot."""
    path, drive = tmp_path / "box.uf2", tmp_path / "media" / "RPI-RP2"
    path.write_bytes(image())
    with served(drive=drive) as (device, _, shown):
        said = listed(json.loads(printed("box", "flash", path, "--box", device, "--drive", drive, "--json")))
        assert shown.written == image()
    flashed = said["flashed"]
    assert (flashed["chip"], flashed["size"], flashed["other"]) == ("RP2040", 1, False)
    assert flashed["box"].startswith("truearm box e6614103e7452b2f, firmware " + __version__)


@pytest.mark.parametrize("version", [__version__, "0.10.0"])
def test_the_firmware_that_answers_is_compared_with_the_images(tmp_path, no_ports, printed, version):
    path, drive = tmp_path / "box.uf2", tmp_path / "RPI-RP2"
    path.write_bytes(image(mark=f"truearm_box {version}".encode()))
    with served(drive=drive) as (device, _, _):
        said = listed(json.loads(printed("box", "flash", path, "--box", device, "--drive", drive, "--json")))
    assert said["flashed"]["version"] == version
    # The box that comes up is the simulated one, whatever was written.
    assert ("other-firmware" in said) == (version != __version__)


def test_a_drive_that_is_there_is_written_to(tmp_path, no_ports, capsys):
    path, drive = tmp_path / "box.uf2", tmp_path / "drive"
    path.write_bytes(image(mark=b"MicroPython alone"))
    drive.mkdir()
    assert box("flash", path, "--drive", drive) == 2
    refused = capsys.readouterr()
    assert "boot drive" in refused.err
    assert not refused.out
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO.replace("RPI-RP2", "RP2350"))
    assert box("flash", path, "--drive", drive) == 2
    assert "for RPI-RP2" in capsys.readouterr().err
    assert [p.name for p in drive.iterdir()] == ["INFO_UF2.TXT"]
    (drive / "INFO_UF2.TXT").write_text(BootDrive.INFO)
    assert box("flash", path, "--drive", drive, "--no-check") == 0
    assert (drive / "box.uf2").read_bytes() == path.read_bytes()
    assert "MicroPython" in capsys.readouterr().out
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
    assert "incomplete" in capsys.readouterr().err
    monkeypatch.setattr("truearm.box.flash.VERSION", "0.0.0")  # of which there is no image
    assert box("flash", "--drive", drive) == 2
    assert "truearm-0.0.0.uf2" in capsys.readouterr().err
    assert [p.name for p in drive.iterdir()] == ["INFO_UF2.TXT"]
