"""What ``truearm characterize`` prints, from the document that ``--json`` has."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any

from truearm.findings import Finding
from truearm.text import counted
from truearm.units import MM, MRAD, MS, UM, S, Scale


def lines(document: Mapping[str, Any], name: str) -> Iterator[str]:
    """The lines to print; every figure with its interval of 95 %."""
    of, settling, noise = document["repeatability"], document["settling"], document["noise"]
    if document["simulated"]:
        yield Finding("simulated").text()
    yield (
        f"{name}: {counted(document['visits'], 'visit')} of {document['poses']} poses, in {document['sides']} combinations of pose and approach direction, "
        f"bar {document['bar']} (in brackets: 95 % intervals)"
    )
    yield ""
    yield f"repeatability              {_range(of['along_m'], MM)} along the bar, poses approached from one side (1 sigma); 3 sigma: {MM.text(3.0 * of['along_m']['value'], '.3f')}"
    yield f"  without joint scatter    {_range(of['unexplained_m'], MM)}"
    yield ""
    yield f"{'joint':16} {'backlash/mrad':>24} {'difference/mrad':>24} {'scatter/mrad':>22} {'sigma to use/mrad':>20}"
    columns = ("backlash_si", "reading_difference_si", "reading_spread_si")
    for j, joint in enumerate(document["joints"]):
        cells = [_range(of[column][j], MRAD, False) for column in columns]
        cells.append(_range(noise["joint_sigma_si"][j], MRAD, False))
        yield f"{joint:16} {cells[0]:>24} {cells[1]:>24} {cells[2]:>22} {cells[3]:>20}"
    yield "difference: mean reading when the joint comes from below minus from above; scatter: sigma of the readings from one side"
    if not of["backlash_explains"]:
        yield (
            f"one backlash per joint does not explain the differences between sides (probability {of['misfit_probability']:.1e}): it "
            "changes with the pose; the sigma of the bar below includes the remainder"
        )
    yield ""
    for band in settling["bands"]:
        if band["visits"]:
            yield (
                f"settled within {MM.text(band['within_m'])} after: median {_range(band['median_s'], S)}, "
                f"95th percentile {_range(band['share_95_s'], S)}; {counted(band['visits'], 'visit')}"
            )
    if any(band["visits"] for band in settling["bands"]):
        yield "  a visit counts for one of these distances if the bar's length was, on the way, at least four times this distance from its final value, and if the noise of the length is below a sixth of this distance"
    own = settling["dwells_begin_s"]
    yield f"dwells begin {own['median']:.2f} s (median) after the joints stop, {own['largest']:.2f} s at most"
    yield from _noise(document)
    yield ""
    declared = MM.of(noise["declared_bar_sigma_m"])
    yield f"truearm identify --noise uses: sigma of bar {document['bar']} {_range(noise['bar_sigma_m'], MM)}, in place of the rig's {declared:.3f} mm; sigmas of the joints as in the last column, which include half the backlash. For dwells of sessions, it corrects the backlash instead of including this half"


def remarks(document: Mapping[str, Any], name: str) -> Iterator[str]:
    """What stands at the head of the noise file."""
    noise = document["noise"]
    if document["simulated"]:
        yield Finding("simulated").text()
    yield f"{name}: {counted(document['visits'], 'visit')} of {document['poses']} poses; intervals of 95 %"
    for joint, sigma in zip(document["joints"], noise["joint_sigma_si"], strict=True):
        yield f"{joint}: {_range(sigma, MRAD)}"
    yield f"bar {document['bar']}: {_range(noise['bar_sigma_m'], MM)}"


def _noise(document: Mapping[str, Any]) -> Iterator[str]:
    sensor, readings = document["sensor"], document["readings"]
    worst = max(readings, key=lambda one: one["reading_si"]["value"])
    yield (
        f"joint readings: noise {_range(worst['reading_si'], MRAD)}, resolution {MRAD.text(worst['step_si'], '.3g')} at the noisiest joint; "
        f"sigma of a dwell's mean {_range(worst['mean_si'], MRAD)} from the noise, {round(MRAD.of(worst['rounding_si']), 6):.2g} mrad from "
        "the resolution"
    )
    yield (
        f"sensor: noise of a sample {_range(sensor['sample_m'], UM)}, a sample every {MS.text(sensor['period_s'], '.3g')}; samples that are "
        f"{_range(sensor['independent_after_s'], MS)} apart are independent"
    )
    if sensor["floor"] is not None:
        yield f"  lowest Allan deviation {_range(sensor['floor'], UM)} in means over {sensor['floor']['tau_s']:.2g} s"


def _range(interval: Mapping[str, float], scale: Scale, unit: bool = True) -> str:
    """A figure and its interval in some unit; '-' where nothing is known."""
    value, low, high = (scale.of(interval[key]) for key in ("value", "low", "high"))
    if not isfinite(value):
        return "-"
    upper = _digits(high) if isfinite(high) else "…"
    return f"{_digits(value)} ({_digits(low)} to {upper})" + (f" {scale.symbol}" if unit else "")


def _digits(value: float) -> str:
    return f"{value:.3f}" if abs(value) >= 0.01 else f"{value:.2g}"
