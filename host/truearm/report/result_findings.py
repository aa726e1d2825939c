"""The findings of an identification, from the content of result.json: the verdict first, what to do next last."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from statistics import NormalDist
from typing import Any

from truearm.estimate.outliers import MOST
from truearm.estimate.solvers import SOLVERS, Loss, Prior
from truearm.finding_texts import READ
from truearm.findings import Finding, findings_of, ordered, stated, worded
from truearm.report.result_tables import has_little_freedom, kind_name
from truearm.results import Gain, Unusable, chi2_text
from truearm.text import counted, listed, one_line
from truearm.types import DOUBTFUL, NEED_DECISION
from truearm.units import MS, SUFFIXES, UNITS, tolerances

Document = Mapping[str, Any]

CHI2_DOUBTFUL = 2.0  # residuals 1.4 times what the declared sigmas allow
HELD_OUT_DOUBTFUL = 1.5  # held-out RMS over fitted RMS
FAR_OFF = 10.0  # times a wide prior: 100 mm or 0.5 rad, beyond any arm, wherever it is bolted
IGNORED = 0.1  # weight by a robust loss: rows with less hardly count
OUTSIDE = 1e-3  # chance that any parameter of an arm as its prior says lies outside it
MAX_CHOICES = 6  # causes whose application is described
SETTLED = "estimated from the rows that judge"  # unknowns of the rig
SCATTER = {"shared": "shared by the rows of a pose", "turned": "of rotation shared by the rows of a pose"}
SMALL_SHARE = 0.5  # of the range of a sag: it is extrapolated by more than it was measured
MOST_GAPS = 4  # named
EVERY = ".all"  # ends the name of all items of a type
FORMS = {  # what an item does, by the form of a hypothesis; of another form, a kind's own, the name is shown
    "offset": "is off",
    "step": "has moved",
    "run": "was off for a while",
    "drift": "drifts",
    "settling_drift": "drifts and settles",
    "returning_drift": "drifts and returns",
    "growth": "grows",
    "settling_growth": "grows and settles",
    "returning_growth": "grows and returns",
    "backlash": "has backlash",
    "settling": "was read before it stood still",
    "eccentricity": "has an eccentric encoder",
    "hysteresis": "has hysteresis",
    "loose": "is loose",
}
NOISES = {
    "white": "independent",
    "order": "alike in neighbouring rows",
    "mount": "alike within a mount",
    "pose": "alike at similar poses",
}
PLACES = (".x", ".y", ".z", ".rx", ".ry", ".rz")  # numbers of a place
UNIT_RATIOS = {
    1000.0: "a thousand (metres and millimetres)",
    25.4: "25.4 (inches and millimetres)",
    39.37: "39.37 (inches and metres)",
    10.0: "ten (centimetres and millimetres)",
    100.0: "a hundred (metres and centimetres)",
}
SAME_RATIO = 0.02  # relative


def result_findings(document: Document) -> list[Finding]:
    """Return the findings: verdict, warnings, the error of the tool, notes, advice."""
    findings = [
        verdict(document),
        *audit(*(sizes(document[name] or {}, "rms") for name in ("held_out_before", "held_out_drawing", "held_out"))),
        *inputs(document),
        *(finding for finding in findings_of(document) if finding.code in READ),
        *little_freedom(document),
        *_doubts(document),
        *fault_findings(document),
        *_sessions(document),
        *tool_error(document),
        *_identified(document),
        *_residuals(document),
        *outliers(document),
        *law_findings(document),
        *_held_out(document),
    ]
    return ordered([*findings, *_advice(document)], document["simulated"])


# the verdict


def verdict(document: Document) -> Finding:
    """Return whether the result is usable, and how much better than the nominal robot."""
    change, because = document["mean_change"], document["unusable_because"]
    if because is not None:
        return _unusable(Unusable(because), document)
    if change is not None and change["gain"] == Gain.NONE:
        return Finding("no-gain", _change(change))
    judged, nominal, predicted = document["held_out"], document["held_out_before"], document["predicted_error"]
    if change is not None:
        values = _change(change)
    elif judged is not None and nominal is not None:
        values = {"after": sizes(judged, "rms"), "before": sizes(nominal, "rms")}
        values["rows"] = counted(judged["n"], "held-out row")
    else:
        values = {"unjudged": True, "rows": "the fitted rows"}
        values |= {name: sizes(document, f"rms_{name}") for name in ("after", "before")}
    if document["faults"] and predicted:
        unexplained = {} if _is_explained(document) else document["unexplained"] or {}
        error = {"mm": max(predicted["rms_mm"], unexplained.get("mean_mm") or 0.0)}
        applied = document.get("applied")
        values |= {"applied": applied, "remaining": error} if applied else {"expected": error}
    return Finding("usable", values)


def _change(change: Document) -> dict[str, Any]:
    """Return the mean errors where nothing was fitted, of the calibrated robot and of the nominal one."""
    return {**_judged(change), "after": sizes(change, "mean_after"), "before": sizes(change, "mean_before")}


def _judged(errors: Document) -> dict[str, Any]:
    """Return the number of poses that were not fitted, and how they were chosen."""
    by = "held out" if errors["by"] == "held out" else "left out in turn"
    return {"n": max(errors.get(f"n_{suffix}", 0) for suffix in SUFFIXES), "by": by}


def _unusable(because: Unusable, document: Document) -> Finding:
    if because is Unusable.WORSE:
        return Finding("worse-than-nominal", _change(document["mean_change"]))
    if because is Unusable.SCALE:
        scale = document["scale"]
        ratio = max(scale["factor"], 1.0 / scale["factor"]) if scale["factor"] > 0.0 else 1.0
        unit = [units for factor, units in UNIT_RATIOS.items() if abs(ratio / factor - 1.0) < SAME_RATIO]
        return Finding("robot-scale", {**scale, "unit": unit})
    if because in (Unusable.WRONG_INPUTS, Unusable.RESIDUALS):
        large = because is Unusable.RESIDUALS
        return Finding("wrong-inputs", {"after": sizes(document, "rms_after"), "large": large})
    return stated("not-converged" if because is Unusable.NOT_CONVERGED else "no-freedom", document)


# the inputs


def wrong_first(document: Document) -> bool:
    """Return whether inputs are to be corrected before more is measured.

    A fit that did not converge is one of these if other interpretations were tried: with right inputs it may only need
    more iterations.
    """
    because = document["unusable_because"]
    wrong = (Unusable.WRONG_INPUTS, Unusable.RESIDUALS, Unusable.SCALE)
    return because in wrong or (because == Unusable.NOT_CONVERGED and document["alternatives_tried"] > 0)


def inputs(document: Document) -> Iterator[Finding]:
    """Return what may be wrong with the inputs of a fit."""
    explanations = document["explanations"]
    if document["unusable_because"] and not explanations:
        for joint in document["defaults"]["still"]:
            yield Finding("still-joint", {"joint": joint["joint"], "reading": _size(joint["at"], joint["unit"])})
    for number, explanation in enumerate(explanations):
        with_change, without_change = (sizes(explanation, name) for name in ("rms", "rms_given"))
        smaller = any(with_change.get(unit, 0.0) < 0.5 * size for unit, size in without_change.items())
        values = {
            "lead": "This explains them too" if number else "This explains the observations",
            "with_change": with_change,
            "as_given": without_change if smaller else None,
            "place": not smaller and without_change != with_change,
            "noise": without_change == with_change,
        }
        yield Finding(explanation["code"], explanation["values"] | values)
    if document["status"] != "converged" and not SOLVERS[document["solver"]].ends_by_recipe and not explanations:
        is_line = any(re.fullmatch(r"(.*\.)?line\.[^.]*\.rx", entry["name"]) for entry in document["parameters"])
        is_weak = document["hardly_seen"] and document["prior"] == Prior.NONE
        is_limited = document["status"] == "max_iterations" and not is_weak
        yield Finding("meaningless", {"line": is_line, "weak": is_weak, "limit": is_limited})


def little_freedom(document: Document) -> list[Finding]:
    """Return a warning if the residuals have fewer degrees of freedom than parameters were fitted."""
    if document["unusable_because"] == Unusable.NO_FREEDOM or not has_little_freedom(document):
        return []
    rig = any(parameter["of"] == "rig" and parameter["free"] for parameter in document["parameters"])
    values = {"freedom": round(document["chi2_freedom"]), "rank": document["rank"], "rig": rig}
    return [Finding("little-freedom", values)]


def _doubts(document: Document) -> Iterator[Finding]:
    """Return joint zeros, bad rows, copies, residuals above the declared noise."""
    yield from joint_zeros(document)
    bad = document["without_bad_rows"]
    if bad is not None:
        values = {
            "n": bad["n"],
            "fitted": document["n_observations"],
            "after": sizes(bad, "rms_after", document["residual_units"]),
            "chi2": chi2_text(bad["chi2_reduced"]),
            "rows": named_rows(document["suspect"]),
            "most": MOST,
        }
        yield Finding("bad-rows", values)
    yield from copies(document)
    chi2 = document["chi2_reduced"]
    if chi2 is not None and chi2 > CHI2_DOUBTFUL and bad is None and not _is_explained(document):
        # Least squares and robust losses read the noise from the residuals.
        reads_noise = SOLVERS[document["solver"]].reads_noise or document["loss"] != Loss.LINEAR
        values = {
            "factor": math.sqrt(chi2),
            "prior": document["prior"] != Prior.NONE,
            "declared": not reads_noise and document["pose_error"] is None,
        }
        yield Finding("doubtful-residuals", values)
    yield from _outside_prior(document)


def _is_explained(document: Document) -> bool:
    """Return whether faults that are applied explain the residuals, which are those of the fit before."""
    applied, claim = set(document.get("applied") or ()), document.get("claim")
    causes = ({"mean", *(rival["apply"] for rival in fault["rivals"])} for fault in document["faults"])
    is_whole = bool(applied) and not any(map(applied.isdisjoint, causes))
    return is_whole and claim is not None and claim["noise"] == "declared" and claim["chi2_reduced"] <= CHI2_DOUBTFUL


def _outside_prior(document: Document) -> Iterator[Finding]:
    """Return a warning about robot parameters farther from the nominal robot than their prior allows.

    Those that a choice of frame moves, such as the last ones of the tool, also take up what the held ones are off.
    """
    prior, defaults = Prior(document["prior"]), document["defaults"]
    if prior is Prior.NONE:
        return
    moved = {name for frame in defaults["frames"] for name in frame["names"]}
    times: dict[str, float] = {}
    for entry in document["parameters"]:
        name, unit = entry["name"], UNITS[entry["unit"]]
        held = prior is not Prior.WHERE_NEEDED or name in defaults["believed"]
        if entry["of"] == "robot" and entry["free"] and "law" not in entry and held and name not in moved:
            sigma = unit.wide_sigma if prior is Prior.WIDE else unit.weak_sigma
            times[name] = abs(entry["value"] - entry["nominal"]) / sigma
    limit = NormalDist().inv_cdf(1.0 - OUTSIDE / (2.0 * max(len(times), 1)))
    names = sorted((name for name in times if times[name] > limit), key=times.__getitem__, reverse=True)
    if names:
        yield Finding("outside-prior", {"names": names, "times": times[names[0]], "wide": prior is Prior.WIDE})


def joint_zeros(document: Document) -> list[Finding]:
    """Return which joints count from another zero than described; empty if none does.

    The zeros of the first and the last joint place base and tool, so they do not count, and neither do whole turns.
    """
    joints = []
    robot = (entry for entry in document["parameters"] if entry["of"] == "robot" and entry["name"].endswith(".offset"))
    for offset in [] if document["unusable_because"] else [*robot][1:-1]:
        unit, change = offset["unit"], offset["value"] - offset["nominal"]
        change = math.remainder(change, 2.0 * math.pi) if unit == "rad" else change
        if offset["sigma"] is not None and abs(change) > FAR_OFF * UNITS[unit].wide_sigma:
            joints.append(f"{offset['name']} by {UNITS[unit].scale.text(change, '+.1f')}")
    return [Finding("joint-zeros", {"joints": joints})] if joints else []


def copies(document: Document) -> list[Finding]:
    """Return which rows were left out because they are copies; empty if there are none."""
    rows = [f"{row['source']} of {row['of']}" for row in document.get("copies", ())]
    return [Finding("copies", {"n": len(rows), "rows": rows})] if rows else []


def named_rows(rows: Sequence[Document]) -> list[str]:
    """Return rows with their distances."""
    return [f"{row['source']} ({row['distance']:.1f} σ)" for row in rows]


# faults


def fault_findings(document: Document, judging: bool = False) -> Iterator[Finding]:
    """Return what is wrong, since which row, by how much, and what applying it would give.

    ``judging``: the rows judge a calibration, so nothing can be applied.
    """
    faults, claim, applied = document["faults"], document.get("claim"), document.get("applied") or ()
    for fault in faults:
        yield _fault(fault)
        if not judging and not {"mean", *(rival["apply"] for rival in fault["rivals"])}.intersection(applied):
            yield _choice(fault)
    if judging and faults:
        yield Finding("faults-here", {"n": len(faults)})
    if applied:
        held = document["held_out"] and document["held_out"]["n"]
        yield Finding("faults-applied", {"names": applied, "held": held})
    if claim and claim["noise"] != "declared":
        refused = [cause(name) for name in claim["refused"]]
        noise = NOISES.get(claim["noise"], claim["noise"])
        yield Finding("noise-learned", {"noise": noise, "factor": claim["noise_factor"], "refused": refused})
    if claim and claim["unseen"]:
        hidden = [
            f"{cause(name)} by {' and '.join(_size(size, unit, '.2g') for unit, size in by_unit.items())}"
            for name, by_unit in claim["unseen"].items()
        ]
        yield Finding("faults-unseen", {"faults": hidden})


def cause(name: str) -> str:
    """Return a hypothesis in words: "chuck.c1.step" is "chuck.c1 has moved"."""
    item, _, form = name.rpartition(".")
    if item.endswith(EVERY):
        return f"all {one_line(item.removesuffix(EVERY))}s are off"
    return f"{one_line(item)} {FORMS.get(form, f'({one_line(form)})')}"


def _cause(rival: Document) -> str:
    """Return an explanation in words; that by which it is applied says how something drifts."""
    shaped = rival["apply"].rpartition(".")[2] in FORMS
    return cause(rival["apply"] if shaped else rival["name"])


def _fault(fault: Document) -> Finding:
    """Return a fault with its rivals."""
    first, *further = fault["rivals"]
    known = [size for size in fault["sizes"] if None not in (size["value"], size["sigma"])]
    values = {
        "what": _cause(first),
        "size": [f"{_size(s['value'], s['unit'], '.3g')} (σ {_size(s['sigma'], s['unit'], '.1g')})" for s in known],
        "rows": _rows(first),
        "others": [", ".join(filter(None, (_cause(rival), _rows(rival)))) for rival in further],
        "gain": _gain(first),
        "aliases": [cause(name) for name in fault["aliases"]],
    }
    return stated("fault", fault, **values)


def _rows(rival: Document) -> str:
    if rival["first"] is None:
        return ""
    places = " to ".join(dict.fromkeys(one_line(rival[name]) for name in ("from", "to")))
    return f"rows {rival['first']} to {rival['last']} (in the files: {places})"


def _gain(rival: Document) -> str:
    if rival["gain"] is None or rival["gain_t"] is None:
        return ""
    word = "fall" if rival["gain"] >= 0.0 else "rise"
    return f"the squares of left-out rows {word} by {abs(rival['gain']):.2g} of their sum ({rival['gain_t']:.1f} standard errors)"


def _choice(fault: Document) -> Finding:
    """Return what can be applied: what improves left-out rows, a single cause or the mean of several first."""
    rivals, several = fault["rivals"], len(fault["rivals"]) > 1
    items = [rival["name"].rpartition(".")[0] for rival in rivals]
    collective = [f"{item.removesuffix(EVERY)}s" for item in items if item.endswith(EVERY)][:1]
    lasting = not (rivals[0]["apply"] or collective)
    offers = [fault["mean"]] if several and all(rival["apply"] for rival in rivals) else []
    offers = [offer for offer in (*offers, *rivals) if offer["apply"] and (offer["gain"] or 0.0) > 0.0][:MAX_CHOICES]
    deciding, unjudged = fault["deciding"] if several else [], rivals[0]["gain"] is None
    if offers and not collective and not lasting:
        choices = "; ".join(
            f"{one_line(offer['apply'])}: the tool moves by {offer['moves_mm']:.3f} mm, its error is then "
            f"{offer['error_mm']:.3f} mm, and {_gain(offer)}"
            for offer in offers
        )
        return Finding("fault-choice", {"choices": choices, "first": offers[0]["apply"], "deciding": deciding})
    size = next((size for size in fault["sizes"] if collective and size["value"] is not None), None)
    values = {
        "few": not (collective or lasting) and unjudged,
        "worse": not (collective or lasting or unjudged),
        "lasting": lasting,
        "every": collective,
        "sigma": size and _size(size["value"] / math.sqrt(fault["freedom"]), size["unit"], ".2g"),
        "deciding": deciding,
    }
    return Finding("fault-choice", values)


# sessions, and the error of the tool


def _sessions(document: Document) -> Iterator[Finding]:
    """Return how the dwells and lines of each session were used, and what must be decided."""
    for count in document.get("sessions", ()):
        has_dwells, stops, rejected = count["with_bar"] or not count["lines"], count["mountings"], count["rejected"]
        dwells = {
            "used": str(count["used"]),
            "dwells": count["dwells"],
            "last": count["dwells"] + stops if stops else None,
            "stops": stops,
            "rejected": _counts(rejected),
            "relabelled": count["labels"],
        }
        lines = {"lines_used": str(count["lines_used"]), "lines_rejected": _counts(count["lines_rejected"])}
        values = lines | (dwells if has_dwells else dict.fromkeys(dwells))
        yield stated("session", count, **values)
        if n := has_dwells and sum(number for reason, number in rejected.items() if reason in NEED_DECISION):
            none_fits = not count["used"] and set(rejected) == {DOUBTFUL}
            values = {"session": count["session"], "n": n, "dwells": count["dwells"], "path": [count["session"]]}
            yield Finding("doubtful-dwells", {**values, "none_fits": none_fits})


def _counts(rejected: Mapping[str, int]) -> list[str]:
    return [f"{n} {reason}" for reason, n in rejected.items()]


def tool_error(document: Document) -> list[Finding]:
    """Return the error of the tool to expect: that averaged over what may be wrong.

    If the declared noise does not explain the residuals, it is the larger of this and the error of poses that were not
    fitted. If bad rows are in the fit, it is how far the tool moves without them.
    """
    if document["status"] != "converged" or not document["usable"]:
        return []
    predicted, shown, decomposition = document["predicted_error"], document["unexplained"], _decomposition(document)
    if shown is None or _is_explained(document):
        if predicted is None:
            return [Finding("tool-error-unpredictable")]
        largest = {"mm": predicted["max_mm"]}
        return [stated("tool-error", predicted, largest=largest, row=predicted["at"], **decomposition)]
    bad, tool, error = document["without_bad_rows"], predicted and predicted["rms_mm"], sizes(shown, "mean")
    has_faults = document["faults"] and not document.get("applied")
    noise = "The declared noise does not explain the residuals"
    values = {
        "because": "The fit has faults that it does not contain" if has_faults else noise,
        "error": error,
        "range": listed([f"{shown[f'low_{suffix}']:.4f} to {shown[f'high_{suffix}']:.4f}" for suffix in error]),
        **_judged(shown),
        "tool": None if tool is None else {"mm": tool},
        "tool_n": predicted and predicted["n"],
        **decomposition,
    }
    if bad is not None:
        return [Finding("tool-error-bad-rows", {**values, "moves": {"mm": bad["tool_moves_mm"]}})]
    by_sigmas = tool is not None and tool > (shown.get("mean_mm") or 0.0)
    return [Finding("tool-error-by-sigmas" if by_sigmas else "tool-error-shown", values)]


def _decomposition(document: Document) -> dict[str, Any]:
    """Return the parts of the tool's error; None for what is not known or not there."""
    claim, predicted = document.get("claim"), document["predicted_error"]
    if claim is None or predicted is None:
        return dict.fromkeys(("parameters", "unnamed", "scatter", "faults", "names"))
    shares = {
        "scatter": predicted.get("scatter_mm"),  # earlier results do not have it
        "faults": math.hypot(claim["rivals_mm"], claim["shift_mm"]),
    }
    return {
        **{name: {"mm": claim[f"{name}_mm"]} for name in ("parameters", "unnamed")},
        **{name: {"mm": share} if share else None for name, share in shares.items()},
        "names": [_cause(rival) for fault in document["faults"] for rival in fault["rivals"]],
    }


# what was identified, and the residuals


def _identified(document: Document) -> Iterator[Finding]:
    """Return what was identified, what is held by default, base and tool that are elsewhere, time offsets."""
    yield identified(document)
    indices = (document["observability"] or {}).items()
    named = [f"{name.upper()} {value:.3g}" for name, value in indices if value is not None]
    solver = {"solver": document["solver"], "prior": _prior(document), "loss": _loss(document)}
    yield Finding("solver", {**solver, "n": len(document["suggested_free"]), "indices": named})
    if SOLVERS[document["solver"]].ends_by_recipe:
        yield Finding("solver-recipe", {"message": document["message"]})
    defaults = document["defaults"]
    yield from held_frames(defaults)
    for joint in defaults["still"]:
        spread = _size(joint["spread"], joint["unit"])
        yield Finding("still", {"joint": joint["joint"], "spread": spread, "held": defaults["lost"]})
    for offset in (entry for entry in document["parameters"] if entry["unit"] == "s" and entry["free"]):
        value, sigma = offset["value"], offset["sigma"]
        if value is None or sigma is None:
            yield stated("time-offset-unidentifiable", offset)
        else:
            times = {"offset": {"ms": MS.of(abs(value))}, "sigma": {"ms": MS.of(sigma)}}
            yield stated("time-offset", offset, **times, late="late" if value >= 0.0 else "early")


def held_frames(defaults: Document) -> list[Finding]:
    """Return what of base and tool is held; empty if nothing is."""
    base, tool = defaults["base"], defaults["tool"]
    return [Finding("held-frames", {"base": base, "tool": tool})] if base or tool else []


def identified(document: Document) -> Finding:
    """Return how many parameters were identified from which rows."""
    rows: dict[str, int] = {}
    for entry in document["observations"]:
        rows[entry["kind"]] = rows.get(entry["kind"], 0) + entry["fitted"]
    return stated(
        "identified",
        document,
        robot=document["robot"]["name"],
        rows=", ".join(counted(n, f"{kind_name(kind)} row") for kind, n in rows.items() if n),
        held_out=sum(entry["held_out"] for entry in document["observations"]),
        unseen=len(document["null_space"]),
        weak=len(document["hardly_seen"]),
    )


def _prior(document: Document) -> str:
    """Return words for the prior of a fit, such as "without a prior"."""
    prior = Prior(document["prior"])
    if prior is Prior.NONE:
        return "without a prior"
    if prior is Prior.WHERE_NEEDED:
        return f"with a weak prior on {listed(document['defaults']['believed'])}, weakly identifiable here"
    return f"with a {prior} prior ({', '.join(tolerances(prior))}) on the robot's parameters"


def _loss(document: Document) -> str | None:
    return None if document["loss"] == Loss.LINEAR else str(document["loss"])


def _residuals(document: Document) -> Iterator[Finding]:
    """Return χ² and its range, which part of the residuals declared noise explains, what "before" means."""
    low, high = document["chi2_band"] or (None, None)
    chi2, units = document["chi2_reduced"], document["residual_units"]
    if None not in (low, high, chi2):
        position = "within" if low <= chi2 <= high else "above" if chi2 > high else "below"
        values = {"chi2": chi2_text(chi2), "where": position, "low": low, "high": high, "less": chi2 < low}
        yield Finding("chi2", {**values, "loss": _loss(document)})
    if not has_little_freedom(document):
        yield from _noise_share(document, by_chance=None not in (chi2, high) and chi2 <= high)
    if shared := document["pose_error"]:
        yield Finding("pose-error", {"terms": scatter_terms(shared), "n": shared["n"]})
    error_before, raw = (sizes(document, name, units) for name in ("rms_before", "rms_raw"))
    rig = [entry["name"] for entry in document["parameters"] if entry["of"] == "rig" and entry["free"]]
    fitted = list(dict.fromkeys(name.rpartition(".")[0] for name in rig if name.endswith(PLACES)))
    placed = error_before != raw
    yield Finding("before", {"fitted": ["base and tool"] * placed + fitted, "raw": raw, "placed": placed})


def _noise_share(document: Document, by_chance: bool) -> Iterator[Finding]:
    """Return how much of the residuals the declared noise explains.

    ``by_chance``: χ² is not above its band, so noise alone can leave the rest, or outliers that a robust loss weights
    down.
    """
    units, loss = document["residual_units"], _loss(document)
    declared, unexplained = (sizes(document, name, units) for name in ("rms_declared", "rms_unexplained"))
    if unexplained:
        weighted = f" or lie in rows that the {loss} loss weights down" if loss else ""
        remainder = f"may be chance{weighted}" if by_chance else "is unexplained"
        shown = unexplained if any(unexplained.values()) else None
        yield Finding("noise-share", {"declared": declared, "unexplained": shown, "rest": remainder})


# outliers, with joint laws or without
WHY_KEPT = {True: "they hardly change the fit", False: "the residuals of most rows exceed their declared noise"}


def outliers(document: Document) -> Iterator[Finding]:
    """Return the outliers, and the fit of all rows."""
    rows, fitted, all_rows = document["suspect"], document["n_observations"], document["with_outliers"]
    if not rows or document["without_bad_rows"] is not None:
        return
    if len(rows) > MOST * fitted and all(row["weight"] == 1.0 for row in rows):
        if not _is_explained(document):
            yield Finding("too-many-outliers", {"n": len(rows), "fitted": fitted})
        return
    laws = any(law["kept"] for law in (document["joint_laws"] or {}).get("tried", ()))
    left_out, fitted_rows = ([row for row in rows if (row["weight"] == 0.0) is is_out] for is_out in (True, False))
    values: dict[str, Any] = {"n": len(rows), "rows": named_rows(left_out or fitted_rows), "left_out": len(left_out)}
    if loss := _loss(document):
        ignored = sum(row["weight"] < IGNORED for row in rows)
        values |= {"ignored": ignored, "loss": loss, "share": f"{100 * IGNORED:.0f} %"}
    if left_out and fitted_rows:
        values["why"] = WHY_KEPT[laws]
        values |= {"kept": named_rows(fitted_rows), "first": [fitted_rows[0]["source"]]}
    if all_rows is not None:
        after = sizes(all_rows, "rms_after", document["residual_units"])
        values |= {"chi2": all_rows["chi2_reduced"], "geometry": laws, "after": after}
    yield Finding("outliers", values)


def audit(controller: Document, drawing: Document, identified: Document) -> Iterator[Finding]:
    """Return the errors, by unit, of the controller's model, drawing and identified robot on rows not fitted."""
    if drawing:
        yield Finding("audit", {"controller": controller, "drawing": drawing, "identified": identified})


# joint laws


def law_findings(document: Document) -> Iterator[Finding]:
    """Return what was learned about joint laws; empty if they were not requested."""
    laws = document["joint_laws"]
    if laws is None:
        return
    for reason in laws["reasons"]:  # a text in earlier results
        is_text = isinstance(reason, str)
        yield Finding("no-law", {"reason": reason}) if is_text else Finding(reason["code"], reason["values"])
    kept_laws = [law for law in laws["tried"] if law["kept"]]
    dropped = [law for law in laws["tried"] if not law["kept"]]
    if not kept_laws:
        yield Finding("no-law", {"tried": len(dropped), "none": not dropped})
        return
    for law in kept_laws:
        yield _law_kept(law)
    if dropped:
        names = [f"{law['joint']} {law['term']} {round(law['nats'], 1) + 0.0:.1f}" for law in dropped]
        yield Finding("no-law", {"dropped": ", ".join(map(one_line, names))})
    sags = [law for law in kept_laws if law["term"] == "sag"]
    if sags and not laws["gravity_known"]:
        yield Finding("gravity-assumed")
    shares = [(law["joint"], law.get("range_share")) for law in sags]  # earlier results do not have it
    small = [f"{joint} {share:.0%}" for joint, share in shares if share is not None and share < SMALL_SHARE]
    if small:
        yield Finding("sag-extrapolated", {"joints": small})
    payloads = laws.get("payloads", [])
    masses = [f"{mass:g}" for mass in sorted({payload["mass_kg"] for payload in payloads})]
    if sags and any(payload["mass_kg"] for payload in payloads):
        values = {"masses": masses, "several": len(payloads) > 1, "holder": "the calibration"}
        yield Finding("sag-payload", values)
    terms = [f"{laws['noise']['factor']:.2g} times the declared variances", *scatter_terms(laws["noise"])]
    yield Finding("law-noise", {"terms": terms})


def scatter_terms(sizes: Mapping[str, float]) -> list[str]:
    """Return the arm's scatter in words: the sizes in the field ``noise`` of joint laws, or in ``pose_error``."""
    terms = []
    for name, sigma in sizes.items():
        quantity, _, unit = name.rpartition("_")
        if sigma and (unit == "mm" or quantity == "turned"):
            terms.append(f"{sigma:.2g} {unit} {SCATTER.get(quantity, f'at the tool by {one_line(quantity)}')}")
    return terms


def _law_kept(law: Document) -> Finding:
    rms = {"mrad": float(f"{law['rms_mrad']:.2g}")}
    if law["term"] != "curve":
        return stated("law-kept", law, rms=rms)
    periods = [f"{period['cycles']:.0f} ({period['amplitude_mrad']:.2g} mrad)" for period in law["periods"]]
    values = {"covered": intervals_text(law["covered_deg"]), "periods": periods, "short": not periods}
    return stated("law-kept", law, rms=rms, **values, resolution=law["resolution_cycles"])


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
    smaller_gaps = f" and {counted(len(gaps) - len(named), 'smaller gap')}" * (len(gaps) > len(named))
    return f"{text} except {listed} deg{smaller_gaps}"


def _held_out(document: Document) -> Iterator[Finding]:
    """Return the limits of the held-out error."""
    held_out, proposed = document["held_out"], document.get("hold_out_proposal")
    if held_out:
        rms = [(held_out.get(f"rms_{unit}"), document[f"rms_after_{unit}"]) for unit in document["residual_units"]]
        ratio = max((held / fitted for held, fitted in rms if held and fitted), default=0.0)
        if ratio > HELD_OUT_DOUBTFUL:
            yield Finding("held-out-larger", {"ratio": ratio})
        names = [name for name in document.get("all_held_out", ()) if name not in document["held_out_by"]]
        if names:
            yield Finding("group-held-out", {"names": names, **_proposal(proposed)})
        yield from rig_unknowns(held_out["n_settled"], held_out["n_left_out"])
    if folds := document["folds"]:
        errors = [f"{fold['held_out_by']} {worded('{size}', {'size': sizes(fold, 'rms')})}" for fold in folds[:-1]]
        yield Finding("folds", {"errors": errors, "together": sizes(folds[-1], "rms")})
    elif held_out is None and document["held_out_by"]:
        yield Finding("no-row-judged")


def rig_unknowns(n_settled: int, n_left_out: int) -> list[Finding]:
    """Return how many unknowns of the rig the rows that judge determined, and how many rows these fit exactly."""
    settled = [Finding("rig-unknowns", {"n": n_settled, "how": SETTLED})] if n_settled else []
    return settled + ([Finding("rig-unknowns", {"left_out": n_left_out})] if n_left_out else [])


def _advice(document: Document) -> Iterator[Finding]:
    """Return what to do next."""
    because, full_rank = document["unusable_because"], document["rank"] == document["n_free"]
    additions = [] if wrong_first(document) else document["additions"]  # the most useful first
    best_of_kind = {addition["kind"]: addition for addition in reversed(additions)}
    for addition in reversed(best_of_kind.values()):
        what = addition["text"].removeprefix("measure ")
        values = {"what": what, "n": len(addition["parameters"]), "names": addition["parameters"]}
        yield Finding("measure-next", {**values, "full_rank": full_rank})
    if because not in (None, Unusable.NO_FREEDOM, Unusable.WORSE):  # which more rows mend
        yield Finding("correct-next")
    if because is None and not document["held_out_by"]:
        yield Finding("hold-out-next", _proposal(document.get("hold_out_proposal")))


def _proposal(proposed: Document | None) -> dict[str, Any]:
    """Return the values of a hold-out that keeps rows of every combination in the fit."""
    values = dict(proposed or dict.fromkeys(("fraction", "seed", "rows", "combinations")))
    return values | {"combinations": values["combinations"] if values["combinations"] != 1 else None}


def sizes(entry: Document, name: str, units: Sequence[str] = tuple(SUFFIXES)) -> dict[str, float]:
    """Return a figure in each unit that it has."""
    return {
        suffix: entry[f"{name}_{suffix}"] for suffix in units if suffix and entry.get(f"{name}_{suffix}") is not None
    }


def _size(value: float, unit: str, spec: str = ".2f") -> str:
    return UNITS[unit].scale.text(value, spec)
