"""What a box's configuration may be (protocol/SPEC.md §5), so that a mistake is named before anything is sent."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from typing import Any

from truearm.errors import ConfigError

VERSION = 2
OSRS = tuple(1 << k for k in range(7, 15))
GAINS = tuple(1 << k for k in range(8))
MAX_COEFFICIENTS = 16
MAX_EXPONENT = 300
_NEEDED_OF_CALIBRATION = ("unit", "poly", "serial", "date")


def check(config: dict[str, Any]) -> dict[str, Any]:
    """``config``, if it keeps to SPEC §5. Raises ConfigError with the name of what does not."""
    if config.get("version") != VERSION:
        raise ConfigError(f"the box's configuration is of version {config.get('version')!r:.40}; update truearm")
    _need(config.get("osr") in OSRS and type(config["osr"]) is int, f"osr must be one of {', '.join(map(str, OSRS))}")
    channels = config.get("channels")
    if not isinstance(channels, list) or len(channels) != 4:
        raise ConfigError("there must be four channels")
    for channel in channels:
        _check_channel(table(channel))
    _check_head(table(config.get("magnetostrictive")))
    debounce = config.get("debounce_us")
    both = isinstance(debounce, list) and len(debounce) == 2 and all(_within(us, 0, 1_000_000) for us in debounce)
    _need(both, "debounce_us must be two whole numbers, 0 to 1000000")
    _check_trigger(config.get("trigger_ms", [0, 0]))
    watchdog = config.get("watchdog_ms")
    _need(_within(watchdog, 0, 0) or _within(watchdog, 100, 8000), "watchdog_ms must be 0, or 100 to 8000")
    return config


def _check_trigger(limits: Any) -> None:
    two = isinstance(limits, list) and len(limits) == 2 and all(type(ms) is int for ms in limits)
    right = two and (limits == [0, 0] or 10 <= limits[0] < limits[1] <= 16_000)
    _need(right, "trigger_ms must be [0, 0], or two whole numbers, 10 to 16000, the second the longer")


def _check_channel(channel: Mapping[str, Any]) -> None:
    name = channel.get("name")
    _need(isinstance(name, str), "every channel needs a name")
    where = f"channel {name:.40}"
    _need(isinstance(channel.get("unit"), str), f"{where} needs a unit, in quotes")
    _need(decimal_of(channel.get("scale")) is not None, f"{where} needs a scale")
    gain = channel.get("gain", 1)
    _need(type(gain) is int and gain in GAINS, f"{where}: gain must be one of {', '.join(map(str, GAINS))}")
    if "calibration" not in channel:
        return
    calibration = table(channel["calibration"])
    for key in _NEEDED_OF_CALIBRATION:
        _need(isinstance(calibration.get(key), list if key == "poly" else str), f"{where}: its calibration needs {key}")
    poly = calibration["poly"]
    right = 1 <= len(poly) <= MAX_COEFFICIENTS and all(decimal_of(c) is not None for c in poly)
    _need(right, f"{where}: poly must be 1 to {MAX_COEFFICIENTS} numbers")


def _check_head(head: Mapping[str, Any]) -> None:
    period: Any = head.get("period_ns")
    blanking: Any = head.get("blanking_ns")
    timeout: Any = head.get("timeout_ns")
    where = "magnetostrictive."
    eights = "and a multiple of 0.008"
    _need(_within(blanking, 5000, 21_000) and blanking % 8 == 0, f"{where}blanking_us must be 5 to 21, {eights}")
    after = _within(timeout, blanking + 8, 999_990_000) and timeout % 8 == 0
    _need(after, f"{where}timeout_us must be above blanking_us, {eights}")
    fits = _within(period, max(100_000, timeout + 10_000), 1_000_000_000) and period % 8 == 0
    _need(
        _within(period, 0, 0) or fits,
        f"{where}period_us must be 0, or 100 to 1000000, 10 or more above timeout_us, {eights}",
    )
    speed = decimal_of(head.get("us_per_inch"))
    _need(
        speed is not None and -9 <= head["us_per_inch"][1] <= 0 and 5 <= speed < 20,
        f"{where}us_per_inch must be 5 to 20, with at most nine decimals",
    )
    _need(_within(head.get("delay_ns"), -100_000, 100_000), f"{where}delay_us must be -100 to 100")
    for key in ("serial", "date"):
        _need(isinstance(head.get(key), str), f"{where}{key} must be text")


def _within(value: Any, low: int, high: int) -> bool:
    return type(value) is int and low <= value <= high


def _need(holds: bool, text: str) -> None:
    if not holds:
        raise ConfigError(text)


def decimal_of(pair: Any) -> Decimal | None:
    """The number of [mantissa, exponent]; None where it is none, or none that a file could hold."""
    if not isinstance(pair, list) or len(pair) != 2 or any(type(part) is not int for part in pair):
        return None
    mantissa, exponent = pair
    return Decimal(f"{mantissa}E{exponent}") if abs(mantissa) < 2**64 and abs(exponent) <= MAX_EXPONENT else None


def table(value: Any) -> dict[str, Any]:
    """``value``, an empty table if it is none."""
    return value if isinstance(value, dict) else {}
