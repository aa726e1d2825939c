"""What ``truearm plan`` prints: the plan and its forecast."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from truearm.report.result_findings import MAX_TERMS
from truearm.results import largest_terms
from truearm.text import counted
from truearm.types import BAR_MOUNTED
from truearm.units import UNITS


def forecast_lines(document: Mapping[str, Any], check_poses: int | None = None) -> list[str]:
    """Return what ``plan ballbar`` and ``plan line`` planned, the predicted sigmas, and the expected error.

    ``check_poses``: how many were asked for.
    """
    return [
        *visit_lines(document),
        *_fewer_checks(document, check_poses),
        *_known_after(document),
        *_region(document),
        *_curves(document),
        *_written(document),
    ]


def _curves(document: Mapping[str, Any]) -> list[str]:
    """Return the predicted sigmas of error curves, and the readings that the poses do not cover."""
    lines = []
    for curve in document.get("curves", ()):
        parts = ", ".join(
            f"{part['lower_deg']:.0f} to {part['upper_deg']:.0f} deg ± {part['sigma_mrad']:.2g}"
            for part in curve["ranges"]
        )
        line = f"error curve of {curve['joint']}: ± {curve['sigma_mrad']:.2g} mrad ({parts})"
        gaps = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in curve["unseen_deg"])
        lines.append(line + (f"; not determined: {gaps} deg" if gaps else ""))
    if lines:
        lines.append("Outside these ranges, corrections use geometry and sag alone: measure where the robot will work.")
        lines.append(
            "The sigmas and the error in the region above are those of the geometry: curves and sag add to them."
        )
    return lines


def approach_lines(document: Mapping[str, Any]) -> list[str]:
    """Return what ``plan characterize`` planned."""
    return [
        f"{counted(document['poses'], 'pose')} of bar {document['bar']} from {document['chuck']} to {document['sphere']}, "
        f"{counted(document['via_points'], 'approach point')}, {counted(round(document['minutes']), 'minute')}",
        *_written(document),
    ]


def _written(document: Mapping[str, Any]) -> list[str]:
    return [f"written: {path}" for path in document["written"]]


def visit_lines(document: Mapping[str, Any]) -> list[str]:
    """Return what is visited, how long it takes, and what can be held out."""
    if "lines" not in document:
        return [
            f"{counted(document['poses'], 'pose')}, {counted(document['via_points'], 'via point')}, {counted(document['mounts'], 'mount')} of the bar: "
            f"{counted(round(document['minutes']), 'minute')}",
            *_against_drift(document),
            *_pairing_lines(document),
        ]
    lines = []
    for place in document["lines"]:
        ends = " to ".join(", ".join(f"{v:.0f}" for v in place[end]) for end in ("from_mm", "to_mm"))
        turn = ", ".join(f"{v:.4f}" for v in place["rotation_rad"])
        lines.append(
            f"{place['line']:<8} {ends} mm, rotation_rad = [{turn}]; expected error {place['a_priori_mm']:.1f} mm"
        )
    return [*lines, f"{counted(len(document['lines']), 'line')}: {counted(round(document['minutes']), 'minute')}"]


def _pairing_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the pairings in the order of their first mount, and what would be left to fit if some poses were held out."""
    rows = [
        f"  {' '.join(pairing[key] for key in BAR_MOUNTED):<32} {counted(pairing['poses'], 'pose'):>9}"
        for pairing in document["pairings"]
    ]
    held_out = [_hold_out(one, document) for one in document["hold_outs"]]
    return ["pairings:", *rows, *(["rows that truearm identify can hold out:"] if held_out else []), *held_out]


def _hold_out(one: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    seed = f" --seed {one['seed']}" * (one["seed"] > 0)
    gone = [name for name in one["all_held_out"] if name != one["hold_out"]]
    words = f"--hold-out {one['hold_out']}{seed}"
    without = f", none with {', '.join(gone)}" * bool(gone)
    return (
        f"  {words:<32} {counted(one['poses'], 'pose'):>9} held out; "
        f"left to fit: rank {one['rank']} of {document['rank']}{without}"
    )


def _against_drift(document: Mapping[str, Any]) -> list[str]:
    if document["visits"] > 1:
        return [f"every mount is visited {document['visits']} times, to reveal drift and slip"]
    if document["check_poses"]:
        return [
            f"{document['check_poses']} check poses of the first mount, visited again half-way and at the end, to reveal drift"
        ]
    return []


def _fewer_checks(document: Mapping[str, Any], asked: int | None) -> list[str]:
    """Return why there are fewer check poses than were asked for."""
    if asked is None or document["check_poses"] >= asked:
        return []
    if document["visits"] > 1:
        return [f"--check-poses {asked} is not used: with several visits of every mount there are no check poses"]
    return [
        f"--check-poses {asked}: {document['check_poses'] or 'none'} planned: at most one per 36 poses, and none below 108 poses"
    ]


def _known_after(document: Mapping[str, Any]) -> list[str]:
    lines = [f"rank {document['rank']}; predicted sigmas after {counted(document['rows'], 'observation')}:"]
    lines += [f"  {parameter['name']:<24}{_in_words(parameter)}" for parameter in document["parameters"]]
    defaults = document["defaults"]
    for names, what in (
        (defaults["base"] + defaults["tool"], "held, because these fixtures cannot determine them in any pose"),
        (defaults["lost"], "held, because their joints hardly move"),
        (defaults["believed"], "with a weak prior, because they are weakly identifiable"),
    ):
        if names:
            lines.append(f"{what}: {', '.join(names)}")
    if document["null_space"] or document["hardly_seen"]:
        lines.append("combinations of parameters, with weights in m, rad and 1:")
    for key, what in (("null_space", "unidentifiable"), ("hardly_seen", "weakly identifiable")):
        lines += [f"{what}: {_direction(direction)}" for direction in document[key]]
    if "poses" in document and document["poses"] < document["rank"] + len(document["null_space"]):
        lines.append(
            f"Next: {counted(document['poses'], 'pose is', 'poses are')} fewer than the unknowns; plan more poses, or fewer mounts with --bar NAME."
        )
    return lines


def _direction(weights: Mapping[str, float]) -> str:
    """Format its largest terms; --json has all."""
    terms = largest_terms(weights.values(), weights)
    rest = f" and {counted(len(terms) - MAX_TERMS, 'other')}" * (len(terms) > MAX_TERMS)
    return " ".join(f"{weight:+.2f}·{name}" for weight, name in terms[:MAX_TERMS]) + rest


def _region(document: Mapping[str, Any]) -> list[str]:
    if document["cartesian_rms_mm"] is None:
        return ["error in the region: unknown, an unidentifiable combination moves the tool"]
    relative = " (excluding the pose of the base)" * document["cartesian_relative"]
    return [
        f"error in the region: {document['cartesian_rms_mm']:.3f} mm RMS, "
        f"{document['cartesian_worst_mm']:.3f} mm at its worst pose{relative}"
    ]


def _in_words(parameter: Mapping[str, Any]) -> str:
    sigma = parameter["sigma"]
    return "unidentifiable" if sigma is None else f"± {UNITS[parameter['unit']].scale.text(sigma, '.2g')}"
