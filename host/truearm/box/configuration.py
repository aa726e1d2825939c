"""A box's configuration (protocol/SPEC.md §5): every key, as a TOML file in practical units and on the wire.

A file has practical units and decimal numbers; the wire has integers in small units and [mantissa, exponent]. The
conversion is lossless, since numbers are never parsed as binary floats: reading a configuration and writing it back
changes nothing. A box keeps whatever a file does not mention, including keys unknown to this version of truearm. The
result is checked by the box's own rules (``truearm_wire.config``) before anything is sent, and the box checks it again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain
from typing import Any

from truearm.box.control import BoxControl
from truearm.disk import parse_toml
from truearm.errors import ConfigError, ProtocolError
from truearm.schema import Entries, Key, List, SchemaError, Table, Text, Value, hint, load_toml, quoted, raising, read
from truearm.session.frames import MAX_COEFFICIENTS, MAX_EXPONENT
from truearm.text import one_line
from truearm.units import NS
from truearm_wire import config as rules

MODULATOR_NS = 240
MAX_TEXT = 200
_LOWEST_EXPONENT = -60
_MANTISSA_END = 2**63
MAX_BYTES = 1 << 16
Values = dict[str, Any]
HEADER = "# The configuration of a truearm box"


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
CALIBRATION = Table[Values](
    (
        _key("unit", _TEXT),
        _key("poly", _POLY, "value = poly[0] + poly[1] x + poly[2] x² …, x = counts · scale / gain"),
        _key("serial", _TEXT),
        _key("date", _TEXT),
        *_PROVENANCE,
    ),
    dict,
)
CHANNEL = Table[Values](
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
MAGNETOSTRICTIVE = Table[Values](
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
THERMOMETERS = Table[Values](
    (_key("bar", _TEXT, "on the bar", needed=False), _key("sensor", _TEXT, "on the bar's sensor", needed=False)), dict
)
CONFIG = Table[Values](
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


SUBTABLES = {"magnetostrictive": MAGNETOSTRICTIVE, "thermometers": THERMOMETERS}
CURVE = ("poly", "us_per_inch", "delay_ns")  # of a calibration
PROVENANCE = frozenset(key.called for key in _PROVENANCE)


def config_keys(table: Table[Values]) -> tuple[ConfigKey, ...]:
    """Return the keys of a table that hold a single value, without its subtables."""
    return tuple(key for key in table.keys if isinstance(key, ConfigKey))


REMOVABLE = {"calibration", "thermometers"} | {
    key.called
    for table in (CONFIG, CHANNEL, MAGNETOSTRICTIVE, THERMOMETERS)
    for key in config_keys(table)
    if not key.needed
}


def check(config: Values) -> Values:
    """Return ``config`` in wire format if the box would accept it. Raises ConfigError naming the faulty key."""
    if config.get("version") != rules.VERSION:
        raise ConfigError(f"the box's configuration has version {config.get('version')!r:.40}; update truearm")
    try:
        rules.check(config)
    except ValueError as exc:
        raise ConfigError(str(exc)) from None
    return config


def mantissa_exponent(number: Decimal) -> list[int]:
    """Return the wire's [mantissa, exponent] of a decimal number, exponent ≤ 0.

    Raises SchemaError for too many digits.
    """
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


def parse_number(text: str) -> Decimal:
    """Parse a TOML float as a decimal number. Raises ValueError."""
    try:
        return Decimal(text.replace("_", ""))
    except InvalidOperation as exc:
        raise ValueError(f"{text[:40]!r} is not a usable number") from exc


def tables_of(config: Values, names: Sequence[object]) -> Iterator[tuple[str, Values, Table[Values]]]:
    """Yield the dotted path of every table, its values and its schema; ``names`` are those of the channels."""
    yield "", config, CONFIG
    for name, channel in zip(names, config["channels"], strict=True):
        yield f"channel.{name}", channel, CHANNEL
        yield f"channel.{name}.calibration", channel.get("calibration", {}), CALIBRATION
    for name, table in SUBTABLES.items():
        yield name, config.get(name, {}), table


# --- to TOML


def format_config(config: Values) -> str:
    """Format a checked configuration as TOML.

    Keys unknown to this version of truearm appear in comments: the box keeps them.
    """
    lines = [f"{HEADER} (truearm box config get, set). A key that is left out keeps its value in the box."]
    for path, values, table in tables_of(config, channel_names(config)):
        title = {id(CHANNEL): "[[channel]]", id(CALIBRATION): "[channel.calibration]"}.get(id(table), f"[{path}]")
        lines += ["", title] if path and values else []
        lines += _lines(values, table)
    return "\n".join(lines) + "\n"


def _lines(values: Mapping[str, Any], table: Table[Values]) -> list[str]:
    lines = []
    for key in config_keys(table):
        comment = key.comment
        if key.name == "osr" and values["osr"] in rules.OSRS:
            comment = f"{NS.factor / MODULATOR_NS / values['osr']:.2f} samples per second"
        if key.called in values:
            lines.append(f"{key.name} = {key.format(values[key.called])}" + f"  # {comment}" * bool(comment))
    declared = {"version", *(key.called for key in table.keys), *(entries.field for entries in table.entries)}
    unknown = (
        "".join(c if c.isprintable() else "?" for c in str(name)[:40]) for name in values if name not in declared
    )
    return [*lines, *(f"# {name}: not known to this truearm; the box keeps it" for name in unknown)]


def change_lines(previous: Values, current: Values) -> list[str]:
    """Return one line per changed key."""
    names: Sequence[object] = channel_names(previous)
    if len(set(names)) < len(names):
        names = range(len(names))
    old, new = (
        {
            f"{path}.{key.name}".lstrip("."): key.format(values[key.called])
            for path, values, table in tables_of(config, names)
            for key in config_keys(table)
            if key.called in values
        }
        for config in (previous, current)
    )
    keys = (key for key in {**old, **new} if old.get(key) != new.get(key))
    return [one_line(f"{key}: {old.get(key, '(none)')} → {new.get(key, '(none)')}") for key in keys]


def channel_names(config: Values) -> list[str]:
    return [channel["name"] for channel in config["channels"]]


# --- from TOML


def with_file(config: Values, text: str, name: str) -> Values:
    """Return ``config`` with the settings in the TOML ``text``, checked.

    Channels are matched by name, or by order if there are four. A calibration replaces the previous one completely; an
    empty one removes it. Raises ConfigError, which refers to the file as ``name``.
    """
    settings = read(CONFIG, parse_toml(text, name, ConfigError, parse_float=parse_number), name, ConfigError)
    channels = settings.pop("channels", ())
    return check(merged(config, settings, dict(zip(_places(config, channels, name), channels, strict=True))))


def merged(config: Values, settings: Mapping[str, Any], channels: Mapping[int, Values]) -> Values:
    """Return ``config`` with settings in the form of the wire; those of ``channels`` by their number."""
    tables = {name: revised(config.get(name, {}), settings[name]) for name in SUBTABLES.keys() & settings.keys()}
    entries = [revised(entry, channels.get(index, {})) for index, entry in enumerate(config["channels"])]
    return revised(config, {**settings, **tables, "channels": entries})


def revised(previous: Mapping[str, Any], settings: Mapping[str, Any]) -> Values:
    """Return a table with new settings; an empty one of a value that the box does not need removes it.

    If the curve of a calibration changes, the previous one's uncertainty and reference are removed.
    """
    if any(settings.get(key, previous.get(key)) != previous.get(key) for key in CURVE):
        previous = {name: value for name, value in previous.items() if name not in PROVENANCE}
    entries = {**previous, **settings}
    return {name: value for name, value in entries.items() if value not in ("", {}) or name not in REMOVABLE}


def check_ratios(config: Values) -> None:
    """Raise ConfigError for a channel that is divided by a channel that the box does not have, or by itself."""
    for channel in config["channels"]:
        other_names = [name for name in channel_names(config) if name != channel["name"]]
        if channel.get("over", other_names[0]) not in other_names:
            raise ConfigError(
                f"channel {channel['name']}: over is {channel['over']!r:.60}; it can be one of {', '.join(other_names)}"
            )


def _places(config: Values, channels: Sequence[Mapping[str, Any]], name: str) -> list[int]:
    """Return which of the box's channels each channel in the file is."""
    names = channel_names(config)
    file_names = [channel.get("name") for channel in channels]
    if len(set(file_names)) < len(file_names):
        raise ConfigError(f"{name}: every channel needs a name of its own")
    if all(file_name in names for file_name in file_names):
        return [names.index(str(file_name)) for file_name in file_names]
    if len(channels) == len(names):
        return list(range(len(names)))
    raise ConfigError(
        f"{name}: the box's channels are {', '.join(names)}; name these channels, or give all {len(names)}"
    )


def with_assignment(config: Values, text: str) -> Values:
    """Return ``config`` with one KEY=VALUE changed, such as ``channel.lvdt.gain=2``. Raises ConfigError.

    Without a value, a key that the box does not need is removed: ``channel.lvdt.over=``, ``channel.lvdt.calibration=``.
    Combinations of values are not checked here; call ``check`` after all changes.
    """
    path, equals, value = map(str.strip, text.partition("="))
    if not equals:
        raise ConfigError(f"{text[:60]!r} is not KEY=VALUE")
    prefix, _, name = path.rpartition(".")
    changed, names = deepcopy(config), channel_names(config)
    for parent, child in ((changed, "thermometers"), *((channel, "calibration") for channel in changed["channels"])):
        parent.setdefault(child, {})  # removed again if it stays empty
    by_number, by_name = tables_of(changed, range(len(names))), tables_of(changed, names)
    tables = {path: (values, table) for path, values, table in chain(by_number, reversed([*by_name]))}
    if prefix not in tables:
        listed = ", ".join(path for path, *_ in tables_of(config, names) if path)
        raise ConfigError(f"{prefix[:60]!r} is not a table of the configuration; its tables are {listed}")
    values, table = tables[prefix]
    keys = {key.name: key for key in config_keys(table)}
    if name not in keys and name in REMOVABLE & values.keys() and value in ("", "{}"):
        del values[name]
        return merged(changed, {}, {})
    if name not in keys:
        nested = [] if prefix else [f"{title}.…" for title in (*SUBTABLES, "channel.NAME", "channel.NAME.calibration")]
        raise ConfigError(f"unknown key {path[:60]!r}; {hint(name, [*keys, *nested])}")
    is_text = isinstance(keys[name].value, Text)
    if not value and keys[name].needed and not is_text:
        field = keys[name].called
        example = f", such as the {keys[name].format(values[field])} that it has" if field in values else ""
        raise ConfigError(f"{path}: needs a value{example}; it cannot be removed")
    with raising(ConfigError, prefix):
        settings = table.parse({name: _text(value) if is_text else _number(value)})
    entries = revised(values, settings)
    values.clear()
    values |= entries
    return merged(changed, {}, {})


def _text(value: str) -> str:
    """Return text from the command line, where it needs no quotes."""
    return value[1:-1] if len(value) > 1 and value[0] == value[-1] == '"' else value


def _number(value: str) -> Any:
    """Return a number or a list from the command line; other text as it is."""
    try:
        document = load_toml(f"value = {value}", parse_number)
    except (ValueError, RecursionError):
        return value
    return document["value"] if set(document) == {"value"} else value


def checked_config(box: BoxControl) -> Values:
    """Return the box's configuration. Raises ProtocolError if this version of truearm could not write it back."""
    try:
        return check(box.config())
    except ConfigError as exc:
        raise ProtocolError(f"the box's own configuration cannot be used: {exc}") from exc
