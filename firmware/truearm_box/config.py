"""What the box knows of itself: rate, channels, their scales and calibrations. A JSON file of integers, text and lists.

Decimals are [mantissa, exponent], so that the chip's single-precision floats never touch them.
"""

import json

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


def load(path):
    """(configuration of a file, fault): the default one if there is no file, or with a fault in words if it is damaged."""
    try:
        with open(path) as f:
            return check(json.load(f)), None
    except OSError:
        return DEFAULT, None
    except ValueError as e:
        return DEFAULT, "config: %s; the default one is used" % e


def check(config):
    """The configuration, if it is one. Raises ValueError."""
    if not isinstance(config, dict) or config.get("osr") not in OSRS:
        raise ValueError("osr is not one of %s" % (OSRS,))
    channels = config.get("channels")
    if not isinstance(channels, list) or len(channels) != 4:
        raise ValueError("four channels are needed")
    for channel in channels:
        if not isinstance(channel, dict):
            raise ValueError("a channel is a table")
        for key in ("name", "unit", "scale"):
            if key not in channel:
                raise ValueError("a channel lacks %s" % key)
    return config


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
