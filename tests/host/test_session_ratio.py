"""A channel divided by another: an LVDT's secondary over its primary, from the box's description to metres."""

import copy

import numpy as np
import pytest
from tests.host.test_box_config import default

from truearm.box.configuration import change_lines, format_config, with_file
from truearm.session.frames import RATIO_STEP, parse_ident
from truearm.session.samples import RAIL_HIGH, RAIL_LOW, extension, railed, with_ratios

SCALE = [1430511474609375, -22]  # 1.2 V / 2^23
MM_PER_RATIO = 34.0


def channels(over="excitation", gains=(1, 1)):
    """Channels of a stream in which the first is over the last; a gain halves the volts of a count."""
    lvdt = {"name": "lvdt", "unit": "V", "scale": [SCALE[0] // gains[0], SCALE[1]], "over": over}
    lvdt["calibration"] = {"unit": "mm", "poly": [[0, 0], [340, -1]], "serial": "", "date": ""}
    plain = [{"name": name, "unit": "V", "scale": SCALE} for name in ("a", "b")]
    drive = {"name": "excitation", "unit": "V", "scale": [SCALE[0] // gains[1], SCALE[1]]}
    stream = {"id": 0, "name": "adc", "period_ns": 983040, "osr": 4096, "group_delay_ns": 0}
    stream["channels"] = [lvdt, *plain, drive]
    ident = {"protocol": [1, 2], "boot_id": 1, "firmware": "x", "streams": [stream]}
    return parse_ident(ident).streams[0].channels


def sampled(secondary_v, primary_v, gains=(1, 1)):
    counts = np.zeros((len(secondary_v), 4), np.int32)
    per_volt = 2**23 / 1.2
    counts[:, 0] = np.rint(np.asarray(secondary_v) * per_volt * gains[0])
    counts[:, 3] = np.rint(np.asarray(primary_v) * per_volt * gains[1])
    counts[:, 1] = 77
    return counts


@pytest.mark.parametrize("gains", [(1, 1), (4, 1), (2, 4)])
def test_the_extension_is_that_of_the_ratio_whatever_drives_the_sensor(gains):
    core = np.linspace(-1, 1, 41)
    drive = 0.14 * (1 + 0.2 * np.sin(np.arange(41)))  # ±20 %
    found = channels(gains=gains)
    counts = with_ratios(sampled(1.08 * core * drive, drive, gains), found)
    # a step of the ratio is 2^-20, a count of the primary 1 ppm of it: together below 0.1 µm
    np.testing.assert_allclose(extension(counts[:, 0], found[0]), 1.08 * core * MM_PER_RATIO * 1e-3, atol=1e-7)
    assert (counts[:, 1] == 77).all()
    assert found[0].unit == "V/V"


def test_saturation_and_signs():
    counts = sampled([0.1, 0.1, 0.1, 0.1], [0.14, 0.0, 0.14, -0.14])
    counts[2, 0] = RAIL_LOW
    counts[0, 3] = RAIL_HIGH
    np.testing.assert_array_equal(railed(with_ratios(counts, channels())[:, 0]), [True, True, True, False])
    # a ratio that its steps cannot hold, here above 8
    assert railed(with_ratios(sampled([1.0], [0.1]), channels())[:, 0]).all()
    ratio = with_ratios(sampled([0.1, -0.1, 0.1, -0.1], [0.1, 0.1, -0.1, -0.1]), channels())[:, 0] * RATIO_STEP
    np.testing.assert_allclose(ratio, [1, -1, -1, 1], atol=1e-5)


@pytest.mark.parametrize("over", ["lvdt", "nothing", 3])
def test_a_divisor_that_is_none_is_a_fault_of_the_channel(over):
    lvdt = channels(over=over)[0]
    assert lvdt.fault.startswith("over ")
    assert repr(over) in lvdt.fault
    assert lvdt.length_unit is None


def test_it_is_in_the_configurations_file():
    config = default()
    config["channels"][0]["over"] = "excitation"
    text = format_config(config)
    assert 'over = "excitation"' in text
    assert change_lines(config, with_file(copy.deepcopy(default()), text, "box.toml")) == []
