"""The tables and sentences of a page: parameters, unidentifiable directions, facts, steps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from truearm.report.page_parts import sentences, table
from truearm.report.page_text import ABSENT, escape, figures, number
from truearm.report.result_words import direction_text, drawing
from truearm.results import Estimate, NullDirection
from truearm.text import counted
from truearm.units import UNITS

MAX_DIRECTIONS = 40
MAX_TERMS = 6


def parameter_table(estimate: Estimate, which: range) -> str:
    """Return nominal, identified, change and σ of the parameters ``which``, in mm, deg or 1."""
    titles = ("parameter", "nominal", "identified", "change", "σ", "unit", "")
    return table(titles, "".join(_parameter_row(estimate, i) for i in which), "parameters", "numbers")


def _parameter_row(estimate: Estimate, i: int) -> str:
    unit = UNITS[estimate.units[i]]
    nominal, value, sigma = (unit.factor * float(v[i]) for v in (estimate.nominal, estimate.value, estimate.sigma))
    free, seen = bool(estimate.free[i]), bool(estimate.free[i] and estimate.identifiable[i])
    said = free and (seen or estimate.units[i] != "s")  # an unidentifiable time offset may have any value
    cells = [
        number(nominal, unit.decimals),
        number(value, unit.decimals) if said else ABSENT,
        number(value - nominal, unit.decimals, sign=True) if said else ABSENT,
        _sigma(sigma, unit.decimals) if seen else ABSENT,
    ]
    first = i > 0 and _owner(estimate.parameter_names[i]) != _owner(estimate.parameter_names[i - 1])
    css, note = ("", "") if seen else ("unseen", "unidentifiable alone") if free else ("held", "held fixed")
    numbers = "".join(f"<td>{cell}</td>" for cell in cells)
    rest = f'<td class="unit">{unit.symbol or unit.si}</td><td class="note">{note}</td>'
    name = f'<th scope="row">{escape(estimate.parameter_names[i])}</th>'
    return f'<tr class="{css}{" first" if first else ""}">{name}{numbers}{rest}</tr>'


def _owner(name: str) -> str:
    return name.rpartition(".")[0]


def _sigma(sigma: float, decimals: int) -> str:
    """Return σ with the decimals of the value, or more if that would show zero."""
    return number(sigma, decimals) if not sigma < 5.0 * 10.0**-decimals else figures(sigma, 2)


def visibility(estimate: Estimate) -> str:
    """Return rank, null space and weakly identifiable combinations in words, as HTML."""
    free = int(estimate.free[: estimate.n_robot_parameters].sum())
    held = estimate.n_robot_parameters - free
    words = [
        f"The observations determine <strong>{estimate.rank} of {free}</strong> combinations of the robot's free parameters."
    ]
    if math.isfinite(estimate.rank_gap):
        gap = figures(estimate.rank_gap, 2)
        words.append(f"The weakest of these is a factor of {gap} above the unidentifiable ones.")
    if held:
        words.append(f"{counted(held, 'parameter is', 'parameters are')} held fixed at the nominal value.")
    timed = any(unit == "s" and is_free for unit, is_free in zip(estimate.units, estimate.free, strict=True))
    combinations = (
        (
            estimate.null_space,
            "Unidentifiable (weights in m, rad and 1). Changes along these combinations do not change any prediction, so the values are one choice of many.",
        ),
        (
            estimate.hardly_seen,
            f"Weakly identifiable: the observations alone determine these combinations less accurately than a manufacturer's drawing ({drawing(timed)}).",
        ),
    )
    listed = (f"<p>{text}</p>{_directions(directions)}" for directions, text in combinations if directions)
    return f"<p>{' '.join(words)}</p>{''.join(listed)}"


def _directions(directions: Sequence[NullDirection]) -> str:
    texts = [direction_text(of.weights, of.names, MAX_TERMS) for of in directions[:MAX_DIRECTIONS]]
    if len(directions) > MAX_DIRECTIONS:
        texts.append(f"and {len(directions) - MAX_DIRECTIONS} more")
    return sentences(texts, "directions")


def fact_list(facts: Sequence[tuple[str, str]]) -> str:
    """Return labels and values as a definition list."""
    entries = (f"<div><dt>{escape(name)}</dt><dd>{escape(value, 400)}</dd></div>" for name, value in facts)
    return f'<dl class="facts">{"".join(entries)}</dl>'


def step_table(steps: Sequence[tuple[str, float]]) -> str:
    """Return steps with their seconds and a bar in proportion."""
    total = sum(seconds for _, seconds in steps)
    longest = max((seconds for _, seconds in steps), default=0.0) or 1.0
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{number(seconds, 1)} s</td>'
        f'<td class="span"><span style="width:{100.0 * max(seconds, 0.0) / longest:.1f}%"></span></td></tr>'
        for name, seconds in steps
    )
    end = f'<tfoot><tr><th scope="row">total</th><td>{number(total, 1)} s</td><td></td></tr></tfoot>'
    return f'<table class="steps"><tbody>{rows}</tbody>{end}</table>'
