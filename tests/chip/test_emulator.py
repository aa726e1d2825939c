"""The emulator itself: its processor compared with rp2040js's, and the image file."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from truearm.box.flash import read_uf2
from truearm_sim import node
from truearm_wire.version import VERSION

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("seed", [7, 99])
def test_the_processor_does_what_rp2040js_s_does(seed):
    command = [node.ready().path, Path(__file__).with_name("cpu_check.mjs"), str(seed), "100000"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"instructions": 100_000, "difference": None}


def test_the_image_is_a_uf2_file_without_holes_and_says_what_it_is_made_of():
    image = node.image().read_bytes()
    blocks = [image[at : at + 512] for at in range(0, len(image), 512)]
    heads = [struct.unpack("<8I", block[:32]) for block in blocks]
    assert all(h[:2] == (0x0A324655, 0x9E5D5157) and h[7] == 0xE48BFF56 for h in heads)
    assert [h[3] for h in heads] == [0x10000000 + 256 * k for k in range(len(blocks))]
    assert all(h[5] == k and h[6] == len(blocks) for k, h in enumerate(heads))
    versions = (node.IMAGES / "versions.txt").read_text()
    for name in ("truearm ", "micropython 1.", "pico-sdk-source ", "tinyusb-source ", "arm-none-eabi-gcc ", "sha256 "):
        assert name in versions
    assert str(ROOT).encode() not in image
    assert b"\0truearm box\0truearm\0" in b"".join(block[32:288] for block in blocks), "SPEC §8: product string, maker"
    assert read_uf2(node.image()).version == VERSION


def test_an_image_of_another_version_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(node, "IMAGES", tmp_path)
    (tmp_path / "truearm-0.3.0.uf2").touch()
    with pytest.raises(node.NodeError, match=rf"truearm-{VERSION}\.uf2 is missing; run make uf2"):
        node.image()


@pytest.mark.soak
def test_the_image_is_the_same_wherever_it_is_built(tmp_path):
    arguments = ["--out", tmp_path / "uf2", "--work", tmp_path / "elsewhere" / "image"]
    subprocess.run([sys.executable, ROOT / "firmware" / "image" / "build.py", *arguments], check=True)
    (built,) = (tmp_path / "uf2").glob("*.uf2")
    assert built.read_bytes() == node.image().read_bytes()
