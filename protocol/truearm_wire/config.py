"""The rules of a box's configuration (SPEC §5), for the box and for the host that changes it.

A configuration is a table of integers, text and lists. Decimals are [mantissa, exponent], so that the chip's
single-precision floats are never used for them. Valid on CPython and MicroPython.
"""

VERSION = 2
OSRS = (128, 256, 512, 1024, 2048, 4096, 8192, 16384)
GAINS = (1, 2, 4, 8, 16, 32, 64, 128)
CHANNELS = 4
TICK_NS = 8
PERIOD_NS = (100000, 1000000000)
BLANKING_NS = (5000, 21000)
DELAY_NS = (-100000, 100000)
REARM_NS = 10000  # between the time-out and the next interrogation
SPEEDS = (5, 20)  # µs per inch
SPEED_DECIMALS = 9
DEBOUNCE_US = (0, 1000000)
TRIGGER_MS = (10, 16000)  # a 65536th of it, times 65535, is a small integer
WATCHDOG_MS = (100, 8000)
THERMOMETERS = 4  # maximum number in a configuration
NO_TRIGGER = [0, 0]  # also where an older host or file leaves it out


def check(config):
    """Return the configuration, if it is valid. Raises ValueError, which names the key."""
    _need(isinstance(config, dict), "the configuration", "a table", config)
    if config.get("version") != VERSION:
        raise ValueError("version %r; this firmware knows %d" % (config.get("version", 1), VERSION))
    _need(_is_int(config.get("osr")) and config["osr"] in OSRS, "osr", "one of %s" % (OSRS,), config.get("osr"))
    channels = config.get("channels")
    if not isinstance(channels, list) or len(channels) != CHANNELS:
        raise ValueError("four channels are needed")
    for channel in channels:
        _check_channel(channel)
    _check_magnetostrictive(config.get("magnetostrictive"))
    debounce = config.get("debounce_us")
    is_pair = isinstance(debounce, list) and len(debounce) == 2 and all(_within(us, DEBOUNCE_US) for us in debounce)
    _need(is_pair, "debounce_us", "two whole numbers, %d to %d" % DEBOUNCE_US, debounce)
    _check_trigger(config.get("trigger_ms", NO_TRIGGER))
    _check_thermometers(config.get("thermometers", {}))
    watchdog = config.get("watchdog_ms")
    _need(
        _is_int(watchdog) and (watchdog == 0 or _within(watchdog, WATCHDOG_MS)),
        "watchdog_ms",
        "0, or %d to %d" % WATCHDOG_MS,
        watchdog,
    )
    return config


def check_period(period_ns, timeout_ns):
    """Raise ValueError unless the magnetostrictive sensor can be interrogated at this period."""
    is_possible = _within(period_ns, PERIOD_NS) and period_ns % TICK_NS == 0 and period_ns >= timeout_ns + REARM_NS
    rule = "0, or %d to %d in steps of %d, %d or more above timeout_ns" % (PERIOD_NS + (TICK_NS, REARM_NS))
    _need(is_possible, "magnetostrictive: period_ns", rule, period_ns)


def _check_channel(channel):
    if not isinstance(channel, dict) or not isinstance(channel.get("name"), str):
        raise ValueError("channel: must be a table with a name in quotes")
    place = "channel %.40s: " % channel["name"]
    _need_text(channel, ("unit",), place)
    _need(_is_decimal(channel.get("scale")), place + "scale", "[mantissa, exponent]", channel.get("scale"))
    gain = channel.get("gain", 1)
    _need(_is_int(gain) and gain in GAINS, place + "gain", "one of %s" % (GAINS,), gain)
    if "calibration" in channel:
        calibration = channel["calibration"]
        _need(isinstance(calibration, dict), place + "calibration", "a table", calibration)
        place += "calibration: "
        poly = calibration.get("poly")
        is_poly = isinstance(poly, list) and len(poly) > 0 and all(_is_decimal(c) for c in poly)
        _need(is_poly, place + "poly", "a list of [mantissa, exponent]", poly)
        _need_text(calibration, ("unit", "serial", "date"), place)


def _check_trigger(limits):
    is_pair = isinstance(limits, list) and len(limits) == 2 and all(_is_int(ms) for ms in limits)
    is_usable = is_pair and (limits == NO_TRIGGER or TRIGGER_MS[0] <= limits[0] < limits[1] <= TRIGGER_MS[1])
    _need(is_usable, "trigger_ms", "[0, 0], or two whole numbers, %d to %d, the second the longer" % TRIGGER_MS, limits)


def _check_thermometers(addresses):
    is_table = isinstance(addresses, dict) and len(addresses) <= THERMOMETERS
    _need(is_table, "thermometers", "a table of at most %d" % THERMOMETERS, addresses)
    for name, address in addresses.items():
        _need(1 <= len(name) <= 32, "thermometers", "names of 1 to 32 characters", name)
        is_address = isinstance(address, str) and len(address) == 16
        is_address = is_address and all(digit in "0123456789abcdef" for digit in address)
        rule = "16 hexadecimal digits in lower case, such as 28ff641e0316c2a5"
        _need(is_address, "thermometers: " + name, rule, address)
    if len(set(addresses.values())) < len(addresses):
        raise ValueError("thermometers: two have the same address; give each its own")


def _check_magnetostrictive(sensor):
    place = "magnetostrictive: "
    _need(isinstance(sensor, dict), "magnetostrictive", "a table", sensor)
    blanking, timeout = sensor.get("blanking_ns"), sensor.get("timeout_ns")
    is_blanking = _within(blanking, BLANKING_NS) and blanking % TICK_NS == 0
    _need(is_blanking, place + "blanking_ns", "%d to %d in steps of %d" % (BLANKING_NS + (TICK_NS,)), blanking)
    longest = PERIOD_NS[1] - REARM_NS
    is_timeout = _within(timeout, (blanking + TICK_NS, longest)) and timeout % TICK_NS == 0
    rule = "above blanking_ns, at most %d, in steps of %d" % (longest, TICK_NS)
    _need(is_timeout, place + "timeout_ns", rule, timeout)
    if not _is_int(sensor.get("period_ns")) or sensor["period_ns"] != 0:
        check_period(sensor.get("period_ns"), timeout)
    speed = sensor.get("us_per_inch")
    is_speed = _is_decimal(speed) and -SPEED_DECIMALS <= speed[1] <= 0
    is_speed = is_speed and SPEEDS[0] <= speed[0] // 10 ** -speed[1] < SPEEDS[1]
    rule = "%d to %d with at most %d decimals" % (SPEEDS + (SPEED_DECIMALS,))
    _need(is_speed, place + "us_per_inch", rule, speed)
    _need(_within(sensor.get("delay_ns"), DELAY_NS), place + "delay_ns", "%d to %d" % DELAY_NS, sensor.get("delay_ns"))
    edge = sensor.get("pulse_edge", 1)
    _need(_within(edge, (0, 2)), place + "pulse_edge", "0, 1 or 2", edge)
    _need_text(sensor, ("serial", "date"), place)


def _need_text(table, keys, place):
    for key in keys:
        _need(isinstance(table.get(key), str), place + key, "text, in quotes", table.get(key))


def _need(is_valid, place, rule, value):
    if not is_valid:
        raise ValueError("%s: must be %s, is %.60r" % (place, rule, value))


def _within(value, limits):
    return _is_int(value) and limits[0] <= value <= limits[1]


def _is_int(value):
    return isinstance(value, int) and not isinstance(value, bool)


def _is_decimal(value):
    return isinstance(value, list) and len(value) == 2 and _is_int(value[0]) and _is_int(value[1])
