"""Sentences about the joint laws of a result, from the content of result.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from truearm.text import counted, one_line

Document = Mapping[str, Any]
MOST_GAPS = 4  # named
SMALL_SHARE = 0.5  # of the range of a sag: it is extrapolated by more than it was measured

STEPS = {"geometry": "geometry", "sag": "with sag", "curves": "with curves"}


def law_sentences(document: Document) -> list[str]:
    """Return what was learned about joint laws; empty if they were not requested."""
    found = document["joint_laws"]
    if found is None:
        return []
    lines = [f"Joint laws: {one_line(reason)}." for reason in found["reasons"]]
    kept = [law for law in found["tried"] if law["kept"]]
    dropped = [law for law in found["tried"] if not law["kept"]]
    if not dropped and not kept:
        return [*lines, "No joint law is used: the geometry alone is fitted."]
    if not kept:
        tried = counted(len(dropped), "law")
        return [*lines, f"No joint law is supported by the evidence ({tried} tried): the geometry alone is used."]
    lines += [_kept(law) for law in kept]
    if dropped:
        names = ", ".join(
            f"{one_line(law['joint'])} {law['term']} {round(law['nats'], 1) + 0.0:.1f}" for law in dropped
        )
        lines.append(f"Tried and dropped, with their evidence in nats (6 are needed): {names}.")
    if any(law["term"] == "sag" for law in kept) and not found["gravity_known"]:
        lines.append(
            "Gravity is assumed to point along -z of the base frame; otherwise give gravity in the robot file or the table."
        )
    lines += _extrapolated([law for law in kept if law["term"] == "sag"])
    lines += _payload([law for law in kept if law["term"] == "sag"], found.get("payloads", []))
    noise = found["noise"]
    parts = [f"{noise['factor']:.2g} times the declared variances"]
    if noise["shared_mm"]:
        parts.append(f"{noise['shared_mm']:.2g} mm shared by the rows of a pose")
    if noise["joint_mrad"]:
        parts.append(f"{noise['joint_mrad']:.2g} mrad in every joint")
    lines.append(f"Noise learned from the residuals: {', '.join(parts)}.")
    return lines


def _kept(law: Mapping[str, Any]) -> str:
    start = f"{one_line(law['joint'])} {law['term']}: {law['rms_mrad']:.2g} mrad RMS, evidence {law['nats']:.0f} nats"
    if law["term"] != "curve":
        return f"{start}."
    periods = ", ".join(f"{one['cycles']:.0f} ({one['amplitude_mrad']:.2g} mrad)" for one in law["periods"])
    spectrum = (
        f"strongest cycles per turn: {periods}; the covered range resolves {law['resolution_cycles']:.2g} cycles per turn"
        if periods
        else "covered range too short for a spectrum"
    )
    return f"{start}, covered {intervals_text(law['covered_deg'])}, {spectrum}."


def intervals_text(intervals: Sequence[Sequence[float]]) -> str:
    """Return ascending intervals [deg] as their whole range and its widest gaps."""
    if not intervals:
        return "nowhere"
    text = f"{intervals[0][0]:.0f} to {intervals[-1][1]:.0f} deg"
    gaps = [(a[1], b[0]) for a, b in pairwise(intervals)]
    named = sorted(sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MOST_GAPS])
    if not named:
        return text
    listed = ", ".join(f"{low:.0f} to {high:.0f}" for low, high in named)
    more = f" and {counted(len(gaps) - len(named), 'smaller gap')}" * (len(gaps) > len(named))
    return f"{text} except {listed} deg{more}"


def _extrapolated(sags: Sequence[Mapping[str, Any]]) -> list[str]:
    """Name the sags of which the fitted poses show little; earlier results do not have ``range_share``."""
    shares = [(law["joint"], law.get("range_share")) for law in sags]
    small = [f"{one_line(joint)} {share:.0%}" for joint, share in shares if share is not None and share < SMALL_SHARE]
    if not small:
        return []
    return [
        f"The fitted poses show only part of the sag's range within the joint limits ({', '.join(small)}): "
        "the rest is extrapolated. Measure poses with other gravity torques if you use them."
    ]


def _payload(sags: Sequence[Mapping[str, Any]], payloads: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is known of how a payload acts; empty where no joint sags or no row has a payload."""
    masses = sorted({one["mass_kg"] for one in payloads})
    if not sags or not any(masses):
        return []
    if len(payloads) > 1:
        listed = ", ".join(f"{mass:g}" for mass in masses)
        return [f"The sag of the joints depends on the payload, which was {listed} kg."]
    return [
        f"The sag of the joints holds for the payload of these rows, {masses[0]:g} kg: it is the same in all of them."
    ]


def law_steps(document: Document, suffix: str) -> list[tuple[str, str, str]]:
    """Return each fit's name, fitted RMS and held-out mean in a suffix's unit; empty if only geometry was fitted."""
    found = document["joint_laws"]
    steps = found["steps"] if found else []
    rows = []
    for step in steps:
        held = (step["held_out"] or {}).get(f"mean_{suffix}")
        rows.append((STEPS[step["name"]], _number(step.get(f"rms_after_{suffix}")), _number(held)))
    return rows if len(rows) > 1 else []


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
