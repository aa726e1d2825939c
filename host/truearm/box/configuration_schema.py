"""Schema of a box's configuration (protocol/SPEC.md §5): every key, in a file and on the wire.

A file has practical units and decimal numbers; the wire has integers in small units and [mantissa, exponent]. Values
are converted without binary floats, so nothing is lost. The bounds are those of the box, ``truearm_wire.config``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from truearm.errors import ConfigError
from truearm.schema import Entries, Key, List, SchemaError, Table, Text, Value, quoted
from truearm.session.box_ident import MAX_COEFFICIENTS, MAX_EXPONENT
from truearm_wire import config as rules

MODULATOR_NS = 240
MAX_TEXT = 200
_LOWEST_EXPONENT = -60
_MANTISSA_END = 2**63


@dataclass(frozen=True)
class WireNumber(Value):
    """A decimal number in a file: on the wire an integer in units of 10^-``decimals``, [mantissa, exponent] if None."""

    decimals: int | None = 0

    def parse(self, raw: Any, suffix: str = "") -> int | list[int]:
        number = _decimal(raw)
        if self.decimals is None:
            return mantissa_exponent(number)
        scaled = number.scaleb(self.decimals)
        if scaled != scaled.to_integral_value() or abs(scaled) >= 2**31:
            rule = f"number with at most {self.decimals} decimals" if self.decimals else "whole number"
            raise SchemaError(f"{_shown(raw)} is not a {rule}")
        return int(scaled)

    def format(self, value: Any) -> str:
        return format_decimal(value if self.decimals is None else [value, -self.decimals])


class WireList(List):
    """A list of numbers."""

    def parse(self, raw: Any, suffix: str = "") -> Any:
        return list(super().parse(raw, suffix))


@dataclass(frozen=True)
class ConfigKey(Key):
    """A key in a file. Any key may be left out: the box then keeps its value. ``field`` is its name on the wire.

    ``needed``: the box accepts no configuration without it; others are removed by "".
    """

    value: WireNumber | WireList | Text
    optional: bool = True
    needed: bool = True
    comment: str = ""

    def parse(self, raw: Any, spelled: str) -> Any:
        return raw if raw == "" and not self.needed else super().parse(raw, spelled)

    def format(self, value: Any) -> str:
        """Return a value as TOML; as text, if a later host wrote it in a form that this one does not know."""
        try:
            return self.value.format(value)
        except (TypeError, ValueError, ArithmeticError):
            return Text().format(repr(value)[:MAX_TEXT])


def _key(name: str, value: WireNumber | WireList | Text, comment: str = "", **fields: Any) -> ConfigKey:
    return ConfigKey(name, value, comment=comment, **fields)


def _microseconds(name: str, comment: str = "") -> ConfigKey:
    return _key(f"{name}_us", WireNumber(3), comment, field=f"{name}_ns")


_PAIR = WireList(WireNumber(), 2)
_EXACT = WireNumber(None)
_TEXT = Text(MAX_TEXT)
_PROVENANCE = (  # of a calibration that a host made
    _key("sigma", _EXACT, "standard deviation of the residuals, in unit"),
    _key("reference", _TEXT, "instrument that it was calibrated against"),
    _key("reference_sigma", _EXACT, "standard uncertainty of the reference, in unit"),
    _key("temperature_degc", WireNumber(3), "of the box during the calibration", field="temperature_mdegc"),
)
_POLY = WireList(_EXACT, most=MAX_COEFFICIENTS)
CALIBRATION = Table[dict[str, Any]](
    (
        _key("unit", _TEXT),
        _key("poly", _POLY, "value = poly[0] + poly[1] x + poly[2] x² …, x = counts · scale / gain"),
        _key("serial", _TEXT),
        _key("date", _TEXT),
        *_PROVENANCE,
    ),
    dict,
)
CHANNEL = Table[dict[str, Any]](
    (
        _key("name", _TEXT),
        _key("unit", _TEXT),
        _key("scale", _EXACT, "of a count, at gain 1"),
        _key("gain", WireNumber(), needed=False),
        _key("over", _TEXT, "name of the channel that this one is divided by", needed=False),
        Key("calibration", CALIBRATION, optional=True),
    ),
    dict,
)
MAGNETOSTRICTIVE = Table[dict[str, Any]](
    (
        _microseconds("period", "0: off"),
        _microseconds("blanking"),
        _microseconds("timeout"),
        _key("us_per_inch", _EXACT, "on the sensor's label"),
        _microseconds("delay", "of its electronics"),
        _key("pulse_edge", WireNumber(), "1: first edge of each pulse, 2: second, 0: a gate", needed=False),
        _key("serial", _TEXT),
        _key("date", _TEXT),
        *_PROVENANCE,
    ),
    dict,
)
THERMOMETERS = Table[dict[str, Any]](
    (_key("bar", _TEXT, "on the bar", needed=False), _key("sensor", _TEXT, "on the bar's sensor", needed=False)), dict
)
CONFIG = Table[dict[str, Any]](
    (
        _key("osr", WireNumber()),
        _key("debounce_us", _PAIR, "of trigger inputs 0 and 1; 0: off"),
        _key("trigger_ms", _PAIR, "between edges of the output, shortest and longest; [0, 0]: none", needed=False),
        _key("watchdog_ms", WireNumber(), "0: off"),
        Key("magnetostrictive", MAGNETOSTRICTIVE, optional=True),
        Key("thermometers", THERMOMETERS, optional=True),
    ),
    dict,
    entries=(Entries("channel", CHANNEL, "channels"),),
)


CURVE = ("poly", "us_per_inch", "delay_ns")  # of a calibration
PROVENANCE = frozenset(key.called for key in _PROVENANCE)


def config_keys(table: Table[dict[str, Any]]) -> tuple[ConfigKey, ...]:
    """Return the keys of a table that hold a single value, without its subtables."""
    return tuple(key for key in table.keys if isinstance(key, ConfigKey))


REMOVABLE = {"calibration", "thermometers"} | {
    key.called
    for table in (CONFIG, CHANNEL, MAGNETOSTRICTIVE, THERMOMETERS)
    for key in config_keys(table)
    if not key.needed
}


def check(config: dict[str, Any]) -> dict[str, Any]:
    """Return ``config`` in wire format if the box would accept it. Raises ConfigError naming the faulty key."""
    if config.get("version") != rules.VERSION:
        raise ConfigError(f"the box's configuration has version {config.get('version')!r:.40}; update truearm")
    try:
        rules.check(config)
    except ValueError as exc:
        raise ConfigError(str(exc)) from None
    return config


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


def format_decimal(pair: Sequence[int]) -> str:
    """Return the number in [mantissa, exponent] as TOML. Raises ValueError if it cannot be represented in a file."""
    mantissa, exponent = pair
    if abs(mantissa) >= 2**64 or abs(exponent) > MAX_EXPONENT:
        raise ValueError(pair)
    short = Decimal(f"{mantissa}E{exponent}").normalize()
    return f"{short:f}" if -7 < short.adjusted() < 15 else f"{short:E}".replace("E+", "e").replace("E", "e")


def _decimal(raw: Any) -> Decimal:
    if type(raw) is int and abs(raw) < 2**64:
        return Decimal(raw)
    if isinstance(raw, Decimal) and raw.is_finite() and abs(raw.adjusted()) < MAX_EXPONENT:
        return raw
    raise SchemaError(f"{_shown(raw)} is not a number" + " of reasonable size" * isinstance(raw, int | Decimal))


def _shown(raw: Any) -> str:
    return str(raw)[:40] if isinstance(raw, Decimal) else quoted(raw)
