"""Describe the results of a box's self-test (protocol/SPEC.md §5): what each means, and what to do about it.

The box applies its own limits. A value within but close to a limit is a warning here: a sagging rail, a doubled noise
or a lost stop pulse indicates a coming failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from truearm.text import box_command, page

PASS, WARN, FAIL = "pass", "warn", "fail"
MAX_RESULTS = 64


@dataclass(frozen=True)
class Finding:
    """One result. ``value`` with its unit, "" if there is none; ``advice`` if the result is not a pass."""

    name: str
    verdict: str
    title: str
    value: str
    advice: str


@dataclass(frozen=True)
class _Item:
    """``inner``: a value in this range passes without a warning; the displayed unit is the wire's times 1 / ``per``.

    ``advice`` may contain the commands {off}, which switches the head off, {get}, which prints the configuration,
    {undivided}, which removes ``over``, and {address}, which changes the address of a thermometer.
    """

    title: str
    advice: str
    inner: tuple[float, float]
    unit: str = ""
    per: int = 1
    shown_as: str = "d"


_HARDWARE = page("Build the box: parts, wiring, accuracy")
_NOISE = _Item(
    "noise of converter input {0}, shorted",
    "check the analogue ground and the 3.3 V supply; keep USB and motor cables away from the converter",
    (1, 10_000), "µV", 1000, ".2f",
)  # fmt: skip
_ITEMS = {
    "converter_id": _Item(
        "the converter answers",
        f"check its supply and the SPI wires: DOUT, CS, SCLK, DIN ({_HARDWARE})",
        (0x2400, 0x24FF), shown_as="#x",
    ),
    "excitation": _Item(
        "current of the LVDT's primary, as a voltage",
        f"check the LVDT's plug, primary and supply ({_HARDWARE}); "
        "without an LVDT, run {undivided} for each channel that has the key 'over' (the channel to divide by)",
        (60_000, 1_100_000), "mV", 1000, ".1f",
    ),
    "noise_0": _NOISE, "noise_1": _NOISE, "noise_2": _NOISE, "noise_3": _NOISE,
    "stops": _Item(
        "stop pulses of 16 interrogations of the magnetostrictive head",
        "check the head's supply, that the magnet is on its rod, both RS-422 pairs, and blanking_us and timeout_us, which {get} prints; "
        "without such a head, run {off}",
        (16, 16),
    ),
    "rail_5v": _Item(
        "5 V of the USB port", "use another port or a shorter cable, or a powered hub",
        (4_500, 5_400), "V", 1000, ".2f",
    ),
    "temperature": _Item("temperature of the chip", "cool or warm the box", (-10_000, 60_000), "°C", 1000, ".1f"),
    "thermometers_missing": _Item(
        "thermometers of the configuration that do not answer",
        "check the wires at J1 and the addresses: {get} prints those of the configuration, {address} changes one",
        (0, 0),
    ),
}  # fmt: skip
ALWAYS = ("converter_id", "noise_0", "noise_1", "noise_2", "noise_3", "rail_5v", "temperature")


def findings(results: Mapping[str, Any], device: str = "DEVICE") -> list[Finding]:
    """Return the findings in the order of the signal path; unknown names come last, as judged by the box.

    A result that cannot be read is a failure; a missing one of ``ALWAYS`` is a warning. ``device`` is the box's port, for
    the commands in the advice.
    """
    names = [name for name in _ITEMS if name in results or name in ALWAYS]
    names += sorted(set(results) - set(_ITEMS))[:MAX_RESULTS]
    return [_finding(name, results.get(name), device) for name in names]


def _finding(name: str, result: Any, device: str) -> Finding:
    item = _ITEMS.get(
        name, _Item(name[:40], "the box's firmware is newer than this truearm; update truearm", (-(2.0**63), 2.0**63))
    )
    title = item.title.format(name[-1])
    advice = item.advice.format(
        off=box_command("config set magnetostrictive.period_us=0", device),
        get=box_command("config get", device),
        undivided=box_command("config set channel.NAME.over=", device),
        address=box_command("config set thermometers.NAME=ADDRESS", device),
    )
    if result is None:
        return Finding(name, WARN, title, "", f"the box did not measure it; {advice}")
    value = result.get("value") if isinstance(result, dict) else None
    if type(value) is not int or abs(value) >= 2**63 or result.get("ok") not in (0, 1):
        return Finding(
            name, FAIL, title, "", "the box's answer cannot be read; update its firmware with truearm box flash"
        )
    unit = item.unit if name in _ITEMS else str(result.get("unit", ""))[:10]
    shown = f"{_scaled(value, item)} {unit}".strip()
    if not result["ok"]:
        limits = [
            _scaled(v, item) for v in (result.get("low"), result.get("high")) if type(v) is int and abs(v) < 2**63
        ]
        between = f" (allowed: {' to '.join(limits)} {unit}".rstrip() + ")" if len(limits) == 2 else ""
        return Finding(name, FAIL, title, shown + between, advice)
    is_near = not item.inner[0] <= value <= item.inner[1]
    return Finding(name, WARN if is_near else PASS, title, shown, f"near its limit; {advice}" if is_near else "")


def _scaled(value: int, item: _Item) -> str:
    return format(value if item.per == 1 else value / item.per, item.shown_as)
