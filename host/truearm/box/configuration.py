"""A box's configuration as a TOML file in units for people, and back to what the wire holds (protocol/SPEC.md §5).

Nothing is lost on the way: the wire's [mantissa, exponent] is a decimal number, TOML's numbers are decimal, and they are
read as such (never as binary floats). So a file that was read out and is put back unchanged changes nothing. A box keeps
what a file does not say, what this truearm does not know included. What comes of a file is held
against the specification (box_rules.py) before anything is sent; the box judges it again.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING, Any

from truearm.box.configuration_rules import MAX_COEFFICIENTS, MAX_EXPONENT, OSRS, check, decimal_of, table
from truearm.errors import ConfigError, ProtocolError
from truearm.files.disk import parse_toml
from truearm.text import one_line

if TYPE_CHECKING:
    from truearm.box.control import BoxControl

MAX_BYTES = 1 << 16
MAX_TEXT = 200
MODULATOR_NS = 240
_LOWEST_EXPONENT = -60
_MANTISSA_END = 2**63


@dataclass(frozen=True)
class _Key:
    """A value: its name in the file, on the wire, and how it goes either way."""

    name: str
    wire: str
    show: Callable[[Any], str]  # of the wire's value, as TOML
    read: Callable[[Any, str], Any]  # of TOML's value, with what to call it
    comment: str = ""


def _integer(value: Any, where: str) -> int:
    if isinstance(value, Decimal) and value == value.to_integral_value():
        value = int(value)
    if type(value) is not int or abs(value) >= 2**31:
        raise ConfigError(f"{where} must be a whole number")
    return value


def _thousandths(value: Any, where: str) -> int:
    """Of a number in µs, its ns; of °C, its thousandths."""
    number = _number(value, where) * 1000
    if number != number.to_integral_value() or abs(number) >= 2**31:
        raise ConfigError(f"{where} must be a number with at most three decimals")
    return int(number)


def _decimal(value: Any, where: str) -> list[int]:
    return mantissa_exponent(_number(value, where), where)


def _decimals(value: Any, where: str) -> list[list[int]]:
    if not isinstance(value, list) or not 1 <= len(value) <= MAX_COEFFICIENTS:
        raise ConfigError(f"{where} must be a list of 1 to {MAX_COEFFICIENTS} numbers")
    return [_decimal(item, f"{where}[{k}]") for k, item in enumerate(value)]


def _integers(value: Any, where: str) -> list[int]:
    if not isinstance(value, list) or len(value) != 2:
        raise ConfigError(f"{where} must be two whole numbers")
    return [_integer(item, where) for item in value]


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise ConfigError(f"{where} must be text of at most {MAX_TEXT} characters, in quotes")
    return value


def _number(value: Any, where: str) -> Decimal:
    if type(value) is int and abs(value) < 2**64:
        return Decimal(value)
    if isinstance(value, Decimal) and value.is_finite() and abs(value.adjusted()) < MAX_EXPONENT:
        return value
    raise ConfigError(f"{where} must be a number")


def mantissa_exponent(number: Decimal, where: str) -> list[int]:
    """The wire's [mantissa, exponent] of a decimal number, exponent ≤ 0. Raises ConfigError if it has too many digits."""
    sign, digits, exponent = number.normalize().as_tuple()
    assert isinstance(exponent, int)  # of a finite number
    mantissa = int("".join(map(str, digits))) * (-1 if sign else 1)
    if 0 < exponent < 20:
        mantissa, exponent = mantissa * 10**exponent, 0
    if abs(mantissa) >= _MANTISSA_END or not _LOWEST_EXPONENT <= exponent <= 0:
        raise ConfigError(f"{where} has too many digits, or is too large; 18 digits are possible")
    return [mantissa, exponent if mantissa else 0]


def _show_decimal(value: Any) -> str:
    number = decimal_of(value)
    if number is None:
        return _show_unknown(value)
    short = number.normalize()
    return f"{short:f}" if -7 < short.adjusted() < 15 else f"{short:E}".replace("E+", "e").replace("E", "e")


def _show_thousandths(value: Any) -> str:
    return _show_decimal([value, -3])


def _show_decimals(value: Any) -> str:
    return "[" + ", ".join(map(_show_decimal, value)) + "]" if isinstance(value, list) else _show_unknown(value)


def _show(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list) and all(type(item) is int for item in value):
        return "[" + ", ".join(map(str, value)) + "]"
    return str(value) if type(value) is int else _show_unknown(value)


def _show_unknown(value: Any) -> str:
    return json.dumps(repr(value)[:MAX_TEXT], ensure_ascii=True)


_TOP = (
    _Key("osr", "osr", _show, _integer),
    _Key("debounce_us", "debounce_us", _show, _integers, "of trigger inputs 0 and 1; 0: off"),
    _Key(
        "trigger_ms",
        "trigger_ms",
        _show,
        _integers,
        "between edges of the trigger output, shortest and longest; [0, 0]: none",
    ),
    _Key("watchdog_ms", "watchdog_ms", _show, _integer, "0: off"),
)
_CHANNEL = (
    _Key("name", "name", _show, _text),
    _Key("unit", "unit", _show, _text),
    _Key("scale", "scale", _show_decimal, _decimal, "of a count, at gain 1"),
    _Key("gain", "gain", _show, _integer),
)
_CALIBRATION = (
    _Key("unit", "unit", _show, _text),
    _Key(
        "poly",
        "poly",
        _show_decimals,
        _decimals,
        "value = poly[0] + poly[1] x + poly[2] x² …, x = counts · scale / gain",
    ),
    _Key("serial", "serial", _show, _text),
    _Key("date", "date", _show, _text),
    _Key("sigma", "sigma", _show_decimal, _decimal, "standard deviation of what was left, in unit"),
    _Key("temperature_degc", "temperature_mdegc", _show_thousandths, _thousandths, "of the box meanwhile"),
)
_HEAD = (
    _Key("period_us", "period_ns", _show_thousandths, _thousandths, "0: off"),
    _Key("blanking_us", "blanking_ns", _show_thousandths, _thousandths),
    _Key("timeout_us", "timeout_ns", _show_thousandths, _thousandths),
    _Key("us_per_inch", "us_per_inch", _show_decimal, _decimal, "on the sensor's label"),
    _Key("delay_us", "delay_ns", _show_thousandths, _thousandths, "of its electronics"),
    _Key("serial", "serial", _show, _text),
    _Key("date", "date", _show, _text),
)


def parse_number(text: str) -> Decimal:
    """A TOML float as a decimal number. Raises ValueError."""
    try:
        return Decimal(text.replace("_", ""))
    except InvalidOperation as exc:
        raise ValueError(f"{text[:40]!r} is no number that can be used") from exc


# --- out


def format_config(config: Mapping[str, Any]) -> str:
    """A box's configuration as TOML. What this truearm does not know stands in comments: the box keeps it."""
    lines = ["# The configuration of a truearm box (truearm box config get, set). What is left out, the box keeps."]
    lines += _lines(config, _TOP, ("version", "channels", "magnetostrictive"))
    for channel in _tables(config.get("channels")):
        lines += ["", "[[channel]]", *_lines(channel, _CHANNEL, ("calibration",))]
        if isinstance(channel.get("calibration"), dict):
            lines += ["[channel.calibration]", *_lines(channel["calibration"], _CALIBRATION)]
    head = config.get("magnetostrictive")
    if isinstance(head, dict):
        lines += ["", "[magnetostrictive]", *_lines(head, _HEAD)]
    return "\n".join(lines) + "\n"


def _lines(table: Mapping[str, Any], keys: Sequence[_Key], elsewhere: Sequence[str] = ()) -> list[str]:
    found = []
    for key in keys:
        if key.wire in table:
            comment = (
                f"{1e9 / MODULATOR_NS / table['osr']:.2f} samples a second" if _is_osr(key, table) else key.comment
            )
            found.append(f"{key.name} = {key.show(table[key.wire])}" + (f"  # {comment}" if comment else ""))
    known = {key.wire for key in keys} | set(elsewhere)
    return found + [f"# {_one_line(k)}: not known to this truearm; the box keeps it" for k in table if k not in known]


def _is_osr(key: _Key, table: Mapping[str, Any]) -> bool:
    return key.name == "osr" and table["osr"] in OSRS


def _one_line(text: object) -> str:
    return "".join(c if c.isprintable() else "?" for c in str(text)[:40])


def flat(config: Mapping[str, Any], names: Sequence[str]) -> dict[str, str]:
    """Every value by its dotted key, as TOML; channels go by ``names``."""
    found = _flat("", config, _TOP)
    for name, channel in zip(names, _tables(config.get("channels")), strict=False):
        found |= _flat(f"channel.{name}.", channel, _CHANNEL)
        found |= _flat(f"channel.{name}.calibration.", table(channel.get("calibration")), _CALIBRATION)
    return found | _flat("magnetostrictive.", table(config.get("magnetostrictive")), _HEAD)


def _flat(prefix: str, table: Mapping[str, Any], keys: Sequence[_Key]) -> dict[str, str]:
    return {prefix + key.name: key.show(table[key.wire]) for key in keys if key.wire in table}


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(key, before, after) of all that changes, "" for what is not there."""
    names = channel_names(before)
    if len(set(names)) < len(names):
        names = [str(index) for index in range(len(names))]
    a, b = flat(before, names), flat(after, names)
    return [
        (key, a.get(key, ""), b.get(key, "")) for key in [*a, *(k for k in b if k not in a)] if a.get(key) != b.get(key)
    ]


def channel_names(config: Mapping[str, Any]) -> list[str]:
    return [str(channel.get("name", "")) for channel in _tables(config.get("channels"))]


def _tables(value: Any) -> list[dict[str, Any]]:
    return [table(item) for item in value] if isinstance(value, list) else []


# --- in


def with_file(config: Mapping[str, Any], text: str, name: str) -> dict[str, Any]:
    """``config`` with what the TOML ``text`` says, checked. Channels are matched by name, or by their order if there are
    four; a calibration replaces the one before as a whole, an empty one removes it. Raises ConfigError, which calls the file ``name``."""
    table = parse_toml(text, name, ConfigError, parse_float=parse_number)
    new = copy.deepcopy(dict(config))
    channels, head = table.pop("channel", []), table.pop("magnetostrictive", {})
    _put(new, table, _TOP, f"{name}: ")
    if not isinstance(head, dict) or not isinstance(channels, list) or not all(isinstance(c, dict) for c in channels):
        raise ConfigError(f"{name}: write channels as [[channel]] and the sensor as [magnetostrictive]")
    _put(new.setdefault("magnetostrictive", {}), head, _HEAD, f"{name}: magnetostrictive.")
    for index, channel in zip(_places(new, channels, name), channels, strict=True):
        _put_channel(new["channels"][index], dict(channel), f"{name}: channel {channel.get('name', index)!s:.40}: ")
    return check(new)


def _put_channel(target: dict[str, Any], channel: dict[str, Any], where: str) -> None:
    calibration = channel.pop("calibration", None)
    _put(target, channel, _CHANNEL, where)
    if calibration == {}:
        target.pop("calibration", None)
    elif calibration is not None:
        if not isinstance(calibration, dict):
            raise ConfigError(f"{where}calibration must be a table")
        target["calibration"] = {}
        _put(target["calibration"], calibration, _CALIBRATION, f"{where}calibration.")


def _places(config: Mapping[str, Any], channels: Sequence[Mapping[str, Any]], name: str) -> list[int]:
    """Which of the box's channels each of the file's is."""
    known = channel_names(config)
    wanted = [channel.get("name") for channel in channels]
    if len(set(map(str, wanted))) < len(wanted):
        raise ConfigError(f"{name}: two channels share a name, or have none")
    if all(w in known for w in wanted):
        return [known.index(str(w)) for w in wanted]
    if len(channels) == len(known):
        return list(range(len(known)))
    raise ConfigError(f"{name}: the box's channels are {', '.join(known)}; name these, or give all {len(known)}")


def _put(target: dict[str, Any], table: Mapping[str, Any], keys: Sequence[_Key], where: str) -> None:
    by_name = {key.name: key for key in keys}
    for name, value in table.items():
        if name not in by_name:
            raise ConfigError(f"{where}{name[:40]} is no key; there are {', '.join(by_name)}")
        target[by_name[name].wire] = by_name[name].read(value, where + name)


def with_assignment(config: Mapping[str, Any], text: str) -> dict[str, Any]:
    """``config`` with one KEY=VALUE changed, such as ``channel.lvdt.gain=2``, not yet checked. Raises ConfigError."""
    path, equals, value = text.partition("=")
    new = copy.deepcopy(dict(config))
    target, keys, name = _place(new, path.strip())
    found = next((key for key in keys if key.name == name), None)
    if not equals or found is None:
        raise ConfigError(f"{text[:60]!r} is not KEY=VALUE; here the keys are {', '.join(key.name for key in keys)}")
    target[found.wire] = found.read(_value(value.strip(), found), found.name)
    return new


def _place(config: dict[str, Any], path: str) -> tuple[dict[str, Any], Sequence[_Key], str]:
    """The table that a dotted key lies in, what may be in it, and the last part of the key."""
    prefix, _, name = path.rpartition(".")
    if not prefix:
        return config, _TOP, name
    if prefix == "magnetostrictive":
        return config.setdefault("magnetostrictive", {}), _HEAD, name
    for index, channel in enumerate(_tables(config.get("channels"))):
        for called in (f"channel.{channel.get('name')}", f"channel.{index}"):
            if prefix == called:
                return channel, _CHANNEL, name
            if prefix == called + ".calibration":
                return channel.setdefault("calibration", {}), _CALIBRATION, name
    known = ", ".join(f"channel.{n}" for n in channel_names(config))
    raise ConfigError(f"{prefix[:60]!r} is no part of the configuration; there are magnetostrictive, {known}")


def _value(text: str, key: _Key) -> Any:
    """A value of the command line: text needs no quotes there, numbers are TOML's."""
    if key.read is _text:
        return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
    if "\n" in text:
        raise ConfigError(f"{key.name} must be one value")
    table = parse_toml(f"value = {text}", key.name, ConfigError, parse_float=parse_number)
    return table["value"] if set(table) == {"value"} else None


def checked_config(box: BoxControl) -> dict[str, Any]:
    """The box's configuration. Raises ProtocolError where this truearm could not put it back."""
    try:
        return check(box.config())
    except ConfigError as exc:
        raise ProtocolError(f"the box's own configuration cannot be used: {exc}") from exc


def change_lines(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """A line for each key that changes; none where nothing does."""
    return [one_line(f"{key}: {old or '(none)'} → {new or '(none)'}") for key, old, new in differences(before, after)]
