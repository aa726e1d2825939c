"""The findings of ``truearm characterize``, from its document, and its joints as rows of a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any

from truearm.findings import Finding, ordered, stated
from truearm.report.tables import Table
from truearm.text import counted, one_line
from truearm.units import MM, MRAD, MS, UM, S, Scale

Document = Mapping[str, Any]

JOINTS = ("joint", "backlash/mrad", "difference/mrad", "scatter/mrad", "sigma to use/mrad")


def repeatability_findings(document: Document) -> list[Finding]:
    """Return the repeatability, what identify uses, how the arm settles, and the noise; figures with intervals of 95 %."""
    spread, settling, noise, sensor = (document[name] for name in ("repeatability", "settling", "noise", "sensor"))
    widths = zip(spread["backlash_si"], document["joints"], strict=True)
    largest, joint = max(widths, key=lambda width: width[0]["value"] if isfinite(width[0]["value"]) else -1.0)
    noisiest, floor = max(document["readings"], key=lambda row: row["reading_si"]["value"]), sensor["floor"]
    bands = [
        f"{MM.text(band['within_m'])} after {interval(band['median_s'], S)} (median) and {interval(band['share_95_s'], S)} "
        f"(95th percentile) in {counted(band['visits'], 'visit')}"
        for band in settling["bands"]
        if band["visits"]
    ]
    verdict = {
        "along": interval(spread["along_m"], MM),
        "alone": interval(spread["unexplained_m"], MM),
        "backlash": interval(largest, MRAD),
        "joint": joint,
    }
    declared = {"mm": MM.of(noise["declared_bar_sigma_m"])}
    to_use = {"bar": document["bar"], "sigma": interval(noise["bar_sigma_m"], MM), "declared": declared}
    misfit = {"probability": spread["misfit_probability"]}
    begin = {name: {"s": value} for name, value in settling["dwells_begin_s"].items()}
    measured = {
        "reading": interval(noisiest["reading_si"], MRAD),
        "step": MRAD.text(noisiest["step_si"], ".3g"),
        "mean": interval(noisiest["mean_si"], MRAD),
        "rounding": f"{round(MRAD.of(noisiest['rounding_si']), 6):.2g} mrad",
        "sample": interval(sensor["sample_m"], UM),
        "period": MS.text(sensor["period_s"], ".3g"),
        "independent": interval(sensor["independent_after_s"], MS),
        "floor": floor and interval(floor, UM),
        "over": floor and floor["tau_s"],
    }
    findings = [
        stated("repeatability", document, **verdict),
        Finding("noise-to-use", to_use),
        *([] if spread["backlash_explains"] else [Finding("backlash-varies", misfit)]),
        Finding("settling-measured", {**begin, "bands": bands}),
        Finding("noise-measured", measured),
    ]
    return ordered(findings, document["simulated"])


def joint_table(document: Document) -> Table:
    """Return the figures of each joint [mrad]."""
    spread = document["repeatability"]
    columns = [spread[name] for name in ("backlash_si", "reading_difference_si", "reading_spread_si")]
    columns.append(document["noise"]["joint_sigma_si"])
    rows = zip(document["joints"], *columns, strict=True)
    return Table(JOINTS, [(joint, *(interval(figure, MRAD, False) for figure in figures)) for joint, *figures in rows])


def remarks(document: Document) -> Iterator[str]:
    """Return what stands at the head of the noise file."""
    noise = document["noise"]
    if document["simulated"]:
        yield Finding("simulated").text()
    name = one_line(document["session"])
    yield f"{name}: {counted(document['visits'], 'visit')} of {document['poses']} poses; intervals of 95 %"
    for joint, sigma in zip(document["joints"], noise["joint_sigma_si"], strict=True):
        yield f"{joint}: {interval(sigma, MRAD)}"
    yield f"bar {document['bar']}: {interval(noise['bar_sigma_m'], MM)}"


def interval(figure: Mapping[str, float], scale: Scale, unit: bool = True) -> str:
    """Return a figure with its interval in some unit; "-" if nothing is known."""
    value, low, high = (scale.of(figure[key]) for key in ("value", "low", "high"))
    if not isfinite(value):
        return "-"
    upper = _digits(high) if isfinite(high) else "…"
    return f"{_digits(value)} ({_digits(low)} to {upper})" + (f" {scale.symbol}" if unit else "")


def _digits(value: float) -> str:
    return f"{value:.3f}" if abs(value) >= 0.01 else f"{value:.2g}"
