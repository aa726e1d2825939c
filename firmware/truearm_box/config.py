"""The configuration: rates, channels, scales, calibrations, times. A table of integers, text and lists (SPEC §5).

Decimals are [mantissa, exponent], so that the chip's single-precision floats are never used for them.
"""

from truearm_wire.cbor import Tag

VERSION = 2
OSRS = (128, 256, 512, 1024, 2048, 4096, 8192, 16384)
GAINS = (1, 2, 4, 8, 16, 32, 64, 128)
TICK_NS = 8
PERIOD_MIN_NS = 100000
PERIOD_MAX_NS = 1000000000
TRIGGER_MIN_MS = 10
TRIGGER_MAX_MS = 16000  # a 65536th of it, times 65535, is a small integer
THERMOMETERS = 4  # maximum number in a configuration
NO_TRIGGER = [0, 0]  # also where an older host or file leaves it out
REARM_NS = 10000  # between the time-out and the next interrogation
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


def check(config):
    """Return the configuration, if it is valid. Raises ValueError."""
    if not isinstance(config, dict):
        raise ValueError("it is not a table")
    if config.get("version") != VERSION:
        raise ValueError("version %r; this firmware knows %d" % (config.get("version", 1), VERSION))
    if not _within(config.get("osr"), OSRS[0], OSRS[-1]) or config["osr"] not in OSRS:
        raise ValueError("osr is not one of %s" % (OSRS,))
    channels = config.get("channels")
    if not isinstance(channels, list) or len(channels) != 4:
        raise ValueError("four channels are needed")
    for channel in channels:
        _check_channel(channel)
    _check_magnetostrictive(config.get("magnetostrictive"))
    debounce = config.get("debounce_us")
    if not isinstance(debounce, list) or len(debounce) != 2 or not all(_within(us, 0, 1000000) for us in debounce):
        raise ValueError("debounce_us is two times of 0 to 1000000")
    _check_trigger(config.get("trigger_ms", NO_TRIGGER))
    _check_thermometers(config.get("thermometers", {}))
    if config.get("watchdog_ms") != 0 and not _within(config.get("watchdog_ms"), 100, 8000):
        raise ValueError("watchdog_ms is 0 or 100 to 8000")
    return config


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
        _check_period(rate, config["magnetostrictive"]["timeout_ns"])
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


def _check_channel(channel):
    if not isinstance(channel, dict) or not isinstance(channel.get("name"), str):
        raise ValueError("a channel is a table with a name")
    if not isinstance(channel.get("unit"), str) or not _is_decimal(channel.get("scale")):
        raise ValueError("channel %s needs unit, and scale as [mantissa, exponent]" % channel["name"])
    if channel.get("gain", 1) not in GAINS:
        raise ValueError("the gain of %s is not one of %s" % (channel["name"], GAINS))
    if "calibration" in channel:
        _check_calibration(channel)


def _check_calibration(channel):
    calibration = channel["calibration"]
    if not isinstance(calibration, dict) or not isinstance(calibration.get("poly"), list):
        raise ValueError("the calibration of %s is a table with poly" % channel["name"])
    if not calibration["poly"] or not all(_is_decimal(c) for c in calibration["poly"]):
        raise ValueError("poly of %s holds [mantissa, exponent] pairs" % channel["name"])
    for key in ("unit", "serial", "date"):
        if not isinstance(calibration.get(key), str):
            raise ValueError("the calibration of %s needs %s as text" % (channel["name"], key))


def _check_trigger(limits):
    if not isinstance(limits, list) or len(limits) != 2 or not all(_is_int(ms) for ms in limits):
        raise ValueError("trigger_ms is two times")
    if limits != [0, 0] and not TRIGGER_MIN_MS <= limits[0] < limits[1] <= TRIGGER_MAX_MS:
        raise ValueError(
            "trigger_ms is [0, 0] or two times, %d to %d, the second longer" % (TRIGGER_MIN_MS, TRIGGER_MAX_MS)
        )


def _check_thermometers(named):
    if not isinstance(named, dict) or len(named) > THERMOMETERS:
        raise ValueError("thermometers is a table of at most %d" % THERMOMETERS)
    for name, uid in named.items():
        if not 1 <= len(name) <= 32:
            raise ValueError("a thermometer's name has 1 to 32 characters")
        if not isinstance(uid, str) or len(uid) != 16 or any([digit not in "0123456789abcdef" for digit in uid]):
            raise ValueError("the address of thermometer %s is 16 hexadecimal digits" % name)
    if len(set(named.values())) < len(named):
        raise ValueError("two thermometers have the same address")


def _check_magnetostrictive(sensor):
    if not isinstance(sensor, dict):
        raise ValueError("magnetostrictive is a table")
    if not _within(sensor.get("blanking_ns"), 5000, 21000) or sensor["blanking_ns"] % TICK_NS:
        raise ValueError("blanking_ns is a multiple of 8, 5000 to 21000")
    longest = PERIOD_MAX_NS - REARM_NS
    if (
        not _within(sensor.get("timeout_ns"), sensor["blanking_ns"] + TICK_NS, longest)
        or sensor["timeout_ns"] % TICK_NS
    ):
        raise ValueError("timeout_ns is a multiple of 8 above blanking_ns")
    if sensor.get("period_ns") != 0:
        _check_period(sensor.get("period_ns"), sensor["timeout_ns"])
    speed = sensor.get("us_per_inch")
    if not _is_decimal(speed) or not -9 <= speed[1] <= 0 or not 5 <= speed[0] // 10 ** -speed[1] < 20:
        raise ValueError("us_per_inch is [mantissa, exponent], 5 to 20")
    if not _within(sensor.get("delay_ns"), -100000, 100000):
        raise ValueError("delay_ns is -100000 to 100000")
    if not _within(sensor.get("pulse_edge", 1), 0, 2):
        raise ValueError("pulse_edge is 0, 1 or 2")
    if not isinstance(sensor.get("serial"), str) or not isinstance(sensor.get("date"), str):
        raise ValueError("serial and date of the magnetostrictive sensor are text")


def _check_period(period_ns, timeout_ns):
    if not _within(period_ns, PERIOD_MIN_NS, PERIOD_MAX_NS) or period_ns % TICK_NS or period_ns < timeout_ns + REARM_NS:
        raise ValueError("period_ns is 0 or a multiple of 8, 100000 to 1000000000, 10000 or more above timeout_ns")


def _within(value, low, high):
    return _is_int(value) and low <= value <= high


def _is_int(value):
    return isinstance(value, int) and not isinstance(value, bool)


def _is_decimal(value):
    return isinstance(value, list) and len(value) == 2 and _is_int(value[0]) and _is_int(value[1])
