"""What ``truearm identify`` prints: parameters in mm and deg, unidentifiable combinations, errors, what to do next.

All of it comes from the content of result.json, so that what is printed and what is stored cannot differ.
"""

from __future__ import annotations

import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, assert_never

from rich.console import Console
from rich.table import Table

from truearm.cli.outlier_text import suspects
from truearm.estimate.solvers import SOLVERS, Loss, Prior
from truearm.report.law_words import law_sentences, law_steps
from truearm.report.parameter_cells import parameter_cells
from truearm.report.result_words import (
    CHI2_DOUBTFUL,
    SIMULATED,
    SMALLEST_WEIGHT,
    all_identifiable,
    copy_sentences,
    displacement_sentences,
    drawing,
    gain_words,
    kind_name,
    parts_words,
    pose_error_words,
    time_offset,
    unexplained_words,
    zero_sentences,
)
from truearm.report.suspect_words import bad_row_sentences
from truearm.report.systematic_words import hardly_matters, systematic_sentences
from truearm.report.usability_words import few_freedom, freedom_words, usability_sentences, wrong_first
from truearm.results import MeanError, PoseError, ResidualParts, Unusable, chi2_text, largest_terms
from truearm.session.dwells import DOUBTFUL, NEED_DECISION
from truearm.text import counted, one_line, outcome
from truearm.units import MM, SUFFIXES, UNITS, from_shown, size, title

Document = Mapping[str, Any]

MAX_DIRECTIONS = 6
WEIGHTS = "; weights in m, rad and 1:"  # of directions
MAX_TERMS = 4
MAX_NAMES = 12
PLACES = (".x", ".y", ".z", ".rx", ".ry", ".rz")  # numbers of a place


class ResultFiles(NamedTuple):
    """Files of an identification: those it read, where its result was written, and the others that were written."""

    inputs: Sequence[Path]
    out: Path | None
    others: Sequence[Path] = ()


def show_result(document: Document, files: ResultFiles) -> None:
    """Print the content of a result.json, the session to relabel, and the files that were written."""
    # No markup, because names come from files. Into a pipe, rich would wrap at 80 columns.
    width = None if sys.stdout.isatty() else 120
    console = Console(markup=False, highlight=False, emoji=False, width=width)
    if document["simulated"]:
        console.print(SIMULATED)
    for line in (*usability_sentences(document, _option), *not_converged(document), *little_freedom(document)):
        console.print(line)
    for line in (*zero_sentences(document), *bad_row_sentences(document, _option)):
        console.print(line)
    for line in () if hardly_matters(document) else systematic_sentences(document, _option):
        console.print(line)
    for line in (*copy_sentences(document), *dwell_lines(document, files.inputs)):
        console.print(line)
    console.print(headline(document))
    console.print(how(document))
    for line in held(document):
        console.print(line)
    console.print(_parameter_table(document))
    for line in unseen(document):
        console.print(line)
    for suffix in document["residual_units"]:
        console.print(_error_table(document, suffix))
        if steps := law_steps(document, suffix):
            console.print(_law_table(steps, SUFFIXES[suffix].symbol))
    if _says_nothing(document):
        console.print(
            '"-": with so few degrees of freedom, the fit follows the noise too: its residuals show no error.'
        )
    if hardly_matters(document):
        for line in systematic_sentences(document, _option):
            console.print(line)
    notes = (
        law_sentences,
        raw,
        timing,
        chi2_notes,
        suspects,
        held_out_notes,
        predicted,
        displacement_sentences,
        seen,
    )
    for line in (line for words in notes for line in words(document)):
        console.print(line)
    for line in advice(document, files):
        console.print(line)


def not_converged(document: Document) -> list[str]:
    """Return what to do about a fit that did not converge."""
    if document["status"] == "converged" or SOLVERS[document["solver"]].ends_by_recipe or document["explanations"]:
        return []
    line = "Its parameters and errors are meaningless."
    if any(re.fullmatch(r"(.*\.)?line\.[^.]*\.rx", parameter["name"]) for parameter in document["parameters"]):
        line += (
            " A straight line hardly determines the roll of its device: give the roll in the rig, with turn_sigma_deg."
        )
    if document["hardly_seen"] and document["prior"] == Prior.NONE:
        return [f"{line} Weakly identifiable parameters slow a fit down: give --prior weak."]
    raised = ", or raise --max-iterations" if document["status"] == "max_iterations" else ""
    return [f"{line} Check the units, the order and signs of the joints, and the labels{raised}."]


def little_freedom(document: Document) -> list[str]:
    """Return a warning if the residuals have fewer degrees of freedom than parameters were fitted."""
    none = document["unusable_because"] == Unusable.NO_FREEDOM  # which has its own sentence
    if none or not _says_nothing(document):
        return []
    unknowns = any(one["of"] == "rig" and one["free"] for one in document["parameters"])
    few = freedom_words(document["chi2_freedom"], document["rank"], unknowns)
    return [f"{few} Measure more rows, and hold some of them out."]


def _option(argument: str) -> str:
    return f"--{argument.replace('_', '-')}"


def dwell_lines(document: Document, inputs: Sequence[Path]) -> list[str]:
    """Return a line per session: how its dwells and lines were used; a command names the session as it was given."""
    lines, given = [], {path.name: str(path) for path in inputs}
    for count in document.get("sessions", ()):
        passes = f"{count['lines_used']} of {counted(count['lines'], 'line')} used{_rejected(count['lines_rejected'])} (points are named PASS.POINT)"
        if count["lines"] and not count["with_bar"]:
            lines.append(f"{one_line(count['session'])}: {passes}")
            continue
        line = f"{one_line(count['session'])}: {count['used']} of {counted(count['dwells'], 'dwell')} used"
        stops = count["mountings"]
        line += f" (numbered 1 to {count['dwells'] + stops} with {counted(stops, 'stop')} for mounting)" * bool(stops)
        line += _rejected(count["rejected"])
        unsettled = sum(n for reason, n in count["rejected"].items() if reason in NEED_DECISION)
        if unsettled:
            session = one_line(given.get(count["session"], count["session"]))
            none_fits = not count["used"] and set(count["rejected"]) == {DOUBTFUL}
            line += (
                "; none fits: check that robot and rig are those that were measured; if so, "
                if none_fits
                else f"; {unsettled} need a decision: "
            )
            line += f"truearm session relabel {shlex.quote(session)}"
        lines.append(line + " (as relabelled)" * count["labels"] + f"; {passes}" * bool(count["lines"]))
    return lines


def _rejected(reasons: Mapping[str, int]) -> str:
    return f"; rejected: {', '.join(f'{n} {reason}' for reason, n in reasons.items())}" * bool(reasons)


def headline(document: Document) -> str:
    """Return one line: the robot, the observations, how the solver ended."""
    fitted: dict[str, int] = {}
    for entry in document["observations"]:
        fitted[entry["kind"]] = fitted.get(entry["kind"], 0) + entry["fitted"]
    kinds = ", ".join(f"{n} {kind}" for kind, n in fitted.items() if n)
    held = sum(k["held_out"] for k in document["observations"])
    rows = f"{kinds} {'row' if sum(fitted.values()) == 1 else 'rows'} fitted" + (f", {held} held out" if held else "")
    robot, end = one_line(document["robot"]["name"]), outcome(document["status"], document["iterations"])
    return f"{robot}: {rows}; {end}; rank {document['rank']} of {document['n_free']} free"


def how(document: Document) -> str:
    """Return one line: the solver and its prior."""
    loss = "" if document["loss"] == Loss.LINEAR else f", {document['loss']} loss"
    return f"Solved by {document['solver']} {_prior(document)}{loss}."


def _prior(document: Document) -> str:
    match Prior(document["prior"]):
        case Prior.NONE:
            return "without a prior"
        case Prior.WHERE_NEEDED:
            believed = document["defaults"]["believed"]
            return f"with a weak prior on {_names(believed)}, weakly identifiable here (--prior none turns it off)"
        case Prior.WEAK | Prior.WIDE as name:
            return f"with a {name} prior on the robot's parameters"
        case never:
            assert_never(never)


def held(document: Document) -> list[str]:
    """Return what is held by default: a choice of frame, and joints that do not move."""
    defaults = document["defaults"]
    lines = []
    frames = {"the pose of the base": defaults["base"], "the mounting of the tool": defaults["tool"]}
    if any(frames.values()):
        what = " and ".join(f"{words} ({_names(names)})" for words, names in frames.items() if names)
        lines.append(
            f"Held at the nominal values, because such observations cannot determine them in any pose: {what}."
        )
    for joint in defaults["still"]:
        spread = UNITS[joint["unit"]].scale.text(joint["spread"], ".2f")
        lines.append(
            f"{one_line(joint['joint'])} moves by only {spread}, too little to identify its axis; move it more."
        )
    if defaults["lost"]:
        lines.append(f"Therefore also held at the nominal values: {_names(defaults['lost'])}.")
    return lines


def _names(names: list[str]) -> str:
    shown = ", ".join(one_line(name) for name in names[:MAX_NAMES])
    return shown + (f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else "")


def _parameter_table(document: Document) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("parameter", overflow="fold")
    for column in ("nominal", "value", "change", "sigma"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("unit")
    for parameter in document["parameters"]:
        if parameter["free"] and not parameter.get("law", False):
            table.add_row(*parameter_cells(parameter))
    return table


def _law_table(steps: list[tuple[str, str, str]], unit: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(f"joint laws [{unit}]")
    for column in ("fitted, RMS", "held out, mean"):
        table.add_column(column, justify="right", no_wrap=True)
    for step in steps:
        table.add_row(*step)
    return table


def unseen(document: Document) -> list[str]:
    """Return the unidentifiable and the weakly identifiable combinations, a line each."""
    directions, weak = document["null_space"], document["hardly_seen"]
    if not directions and not weak:
        return [all_identifiable(document["prior"], document["defaults"]["believed"])]
    lines = []
    if directions:
        what = counted(len(directions), "combination")
        are, them = ("is", "it") if len(directions) == 1 else ("are", "them")
        lines.append(f"{what} of parameters {are} unidentifiable; predictions do not depend on {them}{WEIGHTS}")
        lines += _directions(directions, "null_space")
    if weak:
        lines.append(
            f"{counted(len(weak), 'combination')} of parameters {'is' if len(weak) == 1 else 'are'} weakly identifiable: these observations determine "
            f"{'it' if len(weak) == 1 else 'them'} less accurately than a drawing does ({drawing(bool(timing(document)))}){WEIGHTS}"
        )
        lines += _directions(weak, "hardly_seen")
    return lines


def _directions(directions: list[Mapping[str, Any]], field: str) -> list[str]:
    lines = [f"  {direction_text(direction)}" for direction in directions[:MAX_DIRECTIONS]]
    if len(directions) > MAX_DIRECTIONS:
        lines.append(f"  and {len(directions) - MAX_DIRECTIONS} more ({field} in the JSON result)")
    return lines


def direction_text(direction: Mapping[str, Any]) -> str:
    """Format a null direction as "1.00 link1.z - 0.50 link2.z", its largest terms first."""
    terms = largest_terms(direction["weights"], direction["names"])
    shown = [(weight, name) for weight, name in terms[:MAX_TERMS] if abs(weight) >= SMALLEST_WEIGHT]
    words = [f"{'-' if weight < 0.0 else '+'} {abs(weight):.2f} {one_line(name)}" for weight, name in shown]
    return " ".join(words).removeprefix("+ ") + f" and {len(terms) - len(shown)} smaller" * (len(terms) > len(shown))


def _error_table(document: Document, suffix: str) -> Table:
    """Return the errors in the unit of ``suffix``: of the fitted rows, of each kind, of the held-out rows."""
    scale = SUFFIXES[suffix]
    before, after = f"rms_before_{suffix}", f"rms_after_{suffix}"
    decimals = UNITS[scale.si].decimals
    table = Table(box=None, pad_edge=False)
    table.add_column(title("error", scale.si))
    for column in ("before", "after", "rows"):
        table.add_column(column, justify="right")
    entries = [entry for entry in document["observations"] if entry[after] is not None]
    says_nothing = _says_nothing(document)
    if entries:
        rows = str(sum(entry["fitted"] for entry in entries))
        fitted = _cell(None if says_nothing else document[after], decimals)
        table.add_row("fitted, RMS", _cell(document[before], decimals), fitted, rows)
    for entry in entries if len(document["observations"]) > 1 else ():
        fitted = _cell(None if says_nothing else entry[after], decimals)
        cells = (_cell(entry[before], decimals), fitted, str(entry["fitted"]))
        table.add_row(f"  {_of(entry)}", *cells)
    held_out, held_out_before = (document[name] or {} for name in ("held_out", "held_out_before"))
    if held_out.get(f"n_{suffix}"):
        for figure, words in (("rms", "RMS"), ("mean", "mean"), ("max", "largest")):
            numbers = (_cell(of.get(f"{figure}_{suffix}"), decimals) for of in (held_out_before, held_out))
            table.add_row(f"held out, {words}", *numbers, str(held_out[f"n_{suffix}"]))
    return table


def _says_nothing(document: Document) -> bool:
    return few_freedom(document["chi2_freedom"], document["rank"])


def _of(entry: Mapping[str, Any]) -> str:
    """Return a kind of observation, and its rig if there are several."""
    return one_line(f"{entry['rig']}: {kind_name(entry['kind'])}" if entry["rig"] else kind_name(entry["kind"]))


def predicted(document: Document) -> list[str]:
    """Return the predicted error of the tool."""
    error = document["predicted_error"]
    if document["status"] != "converged" or not document["usable"]:
        return []
    if document["unexplained"] is not None:
        tool = (MM.to_si(error["rms_mm"]), error["n"]) if error else None
        would_be = document["without_systematic"]
        moves = (
            None
            if would_be is None
            else math.nan
            if would_be["tool_moves_mm"] is None
            else MM.to_si(would_be["tool_moves_mm"])
        )
        bad = document["without_bad_rows"]
        without_bad = None if bad is None else MM.to_si(bad["tool_moves_mm"])
        return unexplained_words(_unexplained(document["unexplained"]), moves, tool, without_bad)
    if error is None:
        return [
            "The tool error cannot be predicted: unidentifiable or weakly identifiable combinations would move the tool."
        ]
    where = " (excluding the pose of the base)" if error["relative"] else ""
    return [
        f"Tool error predicted from these sigmas: {_cell(error['rms_mm'])} mm RMS over {counted(error['n'], 'pose')}{where}, at most "
        f"{_cell(error['max_mm'])} mm, at {one_line(error['at'])}."
    ]


def _unexplained(error: Document) -> dict[str, MeanError]:
    """Return the mean errors of poses that were not fitted, by SI unit."""
    found = {}
    for unit in (SUFFIXES[name[5:]] for name in error if name.startswith("mean_")):
        mean, low, high = (from_shown(error[f"{name}_{unit.suffix}"], unit.si) for name in ("mean", "low", "high"))
        found[unit.si] = MeanError(mean, low, high, error[f"n_{unit.suffix}"], error["by"] == "held out")
    return found


def seen(document: Document) -> list[str]:
    """Return the observability indices of the suggested free set."""
    indices = document["observability"]
    if indices is None or any(value is None for value in indices.values()):
        return []
    named = ", ".join(f"{name.upper()} {value:.3g}" for name, value in indices.items())
    return [f"Observability of {counted(len(document['suggested_free']), 'parameter')}: {named} (larger is better)."]


def raw(document: Document) -> list[str]:
    """Return what "before" means, and the errors without fitting base and tool, if they differ."""
    units = [SUFFIXES[suffix] for suffix in document["residual_units"]]
    before, as_described = ([document[f"{name}_{unit.suffix}"] for unit in units] for name in ("rms_before", "rms_raw"))
    placed = _placed(document)
    if before == as_described:
        of_rig = f" with {_names(placed)} fitted to these rows" if placed else ""
        return [f'"Before" is the nominal robot{of_rig}.']
    sizes = " and ".join(size(rms, unit) for unit, rms in zip(units, as_described, strict=True))
    fitted = _names(["base and tool", *placed])
    return [f'"Before" is the nominal robot with {fitted} fitted; with base and tool as described: {sizes} RMS.']


def _placed(document: Document) -> list[str]:
    """Return the items of the rig that are fitted to the nominal robot too, because their places are unknown."""
    rig = [parameter["name"] for parameter in document["parameters"] if parameter["of"] == "rig" and parameter["free"]]
    return list(dict.fromkeys(name.rpartition(".")[0] for name in rig if name.endswith(PLACES)))


def timing(document: Document) -> list[str]:
    """Return the delay of the joint readings of each rig that has a time offset."""
    offsets = [p for p in document["parameters"] if p["unit"] == "s" and p["free"]]
    return [time_offset(one_line(p["name"]), p["value"], p["sigma"]) for p in offsets]


def chi2_notes(document: Document) -> list[str]:
    """Return χ² and its range; which part of the residuals declared noise explains; the error that rows of a pose share."""
    lines = []
    low, high = document["chi2_band"]
    chi2, by_chance = document["chi2_reduced"], False
    if None not in (low, high, chi2):
        by_chance = chi2 <= high
        where = "within" if low <= chi2 <= high else "above" if chi2 > high else "below"
        weighted = "" if document["loss"] == Loss.LINEAR else f" (rows weighted by the {document['loss']} loss)"
        less = ": the rows scatter less than their declared noise" if chi2 < low else ""
        lines.append(
            f"χ² per degree of freedom {chi2_text(chi2)}{weighted}, {where} its 95 % range of {low:.3g} to {high:.3g}{less}."
        )
    parts = {}
    for unit in (SUFFIXES[suffix] for suffix in document["residual_units"]):
        both = [document[f"rms_{name}_{unit.suffix}"] for name in ("declared", "unexplained")]
        if None not in both:
            parts[unit.si] = ResidualParts(*(from_shown(value, unit.si) for value in both))
    if not _says_nothing(document):
        lines += filter(None, [parts_words(parts, by_chance, document["loss"])])
    shared = document["pose_error"]
    if shared is not None:
        lines.append(pose_error_words(PoseError(MM.to_si(shared["sigma_mm"]), shared["row_variance"], shared["n"])))
    return lines


def held_out_notes(document: Document) -> list[str]:
    """Return the limits of the held-out error."""
    held_out, notes = document["held_out"], []
    gone = [one_line(name) for name in document["all_held_out"] if name not in document["held_out_by"]]
    if held_out and gone:
        other = f" If you did not intend this, hold out others{_proposal(document)}." * (
            document["hold_out_proposal"] is not None
        )
        notes.append(f"No row with {_names(gone)} is left in the fit.{other}")
    if held_out and held_out["n_settled"]:
        notes.append(
            f"{counted(held_out['n_settled'], 'unknown of the rig was', 'unknowns of the rig were')} estimated from the held-out rows themselves."
        )
    if held_out and held_out["n_left_out"]:
        notes.append(
            f"{counted(held_out['n_left_out'], 'held-out row is', 'held-out rows are')} not judged: unknowns of the rig fit such rows exactly."
        )
    if held_out is None and document["held_out_by"]:
        notes.append(
            "No held-out row can be judged: unknowns of the rig fit each of them exactly. Measure more rows there."
        )
    return notes


def _cell(value: float | None, decimals: int = UNITS["m"].decimals) -> str:
    """Format a number that is already in the unit of its column."""
    return "-" if value is None else f"{value:.{decimals}f}"


def advice(document: Document, files: ResultFiles) -> list[str]:
    """Return what to do next, a line each."""
    lines = []
    solver = SOLVERS[document["solver"]]
    if solver.ends_by_recipe:
        lines.append(f"The solver {one_line(document['message'])}.")
    doubtful = document["chi2_reduced"] is not None and document["chi2_reduced"] > CHI2_DOUBTFUL
    if doubtful and document["without_bad_rows"] is None:
        factor = math.sqrt(document["chi2_reduced"])
        # Least squares and robust losses read the noise from the residuals.
        read_off = solver.reads_noise or document["loss"] != Loss.LINEAR
        prior = ", or the prior is too tight" * (document["prior"] != Prior.NONE)
        lines.append(
            f"Residuals are {factor:.1f} times what the declared sigmas allow: the robot has errors that these parameters "
            f"do not model, or the sigmas are too small{prior}."
            + " The sigmas above follow from the declared noise alone."
            * (not read_off and document["pose_error"] is None)
        )
    unusable = document["unusable_because"]
    lines += [] if wrong_first(document) else further_measurements(document)
    if unusable not in (None, Unusable.NO_FREEDOM, Unusable.WORSE):  # which more rows mend
        lines.append("Next: correct what the first lines name, then identify again.")
    if unusable is None and not document["held_out_by"]:
        lines.append(f"Next: judge the result by held-out rows{_proposal(document)}.")
    if unusable is None and files.out is None:
        lines.append("Next: keep the result with --out result.json.")
    written = [*([files.out] if files.out else []), *files.others]
    return [*lines, *(f"Written: {one_line(str(path))}" for path in written)]


def _proposal(document: Document) -> str:
    """Return a hold-out that keeps rows of every combination in the fit."""
    proposed = document["hold_out_proposal"]
    if proposed is None:
        return " of other poses: these are too few to hold any out"
    seed = f" --seed {proposed['seed']}" * (proposed["seed"] > 0)
    n = proposed["combinations"]
    every = "" if n == 1 else f" and leaves at least half the rows of each of the {n} combinations of names in the fit"
    return f": --hold-out {proposed['fraction']:g}{seed} holds out {counted(proposed['rows'], 'row')}{every}"


def further_measurements(document: Document) -> list[str]:
    """Return the most useful proposal of each kind."""
    best: dict[str, Mapping[str, Any]] = {}
    for addition in document["additions"]:  # the most useful first
        best.setdefault(addition["kind"], addition)
    full_rank = document["rank"] == document["n_free"]
    return [
        f"Next: {one_line(a['text'])} {gain_words(len(a['parameters']), full_rank)}: {_few(a)}." for a in best.values()
    ]


def _few(addition: Mapping[str, Any]) -> str:
    names = [one_line(name) for name in addition["parameters"]]
    return ", ".join(names[:MAX_TERMS]) + (
        f" and {counted(len(names) - MAX_TERMS, 'other')}" if len(names) > MAX_TERMS else ""
    )
