"""Schema of a box's configuration (protocol/SPEC.md §5): every key, in a file and on the wire, and its bounds.

A file has practical units and decimal numbers; the wire has integers in small units and [mantissa, exponent]. Values
are converted without binary floats, so nothing is lost. ``check`` reports a mistake before anything is sent.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, ClassVar

from truearm.errors import ConfigError
from truearm.schema import NO_UNIT, Entries, Key, SchemaError, Table, Text, at, quoted, raising
from truearm.session.box_ident import MAX_COEFFICIENTS, MAX_EXPONENT

VERSION = 2
OSRS = tuple(1 << k for k in range(7, 15))
GAINS = tuple(1 << k for k in range(8))
MODULATOR_NS = 240
MAX_TEXT = 200
_LOWEST_EXPONENT = -60
_MANTISSA_END = 2**63


@dataclass(frozen=True)
class DecimalSteps:
    """An integer in units of 10^-``decimals`` on the wire, a decimal number in a file.

    ``options`` lists all allowed values. ``ranges`` (least, most) and the step are in units of the wire.
    """

    ranges: tuple[tuple[int, int], ...] = ()
    options: tuple[int, ...] = ()
    decimals: int = 0
    step: int = 1
    suffixes: ClassVar[Sequence[str]] = NO_UNIT

    def parse(self, raw: Any, suffix: str = "") -> int:
        scaled = _decimal(raw).scaleb(self.decimals)
        if scaled != scaled.to_integral_value() or abs(scaled) >= 2**31:
            wanted = f"number with at most {self.decimals} decimals" if self.decimals else "whole number"
            raise SchemaError(f"{_shown(raw)} is not a {wanted}")
        return self.check(int(scaled))

    def format(self, value: Any) -> str:
        return format_decimal([value, -self.decimals]) if type(value) is int else _unknown(value)

    def check(self, wire: Any) -> int:
        in_range = type(wire) is int and any(low <= wire <= high for low, high in self.ranges)
        if type(wire) is not int or not (wire in self.options or (in_range and wire % self.step == 0)):
            raise SchemaError(f"must be {self._wanted()}, is {self.format(wire)}")
        return wire

    def _wanted(self) -> str:
        if self.options:
            return f"one of {', '.join(map(str, self.options))}"
        spans = " or ".join(" to ".join(self.format(end) for end in sorted(set(span))) for span in self.ranges)
        return spans + f", in steps of {self.format(self.step)}" * (self.step > 1)


@dataclass(frozen=True)
class Exact:
    """A decimal number, [mantissa, exponent] on the wire; ``least`` ≤ number < ``end``, with a maximum number of
    decimals.
    """

    least: int | None = None
    end: int = 0
    decimals: int = 0
    suffixes: ClassVar[Sequence[str]] = NO_UNIT

    def parse(self, raw: Any, suffix: str = "") -> list[int]:
        return self.check(mantissa_exponent(_decimal(raw)))

    def format(self, value: Any) -> str:
        return format_decimal(value)

    def check(self, wire: Any) -> list[int]:
        number = decimal_of(wire)
        if number is None:
            raise SchemaError(f"{_unknown(wire)} is not a number that a file can hold")
        if self.least is not None and not (self.least <= number < self.end and -self.decimals <= wire[1] <= 0):
            raise SchemaError(
                f"must be {self.least} to {self.end}, with at most {self.decimals} decimals, is {self.format(wire)}"
            )
        return list(wire)


@dataclass(frozen=True)
class WireList:
    """A list of ``least`` to ``most`` values of one type."""

    item: DecimalSteps | Exact
    least: int
    most: int
    suffixes: ClassVar[Sequence[str]] = NO_UNIT

    def parse(self, raw: Any, suffix: str = "") -> list[Any]:
        return [self._item(k, self.item.parse, value) for k, value in enumerate(self._list(raw))]

    def format(self, value: Any) -> str:
        return f"[{', '.join(map(self.item.format, value))}]" if isinstance(value, list) else _unknown(value)

    def check(self, wire: Any) -> list[Any]:
        return [self._item(k, self.item.check, value) for k, value in enumerate(self._list(wire))]

    def _list(self, value: Any) -> list[Any]:
        if not isinstance(value, list) or not self.least <= len(value) <= self.most:
            count = str(self.most) if self.least == self.most else f"{self.least} to {self.most}"
            raise SchemaError(f"must be a list of {count} numbers")
        return value

    def _item(self, index: int, function: Any, value: Any) -> Any:
        with at(f"[{index}]"):
            return function(value)


@dataclass(frozen=True)
class UnquotedText(Text):
    """Text; the command line needs no quotes around it. The box accepts any length."""

    longest: int = MAX_TEXT

    def format(self, value: Any) -> str:
        return super().format(value) if isinstance(value, str) else _unknown(value)

    def check(self, wire: Any) -> str:
        if not isinstance(wire, str):
            raise SchemaError("must be text, in quotes")
        return wire


@dataclass(frozen=True)
class Address(UnquotedText):
    """The 1-Wire address of a thermometer: 16 hexadecimal digits."""

    def check(self, wire: Any) -> str:
        if not isinstance(wire, str) or not re.fullmatch("[0-9a-f]{16}", wire):
            raise SchemaError("must be 16 hexadecimal digits in lower case, such as 28ff641e0316c2a5")
        return wire


WireValue = DecimalSteps | Exact | WireList | UnquotedText


@dataclass(frozen=True)
class ConfigKey(Key):
    """A key in a file. Any key may be left out: the box then keeps its value. ``field`` is its name on the wire.

    ``needed``: the box accepts no configuration without it. ``judged``: the box checks it.
    """

    value: WireValue
    optional: bool = True
    needed: bool = True
    judged: bool = True
    comment: str = ""


def _key(name: str, value: WireValue, comment: str = "", **more: Any) -> ConfigKey:
    return ConfigKey(name, value, comment=comment, **more)


def _microseconds(name: str, *ranges: tuple[int, int], step: int = 1, comment: str = "") -> ConfigKey:
    return _key(f"{name}_us", DecimalSteps(ranges, decimals=3, step=step), comment, field=f"{name}_ns")


_DEBOUNCE = WireList(DecimalSteps(((0, 1_000_000),)), 2, 2)
_TRIGGER = WireList(DecimalSteps(((0, 0), (10, 16_000))), 2, 2)
_POLY = WireList(Exact(), 1, MAX_COEFFICIENTS)
_MILLIDEGREES = DecimalSteps(((-(2**31), 2**31),), decimals=3)
PROVENANCE = (  # of a calibration that a host made
    _key("sigma", Exact(), "standard deviation of the residuals, in unit", judged=False),
    _key("reference", UnquotedText(), "instrument that it was calibrated against", judged=False),
    _key("reference_sigma", Exact(), "standard uncertainty of the reference, in unit", judged=False),
    _key(
        "temperature_degc", _MILLIDEGREES, "of the box during the calibration", judged=False, field="temperature_mdegc"
    ),
)
CALIBRATION = Table[dict[str, Any]](
    (
        _key("unit", UnquotedText()),
        _key("poly", _POLY, "value = poly[0] + poly[1] x + poly[2] x² …, x = counts · scale / gain"),
        _key("serial", UnquotedText()),
        _key("date", UnquotedText()),
        *PROVENANCE,
    ),
    dict,
)
CHANNEL = Table[dict[str, Any]](
    (
        _key("name", UnquotedText()),
        _key("unit", UnquotedText()),
        _key("scale", Exact(), "of a count, at gain 1"),
        _key("gain", DecimalSteps(options=GAINS), needed=False),
        _key("over", UnquotedText(), "name of the channel that this one is divided by", needed=False, judged=False),
        Key("calibration", CALIBRATION, optional=True),
    ),
    dict,
)
MAGNETOSTRICTIVE = Table[dict[str, Any]](
    (
        _microseconds("period", (0, 0), (100_000, 1_000_000_000), step=8, comment="0: off"),
        _microseconds("blanking", (5000, 21_000), step=8),
        _microseconds("timeout", (5008, 999_990_000), step=8),
        _key("us_per_inch", Exact(5, 20, 9), "on the sensor's label"),
        _microseconds("delay", (-100_000, 100_000), comment="of its electronics"),
        _key(
            "pulse_edge",
            DecimalSteps(options=(1, 2, 0)),
            "1: first edge of each pulse, 2: second, 0: a gate",
            needed=False,
        ),
        _key("serial", UnquotedText()),
        _key("date", UnquotedText()),
        *PROVENANCE,
    ),
    dict,
)
THERMOMETERS = Table[dict[str, Any]](
    tuple(
        _key(name, Address(), f"on the {what}", needed=False)
        for name, what in (("bar", "bar"), ("sensor", "bar's sensor"))
    ),
    dict,
)
CONFIG = Table[dict[str, Any]](
    (
        _key("osr", DecimalSteps(options=OSRS)),
        _key("debounce_us", _DEBOUNCE, "of trigger inputs 0 and 1; 0: off"),
        _key("trigger_ms", _TRIGGER, "between edges of the output, shortest and longest; [0, 0]: none", needed=False),
        _key("watchdog_ms", DecimalSteps(((0, 0), (100, 8000))), "0: off"),
        Key("magnetostrictive", MAGNETOSTRICTIVE, optional=True),
        Key("thermometers", THERMOMETERS, optional=True),
    ),
    dict,
    entries=(Entries("channel", CHANNEL, "channels"),),
)


def config_keys(table: Table[dict[str, Any]]) -> tuple[ConfigKey, ...]:
    """Return the keys of a table that hold a single value, without its subtables."""
    return tuple(key for key in table.keys if isinstance(key, ConfigKey))


def check(config: dict[str, Any]) -> dict[str, Any]:
    """Return ``config`` in wire format if it conforms to SPEC §5. Raises ConfigError naming the faulty key."""
    if config.get("version") != VERSION:
        raise ConfigError(f"the box's configuration has version {config.get('version')!r:.40}; update truearm")
    channels = config.get("channels")
    if not isinstance(channels, list) or len(channels) != 4:
        raise ConfigError("four channels are needed")
    with raising(ConfigError):
        _check_keys(CONFIG, config)
        for channel in map(as_table, channels):
            with at(f"channel {channel.get('name')!s:.40}"):
                _check_keys(CHANNEL, channel)
                if "calibration" in channel:
                    with at("calibration"):
                        _check_keys(CALIBRATION, as_table(channel["calibration"]))
        with at("thermometers"):
            named = as_table(config.get("thermometers"))
            _check_keys(THERMOMETERS, named)
            if len(set(named.values())) < len(named):
                raise SchemaError("two have the same address; give each its own")
        head = as_table(config.get("magnetostrictive"))
        with at("magnetostrictive"):
            _check_keys(MAGNETOSTRICTIVE, head)
            _check_times(head)
        first, second = config.get("trigger_ms", [0, 0])
        if not (first == second == 0 or 0 < first < second):
            raise SchemaError("trigger_ms: must be [0, 0], or two whole numbers, 10 to 16000, the second the longer")
    return config


def _check_keys(table: Table[dict[str, Any]], values: Mapping[str, Any]) -> None:
    for key in config_keys(table):
        if key.called in values and key.judged:
            with at(key.name):
                key.value.check(values[key.called])
        elif key.needed and key.judged:
            raise SchemaError(f"needs {key.name}")


def _check_times(head: Mapping[str, Any]) -> None:
    """Check that the sensor listens from the blanking to the time-out, and that the next interrogation is at least 10
    µs later.
    """
    if head["timeout_ns"] <= head["blanking_ns"]:
        raise SchemaError("timeout_us: must be above blanking_us")
    if 0 < head["period_ns"] < head["timeout_ns"] + 10_000:
        raise SchemaError("period_us: must be 0, or 10 or more above timeout_us")


def as_table(value: Any) -> dict[str, Any]:
    """Return ``value``, or an empty table if it is not a table."""
    return value if isinstance(value, dict) else {}


def decimal_of(pair: Any) -> Decimal | None:
    """Return the number in [mantissa, exponent]; None if it is invalid or cannot be represented in a file."""
    if not isinstance(pair, list) or len(pair) != 2 or any(type(part) is not int for part in pair):
        return None
    mantissa, exponent = pair
    return Decimal(f"{mantissa}E{exponent}") if abs(mantissa) < 2**64 and abs(exponent) <= MAX_EXPONENT else None


def mantissa_exponent(number: Decimal) -> list[int]:
    """Return the wire's [mantissa, exponent] of a decimal number, exponent ≤ 0. Raises SchemaError for too many digits."""
    sign, digits, exponent = number.normalize().as_tuple()
    assert isinstance(exponent, int)  # of a finite number
    mantissa = int("".join(map(str, digits))) * (-1 if sign else 1)
    if 0 < exponent < 20:
        mantissa, exponent = mantissa * 10**exponent, 0
    if abs(mantissa) >= _MANTISSA_END or not _LOWEST_EXPONENT <= exponent <= 0:
        raise SchemaError("has too many digits or is too large; 18 digits are possible")
    return [mantissa, exponent if mantissa else 0]


def format_decimal(pair: Any) -> str:
    """Return the number in [mantissa, exponent] as TOML; anything that is not such a pair as text."""
    number = decimal_of(pair)
    if number is None:
        return _unknown(pair)
    short = number.normalize()
    return f"{short:f}" if -7 < short.adjusted() < 15 else f"{short:E}".replace("E+", "e").replace("E", "e")


def _decimal(raw: Any) -> Decimal:
    if type(raw) is int and abs(raw) < 2**64:
        return Decimal(raw)
    if isinstance(raw, Decimal) and raw.is_finite() and abs(raw.adjusted()) < MAX_EXPONENT:
        return raw
    raise SchemaError(f"{_shown(raw)} is not a number" + " of reasonable size" * isinstance(raw, int | Decimal))


def _shown(raw: Any) -> str:
    return str(raw)[:40] if isinstance(raw, Decimal) else quoted(raw)


def _unknown(value: Any) -> str:
    return Text().format(repr(value)[:MAX_TEXT])
