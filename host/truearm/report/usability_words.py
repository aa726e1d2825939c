"""Why a fit is not usable, and what would explain the observations, in sentences from the content of result.json."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, assert_never

from truearm.report.result_words import scale_sentence
from truearm.results import Gain, Unusable
from truearm.text import counted, one_line
from truearm.units import SUFFIXES, UNITS, size

Document = Mapping[str, Any]
MORE_POSES = "Measure more poses, in more of the workspace"
NUMBERED = " (rows numbered from 1 over all inputs)"


def few_freedom(freedom: float | None, rank: int) -> bool:
    """Return whether there are fewer degrees of freedom than fitted parameters: residuals then show no accuracy."""
    return freedom is not None and freedom < rank


def freedom_words(freedom: float, rank: int, unknowns: bool) -> str:
    """Return how few degrees of freedom there are; ``unknowns``: some of the rig were estimated too."""
    of_rig = " of the robot, besides the unknowns of the rig" * unknowns
    left = counted(round(freedom), "degree of freedom", "degrees of freedom")
    return f"Only {left} for {counted(rank, 'parameter')}{of_rig}: the residuals say nothing about accuracy."


def wrong_first(document: Document) -> bool:
    """Return whether inputs are to be corrected before more is measured.

    A fit that did not converge is one of these if it is explained or labels were searched: with right inputs it may only
    need more iterations.
    """
    because = document["unusable_because"]
    doubted = document["relabelling_search"] != "not needed" or bool(document["explanations"])
    wrong = (Unusable.WRONG_INPUTS, Unusable.RESIDUALS, Unusable.SCALE)
    return because in wrong or (because == Unusable.NOT_CONVERGED and doubted)


def usability_sentences(document: Document, argument: Callable[[str], str] = str) -> list[str]:
    """Return why the fit is not usable, then each explanation; empty for a usable fit that needs none.

    ``argument`` is the format of the arguments of an identification.
    """
    explanations = document["explanations"]
    lines = []
    because = document["unusable_because"]
    if because is not None:
        lines.append(f"This fit is not usable. {_because(Unusable(because), document)}")
        for joint in () if explanations else document["defaults"]["still"]:
            at = UNITS[joint["unit"]].scale.text(joint["at"], ".2f")
            lines.append(f"{one_line(joint['joint'])} reads {at} in all rows: if it moved, its readings are wrong.")
    else:
        lines += no_gain_sentences(document)
    if document["relabelling_search"] == "too many groups":
        lines.append(
            "Labels were not checked: the rows have too many different labels to search them all. Identify fewer at a time."
        )
    for i, one in enumerate(explanations):
        lead = "This explains the observations" if i == 0 else "This explains them too"
        text = one_line(one["text"])
        now, given = (_sizes(one, name) for name in ("rms", "rms_given"))
        fits = f"in a quick fit: RMS {now} with this change, {given} as given"
        if now == given:
            fits = f"RMS {now} in a quick fit either way; relative to their declared noise, the residuals are smaller with this change"
        apply = "".join(
            f"; correct this, or give {argument(name)} {one_line(value)}{NUMBERED if name == 'leave_out' else ''}"
            for name, value in (one["apply"] or {}).items()
        )
        lines.append(f"{lead}: {text} ({fits}){apply}.")
    if explanations:
        lines.append("Everything below is for the inputs as given.")
    return lines


def no_gain_sentences(document: Document) -> list[str]:
    """Return that the poses do not show a calibration to be better than the nominal robot; empty if it is better, or worse."""
    change = document["mean_change"]
    if change is None or change["gain"] != Gain.NONE:
        return []
    return [
        f"The calibration is not significantly better than {_errors_against(change)}. "
        f"{MORE_POSES}, or keep the nominal robot."
    ]


def _errors_against(change: Document) -> str:
    """Return the mean errors where nothing was fitted, of the calibrated robot and of the nominal one."""
    n = counted(max(change.get(f"n_{suffix}", 0) for suffix in SUFFIXES), "pose")
    poses = f"{n} held out" if change["by"] == "held out" else f"{n} left out in turn"
    after, before = (_sizes(change, f"mean_{name}") for name in ("after", "before"))
    return f"the nominal robot with base and tool placed: mean error {after} against {before}, for {poses}"


def _because(unusable: Unusable, document: Document) -> str:
    match unusable:
        case Unusable.NOT_CONVERGED:
            return f"It did not converge: {one_line(document['message'])}."
        case Unusable.NO_FREEDOM:
            return (
                "Its residuals have no degrees of freedom: the parameters fit any readings. Measure more rows, or free fewer "
                "parameters."
            )
        case Unusable.WRONG_INPUTS:
            return f"Its inputs are probably wrong. Residuals of {_sizes(document, 'rms_after')} RMS remain."
        case Unusable.RESIDUALS:
            return (
                f"Residuals of {_sizes(document, 'rms_after')} RMS remain, more than the errors of any arm. Check the robot, the units, the "
                "order and signs of the joints, the rig and the labels."
            )
        case Unusable.SCALE:
            return scale_sentence(document["scale"])
        case Unusable.WORSE:
            against = _errors_against(document["mean_change"])
            return f"It is worse than {against}. {MORE_POSES}, free fewer parameters, or keep the nominal robot."
        case never:
            assert_never(never)


def _sizes(of: Document, name: str) -> str:
    """Return a figure in each unit that it has."""
    found = []
    for suffix, scale in SUFFIXES.items():
        value = of.get(f"{name}_{suffix}") if suffix else None
        if value is not None:
            found.append(size(value, scale, 1))
    return " and ".join(found)
