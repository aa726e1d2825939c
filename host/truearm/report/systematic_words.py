"""The systematic errors of a fit in sentences, for the terminal and the page, from the content of result.json."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Any, assert_never

from truearm.results import DriftWith, ErrorForm, chi2_text
from truearm.text import counted, one_line
from truearm.units import DEGC, MM, UNITS

GRADUAL = "a gradual change of "  # begins a rival that is no form of ``Effect``
LITTLE = 0.1  # of the error to expect: a tool motion below it changes nothing that the calibration is used for


def hardly_matters(document: Mapping[str, Any]) -> bool:
    """Return whether the tool moves by less than LITTLE of the error to expect if the systematic errors are applied."""
    would_be, expected = document["without_systematic"], (document.get("unexplained") or {}).get("mean_mm")
    if would_be is None or would_be["tool_moves_mm"] is None or expected is None:
        return False
    return bool(would_be["tool_moves_mm"] < LITTLE * expected)


def systematic_sentences(document: Mapping[str, Any], argument: Callable[[str], str] | None = None) -> list[str]:
    """Return what is wrong, from which row, by how much, and what to do; empty if nothing was found.

    ``argument`` is the format of the arguments of an identification; None if they do not apply, as in a validation.
    """
    found, would_be = document["systematic"], document["without_systematic"]
    lines = [_sentence(entry) for entry in found]
    if would_be is None:
        return lines
    chi2, moves = would_be["chi2_reduced"], would_be["tool_moves_mm"]
    them = "it" if len(found) == 1 else "all of them"
    if argument is None:
        would = "" if chi2 is None else f" Without {them}, χ² per degree of freedom would be {chi2_text(chi2)}."
        return [*lines, f"Correct the error at its source, or judge the result by rows without it.{would}"]
    after = "" if chi2 is None else f" χ² per degree of freedom is then {chi2_text(chi2)}"
    moved = "" if moves is None else f", and the tool moves by {MM.text(MM.to_si(moves), '.3f')} RMS"
    held = (
        ""
        if would_be["held_out_ratio"] is None
        else f" The cross-validation error is then {would_be['held_out_ratio']:.3g} times as large."
    )
    little = " This is less than a tenth of the error to expect." if hardly_matters(document) else ""
    unknown = _undetermined(found)
    if unknown:  # a motion to first order says nothing about how far such numbers take the tool
        moved, little = ", but the tool is then as uncertain as these estimates", ""
    lines += unknown
    sure = [entry for entry in found if not other_items(entry)]
    apply = " ".join(
        f"{argument(name)} {shlex.quote(one_line(value))}" for entry in sure for name, value in entry["apply"].items()
    )
    if len(sure) == len(found):
        return [*lines, f"To apply {them}: {apply}.{after}{moved}.{little}{held}"]
    first = "With the first explanation" if len(found) == 1 else "With the first explanation of each error"
    return [
        *lines,
        "The rows do not show which of these explanations is right, and the position of the tool depends on it. Check the "
        f"items that they name, then estimate the error of the one that is wrong with {argument('allow')}."
        + f" Until then, apply only what is certain: {apply}."
        * bool(sure),
        f"{first}:{after.replace(' is then', ' is')}{moved}.{little}{held}",
    ]


def other_items(entry: Mapping[str, Any]) -> list[str]:
    """Return the rivals of a finding that are errors of other items: to apply the finding could then be wrong.

    Another form of an error of the same item, such as a gradual change in place of a step, is none of them.
    """
    return [name for name in entry["rivals"] if _item(name) != entry["what"]]


def _item(rival: str) -> str:
    what = rival.removeprefix(GRADUAL).partition("@")[0]
    endings = [drift.ending for drift in DriftWith if what.endswith(drift.ending)]
    return what.removesuffix(max(endings, key=len, default=""))


def _sentence(entry: Mapping[str, Any]) -> str:
    rows, others = _rows(entry), other_items(entry)
    freedom = counted(entry["freedom"], "degree of freedom", "degrees of freedom")
    gain = f"χ² falls by {entry['chi2_drop']:.4g} with {freedom}"
    match ErrorForm(entry["form"]):
        case ErrorForm.ROWS:
            error, estimated = f"{rows} do not fit the others", "Without them,"
        case ErrorForm.DRIFT | ErrorForm.BACKLASH | ErrorForm.SETTLING:
            error, estimated = f"{_what(entry)} {_linear(entry)} over {rows}", "Estimating this error:"
        case ErrorForm.OFFSET:
            error, estimated = f"{_what(entry)} is off by {_size(entry)} in {rows}", "Estimating this error:"
        case form:
            assert_never(form)
    rivals = [_rival(name) for name in entry["rivals"]]
    if others:
        estimated = "Without the rows," if entry["form"] == ErrorForm.ROWS else "Estimating the first:"
        return f"Systematic error: {error}; or, nearly as well supported: {', or '.join(rivals)}. {estimated} {gain}."
    also = f" Other possible explanations: {', '.join(rivals)}." * bool(rivals)
    return f"Systematic error: {error}. {estimated} {gain}.{also}"


def _rival(name: str) -> str:
    """Return another explanation in words, with the name that ``allow`` takes if it has one."""
    text = one_line(name)
    if text.startswith(GRADUAL):
        return text
    if re.fullmatch(r"rows \d+ to \d+", text):
        return f"bad {text}"
    what, _, rows = text.partition("@")
    first, _, last = rows.partition(":")
    where = f" in rows {first} to {last}" if last else f" from row {first} on" if first else " in all rows"
    for drift in DriftWith:
        if what.endswith(drift.ending):
            return f"{_linear_rival(what.removesuffix(drift.ending), drift)}{where} ({text})"
    return f"a constant error of {what}{where}" + f" ({text})" * bool(rows)


def _linear_rival(what: str, drift: DriftWith) -> str:
    match drift:
        case DriftWith.TIME:
            return f"a drift of {what} linear in time"
        case DriftWith.TEMPERATURE:
            return f"a drift of {what} linear in the temperature"
        case DriftWith.DIRECTION:
            return f"a backlash of {what}"
        case DriftWith.MOVE:
            return f"an error of {what} in proportion to its last move"
        case never:
            assert_never(never)


def _rows(entry: Mapping[str, Any]) -> str:
    """Return the rows that an error concerns, and how far off the first and the last may be.

    If one may be off by more rows than these are, the error is not located.
    """
    first, last = entry["rows"]
    off = [
        max(row - within[0], within[1] - row)
        for row, within in ((first, entry["first_within"]), (last, entry["last_within"]))
    ]
    if max(off) > last - first:
        of = f"rows {entry['first_within'][0]} to {entry['last_within'][1]}"
        best = f"rows {first} to {last}"
        return f"some of {of}" if best == of else f"some of {of} ({best} fit best, but others fit nearly as well)"
    places = one_line(entry["from"]) if first == last else f"{one_line(entry['from'])} to {one_line(entry['to'])}"
    begins, ends = (f"{row}±{by}" if by else str(row) for row, by in zip((first, last), off, strict=True))
    return f"rows {begins} to {ends} (in the files: {places})"


def _linear(entry: Mapping[str, Any]) -> str:
    """Return what an item does that is linear in the box's temperature, in time, or in a joint's direction."""
    match DriftWith(entry["drifts_with"]):
        case DriftWith.TEMPERATURE:
            varies = DEGC.text(entry["over_degc"], ".1f")
            return f"drifts with the box's temperature (which varies by {varies}) by {_size(entry)}"
        case DriftWith.TIME:
            seconds = entry["over_s"]  # None: in the order of the rows
            return f"drifts linearly {'' if seconds is None else f'in {round(seconds / 60.0)} min '}by {_size(entry)}"
        case DriftWith.DIRECTION:
            return f"has a backlash of {_size(entry)}"
        case DriftWith.MOVE:
            return (
                f"is off in proportion to its last move: the error changes by {_size(entry)} from the largest negative to the "
                "largest positive move (read before the arm stood still?),"
            )
        case drift:
            assert_never(drift)


def _what(entry: Mapping[str, Any]) -> str:
    return one_line(str(entry["what"]))


def _size(entry: Mapping[str, Any]) -> str:
    unit = UNITS[entry["unit"]]
    if entry["size"] is None or entry["sigma"] is None:
        return "an amount that cannot be determined"
    off_by = entry.get("off_by", ())
    if any(map(hardly_determined, off_by)):
        return ", ".join(_number(of, named=len(off_by) > 1) for of in off_by)
    return f"{unit.scale.text(entry['size'], '.3g')} (σ {unit.scale.text(entry['sigma'], '.1g')})"


def hardly_determined(off_by: Mapping[str, Any]) -> bool:
    """Return whether the rows determine a number of an item less accurately than a drawing does."""
    return off_by["sigma"] is None or bool(off_by["sigma"] > UNITS[off_by["unit"]].weak_sigma)


def _number(off_by: Mapping[str, Any], named: bool) -> str:
    """Return the name, size and σ of a number that is off; a size within its large σ would say nothing."""
    name = f"{one_line(off_by['name']).rpartition('.')[2]} " if named else ""
    value, sigma = off_by["value"], off_by["sigma"]
    unknown = f"{name}not determined" if named else "an amount that is not determined"
    scale = UNITS[off_by["unit"]].scale
    if value is None or sigma is None:
        return unknown
    if hardly_determined(off_by) and abs(value) < 2.0 * sigma:
        return f"{unknown} (σ {scale.text(sigma, '.2g')})"
    return f"{name}{scale.text(value, '.3g')} (σ {scale.text(sigma, '.1g')})"


def _undetermined(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what follows for the tool from items that are off in all rows by a hardly determined amount."""
    of = [
        one
        for one in found
        if one["apply"].get("allow") == one["what"] and any(map(hardly_determined, one.get("off_by", ())))
    ]
    if not of:
        return []
    names = [str(number["name"]) for one in of for number in one["off_by"] if hardly_determined(number)]
    them = "it" if len(names) == 1 else "them"
    return [
        f"These rows hardly determine {', '.join(map(one_line, names))}, and the position of the tool depends on {them}. Measure "
        f"{them}, and correct the rig."
    ]
