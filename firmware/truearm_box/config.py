"""The configuration of a new box, and what the box alone has to know of one.

Its rules are those of truearm_wire.config.
"""

from truearm_wire.cbor import Tag
from truearm_wire.config import NO_TRIGGER, OSRS, VERSION, check, check_period

__all__ = ("NO_TRIGGER", "check")

DEFAULT = {
    "version": VERSION,
    "osr": 4096,
    "channels": [
        {"name": "lvdt", "unit": "V", "scale": [1430511474609375, -22]},
        {"name": "transverse_a", "unit": "V", "scale": [1430511474609375, -22]},
        {"name": "transverse_b", "unit": "V", "scale": [1430511474609375, -22]},
        {"name": "excitation", "unit": "V", "scale": [1430511474609375, -22]},
    ],  # 1.2 V / 2^23 per count
    "magnetostrictive": {
        "period_ns": 983040,  # as for the converter at its osr of 4096
        "blanking_ns": 10000,
        "timeout_ns": 500000,  # 1.4 m
        "us_per_inch": [905, -2],
        "delay_ns": 0,
        "serial": "",
        "date": "",
    },
    "debounce_us": [0, 0],
    "trigger_ms": [50, 150],
    "watchdog_ms": 2000,
}


def completed(config):
    """Return a configuration of version 1, without magnetostrictive sensor, as version 2; any other unchanged."""
    if not isinstance(config, dict) or "version" in config or "osr" not in config or "channels" not in config:
        return config
    new = dict(DEFAULT)
    new["magnetostrictive"] = dict(DEFAULT["magnetostrictive"])
    new["magnetostrictive"]["period_ns"] = 0
    new["trigger_ms"] = NO_TRIGGER
    new.update(config)
    return new


def check_storable(value):
    """Raise ValueError for a value that CBOR can carry but JSON cannot. Nesting is limited as in CBOR here."""
    if isinstance(value, (bytes, Tag)):
        raise ValueError("bytes have no place in it")
    if isinstance(value, list):
        for item in value:
            check_storable(item)
    elif isinstance(value, dict):
        for key in value:
            check_storable(value[key])


def check_rate(config, stream, rate):
    """Raise ValueError unless a stream can run at this rate."""
    if stream == 0 and rate not in OSRS:
        raise ValueError("osr is a power of two, 128 to 16384")
    if stream == 1 and rate:
        check_period(rate, config["magnetostrictive"]["timeout_ns"])
    if stream > 1:
        raise ValueError("there are streams 0 and 1")


def group_delay_ns(osr):
    """Return the delay of the converter's filter: sinc3 up to an oversampling of 1024, an average of its outputs above.

    In modulator periods of 240 ns: 3 (osr - 1) / 2, or that at 1024 plus half of the averaged span (ADS131M04
    datasheet, digital filter).
    """
    if osr <= 1024:
        return 360 * (osr - 1)
    return 360 * 1023 + 120 * (osr - 1024)
