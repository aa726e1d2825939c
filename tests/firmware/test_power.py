"""Power cuts and a full flash while a configuration is stored, on a real littlefs (power_cuts.py describes them)."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.firmware.conftest import real_micropython

ROOT = Path(__file__).parents[2]


def run(cuts: int, seed: int) -> list[int]:
    path = f"{ROOT / 'firmware'}:{ROOT / 'protocol'}"
    done = subprocess.run(
        [real_micropython().path, "-X", "heapsize=4m", Path(__file__).with_name("power_cuts.py"), str(cuts), str(seed)],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "MICROPYPATH": path},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return [int(number) for number in re.findall(r"\d+", done.stdout)]


@pytest.mark.parametrize("seed", [1, pytest.param(20, marks=pytest.mark.soak)])
def test_power_cuts_leave_the_old_configuration_or_the_new_one(seed):
    cut, new_found, operations, refused = run(1000, seed)
    assert cut > 300, "the cuts hit"
    assert 0 < new_found < cut, "some hit after the new one had taken its place"
    assert operations > 3
    assert refused > 0, "the flash was full"
