"""Convert a box's configuration to a TOML file in practical units, and back to the wire format (protocol/SPEC.md §5).

The conversion is lossless: the wire's [mantissa, exponent] is a decimal number, TOML's numbers are decimal, and they
are parsed as such (never as binary floats). Reading a configuration and writing it back unchanged therefore changes
nothing. A box keeps whatever a file does not mention, including keys unknown to this version of truearm. The result is
checked by the box's own rules before anything is sent, and the box checks it again.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING, Any

from truearm.box.configuration_schema import (
    CALIBRATION,
    CHANNEL,
    CONFIG,
    MAGNETOSTRICTIVE,
    MODULATOR_NS,
    PROVENANCE,
    THERMOMETERS,
    UnquotedText,
    as_table,
    check,
    config_keys,
)
from truearm.errors import ConfigError, ProtocolError
from truearm.files.disk import parse_toml
from truearm.schema import Table, at, check_known, load_toml, raising, read
from truearm.text import one_line
from truearm.units import NS
from truearm_wire.config import OSRS

if TYPE_CHECKING:
    from truearm.box.control import BoxControl

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


# --- to TOML


def format_config(config: Mapping[str, Any]) -> str:
    """Format a box's configuration as TOML. Keys unknown to this version of truearm appear in comments: the box keeps
    them.
    """
    lines = [f"{HEADER} (truearm box config get, set). A key that is left out keeps its value in the box."]
    lines += _lines(config, CONFIG, ("version", "channels", *SUBTABLES))
    for channel in _channels(config):
        lines += ["", "[[channel]]", *_lines(channel, CHANNEL, ("calibration",))]
        if isinstance(channel.get("calibration"), dict):
            lines += ["[channel.calibration]", *_lines(channel["calibration"], CALIBRATION)]
    for name, table in SUBTABLES.items():
        if values := as_table(config.get(name)):
            lines += ["", f"[{name}]", *_lines(values, table)]
    return "\n".join(lines) + "\n"


def _lines(values: Mapping[str, Any], table: Table[Values], subtables: Sequence[str] = ()) -> list[str]:
    keys = {key.called: key for key in config_keys(table)}
    comments = {key.name: key.comment for key in keys.values()}
    if values.get("osr") in OSRS:
        comments["osr"] = f"{NS.factor / MODULATOR_NS / values['osr']:.2f} samples per second"
    lines = [
        key.line(values[c]) + f"  # {comments[key.name]}".removesuffix("  # ") for c, key in keys.items() if c in values
    ]
    unknown = [name for name in values if name not in {*keys, *subtables}]
    return lines + [f"# {_one_line(name)}: not known to this truearm; the box keeps it" for name in unknown]


def _one_line(text: object) -> str:
    return "".join(c if c.isprintable() else "?" for c in str(text)[:40])


def flat(config: Mapping[str, Any], names: Sequence[str]) -> dict[str, str]:
    """Return every value as TOML by its dotted key; ``names`` are the names of the channels."""
    tables = [("", config, CONFIG)]
    for name, channel in zip(names, _channels(config), strict=False):
        tables.append((f"channel.{name}.", channel, CHANNEL))
        tables.append((f"channel.{name}.calibration.", as_table(channel.get("calibration")), CALIBRATION))
    tables += [(f"{name}.", as_table(config.get(name)), table) for name, table in SUBTABLES.items()]
    return {
        prefix + key.name: key.value.format(values[key.called])
        for prefix, values, table in tables
        for key in config_keys(table)
        if key.called in values
    }


def differences(previous: Mapping[str, Any], current: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return (key, previous, current) for every change; "" for a value that is not there."""
    names = channel_names(previous)
    if len(set(names)) < len(names):
        names = [str(index) for index in range(len(names))]
    a, b = flat(previous, names), flat(current, names)
    return [
        (key, a.get(key, ""), b.get(key, "")) for key in [*a, *(k for k in b if k not in a)] if a.get(key) != b.get(key)
    ]


def channel_names(config: Mapping[str, Any]) -> list[str]:
    return [str(channel.get("name", "")) for channel in _channels(config)]


def _channels(config: Mapping[str, Any]) -> list[Values]:
    channels = config.get("channels")
    return [as_table(item) for item in channels] if isinstance(channels, list) else []


# --- from TOML


def with_file(config: Mapping[str, Any], text: str, name: str) -> Values:
    """Return ``config`` with the settings in the TOML ``text``, checked.

    Channels are matched by name, or by order if there are four. A calibration replaces the previous one completely; an
    empty one, or an empty ``over``, removes it. Raises ConfigError, which refers to the file as ``name``.
    """
    settings = read(CONFIG, parse_toml(text, name, ConfigError, parse_float=parse_number), name, ConfigError)
    new = copy.deepcopy(dict(config))
    channels, head = settings.pop("channels", ()), settings.get("magnetostrictive", {})
    present = as_table(config.get("magnetostrictive"))
    if any(head.get(key, present.get(key)) != present.get(key) for key in ("us_per_inch", "delay_ns")):
        _without_provenance(new.setdefault("magnetostrictive", {}))
    for subtable in SUBTABLES.keys() & settings.keys():
        new.setdefault(subtable, {}).update(settings.pop(subtable))
    new |= settings
    for index, channel in zip(_places(new, channels, name), channels, strict=True):
        target = new["channels"][index]
        target |= channel
        if channel.get("calibration") == {}:
            del target["calibration"]
        if channel.get("over") == "":
            del target["over"]
    return check(new)


def check_ratios(config: Mapping[str, Any]) -> None:
    """Raise ConfigError for a channel that is divided by a channel that the box does not have, or by itself."""
    for channel in config["channels"]:
        other_names = [name for name in channel_names(config) if name != channel["name"]]
        if channel.get("over", other_names[0]) not in other_names:
            raise ConfigError(
                f"channel {channel['name']}: over is {channel['over']!r:.60}; it can be one of {', '.join(other_names)}"
            )


def _places(config: Mapping[str, Any], channels: Sequence[Mapping[str, Any]], name: str) -> list[int]:
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


def _without_provenance(calibration: Values) -> None:
    """Remove how a calibration was made: the new one was made otherwise."""
    for key in PROVENANCE:
        calibration.pop(key.called, None)


def with_assignment(config: Mapping[str, Any], text: str) -> Values:
    """Return ``config`` with one KEY=VALUE changed, such as ``channel.lvdt.gain=2``. Raises ConfigError.

    Without a value, a key that the box does not need is removed: ``channel.lvdt.over=``.
    Combinations of values are not checked here; call ``check`` after all changes.
    """
    path, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(f"{text[:60]!r} is not KEY=VALUE")
    new = copy.deepcopy(dict(config))
    target, table, name = _place(new, path.strip())
    keys = {key.name: key for key in config_keys(table)}
    with raising(ConfigError):
        subtables = [] if "." in path else ["channel.NAME.…", "magnetostrictive.…", "thermometers.NAME"]
        check_known({name: value} if name not in keys else {}, [*keys, *subtables])
        key = keys[name]
        if not value.strip() and not key.needed:
            target.pop(key.called, None)
            return new
        if not value.strip() and not isinstance(key.value, UnquotedText):
            raise ConfigError(f"{path.strip()}: needs a value; it cannot be removed")
        if name in ("poly", "us_per_inch", "delay_us"):
            _without_provenance(target)
        with at(path.strip()):
            raw = _value(value.strip(), isinstance(key.value, UnquotedText))
            target[key.called] = key.value.parse(raw, key.spellings[name])
    return new


def _place(config: Values, path: str) -> tuple[Values, Table[Values], str]:
    """Return the table with a dotted key, its allowed contents, and the last part of the key."""
    prefix, _, name = path.rpartition(".")
    if not prefix:
        return config, CONFIG, name
    if prefix in SUBTABLES:
        return config.setdefault(prefix, {}), SUBTABLES[prefix], name
    for index, channel in enumerate(_channels(config)):
        for called in (f"channel.{channel.get('name')}", f"channel.{index}"):
            if prefix == called:
                return channel, CHANNEL, name
            if prefix == called + ".calibration":
                return channel.setdefault("calibration", {}), CALIBRATION, name
    tables = ", ".join([*SUBTABLES, *(f"channel.{channel}" for channel in channel_names(config))])
    raise ConfigError(f"{prefix[:60]!r} is not a table of the configuration; its tables are {tables}")


def _value(text: str, is_words: bool) -> Any:
    """Parse a value from the command line: a TOML number, or text, which needs no quotes."""
    if is_words:
        return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
    try:
        values = load_toml(f"value = {text}", parse_number)
    except (ValueError, RecursionError):
        return text
    return values["value"] if set(values) == {"value"} else text


def checked_config(box: BoxControl) -> Values:
    """Return the box's configuration. Raises ProtocolError if this version of truearm could not write it back."""
    try:
        return check(box.config())
    except ConfigError as exc:
        raise ProtocolError(f"the box's own configuration cannot be used: {exc}") from exc


def change_lines(previous: Values, current: Values) -> list[str]:
    """Return one line per changed key."""
    return [
        one_line(f"{key}: {old or '(none)'} → {new or '(none)'}") for key, old, new in differences(previous, current)
    ]
