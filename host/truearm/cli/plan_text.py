"""The tables of ``truearm plan --details``, from the document that ``--json`` prints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich.table import Table

from truearm.cli.findings_text import table_of
from truearm.report.result_words import direction_text
from truearm.types import BAR_MOUNTED
from truearm.units import UNITS

Document = Mapping[str, Any]

LINES = ("line", "from/mm ", "to/mm ", "rotation_rad ", "expected error/mm")
HOLD_OUTS = ("can be held out", "poses", "rank of the fitted", "none left with ")
CURVES = ("error curve", "sigma/mrad", "in ranges/deg ", "not determined/deg ")


def tables(document: Document) -> Iterator[Table | str]:
    """Return lines or pairings, what can be held out, the predicted sigmas, combinations, error curves."""
    if "lines" in document:
        yield table_of(LINES, map(_line, document["lines"]))
    else:
        pairings = (([row[key] for key in BAR_MOUNTED], row["poses"]) for row in document["pairings"])
        yield table_of(("pairing", "poses"), ((" ".join(names), poses) for names, poses in pairings))
        if document["hold_outs"]:
            yield table_of(HOLD_OUTS, map(_hold_out, document["hold_outs"]))
    yield table_of(("parameter", "predicted sigma "), map(_sigma, document["parameters"]))
    if document["null_space"] or document["hardly_seen"]:
        yield "Combinations of parameters, with weights in m, rad and 1:"
    for key, words in (("null_space", "unidentifiable"), ("hardly_seen", "weakly identifiable")):
        yield from (f"{words}: {direction_text(direction.values(), direction)}" for direction in document[key])
    if document.get("curves"):
        yield table_of(CURVES, map(_curve, document["curves"]))
        yield "Outside these ranges, corrections use geometry and sag alone. Curves and sag add to the other sigmas."


def _line(row: Document) -> tuple[str, ...]:
    ends = [", ".join(f"{v:.0f}" for v in row[end]) for end in ("from_mm", "to_mm")]
    return row["line"], *ends, ", ".join(f"{v:.4f}" for v in row["rotation_rad"]), f"{row['a_priori_mm']:.1f}"


def _hold_out(row: Document) -> tuple[object, ...]:
    seed = f" --seed {row['seed']}" * (row["seed"] > 0)
    gone = [name for name in row["all_held_out"] if name != row["hold_out"]]
    return f"--hold-out {row['hold_out']}{seed}", row["poses"], row["rank"], ", ".join(gone) or "-"


def _sigma(parameter: Document) -> tuple[str, str]:
    name, unit, sigma = (parameter[key] for key in ("name", "unit", "sigma"))
    return name, "unidentifiable" if sigma is None else f"± {UNITS[unit].scale.text(sigma, '.2g')}"


def _curve(curve: Document) -> tuple[str, ...]:
    ranges = [
        f"{row['lower_deg']:.0f} to {row['upper_deg']:.0f} (± {row['sigma_mrad']:.2g})" for row in curve["ranges"]
    ]
    gaps = ", ".join(f"{low:.0f} to {high:.0f}" for low, high in curve["unseen_deg"])
    return curve["joint"], f"± {curve['sigma_mrad']:.2g}", ", ".join(ranges), gaps or "-"
