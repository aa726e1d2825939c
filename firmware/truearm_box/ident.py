"""The box's description of itself (SPEC §5), from its board and its configuration."""

from truearm_wire import PROTOCOL
from truearm_wire.messages import STREAM_ADC, STREAM_MAG, STREAM_SENSOR
from truearm_wire.version import VERSION

from .config import group_delay_ns
from .temperatures import thermometers

FAULT_MAX = 400  # characters
ERROR_MAX = 600
INT_MAX = 1 << 63  # limit of a signed integer on the wire


def document(board, config, osr, mag_period_ns, fault, last_error):
    """Return the ident document. A stream that is off is omitted."""
    boot_id = 0
    for byte in board.boot_id:
        boot_id = boot_id << 8 | byte
    found = {
        "protocol": list(PROTOCOL),
        "firmware": VERSION,
        "board": board.name,
        "uid": board.uid,
        "boot_id": boot_id,
        "clock_hz": 1000000,
        "streams": [_adc(config, osr)],
    }
    if mag_period_ns:
        found["streams"].append(_mag(config["magnetostrictive"], mag_period_ns))
    for stream in found["streams"]:
        stream["shortest_period_ns"] = board.shortest_period_ns
    for i in range(len(board.sensors)):
        described = {"id": STREAM_SENSOR + i, "osr": 0, "group_delay_ns": 0}
        described.update(board.sensors[i].stream)
        found["streams"].append(described)
    described = [{"name": name, "uid": uid} for name, uid in thermometers(config, board.thermometers.uids)]
    if described:
        found["thermometers"] = described
    if fault:
        found["fault"] = plain(fault, FAULT_MAX)
    if last_error:
        found["last_error"] = plain(last_error, ERROR_MAX)
    return found


def plain(text, length):
    """Return the beginning of a text that may be external: ASCII, so that characters are bytes."""
    found = bytearray(text[:length].encode())  # in place: a list of characters takes ten times as much memory
    for i in range(len(found)):
        if not (32 <= found[i] <= 126 or found[i] == 10):
            found[i] = 63  # a question mark
    return str(found[:length], "ascii")


def _adc(config, osr):
    return {
        "id": STREAM_ADC,
        "name": "adc",
        "period_ns": 240 * osr,
        "osr": osr,
        "group_delay_ns": group_delay_ns(osr),
        "channels": [_input(channel) for channel in config["channels"]],
    }


def _input(channel):
    """Return a channel with the scale of the volts before the gain."""
    gain = channel.get("gain", 1)
    if gain == 1:
        return channel
    mantissa, exponent = channel["scale"]
    while gain > 1:  # half of m · 10^e is 5 m · 10^(e - 1)
        mantissa *= 5
        exponent -= 1
        gain >>= 1
    described = dict(channel)
    described["scale"] = _fitting(mantissa, exponent)
    return described


def _mag(sensor, period_ns):
    """Return stream 1, with position = v · (time of flight - delay), v = 25.4 mm / us_per_inch."""
    mantissa, exponent = sensor["us_per_inch"]
    speed = (25400 * 10**14 + mantissa // 2) // mantissa  # m/s, times 10^(14 + exponent)
    calibration = {
        "unit": "m",
        "poly": [_fitting(-speed * sensor["delay_ns"], -23 - exponent), _fitting(speed, -14 - exponent)],
        "serial": sensor["serial"],
        "date": sensor["date"],
    }
    for key in ("sigma", "temperature_mdegc", "reference", "reference_sigma"):  # of a host that calibrated it
        if key in sensor:
            calibration[key] = sensor[key]
    return {
        "id": STREAM_MAG,
        "name": "mag",
        "period_ns": period_ns,
        "osr": 0,
        "group_delay_ns": 0,
        "channels": [
            {
                "name": "magnetostrictive",
                "unit": "s",
                "scale": [8, -9],
                "calibration": calibration,
            }
        ],
    }


def _fitting(mantissa, exponent):
    """Return a decimal with a mantissa that fits the wire; at least 18 digits remain."""
    while not -INT_MAX <= mantissa < INT_MAX:
        mantissa = (mantissa + 5) // 10
        exponent += 1
    return [mantissa, exponent]
