"""Convert a box's configuration to a TOML file in practical units, and back to the wire format (protocol/SPEC.md §5).

The conversion is lossless: the wire's [mantissa, exponent] is a decimal number, TOML's numbers are decimal, and they
are parsed as such (never as binary floats). Reading a configuration and writing it back unchanged therefore changes
nothing. A box keeps whatever a file does not mention, including keys unknown to this version of truearm. The result is
checked by the box's own rules before anything is sent, and the box checks it again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from decimal import Decimal, InvalidOperation
from itertools import chain
from typing import Any

from truearm.box.configuration_schema import (
    CALIBRATION,
    CHANNEL,
    CONFIG,
    CURVE,
    MAGNETOSTRICTIVE,
    MODULATOR_NS,
    PROVENANCE,
    REMOVABLE,
    THERMOMETERS,
    check,
    config_keys,
)
from truearm.box.control import BoxControl
from truearm.disk import parse_toml
from truearm.errors import ConfigError, ProtocolError
from truearm.schema import Table, Text, hint, load_toml, raising, read
from truearm.text import one_line
from truearm.units import NS
from truearm_wire.config import OSRS

MAX_BYTES = 1 << 16
Values = dict[str, Any]

HEADER = "# The configuration of a truearm box"
SUBTABLES = {"magnetostrictive": MAGNETOSTRICTIVE, "thermometers": THERMOMETERS}


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
    """Format a checked configuration as TOML. Keys unknown to this version of truearm appear in comments: the box keeps
    them.
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
        if key.name == "osr" and values["osr"] in OSRS:
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
