"""What the box knows of itself: rate, channels, their scales and calibrations. A JSON file of integers, text and lists.

Decimals are [mantissa, exponent], so that the chip's single-precision floats never touch them.
"""

import json

from truearm_wire.cbor import encode
from truearm_wire.messages import pages

OSRS = (128, 256, 512, 1024, 2048, 4096, 8192, 16384)
DEFAULT = {
    "osr": 4096,
    "channels": [
        {"name": "lvdt", "unit": "V", "scale": [1430511474609375, -22]},
        {"name": "transverse_a", "unit": "V", "scale": [1430511474609375, -22]},
        {"name": "transverse_b", "unit": "V", "scale": [1430511474609375, -22]},
        {"name": "excitation", "unit": "V", "scale": [1430511474609375, -22]},
    ],
}  # 1.2 V / 2^23 a count


def load(path, board, version, protocol):
    """(configuration of a file, fault): the default one if there is no file, or with a fault in words if it is damaged.

    The ident document is built and cut once on trial: what cannot be told to the host must not stop the box from booting.
    """
    try:
        with open(path) as f:
            config = check(json.load(f))
        pages(encode(describe(config, None, config["osr"], board, version, protocol)))
        return config, None
    except OSError:
        return DEFAULT, None
    except ValueError as e:
        return DEFAULT, "config: %s; the default one is used" % e


def check(config):
    """The configuration, if it is one. Raises ValueError."""
    if not isinstance(config, dict) or not isinstance(config.get("osr"), int) or config["osr"] not in OSRS:
        raise ValueError("osr is not one of %s" % (OSRS,))
    channels = config.get("channels")
    if not isinstance(channels, list) or len(channels) != 4:
        raise ValueError("four channels are needed")
    for channel in channels:
        if not isinstance(channel, dict) or not isinstance(channel.get("name"), str):
            raise ValueError("a channel is a table with a name")
        if not isinstance(channel.get("unit"), str) or not _is_decimal(channel.get("scale")):
            raise ValueError("channel %s needs unit, and scale as [mantissa, exponent]" % channel["name"])
        if "calibration" in channel:
            _check_calibration(channel)
    return config


def _check_calibration(channel):
    calibration = channel["calibration"]
    if not isinstance(calibration, dict) or not isinstance(calibration.get("poly"), list):
        raise ValueError("the calibration of %s is a table with poly" % channel["name"])
    if not calibration["poly"] or not all(_is_decimal(c) for c in calibration["poly"]):
        raise ValueError("poly of %s holds [mantissa, exponent] pairs" % channel["name"])
    for key in ("unit", "serial", "date"):
        if not isinstance(calibration.get(key), str):
            raise ValueError("the calibration of %s needs %s as text" % (channel["name"], key))


def _is_decimal(value):
    return isinstance(value, list) and len(value) == 2 and isinstance(value[0], int) and isinstance(value[1], int)


def group_delay_ns(osr):
    """Delay of the converter's filter: sinc3 up to an oversampling of 1024, an average of its outputs beyond.

    In modulator periods of 240 ns: 3 (osr - 1) / 2, or that at 1024 plus half of what the average spans (ADS131M04
    datasheet, digital filter).
    """
    if osr <= 1024:
        return 360 * (osr - 1)
    return 360 * 1023 + 120 * (osr - 1024)


def describe(config, fault, osr, board, version, protocol):
    """The ident document (SPEC §5)."""
    boot_id = 0
    for byte in board.boot_id:
        boot_id = boot_id << 8 | byte
    document = {
        "protocol": list(protocol),
        "firmware": version,
        "uid": board.uid,
        "boot_id": boot_id,
        "clock_hz": 1000000,
        "streams": [
            {
                "id": 0,
                "name": "adc",
                "period_ns": 240 * osr,
                "osr": osr,
                "group_delay_ns": group_delay_ns(osr),
                "channels": config["channels"],
            }
        ],
    }
    if fault:
        document["fault"] = fault
    return document
