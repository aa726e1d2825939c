"""The tables and sentences of a page: parameters, unidentifiable directions, facts, steps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from truearm.report.page_parts import table
from truearm.report.page_text import ABSENT, escape, figures, number
from truearm.report.result_words import SMALLEST_WEIGHT, drawing
from truearm.results import Estimate, NullDirection, largest_terms
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
    """Return rank and null space in words, as HTML."""
    of = int(estimate.free[: estimate.n_robot_parameters].sum())
    held = estimate.n_robot_parameters - of
    gap = (
        f" The weakest of these is a factor of {figures(estimate.rank_gap, 2)} above the unidentifiable ones."
        if math.isfinite(estimate.rank_gap)
        else ""
    )
    words = [
        f"The observations determine <strong>{estimate.rank} of {of}</strong> combinations of the robot's free parameters."
        f"{gap}"
    ]
    if held:
        words.append(f"{counted(held, 'parameter is', 'parameters are')} held fixed at the nominal value.")
    if not estimate.null_space:
        words.append("The observations alone identify all free parameters.")
        return f"<p>{' '.join(words)}</p>" + _hardly(estimate)
    words.append(
        "The changes listed here (in m, rad and 1) do not change any prediction. The values of their parameters are one choice "
        "of many with the same predictions, and are meaningful only together."
    )
    return f"<p>{' '.join(words)}</p>" + _directions(estimate.null_space) + _hardly(estimate)


def _hardly(estimate: Estimate) -> str:
    """Return what is determined less well than by a drawing; "" if there is nothing of this kind."""
    directions = estimate.hardly_seen
    if not directions:
        return ""
    one = len(directions) == 1
    timed = any(unit == "s" and free for unit, free in zip(estimate.units, estimate.free, strict=True))
    words = (
        f"{counted(len(directions), 'combination')} of parameters {'is' if one else 'are'} weakly identifiable: the observations "
        f"alone determine {'it' if one else 'them'} less accurately than a manufacturer's drawing ({drawing(timed)})."
    )
    return f"<p>{words}</p>" + _directions(directions, "alone")


def _directions(directions: Sequence[NullDirection], single: str = "unidentifiable") -> str:
    items = [f"<li>{escape(direction_words(d, single), 600)}</li>" for d in directions[:MAX_DIRECTIONS]]
    if len(directions) > MAX_DIRECTIONS:
        items.append(f"<li>and {len(directions) - MAX_DIRECTIONS} more</li>")
    return f'<ul class="directions">{"".join(items)}</ul>'


def direction_words(direction: NullDirection, single: str = "unidentifiable") -> str:
    """Return a direction in words: "link2.z up, link3.z down by as much"; ``single`` describes a lone parameter."""
    terms = largest_terms(direction.weights, direction.names)
    terms = [(weight, name) for weight, name in terms if abs(weight) >= SMALLEST_WEIGHT]
    if len(terms) == 1:
        return f"{terms[0][1]}: {single}"
    if len(terms) == 2 and abs(abs(terms[0][0]) - abs(terms[1][0])) < SMALLEST_WEIGHT:
        way = "up" if terms[0][0] * terms[1][0] > 0.0 else "down"
        return f"{terms[0][1]} up, {terms[1][1]} {way} by the same amount"
    shown = [f"{number(weight, 2, sign=True)} {name}" for weight, name in terms[:MAX_TERMS]]
    more = f" and {len(terms) - MAX_TERMS} smaller terms" if len(terms) > MAX_TERMS else ""
    return f"{' '.join(shown)}{more}"


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
