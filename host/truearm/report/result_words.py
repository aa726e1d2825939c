"""Words for the results of an identification: kinds of observation, observability indices, remaining errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, assert_never

from truearm.estimate.solvers import Loss, Prior
from truearm.kinds.registry import kinds
from truearm.results import Estimate, MeanError, PoseError, ResidualParts
from truearm.text import counted, one_line, with_article
from truearm.units import DEG, MM, MS, UNITS, from_shown, number, symbol, tolerances

CHI2_DOUBTFUL = 2.0  # residuals 1.4 times what the declared sigmas allow
SMALLEST_WEIGHT = 0.005  # of a parameter in a combination; below this, "0.00" would be shown
FAR_OFF = 10.0  # times a wide prior: 100 mm or 0.5 rad, beyond any arm, wherever it is bolted
MAX_COPIES = 5  # copied rows that are named
UNIT_RATIOS = {
    1000.0: "a thousand (metres and millimetres)",
    25.4: "25.4 (inches and millimetres)",
    39.37: "39.37 (inches and metres)",
    10.0: "ten (centimetres and millimetres)",
    100.0: "a hundred (metres and centimetres)",
}
SAME_RATIO = 0.02  # relative
SHARED = "This is the error in what the rows measure. Errors that all rows share do not show in it."
PARTS = {"m": "position", "rad": "rotation"}  # for a kind that has residuals in both units

# In steps of ``tolerances("weak")``; estimate.identifiability defines the four.
OBSERVABILITY = {
    "o1": ("the average parameter: change of one residual in σ, caused by one step (geometric mean)", "σ"),
    "o2": ("ratio of the weakest to the strongest combination of parameters; 1: all are determined equally well", "1"),
    "o3": ("the weakest combination: change of all residuals together in σ, caused by one step", "σ"),
    "o4": ("O2 times O3: small if either is", "σ"),
}


def time_offset(name: str, value_s: float | None, sigma_s: float | None) -> str:
    """Return what was found about the time between joints and readings; without a σ it is unidentifiable."""
    if value_s is None or sigma_s is None:
        return (
            f"{name}: the delay of the joint readings is unidentifiable; along a line driven one way it cannot be distinguished "
            "from the position of the line. Drive lines there and back."
        )
    late = "late" if value_s >= 0.0 else "early"
    return (
        f"{name}: the joint readings are {MS.text(abs(value_s), '.3f')} {late} (σ {MS.text(sigma_s, '.2g')}), including the "
        "shortest latencies of the links."
    )


SIMULATED = (
    "SIMULATED: at least one session was recorded with a simulated box, so this says nothing about a real robot."
)


def copy_sentences(document: Mapping[str, Any]) -> list[str]:
    """Return which rows were left out because they are copies; empty if there are none."""
    copies = document["copies"]
    if not copies:
        return []
    named = ", ".join(f"{one_line(row['source'])} of {one_line(row['of'])}" for row in copies[:MAX_COPIES])
    more = f" and {len(copies) - MAX_COPIES} more (copies in the JSON result)" if len(copies) > MAX_COPIES else ""
    are, them = ("is a copy", "It is") if len(copies) == 1 else ("are copies", "They are")
    return [
        f"{counted(len(copies), 'row')} {are} of earlier rows, with the same joints, readings and names to the last digit: "
        f"{named}{more}. {them} left out, because a copy is not a new measurement."
    ]


def scale_sentence(scale: Mapping[str, Any]) -> str:
    """Return what a common scale of the robot's lengths means."""
    ratio = max(scale["factor"], 1.0 / scale["factor"]) if scale["factor"] > 0.0 else 1.0
    units = [words for of, words in UNIT_RATIOS.items() if abs(ratio / of - 1.0) < SAME_RATIO]
    named = f" A ratio of {units[0]} suggests a wrong unit." if units else ""
    return (
        f"The robot is {scale['factor']:.4f} times as large as described (σ {scale['sigma']:.2g}, {scale['n']} lengths; by chance "
        f"with a probability of {scale['chance']:.0e}). The lengths in the rig and the readings determine "
        f"the scale. If they are wrong by this ratio, so is every position, and no residual shows it.{named} Check them (bars, "
        "distances of sockets, positions of chucks, units) and the robot's model."
    )


def unexplained_words(
    errors: Mapping[str, MeanError],
    systematic: float | None,
    tool: tuple[float, int] | None,
    without_bad: float | None = None,
) -> list[str]:
    """Return the error to expect if the declared noise does not explain the residuals, from poses that were not fitted.

    ``errors`` are their mean errors by SI unit. ``systematic`` is how far the tool moves if the systematic errors that
    were found are estimated [m], NaN if that is not known; None without such errors. ``tool`` is the error of the tool
    that the covariance predicts [m], over a number of poses. The largest of the three is the one to expect: a displaced
    fixture turns the base with it, and rows held out at the same fixture do not show that. If bad rows are in the fit,
    the error to expect is how far the tool moves without them, ``without_bad`` [m].
    """
    parts = []
    for si, error in errors.items():
        low, high = (number(value, si) for value in (error.low, error.high))
        parts.append(f"{number(error.mean, si)} {symbol(si)} (95 %: {low} to {high})")
    n, held_out = max(error.n for error in errors.values()), any(error.held_out for error in errors.values())
    each = "predicted" if n == 1 else "each predicted"
    of = f"{counted(n, 'pose')} " + ("held out" if held_out else f"({each} from the other poses)")
    if without_bad is not None:
        return [
            f"Bad rows are in the fit. Expect tool errors of {number(without_bad, 'm')} {symbol('m')} RMS: the tool moves by that much if they are left out.",
            f"The error that the rows show includes that of the bad rows themselves: {' and '.join(parts)}, the mean of {of}.",
        ]
    because = (
        "The declared noise does not explain the residuals" if systematic is None else "The fit has systematic errors"
    )
    measured = errors["m"].mean if "m" in errors else 0.0
    if systematic is not None and systematic > max(measured, tool[0] if tool else 0.0):
        lines = [
            f"{because}. Expect tool errors of at least {number(systematic, 'm')} {symbol('m')} RMS: the tool moves by that much if these errors are estimated, and their estimates are uncertain too.",
            f"The error that the rows show: {' and '.join(parts)}, the mean of {of}.",
        ]
        return lines if tool is None else [*lines, _by_sigmas(tool)]
    if tool is None:
        return [f"{because}. Expect errors of {' and '.join(parts)}, the mean of {of}. {SHARED}"]
    if "m" in errors and tool[0] > measured:
        return [
            f"{because}. Expect tool errors of {_over_poses(tool)}, as the sigmas predict: the rows show only part of the tool's error.",
            f"The error that the rows show: {' and '.join(parts)}, the mean of {of}.",
        ]
    return [
        f"{because}. Expect errors of {' and '.join(parts)}, the mean of {of}. {SHARED}",
        _by_sigmas(tool),
    ]


def _by_sigmas(tool: tuple[float, int]) -> str:
    return (
        f"The sigmas predict a tool error of {_over_poses(tool)}. They hold only if the declared noise explains the residuals, "
        "and they grow if the fit estimates more errors."
    )


def _over_poses(tool: tuple[float, int]) -> str:
    return f"{number(tool[0], 'm')} {symbol('m')} RMS over {counted(tool[1], 'pose')}"


def before_words(e: Estimate, lead: str = " ") -> str:
    """Return what was fitted to the nominal robot for its errors: base and tool, or "" if they were left as described."""
    return "" if e.rms_before == e.rms_raw else f"{lead}with base and tool fitted"


def parts_words(parts: Mapping[str, ResidualParts], by_chance: bool, loss: str = Loss.LINEAR) -> str:
    """Return how much of the residuals the declared noise explains, by SI unit; "" without residuals.

    ``by_chance``: χ² is not above its band, so noise alone can leave the rest, or outliers that a robust ``loss`` weights
    down.
    """
    more = {si: of for si, of in parts.items() if of.unexplained > 0.0}
    less = " and ".join(f"{number(of.declared, si)} {symbol(si)}" for si, of in parts.items() if si not in more)
    units = " and ".join(symbol(si) for si in parts if si not in more)
    nothing = f"nothing in {units}" if more else "nothing"
    said = [f"Declared noise alone would leave {less} RMS: {nothing} is unexplained."] if less else []
    if more:
        declared, left = (
            " and ".join(f"{number(getattr(of, name), si)} {symbol(si)}" for si, of in more.items())
            for name in ("declared", "unexplained")
        )
        weighted = "" if loss == Loss.LINEAR else f" or lie in rows that the {loss} loss weights down"
        rest = f"may be chance{weighted}" if by_chance else "is unexplained"
        said.append(
            f"Declared noise explains {declared} of the RMS after; the rest, {left}, {rest} (their squares add up to that of the RMS)."
        )
    return " ".join(said)


def pose_error_words(error: PoseError) -> str:
    """Return a sentence about the error shared by the rows of one pose, which the sigmas include."""
    return (
        f"Rows of one pose share an error of {number(error.sigma, 'm')} {symbol('m')} (σ of each coordinate, from {counted(error.n, 'pose')} with several rows). "
        "The sigmas include it."
    )


def all_identifiable(prior: str, believed: Sequence[str]) -> str:
    """Return that the observations alone determine all free parameters, and what the ``prior`` is then for."""
    match Prior(prior):
        case Prior.NONE:
            return "All free parameters are identifiable."
        case Prior.WEAK | Prior.WIDE:
            return "The observations alone, without the prior, identify all free parameters."
        case Prior.WHERE_NEEDED:
            are = "1 of them is" if len(believed) == 1 else f"{len(believed)} of them are"
            return (
                f"With the declared noise, the observations alone identify all free parameters. With residuals as large as "
                f"these, {are} weakly identifiable and held by the weak prior."
            )
        case never:
            assert_never(never)


def drawing(timed: bool) -> str:
    """Return the tolerances of a manufacturer's drawing: the steps that define hardly identifiable parameters.

    ``timed``: also that of a delay of the joint readings, which no drawing has.
    """
    delay = f"; a delay of the joint readings: {MS.text(UNITS['s'].weak_sigma)}" * timed
    return ", ".join(tolerances("weak")) + delay


def gain_words(n: int, full_rank: bool) -> str:
    """Return what a further measurement gains for ``n`` parameters: with ``full_rank``, they are weakly identifiable already."""
    found = counted(n, "more parameter")
    return f"to determine {found} better than a drawing" if full_rank else f"to identify {found}"


def kind_name(kind: str) -> str:
    """Return the name of a kind; a kind of a later version is its own name."""
    return kinds()[kind].name if kind in kinds() else kind


def residual_words(kind: str) -> str:
    """Return a sentence that defines the residual of a kind for each unit."""
    of = kinds()[kind]
    parts = [f"{PARTS.get(si, si)}: {text}" if len(of.residual) > 1 else text for si, text in of.residual.items()]
    return f"Residual of {with_article(of.name)} observation: {'; '.join(parts)}."


def zero_sentences(document: Mapping[str, Any]) -> list[str]:
    """Return which joints count from another zero than described, and what it means; empty if none does.

    The zeros of the first and the last joint place base and tool, so they do not count, and neither do whole turns.
    """
    if document["unusable_because"]:
        return []
    offsets = [p for p in document["parameters"] if p["of"] == "robot" and p["name"].endswith(".offset")]
    far = []
    for one in offsets[1:-1]:
        change = one["value"] - one["nominal"]
        if one["unit"] == "rad":
            change = math.remainder(change, 2.0 * math.pi)
        if one["sigma"] is not None and abs(change) > FAR_OFF * UNITS[one["unit"]].wide_sigma:
            far.append(f"{one['name']} by {(DEG if one['unit'] == 'rad' else MM).text(change, '+.1f')}")
    if not far:
        return []
    return [
        f"Zeros of joints differ from the description: {', '.join(far)}. No assembly does that. Either the readings count from "
        "another zero than the robot's description: correct its offsets. Or an input is wrong: check the signs and axes. "
        "truearm correct needs a description that the controller shares."
    ]


def displacement_sentences(document: Mapping[str, Any]) -> list[str]:
    """Return that base or tool stands elsewhere than described, and what it means if it does not; empty if neither does."""
    found = document["displaced"]
    if not found:
        return []
    each = []
    for one in found:
        sizes = []
        for name, unit, scale, digits in (("distance_mm", "m", MM, ".3g"), ("turn_deg", "rad", DEG, ".2g")):
            size = from_shown(one[name], unit)
            if size > UNITS[unit].weak_sigma:
                sizes.append(scale.text(size, digits))
        each.append(f"the {one['frame']} {' and '.join(sizes)} from where it is described")
    text = " and ".join(each)
    place, they_are, they_were = (
        ("its place", "it is", "it was") if len(each) == 1 else ("their places", "they are", "they were")
    )
    return [
        f"The fit places {text}. This is normal if nobody measured {place}: the rig then defines where {they_are}. If {they_were} "
        "measured, positions in the rig are wrong by as much, and so are the tool positions that the calibration gives. No residual shows this: check the positions "
        "in the rig."
    ]
