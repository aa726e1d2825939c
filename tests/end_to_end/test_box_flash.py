"""UF2 images, and ``truearm box flash`` with a box in real time and a boot drive."""

import json
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.end_to_end.box_server import BootDrive, box, served
from tests.host.findings_bench import listed
from tests.refusals import refused

from truearm import __version__
from truearm.box.flash import BLOCK, CHIPS, MAX_BYTES, boot_checksum, find_drives, parse_uf2, read_uf2
from truearm.errors import ImageError

RP2040 = 0xE48BFF56


def block(number, of, data, *, flags=0x2000, address=None, size=256, family=RP2040, magic=(0x0A324655, 0x9E5D5157)):
    at = 0x1000_0000 + 256 * number if address is None else address
    head = struct.pack("<8I", *magic, flags, at, size, number, of, family)
    return head + data.ljust(476, b"\0") + struct.pack("<I", 0x0AB16F30)


def boot_stage(code=b"\x00\xb5\x32\x4b"):
    stage = code.ljust(252, b"\0")
    return stage + struct.pack("<I", boot_checksum(stage))


def image(pages=4, mark=b"truearm_box"):
    """Return a small image with a valid boot stage."""
    data = [boot_stage(), *(bytes([k]) * 256 for k in range(1, pages - 1)), mark.ljust(256, b"\xff")]
    return b"".join(block(k, pages, page) for k, page in enumerate(data))


def test_a_good_image_tells_its_firmwares_version():
    found = parse_uf2(image(), "x.uf2")
    assert (found.chip, found.blocks, found.size, found.is_box) == (CHIPS[RP2040], 4, 1024, True)
    assert found.data == image()
    assert not parse_uf2(image(mark=b"MicroPython"), "x.uf2").is_box
    assert parse_uf2(image(mark=b"truearm_box 0.12.3"), "x.uf2").version == "0.12.3"
    assert parse_uf2(image(), "x.uf2").version == ""
    assert parse_uf2(image(mark=b"truearm_box 12345.1.1"), "x.uf2").version == ""
    assert boot_checksum(b"123456789") == 0x0376E6E7  # its check value in every catalogue of CRCs


def replaced(data, number, **changes):
    page = data[BLOCK * number + 32 : BLOCK * number + 288]
    return data[: BLOCK * number] + block(number, 4, page, **changes) + data[BLOCK * (number + 1) :]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "whole number"),
        (image()[:-1], "whole number"),
        (image()[:-BLOCK], "incomplete"),
        (image() + image(), "block 4 of 8|incomplete"),
        (b"\0" * BLOCK, "UF2 file"),
        (replaced(image(), 0, magic=(0x0A324655, 0)), "UF2 file"),
        (replaced(image(), 2, magic=(0x0A324655, 0)), "block 2 .*damaged"),
        (replaced(image(), 0, family=0xE48BFF59), "another chip.*0xe48bff59"),
        (replaced(image(), 0, flags=0), "another chip.*no family"),
        (replaced(image(), 1, family=0xE48BFF59), "block 1"),
        (replaced(image(), 1, flags=0x2001), "block 1"),
        (replaced(image(), 1, size=476), "476 bytes"),
        (replaced(image(), 1, address=0x1000_0180), "0x10000180"),
        (replaced(image(), 3, address=0x2000_0000), "block 3 .*0x20000000.*flash"),
        (replaced(image(), 0, address=0x0FFF_FF00), "block 0 .*0xfffff00.*flash"),
        (replaced(image(), 2, address=0x1000_0000), "block 2 .*0x10000000.*flash"),
        (b"\0" * (MAX_BYTES + BLOCK), "chip's flash"),
    ],
)
def test_what_is_wrong_is_named(data, says):
    with pytest.raises(ImageError, match=says):
        parse_uf2(data, "x.uf2")


def test_files_that_are_none_or_would_not_start(tmp_path):
    data = bytearray(image())
    data[40] ^= 1
    with pytest.raises(ImageError, match="checksum"):
        parse_uf2(bytes(data), "x.uf2")
    with refused("missing-file"):
        read_uf2(tmp_path / "gone.uf2")
    with refused("unreadable-file"):
        read_uf2(tmp_path)
    (tmp_path / "huge.uf2").write_bytes(b"\0" * (MAX_BYTES + 1))
    with refused("too-large"):
        read_uf2(tmp_path / "huge.uf2")


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_a_damaged_image_is_refused_or_its_pages_alone_differ(data):
    """UF2 has no checksum over its pages, so what survives is exactly: bytes of pages behind the boot stage, and padding."""
    good = image()
    bad = bytearray(good)
    for _ in range(data.draw(st.integers(1, 3))):
        bad[data.draw(st.integers(0, len(bad) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = parse_uf2(bytes(bad), "x.uf2")
    except ImageError:
        return
    assert found.chip is CHIPS[RP2040]
    for at in (k for k in range(len(bad)) if bad[k] != good[k]):
        number, within = divmod(at, BLOCK)
        # 8: flags without meaning
        assert 8 <= within < 12 or 288 <= within < 508 or (number > 0 and 32 <= within < 288)


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
