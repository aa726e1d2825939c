"""A box's configuration as a file: nothing is lost in either direction, and mistakes are named."""

import copy
import importlib.util
from pathlib import Path

import pytest

from truearm.box.configuration import (
    change_lines,
    channel_names,
    check,
    check_ratios,
    format_config,
    with_assignment,
    with_file,
)
from truearm.errors import ConfigError


def firmware_rules():
    """Return the firmware's own module that checks a configuration, from its sources."""
    path = Path(__file__).parents[2] / "firmware" / "truearm_box" / "config.py"
    spec = importlib.util.spec_from_file_location("firmware_config", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


firmware = firmware_rules()


def default():
    return copy.deepcopy(firmware.DEFAULT)


def full():
    """Return a configuration with every key, and with keys that later firmware may add."""
    config = default()
    config["channels"][0]["gain"] = 4
    config["channels"][0]["calibration"] = {
        "unit": "m",
        "poly": [[-4213, -7], [378812345678901234, -19], [0, 0], [12, -30]],
        "serial": 'a "quoted" \\ näme\x7f\n',
        "date": "2026-11-21",
        "sigma": [21, -7],
        "reference": "micrometer head 164-163, certificate 4711 of 2026-01-05",
        "reference_sigma": [1, -6],
        "temperature_mdegc": -1250,
        "operator": "of a later version",
    }
    config["colour"] = "blue"
    config["magnetostrictive"]["mode"] = 3
    return config


@pytest.mark.parametrize("config", [default(), full()])
def test_a_file_that_is_put_back_changes_nothing(config):
    back = with_file(config, format_config(config), "box.toml")
    assert change_lines(config, back) == []
    again = with_file(back, format_config(back), "box.toml")
    assert again == back
    assert firmware.check(back) is back


def test_calibrations_are_replaced_as_a_whole_or_name_no_reference():
    config = full()
    config["magnetostrictive"] |= {"reference": "scale 17", "reference_sigma": [4, -6]}
    typed = with_assignment(config, "magnetostrictive.us_per_inch=9.017")
    filed = with_file(config, "[magnetostrictive]\nus_per_inch = 9.017\n", "box.toml")
    for changed in (typed, filed):
        assert not {"reference", "reference_sigma"} & changed["magnetostrictive"].keys()
    same = with_assignment(config, "magnetostrictive.serial=S-2")
    assert same["magnetostrictive"]["reference"] == "scale 17"
    config = full()
    head = '[[channel]]\nname = "lvdt"\n'
    new = with_file(config, head + '[channel.calibration]\nunit = "mm"\npoly = [0, 38]\nserial = ""\ndate = ""\n', "x")
    assert new["channels"][0]["calibration"] == {"unit": "mm", "poly": [[0, 0], [38, 0]], "serial": "", "date": ""}
    assert "calibration" not in with_file(config, head + "calibration = {}\n", "x")["channels"][0]


def test_units_are_those_of_people():
    text = format_config(full())
    assert "period_us = 983.04 " in text
    assert "us_per_inch = 9.05 " in text
    assert "temperature_degc = -1.25 " in text
    assert "scale = 1.430511474609375e-7 " in text
    assert "osr = 4096  # 1017.25 samples per second" in text


def test_a_part_of_a_file_changes_that_part():
    config = full()
    new = with_file(
        config, '[[channel]]\nname = "transverse_b"\ngain = 8\n[magnetostrictive]\nblanking_us = 5.008\n', "x"
    )
    assert set(change_lines(config, new)) == {
        "magnetostrictive.blanking_us: 10 → 5.008",
        "channel.transverse_b.gain: (none) → 8",
    }
    assert new["magnetostrictive"]["blanking_ns"] == 5008
    config = default()
    text = "\n".join(f'[[channel]]\nname = "c{k}"' for k in range(4))
    assert channel_names(with_file(config, text, "x")) == ["c0", "c1", "c2", "c3"]
    config = full()
    text = format_config(config)
    assert "# colour: " in text
    assert "# mode: " in text
    back = with_file(config, text.replace("watchdog_ms = 2000", "watchdog_ms = 500"), "box.toml")
    assert back["colour"] == "blue"
    assert back["magnetostrictive"]["mode"] == 3
    assert back["watchdog_ms"] == 500
    assert config["watchdog_ms"] == 2000  # the one that was given is not touched


@pytest.mark.parametrize("over", ["lvdt", "nosuch"])
def test_a_channel_is_divided_by_another_one_of_the_box(over):
    check_ratios(with_assignment(default(), "channel.lvdt.over=excitation"))
    with pytest.raises(ConfigError, match=f"channel lvdt: over .*'{over}'.* transverse_a, "):
        check_ratios(with_assignment(default(), f"channel.lvdt.over={over}"))


def test_a_value_that_may_be_missing_is_removed():
    config = full()
    config["channels"][0]["over"] = "excitation"
    config["thermometers"] = {"bar": "28ff641e0316c2a5"}
    assert "over" not in with_file(config, '[[channel]]\nname = "lvdt"\nover = ""\n', "x")["channels"][0]
    new = with_assignment(with_assignment(config, "channel.lvdt.over="), "thermometers.bar = ")
    assert change_lines(config, new) == [
        'channel.lvdt.over: "excitation" → (none)',
        'thermometers.bar: "28ff641e0316c2a5" → (none)',
    ]
    assert firmware.check(new) is new
    assert with_assignment(new, "channel.lvdt.over=") == new
    assert "calibration" in config["channels"][0]
    for nothing in ("", "{}"):
        assert "calibration" not in with_assignment(config, f"channel.lvdt.calibration={nothing}")["channels"][0]
    assert with_assignment(config, "magnetostrictive.serial=")["magnetostrictive"]["serial"] == ""
    with pytest.raises(ConfigError, match="osr"):
        with_assignment(config, "osr=")


@pytest.mark.parametrize(
    ("change", "key", "wire"),
    [
        ("osr=2048", ("osr",), 2048),
        ("watchdog_ms = 0", ("watchdog_ms",), 0),
        ("debounce_us=[100, 0]", ("debounce_us",), [100, 0]),
        ("magnetostrictive.period_us=0", ("magnetostrictive", "period_ns"), 0),
        ("magnetostrictive.us_per_inch=9.031", ("magnetostrictive", "us_per_inch"), [9031, -3]),
        ("magnetostrictive.us_per_inch=10", ("magnetostrictive", "us_per_inch"), [10, 0]),
        ("magnetostrictive.delay_us=-1.2", ("magnetostrictive", "delay_ns"), -1200),
        ("magnetostrictive.serial=0815", ("magnetostrictive", "serial"), "0815"),
        ('magnetostrictive.serial="a b"', ("magnetostrictive", "serial"), "a b"),
        ("channel.lvdt.gain=2", ("channels", 0, "gain"), 2),
        ("channel.1.name=probe", ("channels", 1, "name"), "probe"),
        ("channel.lvdt.calibration.date=2026-11-21", ("channels", 0, "calibration", "date"), "2026-11-21"),
        ("channel.lvdt.scale=1.5e-7", ("channels", 0, "scale"), [15, -8]),
    ],
)
def test_single_values(change, key, wire):
    found = with_assignment(full(), change)
    for part in key:
        found = found[part]
    assert found == wire


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("osr", "KEY=VALUE"),
        ("oscr=1", r"unknown key 'oscr'.* osr\?"),
        ("=", "unknown key ''.* osr"),
        ("colour=1", r"'colour'.* osr, .*magnetostrictive\.…, thermometers\.…, channel\.NAME\.…"),
        ("channel.lvdt.calibration.colour=1", "'channel.lvdt.calibration.colour'.* poly, "),
        ("osr=", "^osr: .*4096"),
        ("channel.lvdt.calibration.poly=", "^channel.lvdt.calibration.poly: .*0.0378812345678901234"),
        ("channel.nothing.gain=2", "nothing.* channel.lvdt.calibration, "),
        ("osr=fast", "osr: 'fast'"),
        ("osr=1\nwatchdog_ms=0", r"osr: '1\\nwatchdog_ms=0'"),
        ("magnetostrictive.us_per_inch=abc", "^magnetostrictive: us_per_inch: 'abc'"),
        ("osr=4095", "osr: .*128, .* 4095"),
        ("magnetostrictive.period_us=99", "period_ns: .* 100000 to 1000000000 in steps of 8, .* 99000"),
        ("magnetostrictive.us_per_inch=nan", "us_per_inch: NaN"),
        ("magnetostrictive.us_per_inch=1e999999999999999999999", "'1e9+'"),
        ("magnetostrictive.us_per_inch=9.0000000000000000000000001", "too many digits"),
        ("magnetostrictive.delay_us=0.0001", "at most 3 decimals"),
        ("channel.lvdt.calibration.poly=[]", "^channel.lvdt.calibration: poly: .*16 .*0"),
    ],
)
def test_bad_values_are_named(change, says):
    with pytest.raises(ConfigError, match=says) as info:
        check(with_assignment(full(), change))
    assert "\n" not in str(info.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("osr = ", "TOML"),
        ("rate = 1", "box.toml: unknown key 'rate'.* osr"),
        ("version = 3", "unknown key 'version'"),
        ("[[channel]]\ngain = 2", "lvdt"),
        ('[[channel]]\nname = "x"', "lvdt"),
        ('[[channel]]\nname = "lvdt"\n[[channel]]\nname = "lvdt"', "its own"),
        ('[[channel]]\nname = "lvdt"\ngain = 3', r"channel lvdt: gain: must be one of \(1, 2"),
        ('[[channel]]\nname = "lvdt"\ncalibration = 3', "calibration: must be"),
        ('[[channel]]\nname = "lvdt"\n[channel.calibration]\nunit = "m"', "channel lvdt: calibration: poly: must be"),
    ],
)
def test_bad_files_are_named(text, says):
    with pytest.raises(ConfigError, match=says) as info:
        with_file(default(), text, "box.toml")
    assert "\n" not in str(info.value)
