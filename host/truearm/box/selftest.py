"""Judge the results of a box's self-test (protocol/SPEC.md §5), as findings.

The box applies its own limits. A value within but close to a limit is a warning here: a sagging rail, a doubled noise
or a lost stop pulse indicates a coming failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from truearm.findings import Finding, option, worded

PASS, WARN, FAIL = "pass", "warn", "fail"
MAX_RESULTS = 64


@dataclass(frozen=True)
class Check:
    """A result: the code of its finding unless it passes without a warning, which a value in the range ``inner`` does.

    The displayed unit is the wire's times 1 / ``per``.
    """

    code: str
    title: str
    inner: tuple[float, float]
    unit: str = ""
    per: int = 1
    shown_as: str = "d"

    def scaled(self, value: int) -> str:
        """Return a value in the displayed unit."""
        return format(value if self.per == 1 else value / self.per, self.shown_as)


CHECKS = {
    "converter_id": Check("test-converter", "the converter answers", (0x2400, 0x24FF), shown_as="#x"),
    "excitation": Check(
        "test-excitation", "current of the LVDT's primary, as a voltage", (60_000, 1_100_000), "mV", 1000, ".1f"
    ),
    **{
        f"noise_{i}": Check("test-noise", f"noise of converter input {i}, shorted", (1, 10_000), "µV", 1000, ".2f")
        for i in range(4)
    },
    "stops": Check("test-stops", "stop pulses of 16 interrogations of the magnetostrictive head", (16, 16)),
    "rail_5v": Check("test-supply", "5 V of the USB port", (4_500, 5_400), "V", 1000, ".2f"),
    "temperature": Check("test-temperature", "temperature of the chip", (-10_000, 60_000), "°C", 1000, ".1f"),
    "thermometers_missing": Check("test-thermometers", "thermometers of the configuration that do not answer", (0, 0)),
}
ALWAYS = ("converter_id", "noise_0", "noise_1", "noise_2", "noise_3", "rail_5v", "temperature")


def findings(results: Mapping[str, Any], device: str = "DEVICE") -> dict[str, Finding]:
    """Return the findings by name of the result, in the order of the signal path; unknown names come last, as judged by
    the box.

    A result that cannot be read is a failure; a missing one of ``ALWAYS`` is a warning. ``device`` is the box's port, for
    the commands in the remedies.
    """
    names = [name for name in CHECKS if name in results or name in ALWAYS]
    names += sorted(set(results) - set(CHECKS))[:MAX_RESULTS]
    return {name: _finding(name, results.get(name), device) for name in names}


def _finding(name: str, result: Any, device: str) -> Finding:
    check = CHECKS.get(name, Check("test-unknown", name[:40], (-(2.0**63), 2.0**63)))
    values: dict[str, Any] = {"verdict": WARN, "title": check.title, "value": "", "near": False, "device": [device]}
    if result is None:
        return Finding(check.code, values)
    value, ok = (result.get("value"), result.get("ok")) if isinstance(result, dict) else (None, None)
    if type(value) is not int or abs(value) >= 2**63 or ok not in (0, 1):
        return Finding("test-unreadable", {**values, "verdict": FAIL})
    unit = check.unit if name in CHECKS else str(result.get("unit", ""))[:10]
    values["value"] = f"{check.scaled(value)} {unit}".strip()
    if not ok:
        limits = [result.get("low"), result.get("high")]
        if all(type(limit) is int and abs(limit) < 2**63 for limit in limits):
            values["value"] += f" (allowed: {' to '.join(map(check.scaled, limits))} {unit}".rstrip() + ")"
        return Finding(check.code, {**values, "verdict": FAIL})
    near = not check.inner[0] <= value <= check.inner[1]
    return (
        Finding(check.code, {**values, "near": True}) if near else Finding("test-passed", {**values, "verdict": PASS})
    )


def entry(name: str, finding: Finding) -> dict[str, Any]:
    """Return a result as JSON."""
    values, remedy = finding.values, finding.statement.remedy
    return {
        "name": name,
        **{key: values[key] for key in ("verdict", "title", "value")},
        "advice": worded(remedy, values, option),
        **finding.entry(),
    }
